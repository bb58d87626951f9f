//! glTF 2.0 with `KHR_gaussian_splatting`: `.glb` and `.gltf`, and splats packed as SPZ within them.
//! <https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting> (release candidate of 2026) and
//! `KHR_gaussian_splatting_compression_spz_2` (draft).
//!
//! Splats are points with attributes: scales are standard deviations, opacities from 0 to 1, rotations `x, y, z, w`, harmonics one
//! attribute per coefficient. y is up and z forward, so a scene is half a turn about z away from ours.

mod accessor;
mod document;
mod read;
mod write;

pub use read::parse_glb as parse;
pub(crate) use read::{parse_glb, parse_gltf};
pub(crate) use write::{write_glb, write_glb_spz, write_gltf};

const EXTENSION: &str = "KHR_gaussian_splatting";
/// The draft extensions that store a primitive's splats as an SPZ file; the first is written.
const SPZ_EXTENSIONS: [&str; 3] = [
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
];
/// First words of a `.glb` file and of its two chunks.
const GLB_MAGIC: u32 = u32::from_le_bytes(*b"glTF");
const JSON_CHUNK: u32 = u32::from_le_bytes(*b"JSON");
const BIN_CHUNK: u32 = u32::from_le_bytes(*b"BIN\0");

/// The attribute of a coefficient, DC included.
fn sh_attribute(coefficient: usize) -> String {
    let degree = coefficient.isqrt();
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{}", coefficient - degree * degree)
}
