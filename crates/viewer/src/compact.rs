//! The format of splats for browsers that draw them: most important first, so that there is a picture early.
//!
//! Little endian. A header of 32 bytes: `IRS1`, number of splats, SH degree, splats per block, numbers of splats of up to three levels
//! of detail, a word of zero; then the blocks of the scene, and those of each level.
//! A block holds for each of its splats, 32 bytes: mean (3 x f32, world), ln of the standard deviations (3 x f16), opacity (f16),
//! rotation (48 bits), colour of degree 0 (3 x f16, sRGB); then for each of them the higher bands, see [`band_bytes`]: a factor
//! (f16), and the coefficients in units of the factor / 127 (i8; coefficient by coefficient, red, green, blue).
//!
//! A rotation is the unit quaternion w, x, y, z without its largest component, which is made positive: its index in the top two
//! of 48 bits (one is unused), then the others in order, 15 bits each, from -1/sqrt(2) to 1/sqrt(2).

use crate::importance::by_importance;
use irradia_scene::half::{from_half, half};
use irradia_scene::sh;
use irradia_splat::Splats;
use rayon::prelude::*;
use std::borrow::Cow;

/// Splats per block: of 500,000 the first block is 1.6 %.
pub(crate) const BLOCK_SPLATS: usize = 8192;
/// Levels of detail for which the header has room.
const MAX_LEVELS: usize = 3;
/// Bytes of the header.
const HEADER_BYTES: usize = 32;
/// Bytes of a splat without its higher bands.
const CORE_BYTES: usize = 32;

/// Bytes of the bands above 0 of a splat, a multiple of 16.
pub(crate) const fn band_bytes(degree: u32) -> usize {
    16 * degree as usize
}

/// `splats` in compact form, with bands up to `degree`: at most `max_splats` of them, the most important. Splats that can never be seen are left out.
pub(crate) fn compact(splats: &Splats, degree: u32, max_splats: usize) -> Vec<u8> {
    let mut order = by_importance(splats);
    order.truncate(max_splats);
    compact_in_order(splats, degree, &order, &[])
}

/// The splats `order` in compact form, with bands up to `degree`, and after them `levels` of the same degree, most important first.
pub(crate) fn compact_in_order(splats: &Splats, degree: u32, order: &[u32], levels: &[Splats]) -> Vec<u8> {
    let degree = degree.min(splats.sh_degree());
    let mut parts = vec![(splats, Cow::Borrowed(order))];
    let levels = levels
        .iter()
        .filter(|level| level.sh_degree() >= degree)
        .take(MAX_LEVELS);
    parts.extend(levels.map(|level| (level, Cow::Owned(by_importance(level)))));
    let mut bytes = vec![0; HEADER_BYTES];
    bytes[..4].copy_from_slice(b"IRS1");
    let counts: Vec<u32> = parts.iter().map(|(_, order)| order.len() as u32).collect();
    let words = [&[counts[0], degree, BLOCK_SPLATS as u32], &counts[1..]].concat();
    for (at, value) in words.into_iter().enumerate() {
        bytes[4 + 4 * at..][..4].copy_from_slice(&value.to_le_bytes());
    }
    for (splats, order) in parts {
        write_blocks(splats, degree, &order, &mut bytes);
    }
    bytes
}

fn write_blocks(splats: &Splats, degree: u32, order: &[u32], bytes: &mut Vec<u8>) {
    let band = band_bytes(degree);
    let start = bytes.len();
    bytes.resize(start + order.len() * (CORE_BYTES + band), 0);
    bytes[start..]
        .par_chunks_mut(BLOCK_SPLATS * (CORE_BYTES + band))
        .zip(order.par_chunks(BLOCK_SPLATS))
        .for_each(|(to, order)| {
            let (cores, bands) = to.split_at_mut(order.len() * CORE_BYTES);
            for (to, i) in cores.chunks_exact_mut(CORE_BYTES).zip(order) {
                write_core(splats, *i as usize, to);
            }
            if band > 0 {
                for (to, i) in bands.chunks_exact_mut(band).zip(order) {
                    write_bands(splats, *i as usize, degree, to);
                }
            }
        });
}

fn write_core(splats: &Splats, i: usize, to: &mut [u8]) {
    let halves = |to: &mut [u8], values: &[f32]| {
        for (to, value) in to.chunks_exact_mut(2).zip(values) {
            to.copy_from_slice(&half(*value).to_le_bytes());
        }
    };
    for (to, value) in to.chunks_exact_mut(4).zip(splats.mean(i)) {
        to.copy_from_slice(&value.to_le_bytes());
    }
    let scale = |c| splats.log_scales.get(c, i);
    halves(&mut to[12..20], &[scale(0), scale(1), scale(2), splats.opacity(i)]);
    let rotation = packed_rotation(std::array::from_fn(|c| splats.quats.get(c, i)));
    to[20..26].copy_from_slice(&rotation.to_le_bytes()[..6]);
    let color = |c| sh::color_from_dc(splats.sh.get(c, i));
    halves(&mut to[26..32], &[color(0), color(1), color(2)]);
}

