//! `.splat`, the format of antimatter15's viewer: 32 bytes a splat and nothing else.
//! <https://github.com/antimatter15/splat> (`convert.py`, and the shader that reads it).
//!
//! Position (3 x f32), standard deviations (3 x f32), colour and opacity (4 x u8), rotation `w, x, y, z` as `128 + 128 q`. No
//! harmonics above DC. The axes are ours.

use crate::Malformed;
use crate::splats::quantize::{color_byte, dc_of_byte, logits_of_bytes, normalized, opacity_byte, round_to_byte};
use crate::splats::rows::{decode_splats, encode_rows};
use irradia_scene::GaussianCloud;
use std::io::{self, Write};

/// Bytes of a splat.
const ROW_BYTES: usize = 32;

/// Parses a `.splat` file.
///
/// # Errors
/// When its length is not a multiple of 32 bytes; there is no other structure to check.
pub fn parse(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    if !bytes.len().is_multiple_of(ROW_BYTES) {
        return Err(Malformed(format!(
            "its length of {} bytes is not a multiple of {ROW_BYTES}; it is truncated or not a .splat file",
            bytes.len()
        )));
    }
    let logits = logits_of_bytes();
    Ok(decode_splats(bytes.len() / ROW_BYTES, 0, |i, splat| {
        let row = &bytes[i * ROW_BYTES..(i + 1) * ROW_BYTES];
        let float = |at: usize| f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
        for c in 0..3 {
            splat.mean[c] = float(4 * c);
            splat.log_scale[c] = float(12 + 4 * c).ln();
            splat.sh[c] = dc_of_byte(row[24 + c]);
        }
        *splat.opacity_logit = logits[usize::from(row[27])];
        *splat.quat = std::array::from_fn(|c| (f32::from(row[28 + c]) - 128.0) / 128.0);
    }))
}

/// Writes `cloud` without its harmonics above DC.
pub(crate) fn write(out: &mut dyn Write, cloud: &GaussianCloud) -> io::Result<()> {
    let width = 3 * cloud.sh_coefficients();
    out.write_all(&encode_rows(cloud.len(), ROW_BYTES, |i, row| {
        let floats = cloud.means[i].into_iter().chain(cloud.log_scales[i].map(f32::exp));
        for (to, value) in row.chunks_exact_mut(4).zip(floats) {
            to.copy_from_slice(&value.to_le_bytes());
        }
        for c in 0..3 {
            row[24 + c] = color_byte(cloud.sh[i * width + c]);
        }
        row[27] = opacity_byte(cloud.opacity_logits[i]);
        for (to, value) in row[28..].iter_mut().zip(normalized(cloud.quats[i])) {
            *to = round_to_byte(value * 128.0 + 128.0);
        }
    }))
}
