//! `.ksplat`, the format of mkkellogg's viewer, in its three levels of compression.
//! <https://github.com/mkkellogg/GaussianSplats3D> (`SplatBuffer.js`).
//!
//! A header of 4096 bytes, one of 1024 bytes a section, then the sections: lengths of the partly filled buckets, centres of the
//! buckets, splats. Level 0 holds floats; level 1 halves, and positions in 16 bits about the centre of the splat's bucket; level 2
//! a byte for each coefficient above DC. Colour and opacity are bytes in every level, scales are standard deviations, rotations
//! `w, x, y, z`. Coefficients are band by band, each first all of red. The axes are ours. Degree 2 is the highest that is written.

use crate::Malformed;
use crate::bytes::ByteReader;
use crate::splats::Quality;
use crate::splats::quantize::{color_byte, dc_of_byte, logits_of_bytes, normalized, opacity_byte, round_to_byte};
use crate::splats::rows::{bounds, decode_splats, encode_rows};
use irradia_scene::half::{from_half, half};
use irradia_scene::{GaussianCloud, sh};
use std::collections::BTreeMap;
use std::io::{self, Write};

const HEADER_BYTES: usize = 4096;
const SECTION_HEADER_BYTES: usize = 1024;
/// Splats in a full bucket, and steps of a position from a bucket's centre to its side.
const BUCKET_SIZE: usize = 256;
const POSITION_STEPS: u32 = 32767;
/// Maximum side of a bucket's block.
const MAX_BLOCK_SIDE: f32 = 5.0;
/// Bound of level 2's coefficients if the header gives none.
const DEFAULT_SH_RANGE: f32 = 1.5;

/// Bytes per number of position, scale and rotation, and per coefficient.
fn value_sizes(level: u16) -> (usize, usize) {
    match level {
        0 => (4, 4),
        1 => (2, 2),
        _ => (2, 1),
    }
}

/// Where the three channels of coefficient `k` above DC are, in units of coefficients.
fn channel_indices(k: usize) -> [usize; 3] {
    let (first, length) = match k {
        0..3 => (0, 3),
        3..8 => (3, 5),
        _ => (8, 7),
    };
    [0, 1, 2].map(|channel| 3 * first + channel * length + k - first)
}

/// A section's splats in the file.
struct Section<'a> {
    /// Index of its first splat in the scene.
    first_splat: usize,
    degree: u32,
    rows: &'a [u8],
    row_bytes: usize,
    /// World units per step of a position; offset of zero steps from the bucket's centre.
    position_step: f32,
    position_offset: f32,
    /// Splats in all full buckets, splats per full bucket, and number of full buckets.
    splats_in_full: usize,
    bucket_size: usize,
    full_buckets: usize,
    /// Index of the first splat of each partly filled bucket, not counting splats in full ones.
    partial_starts: Vec<usize>,
    /// Three floats a bucket.
    centers: &'a [u8],
}

impl Section<'_> {
    fn bucket(&self, i: usize) -> usize {
        if i < self.splats_in_full {
            return i / self.bucket_size;
        }
        self.full_buckets
            + self
                .partial_starts
                .partition_point(|start| *start <= i - self.splats_in_full)
            - 1
    }

    fn center(&self, i: usize, axis: usize) -> f32 {
        float(self.centers, 3 * self.bucket(i) + axis)
    }
}

fn float(bytes: &[u8], index: usize) -> f32 {
    f32::from_le_bytes(bytes[4 * index..4 * index + 4].try_into().expect("four bytes"))
}

fn short(bytes: &[u8], index: usize) -> u16 {
    u16::from_le_bytes([bytes[2 * index], bytes[2 * index + 1]])
}

