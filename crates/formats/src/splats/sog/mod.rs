//! SOG, PlayCanvas's image-based format: versions 1 and 2, as a folder with `meta.json` or as one zip archive (`.sog`).
//! <https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/>
//!
//! Each attribute is a lossless WebP image with a pixel per splat, row by row: positions in two images of low and high bytes, 16
//! bits between bounds of `sign(x) ln(1 + |x|)`; rotations as three bytes and 252 plus the index of the largest component of
//! `w, x, y, z`; ln scales and DC as indices of a codebook of 256 (version 1: bytes between bounds), and with DC the opacity (version
//! 1: its logit between bounds). Coefficients above DC are a palette: an image of up to 65,536 entries, 64 a row, and one of labels.
//! The axes are ours.

mod palette;
mod read;
mod write;

pub use read::parse_zip as parse;
pub(crate) use read::{MAX_META_BYTES, image_names, is_meta, read_folder};
pub(crate) use write::{encode, write};

/// The file that describes the others.
pub(crate) const META_FILE: &str = "meta.json";
/// Palette entries in a row of the image of centroids.
const ENTRIES_PER_ROW: usize = 64;
/// Fourth byte of a quaternion whose largest component is w; the values for x, y and z follow.
const LARGEST_W: u8 = 252;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splats::{WriteOptions, rows::decode_splats};
    use crate::zip::Writer;

    /// The files of a scene of `count` splats.
    fn scene(count: usize) -> Vec<(&'static str, Vec<u8>)> {
        let cloud = decode_splats(count, 0, |i, splat| {
            splat.mean[0] = i as f32;
            splat.quat[0] = 1.0;
        });
        encode(&cloud, &WriteOptions::default()).unwrap()
    }

    #[test]
    fn of_several_scenes_in_an_archive_it_is_always_the_same() {
        let mut archive = Vec::new();
        let mut writer = Writer::new(&mut archive);
        for (folder, count) in [("0_3/", 3), ("0_1/", 1), ("0_2/", 2), ("near/0_0/", 4)] {
            for (name, content) in scene(count) {
                writer.add_file(&format!("{folder}{name}"), &content).unwrap();
            }
        }
        writer.finish().unwrap();
        for _ in 0..40 {
            assert_eq!(parse(&archive).unwrap().len(), 1);
        }
    }
}
