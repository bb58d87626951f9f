//! NumPy's `.npz`: the columns of a scene as arrays, for other programs.
//! <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>

use crate::zip::Writer;
use irradia_scene::GaussianCloud;
use std::io::{self, Write};

/// Writes `means`, `quats` (w, x, y, z), `log_scales`, `opacity_logits` and `sh` (splat, coefficient, channel), 32-bit floats.
pub(crate) fn write(out: &mut dyn Write, cloud: &GaussianCloud) -> io::Result<()> {
    let n = cloud.len();
    let mut archive = Writer::new(out);
    // One array at a time: together they are as large as the scene.
    archive.add_file("means.npy", &npy(&[n, 3], cloud.means.as_flattened()))?;
    archive.add_file("quats.npy", &npy(&[n, 4], cloud.quats.as_flattened()))?;
    archive.add_file("log_scales.npy", &npy(&[n, 3], cloud.log_scales.as_flattened()))?;
    archive.add_file("opacity_logits.npy", &npy(&[n], &cloud.opacity_logits))?;
    archive.add_file("sh.npy", &npy(&[n, cloud.sh_coefficients(), 3], &cloud.sh))?;
    archive.finish()
}

/// An array file of version 1.
fn npy(shape: &[usize], values: &[f32]) -> Vec<u8> {
    let sizes: String = shape.iter().map(|size| format!("{size}, ")).collect();
    let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({sizes}), }}");
    // Magic, version, length and header are a multiple of 64 bytes.
    let padded = (header.len() + 11).next_multiple_of(64) - 10;
    header.extend(std::iter::repeat_n(' ', padded - header.len() - 1));
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.reserve(header.len() + 4 * values.len() + 2);
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    values.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_are_aligned_and_say_the_shape() {
        for shape in [&[7][..], &[1000, 16, 3]] {
            let values = vec![1.5; shape.iter().product()];
            let bytes = npy(shape, &values);
            assert_eq!((bytes.len() - 4 * values.len()) % 64, 0);
            let header = String::from_utf8_lossy(&bytes[10..bytes.len() - 4 * values.len()]).into_owned();
            assert!(header.contains("'<f4'") && header.ends_with('\n'), "{header}");
            assert!(bytes.ends_with(&1.5f32.to_le_bytes()));
        }
    }
}
