use super::*;
use crate::gzip;
use crate::splats::axes::Signs;
use crate::splats::quantize::{normalized, opacity_byte, round_to_byte, smallest_three};
use crate::splats::rows::{encode_rows, morton_order};
use crate::splats::{Quality, SpzVersion};
use irradia_scene::{GaussianCloud, sh};
use rayon::prelude::*;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use std::io::{self, Write};

/// Fractional bits of positions: those of the format's own writer, and the maximum.
const DEFAULT_FRACTION_BITS: i32 = 12;
const MAX_FRACTION_BITS: i32 = 20;

/// Writes `cloud`; the quality selects the bits of positions and of coefficients above DC.
pub(crate) fn write(
    out: &mut dyn Write,
    cloud: &GaussianCloud,
    quality: Quality,
    version: SpzVersion,
) -> io::Result<()> {
    out.write_all(&encode(cloud, quality, version))
}

/// The bytes of a file.
pub(crate) fn encode(cloud: &GaussianCloud, quality: Quality, version: SpzVersion) -> Vec<u8> {
    let header = Header {
        version: match version {
            SpzVersion::V2 => 2,
            SpzVersion::V3 => 3,
            SpzVersion::V4 => 4,
        },
        count: u32::try_from(cloud.len()).expect("fewer than 2^32 splats"),
        // Readers of version 2 support no higher degree.
        degree: cloud.sh_degree.min(if version == SpzVersion::V2 { 3 } else { 4 }) as u8,
        fraction_bits: fraction_bits(&cloud.means, quality),
        flags: if cloud.antialiased { ANTIALIASED_FLAG } else { 0 },
    };
    let arrays = arrays(cloud, &header, quality);
    let mut bytes = MAGIC.to_vec();
    bytes.extend(header.version.to_le_bytes());
    bytes.extend(header.count.to_le_bytes());
    bytes.extend([header.degree, header.fraction_bits, header.flags]);
    if version == SpzVersion::V4 {
        let arrays: Vec<Vec<u8>> = arrays.into_iter().filter(|array| !array.is_empty()).collect();
        let packed: Vec<Vec<u8>> = arrays
            .par_iter()
            .map(|array| compress_to_vec(&array[..], CompressionLevel::Fastest))
            .collect();
        bytes.push(arrays.len() as u8);
        bytes.extend(32u32.to_le_bytes());
        bytes.extend([0; 12]);
        for (array, packed) in arrays.iter().zip(&packed) {
            bytes.extend((packed.len() as u64).to_le_bytes());
            bytes.extend((array.len() as u64).to_le_bytes());
        }
        packed.iter().for_each(|packed| bytes.extend_from_slice(packed));
        return bytes;
    }
    bytes.push(0);
    // Each array is freed as soon as it is copied.
    arrays.into_iter().for_each(|array| bytes.extend(array));
    gzip(&bytes)
}

/// The largest coordinate of a position in a file of `means`.
pub(crate) fn max_coordinate(means: &[[f32; 3]], quality: Quality) -> f32 {
    MAX_COORDINATE * (-f32::from(fraction_bits(means, quality))).exp2()
}

/// Fractional bits of positions: the format's own 12; more at normal quality as long as the farthest coordinate has at most 16 bits in
/// total, and up to 20 at high quality. Finer steps are noise, which does not compress. Not more than 23 bits in total, so that the
/// farthest coordinate fits, unless it is so far that the others would have fewer than 12 bits: a lost splat ruins no scene.
fn fraction_bits(means: &[[f32; 3]], quality: Quality) -> u8 {
    let bits_of = |coordinate: f32| coordinate.max(f32::MIN_POSITIVE).log2().floor() as i32 + 1;
    let mut extents: Vec<f32> = means
        .iter()
        .map(|mean| mean.iter().fold(0f32, |max, v| max.max(v.abs())))
        .collect();
    extents.push(0.0);
    let rank = (extents.len() - 1) * 99 / 100;
    let (_, most, farther) = extents.select_nth_unstable_by(rank, f32::total_cmp);
    let most = *most;
    let farthest = farther.iter().copied().fold(most, f32::max);
    let integer_bits = match most {
        0.0 => bits_of(farthest),
        _ => bits_of(farthest).min(bits_of(most) + 11),
    };
    let wanted = match quality {
        Quality::Low => DEFAULT_FRACTION_BITS,
        Quality::Normal => (16 - integer_bits).max(DEFAULT_FRACTION_BITS),
        Quality::High => MAX_FRACTION_BITS,
    };
    wanted.min(23 - integer_bits).clamp(0, MAX_FRACTION_BITS) as u8
}