fn write_bands(splats: &Splats, i: usize, degree: u32, to: &mut [u8]) {
    let value = |n: usize| splats.sh.get(3 + n, i);
    let count = 3 * (sh::coefficients(degree) - 1);
    let largest = (0..count).map(|n| value(n).abs()).fold(0.0, f32::max);
    // The factor as the browser reads it, rounded up, so that no coefficient exceeds it.
    let factor = half(largest * 1.001);
    to[..2].copy_from_slice(&factor.to_le_bytes());
    let unit = 127.0 / from_half(factor).max(1e-20);
    for (n, to) in to[2..2 + count].iter_mut().enumerate() {
        *to = ((value(n) * unit).round() as i8) as u8;
    }
}

/// A quaternion in 47 bits, see above.
fn packed_rotation(q: [f32; 4]) -> u64 {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    let largest = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).unwrap_or(0);
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 } / length.max(1e-20);
    let others = (0..4).filter(|c| *c != largest);
    others.fold((largest as u64) << 45, |bits, c| {
        // The position of the component in the bits follows from the number of components after it.
        let value = (q[c] * sign * std::f32::consts::SQRT_2).clamp(-1.0, 1.0);
        let place = 15 * ((0..4).filter(|d| *d != largest && *d > c).count());
        bits | ((((value * 0.5 + 0.5) * 32767.0).round() as u64) << place)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_splat::logit;

    /// The inverse of [`packed_rotation`].
    fn unpacked(bits: u64) -> [f32; 4] {
        let largest = (bits >> 45 & 3) as usize;
        let mut q = [0.0; 4];
        let mut place = 45;
        for c in (0..4).filter(|c| *c != largest) {
            place -= 15;
            q[c] = ((bits >> place & 32767) as f32 / 32767.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2;
        }
        q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
        q
    }

    #[test]
    fn rotations_survive() {
        for q in [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, -3.0],
            [0.5, -0.5, 0.5, -0.5],
            [0.1, 0.9, -0.3, 0.2],
        ] {
            let length = q.iter().map(|v: &f32| v * v).sum::<f32>().sqrt();
            let back = unpacked(packed_rotation(q));
            // Either sign is the same rotation.
            let dot: f32 = q.iter().zip(back).map(|(a, b)| a * b / length).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-6, "{q:?} {back:?}");
        }
    }

    #[test]
    fn the_most_important_come_first_and_the_invisible_not_at_all() {
        let mut splats = Splats::zeros(4, 1);
        for i in 0..4 {
            splats.means.set(0, i, i as f32);
            splats.quats.set(0, i, 1.0);
            splats.opacity_logits.set(0, i, logit(0.5));
            for n in 0..9 {
                splats.sh.set(3 + n, i, (n as f32 - 4.0) * 0.1);
            }
        }
        splats.log_scales.set(1, 2, 2.0);
        splats.log_scales.set(2, 2, 2.0);
        splats.opacity_logits.set(0, 0, -9.0);
        splats.means.set(1, 1, f32::NAN);
        assert_eq!(compact(&splats, 3, 1)[4..8], 1u32.to_le_bytes());
        let bytes = compact(&splats, 3, usize::MAX);
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four"));
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"IRS1"[..], 2, 1));
        assert_eq!(bytes.len(), HEADER_BYTES + 2 * (CORE_BYTES + 16));
        let x = |splat: usize| f32::from_bits(word(HEADER_BYTES + splat * CORE_BYTES));
        assert_eq!((x(0), x(1)), (2.0, 3.0));
        let band = &bytes[HEADER_BYTES + 2 * CORE_BYTES..];
        let factor = from_half(u16::from_le_bytes([band[0], band[1]]));
        for n in 0..9 {
            let value = f32::from(band[2 + n] as i8) / 127.0 * factor;
            assert!((value - (n as f32 - 4.0) * 0.1).abs() < 0.002, "{n}: {value}");
        }
        let with_level = compact_in_order(&splats, 3, &[2, 3], &[splats.gather(&[3])]);
        let at = bytes.len();
        assert_eq!(with_level.len(), at + CORE_BYTES + 16);
        assert_eq!(
            (&with_level[16..20], &with_level[20..28]),
            (&1u32.to_le_bytes()[..], &[0; 8][..])
        );
        assert_eq!(with_level[HEADER_BYTES..at], bytes[HEADER_BYTES..]);
        assert_eq!(with_level[at..at + 4], 3f32.to_le_bytes());
    }
}
