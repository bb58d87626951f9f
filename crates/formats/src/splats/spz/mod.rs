//! SPZ, versions 1 to 4. <https://github.com/nianticlabs/spz> (the README's file format).
//!
//! One array per attribute: positions (24-bit fixed point; half floats in version 1), opacities, colours, ln scales, rotations
//! (three bytes x, y, z up to version 2, then the smallest three in ten bits each), coefficients above DC. Versions 1 to 3 are one
//! gzip stream of a header of 16 bytes and the arrays; version 4 is a header of 32 bytes, a table of sizes, and one zstd frame per
//! array. The axes are right, up, back.

mod read;
mod write;

pub use read::parse;
pub(crate) use write::{encode, max_coordinate, write};

const MAGIC: &[u8; 4] = b"NGSP";
/// Bit of the flags for scenes trained with the Mip-Splatting filters.
const ANTIALIASED_FLAG: u8 = 1;
/// Bit of the flags for extensions, which lie between header and table (version 4) or at the end.
const EXTENSIONS_FLAG: u8 = 2;
/// The largest coordinate of a position: 24 bits with a sign, none of them for a fraction.
const MAX_COORDINATE: f32 = 8_388_607.0;
/// A step of colour is `1 / (255 COLOR_SCALE)` of a DC coefficient.
const COLOR_SCALE: f32 = 0.15;
/// ln scales are stored as `(ln scale + 10) 16`.
const SCALE_OFFSET: f32 = 10.0;
const SCALE_STEPS: f32 = 16.0;
/// Largest magnitude of a ten-bit component, which stands for `1/sqrt(2)`.
const COMPONENT_STEPS: f32 = 511.0;

/// The fields that both headers have, and what they mean for the arrays.
#[derive(Clone, Copy, Debug)]
struct Header {
    version: u32,
    count: u32,
    degree: u8,
    fraction_bits: u8,
    flags: u8,
}

impl Header {
    /// Bytes per splat of each array: positions, opacities, colours, scales, rotations, coefficients above DC.
    fn widths(&self) -> [usize; 6] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version >= 3 { 4 } else { 3 };
        let rest = irradia_scene::sh::coefficients(self.degree.into()) - 1;
        [position, 1, 3, 3, rotation, 3 * rest]
    }
}