/// The six arrays, along a Morton curve, which compresses better.
fn arrays(cloud: &GaussianCloud, header: &Header, quality: Quality) -> [Vec<u8>; 6] {
    let widths = header.widths();
    let (count, width) = (cloud.len(), 3 * cloud.sh_coefficients());
    let order = morton_order(&cloud.means);
    let steps = f32::from(header.fraction_bits).exp2();
    let (first_band_bits, higher_band_bits) = match quality {
        Quality::Low => (4, 3),
        // The format's own.
        Quality::Normal => (5, 4),
        Quality::High => (8, 8),
    };
    let signs = Signs::HALF_TURN_X;
    let (bands, first_band) = (signs.bands(), 3 * (sh::coefficients(1) - 1));
    let array = |array_index: usize, encode: &(dyn Fn(usize, &mut [u8]) + Sync)| {
        encode_rows(count, widths[array_index], |at, row| encode(order[at] as usize, row))
    };
    [
        array(0, &|i, row| {
            for (to, value) in row.chunks_exact_mut(3).zip(signs.position(cloud.means[i])) {
                let fixed = (value * steps).round().clamp(-MAX_COORDINATE - 1.0, MAX_COORDINATE) as i32;
                to.copy_from_slice(&fixed.to_le_bytes()[..3]);
            }
        }),
        array(1, &|i, row| row[0] = opacity_byte(cloud.opacity_logits[i])),
        array(2, &|i, row| {
            for (to, dc) in row.iter_mut().zip(&cloud.sh[i * width..]) {
                *to = round_to_byte((dc * COLOR_SCALE + 0.5) * 255.0);
            }
        }),
        array(3, &|i, row| {
            for (to, scale) in row.iter_mut().zip(cloud.log_scales[i]) {
                *to = round_to_byte((scale + SCALE_OFFSET) * SCALE_STEPS);
            }
        }),
        array(4, &|i, row| {
            let quat = signs.quat(cloud.quats[i]);
            match row.len() {
                3 => row.copy_from_slice(&xyz_bytes(quat)),
                _ => row.copy_from_slice(&rotation_bits(quat).to_le_bytes()),
            }
        }),
        array(5, &|i, row| {
            let rest = &cloud.sh[i * width + 3..(i + 1) * width];
            for (k, (to, value)) in row.iter_mut().zip(rest).enumerate() {
                let bits = if k < first_band {
                    first_band_bits
                } else {
                    higher_band_bits
                };
                *to = harmonic_byte(value * bands[k / 3], bits);
            }
        }),
    ]
}

/// The coefficient's byte, rounded to a multiple of `2^(8 - bits)`: fewer bits compress better.
fn harmonic_byte(value: f32, bits: u32) -> u8 {
    let bucket = 1 << (8 - bits);
    let fine = (value * 128.0).round() as i32 + 128;
    ((fine.clamp(-256, 512) + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

/// The index of the largest of `x, y, z, w`, and a sign and nine bits for each of the others.
fn rotation_bits(quat: [f32; 4]) -> u32 {
    let [w, x, y, z] = normalized(quat);
    let (largest, others) = smallest_three([x, y, z, w]);
    others.into_iter().fold(largest as u32, |bits, value| {
        let magnitude = (value.abs() * std::f32::consts::SQRT_2 * COMPONENT_STEPS)
            .round()
            .min(COMPONENT_STEPS);
        bits << 10 | u32::from(value < 0.0) << 9 | magnitude as u32
    })
}

/// Version 2: x, y, z with a positive w.
fn xyz_bytes(quat: [f32; 4]) -> [u8; 3] {
    let quat = normalized(quat);
    let scale = if quat[0] < 0.0 { -127.5 } else { 127.5 };
    [1, 2, 3].map(|c| round_to_byte(quat[c] * scale + 127.5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_scenes_are_stored_finely_and_large_ones_whole() {
        for (farthest, low, normal, high) in [
            (7.9, 12, 13, 20),
            (8.1, 12, 12, 19),
            (2047.9, 12, 12, 12),
            (2048.1, 11, 11, 11),
            (1e9, 0, 0, 0),
        ] {
            // Most of the splats are that far.
            let means = [[0.5, -farthest, 0.0]; 100];
            let bits = [Quality::Low, Quality::Normal, Quality::High].map(|q| fraction_bits(&means, q));
            assert_eq!(bits, [low, normal, high], "{farthest}");
        }
        // A splat far from all others does not cost them their precision.
        let mut means = vec![[1.5, -1.0, 0.0]; 200];
        means[7][2] = 1e6;
        assert_eq!(fraction_bits(&means, Quality::High), 11);
        assert_eq!(
            (
                fraction_bits(&[], Quality::Low),
                fraction_bits(&[[0.0; 3]], Quality::Low)
            ),
            (12, 12)
        );
    }

    #[test]
    fn coefficients_fall_on_the_centre_of_their_bucket() {
        // Niantic's rule: zero stays zero with any number of bits.
        for bits in 1..=8 {
            assert_eq!(harmonic_byte(0.0, bits), 128);
        }
        assert_eq!(
            (harmonic_byte(0.5, 8), harmonic_byte(0.51, 4), harmonic_byte(9.0, 5)),
            (192, 192, 255)
        );
        assert_eq!(harmonic_byte(-9.0, 3), 0);
    }
}