/// Parses a `.ksplat` file.
///
/// # Errors
/// When its version or level is not known, or a section is larger than the file.
pub fn parse(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    let mut header = ByteReader::new(bytes);
    let mut header = ByteReader::new(header.take(HEADER_BYTES)?);
    let (major, minor) = (header.u8()?, header.u8()?);
    if major != 0 || minor < 1 {
        return Err(Malformed(format!(
            "its .ksplat version is {major}.{minor}; expected 0.1"
        )));
    }
    header.take(2)?;
    let [sections, _, _, count] = [header.u32()?, header.u32()?, header.u32()?, header.u32()?];
    let level = header.u16()?;
    if level > 2 {
        return Err(Malformed(format!(
            "its compression level is {level}; expected 0, 1 or 2"
        )));
    }
    header.take(2 + 12)?;
    let [low, high] = [header.u32()?, header.u32()?].map(f32::from_bits);
    let low = if low == 0.0 { -DEFAULT_SH_RANGE } else { low };
    let high = if high == 0.0 { DEFAULT_SH_RANGE } else { high };

    let sections = parse_sections(&bytes[HEADER_BYTES..], sections as usize, level)?;
    let total: usize = sections.iter().map(|s| s.rows.len() / s.row_bytes).sum();
    if total != count as usize {
        return Err(Malformed(format!(
            "declares {count} splats, and its sections hold {total}; the file is damaged"
        )));
    }
    let degree = sections.iter().map(|s| s.degree).max().unwrap_or(0);
    let (number_bytes, coefficient_bytes) = value_sizes(level);
    let logits = logits_of_bytes();
    Ok(decode_splats(total, degree, |i, splat| {
        let section = &sections[sections.partition_point(|s| s.first_splat <= i) - 1];
        let i = i - section.first_splat;
        let row = &section.rows[i * section.row_bytes..(i + 1) * section.row_bytes];
        let (numbers, rest) = row.split_at(10 * number_bytes);
        let value = |k: usize| match level {
            0 => float(numbers, k),
            _ => from_half(short(numbers, k)),
        };
        for c in 0..3 {
            splat.mean[c] = match level {
                0 => float(numbers, c),
                _ => {
                    f32::from(short(numbers, c)).mul_add(section.position_step, section.position_offset)
                        + section.center(i, c)
                }
            };
            splat.log_scale[c] = value(3 + c).ln();
            splat.sh[c] = dc_of_byte(rest[c]);
        }
        *splat.quat = std::array::from_fn(|c| value(6 + c));
        *splat.opacity_logit = logits[usize::from(rest[3])];
        let rest = &rest[4..];
        for (k, to) in splat.sh[3..3 * sh::coefficients(section.degree)]
            .chunks_exact_mut(3)
            .enumerate()
        {
            for (to, channel_index) in to.iter_mut().zip(channel_indices(k)) {
                *to = match coefficient_bytes {
                    4 => float(rest, channel_index),
                    2 => from_half(short(rest, channel_index)),
                    _ => low + f32::from(rest[channel_index]) / 255.0 * (high - low),
                };
            }
        }
    }))
}

/// The sections, each with as many splats as its part of the file holds.
fn parse_sections(bytes: &[u8], count: usize, level: u16) -> Result<Vec<Section<'_>>, Malformed> {
    let mut body = ByteReader::new(bytes);
    let headers = body.take(count.saturating_mul(SECTION_HEADER_BYTES))?;
    let (number_bytes, coefficient_bytes) = value_sizes(level);
    let mut sections = Vec::new();
    let mut first_splat = 0;
    for (index, header) in headers.chunks_exact(SECTION_HEADER_BYTES).enumerate() {
        let malformed = |reason: String| Malformed(format!("its section {index} {reason}; the file is damaged"));
        let mut header = ByteReader::new(header);
        let [splats, capacity, bucket_size, buckets] = [header.u32()?, header.u32()?, header.u32()?, header.u32()?];
        let block = f32::from_bits(header.u32()?);
        let bucket_bytes = header.u16()?;
        header.take(2)?;
        let steps = header.u32()?;
        header.take(4)?;
        let [full_buckets, partial_buckets] = [header.u32()?, header.u32()?].map(|v| v as usize);
        let degree = u32::from(header.u16()?);
        if degree > 3 {
            return Err(malformed(format!("declares spherical harmonics of degree {degree}")));
        }
        if splats > capacity {
            return Err(malformed(format!(
                "declares {splats} splats in the space of {capacity}"
            )));
        }
        let row_bytes = 10 * number_bytes + 4 + 3 * (sh::coefficients(degree) - 1) * coefficient_bytes;
        let lengths = body.take(4usize.saturating_mul(partial_buckets))?;
        let centers = body.take(usize::from(bucket_bytes).saturating_mul(buckets as usize))?;
        let rows = body.take(row_bytes.saturating_mul(capacity as usize))?;
        let (splats, bucket_size) = (splats as usize, bucket_size as usize);
        let splats_in_full = full_buckets.saturating_mul(bucket_size);
        let mut partial_starts = vec![0];
        for length in lengths.chunks_exact(4) {
            let length = u32::from_le_bytes(length.try_into().expect("four bytes")) as usize;
            partial_starts.push(partial_starts[partial_starts.len() - 1] + length);
        }
        let splats_in_partial = partial_starts.pop().unwrap_or(0);
        // Only compressed positions are relative to the centres.
        if level > 0 {
            if splats_in_full.saturating_add(splats_in_partial) < splats {
                return Err(malformed(format!(
                    "declares {splats} splats, and its buckets hold fewer"
                )));
            }
            if bucket_bytes != 12 || (buckets as usize) < full_buckets.saturating_add(partial_buckets) {
                return Err(malformed(format!(
                    "declares {buckets} centres of {bucket_bytes} bytes for its buckets"
                )));
            }
        }
        let steps = if steps == 0 { POSITION_STEPS } else { steps };
        let position_step = block / 2.0 / steps as f32;
        sections.push(Section {
            first_splat,
            degree,
            rows: &rows[..row_bytes * splats],
            row_bytes,
            position_step,
            position_offset: -(steps as f32) * position_step,
            splats_in_full,
            bucket_size: bucket_size.max(1),
            full_buckets,
            partial_starts,
            centers,
        });
        first_splat += splats;
    }
    Ok(sections)
}

/// Writes `cloud`: the best quality is level 0, the lowest level 2.
pub(crate) fn write(out: &mut dyn Write, cloud: &GaussianCloud, quality: Quality) -> io::Result<()> {
    let level: u16 = match quality {
        Quality::High => 0,
        Quality::Normal => 1,
        Quality::Low => 2,
    };
    let (degree, width) = (cloud.sh_degree.min(2), 3 * cloud.sh_coefficients());
    let rest = sh::coefficients(degree) - 1;
    let (number_bytes, coefficient_bytes) = value_sizes(level);
    let row = 10 * number_bytes + 4 + 3 * rest * coefficient_bytes;
    let buckets = match level {
        0 => Buckets::none(cloud.len()),
        _ => Buckets::of(&cloud.means),
    };
    let above_dc = |i: usize| &cloud.sh[i * width + 3..i * width + 3 + 3 * rest];
    let (low, high) = (0..cloud.len())
        .flat_map(above_dc)
        .fold((0f32, 0f32), |(low, high), v| (low.min(*v), high.max(*v)));
    // Zero would mean the default.
    let (low, high) = (low.min(-1e-3), high.max(1e-3));

    let count = cloud.len() as u32;
    let mut header = vec![0; HEADER_BYTES + SECTION_HEADER_BYTES];
    let write_word = |to: &mut [u8], at: usize, word: u32| to[at..at + 4].copy_from_slice(&word.to_le_bytes());
    header[1] = 1;
    for (at, word) in [(4, 1), (8, 1), (12, count), (16, count), (20, level.into())] {
        write_word(&mut header, at, word);
    }
    write_word(&mut header, 36, low.to_bits());
    write_word(&mut header, 40, high.to_bits());
    let bucket_count = buckets.centers.len();
    let bucket_bytes = 4 * buckets.partial.len() + 12 * bucket_count;
    let section_bytes = u32::try_from(bucket_bytes + row * cloud.len())
        .map_err(|_| io::Error::other("a .ksplat file holds at most 4 GiB; choose another format"))?;
    for (at, word) in [
        (0, count),
        (4, count),
        (8, BUCKET_SIZE as u32),
        (12, bucket_count as u32),
        (16, buckets.block_side.to_bits()),
        (20, if level > 0 { 12 } else { 0 }),
        (24, if level > 0 { POSITION_STEPS } else { 1 }),
        (28, section_bytes),
        (32, (bucket_count - buckets.partial.len()) as u32),
        (36, buckets.partial.len() as u32),
        (40, degree),
    ] {
        write_word(&mut header, HEADER_BYTES + at, word);
    }
    out.write_all(&header)?;
    for length in &buckets.partial {
        out.write_all(&length.to_le_bytes())?;
    }
    for value in buckets.centers.as_flattened() {
        out.write_all(&value.to_le_bytes())?;
    }
    let position_step = buckets.block_side / 2.0 / POSITION_STEPS as f32;
    out.write_all(&encode_rows(cloud.len(), row, |at, row| {
        let (i, bucket) = buckets.order[at];
        let (i, bucket) = (i as usize, bucket as usize);
        let shape = cloud.log_scales[i]
            .map(f32::exp)
            .into_iter()
            .chain(normalized(cloud.quats[i]));
        let (numbers, colors) = row.split_at_mut(10 * number_bytes);
        if level == 0 {
            let values = cloud.means[i].into_iter().chain(shape);
            for (to, value) in numbers.chunks_exact_mut(4).zip(values) {
                to.copy_from_slice(&value.to_le_bytes());
            }
        } else {
            let center = buckets.centers[bucket];
            let position = (0..3).map(|c| {
                let steps = ((cloud.means[i][c] - center[c]) / position_step).round() + POSITION_STEPS as f32;
                steps.clamp(0.0, 65535.0) as u16
            });
            for (to, value) in numbers.chunks_exact_mut(2).zip(position.chain(shape.map(half))) {
                to.copy_from_slice(&value.to_le_bytes());
            }
        }
        for c in 0..3 {
            colors[c] = color_byte(cloud.sh[i * width + c]);
        }
        colors[3] = opacity_byte(cloud.opacity_logits[i]);
        let to = &mut colors[4..];
        for (k, triple) in above_dc(i).chunks_exact(3).enumerate() {
            for (value, channel_index) in triple.iter().zip(channel_indices(k)) {
                let to = &mut to[channel_index * coefficient_bytes..(channel_index + 1) * coefficient_bytes];
                match coefficient_bytes {
                    4 => to.copy_from_slice(&value.to_le_bytes()),
                    2 => to.copy_from_slice(&half(*value).to_le_bytes()),
                    _ => to[0] = round_to_byte((value - low) / (high - low) * 255.0),
                }
            }
        }
    }))
}

/// Splats grouped by blocks of space into buckets of at most [`BUCKET_SIZE`]; full buckets first.
struct Buckets {
    /// Side of a block.
    block_side: f32,
    /// Splat and bucket, in the order of the file.
    order: Vec<(u32, u32)>,
    centers: Vec<[f32; 3]>,
    /// Number of splats in each bucket that is not full.
    partial: Vec<u32>,
}

impl Buckets {
    fn none(count: usize) -> Self {
        Self {
            block_side: MAX_BLOCK_SIDE,
            order: (0..count as u32).map(|i| (i, 0)).collect(),
            centers: Vec::new(),
            partial: Vec::new(),
        }
    }

    fn of(means: &[[f32; 3]]) -> Self {
        let (low, high) = bounds(means);
        let extents: [f32; 3] = std::array::from_fn(|c| high[c] - low[c]);
        let longest = extents.into_iter().fold(1e-6, f32::max);
        let volume: f32 = extents.into_iter().map(|extent| extent.max(1e-3 * longest)).product();
        // A block that would hold one bucket of evenly spread splats, and that floats can resolve.
        let even_side = (volume * BUCKET_SIZE as f32 / means.len().max(1) as f32).cbrt();
        let block_side = even_side.max(1e-4 * longest).min(MAX_BLOCK_SIDE);
        let mut blocks: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
        for (i, mean) in means.iter().enumerate() {
            let block = std::array::from_fn(|c| ((mean[c] - low[c]) / block_side) as i64);
            blocks.entry(block).or_default().push(i as u32);
        }
        let (mut full, mut partial) = (Vec::new(), Vec::new());
        for (block, splats) in &blocks {
            for bucket in splats.chunks(BUCKET_SIZE) {
                if bucket.len() == BUCKET_SIZE {
                    full.push((block, bucket));
                } else {
                    partial.push((block, bucket));
                }
            }
        }
        let lengths = partial.iter().map(|(_, bucket)| bucket.len() as u32).collect();
        full.append(&mut partial);
        let center = |block: &[i64; 3]| std::array::from_fn(|c| low[c] + (block[c] as f32 + 0.5) * block_side);
        Self {
            block_side,
            centers: full.iter().map(|(block, _)| center(block)).collect(),
            order: full
                .iter()
                .enumerate()
                .flat_map(|(bucket, (_, splats))| splats.iter().map(move |i| (*i, bucket as u32)))
                .collect(),
            partial: lengths,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_are_band_by_band_and_red_first() {
        assert_eq!(channel_indices(0), [0, 3, 6]);
        assert_eq!(channel_indices(2), [2, 5, 8]);
        assert_eq!(channel_indices(3), [9, 14, 19]);
        assert_eq!(channel_indices(7), [13, 18, 23]);
        assert_eq!(channel_indices(8), [24, 31, 38]);
    }

    #[test]
    fn every_splat_is_in_one_bucket_and_full_ones_come_first() {
        let means: Vec<[f32; 3]> = (0..2000)
            .map(|i| [(i % 2) as f32 * 30.0, 0.0, (i % 7) as f32 * 1e-3])
            .collect();
        let buckets = Buckets::of(&means);
        let mut seen: Vec<u32> = buckets.order.iter().map(|(i, _)| *i).collect();
        seen.sort_unstable();
        assert!(seen.iter().copied().eq(0..2000));
        let full = buckets.centers.len() - buckets.partial.len();
        assert_eq!(full * BUCKET_SIZE + buckets.partial.iter().sum::<u32>() as usize, 2000);
        for (i, bucket) in &buckets.order {
            for c in 0..3 {
                let distance = means[*i as usize][c] - buckets.centers[*bucket as usize][c];
                assert!(distance.abs() <= buckets.block_side * 0.501, "{distance}");
            }
        }
    }
}
