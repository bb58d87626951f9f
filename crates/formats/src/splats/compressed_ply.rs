//! PlayCanvas's compressed PLY: chunks of 256 splats with their bounds, 16 bytes a splat, and a byte for each coefficient above DC.
//! <https://blog.playcanvas.com/compressing-gaussian-splats/>; the layout as SuperSplat and splat-transform read and write it.
//!
//! `packed_position` and `packed_scale` (ln) hold 11, 10 and 11 bits between the chunk's bounds, `packed_rotation` the index of the
//! largest component of `w, x, y, z` in two bits and the others in ten each, `packed_color` four bytes: the colour, between the
//! chunk's colour bounds if it has any, and the opacity. `f_rest` is a byte in an element of its own, from -4 to 4.

use crate::Malformed;
use crate::ply::{Column, Ply, Rows};
use crate::splats::quantize::{
    MAX_LOG_SCALE, from_smallest_three, from_unorm, logits_of_bytes, opacity_byte, smallest_three, unorm,
};
use crate::splats::rows::{decode_splats, encode_rows, morton_order};
use irradia_scene::{GaussianCloud, sh};
use rayon::prelude::*;
use std::io::{self, Write};

/// The element of the chunks' bounds, by which the format is recognised.
pub(crate) const CHUNK_ELEMENT: &str = "chunk";
/// Splats per chunk.
const CHUNK_SIZE: usize = 256;
/// Coefficients above DC are from `-SH_RANGE` to `SH_RANGE`.
const SH_RANGE: f32 = 4.0;

const BOUND_PROPERTIES: [&str; 12] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
];
const COLOR_BOUND_PROPERTIES: [&str; 6] = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
const PACKED_PROPERTIES: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];

/// The splats of a parsed header that declares chunks.
pub(crate) fn parse(ply: &Ply) -> Result<GaussianCloud, Malformed> {
    let chunks = ply.rows(CHUNK_ELEMENT)?;
    let vertices = ply.rows("vertex")?;
    let bounds = chunks.columns(BOUND_PROPERTIES)?;
    let color_bounds = chunks.columns(COLOR_BOUND_PROPERTIES).ok();
    let [position, rotation, scale, color] = vertices.columns(PACKED_PROPERTIES)?;
    let count = vertices.len();
    if count.div_ceil(CHUNK_SIZE) > chunks.len() {
        return Err(Malformed(format!(
            "{count} splats need {} chunks of {CHUNK_SIZE}, and the file declares {}; the file is damaged",
            count.div_ceil(CHUNK_SIZE),
            chunks.len()
        )));
    }
    let harmonics = Harmonics::find(ply, count)?;
    let degree = harmonics.as_ref().map_or(0, |harmonics| harmonics.degree);
    let logits = logits_of_bytes();
    let lerp = |chunk: &[u8], columns: &[Column], c: usize, t: f32| {
        let (low, high) = (columns[c].f32(chunk), columns[c + 3].f32(chunk));
        low * (1.0 - t) + high * t
    };
    Ok(decode_splats(count, degree, |i, splat| {
        let (row, chunk) = (vertices.row(i), chunks.row(i / CHUNK_SIZE));
        let spatial = |column: Column| {
            let bits = column.u32(row);
            [
                from_unorm(bits >> 21, 11),
                from_unorm(bits >> 11, 10),
                from_unorm(bits, 11),
            ]
        };
        let (mean_fraction, scale_fraction) = (spatial(position), spatial(scale));
        for c in 0..3 {
            splat.mean[c] = lerp(chunk, &bounds[..6], c, mean_fraction[c]);
            splat.log_scale[c] = lerp(chunk, &bounds[6..], c, scale_fraction[c]);
        }
        let bits = rotation.u32(row);
        let component = |shift: u32| (from_unorm(bits >> shift, 10) - 0.5) * std::f32::consts::SQRT_2;
        *splat.quat = from_smallest_three((bits >> 30) as usize, [component(20), component(10), component(0)]);
        let bytes = color.u32(row).to_be_bytes();
        for c in 0..3 {
            let value = f32::from(bytes[c]) / 255.0;
            splat.sh[c] = sh::dc_from_color(match &color_bounds {
                Some(columns) => lerp(chunk, columns, c, value),
                None => value,
            });
        }
        *splat.opacity_logit = logits[usize::from(bytes[3])];
        if let Some(harmonics) = &harmonics {
            harmonics.decode(i, &mut splat.sh[3..]);
        }
    }))
}

/// The element `sh`: a byte a coefficient, channel-major as `f_rest`.
struct Harmonics<'a> {
    rows: Rows<'a>,
    /// In the order of [`GaussianCloud::sh`].
    columns: Vec<Column>,
    degree: u32,
}

impl<'a> Harmonics<'a> {
    fn find(ply: &Ply<'a>, count: usize) -> Result<Option<Self>, Malformed> {
        if !ply.has("sh") {
            return Ok(None);
        }
        let rows = ply.rows("sh")?;
        let values = ply.property_names("sh")?.count();
        let degree = (1..=4).find(|degree| 3 * (sh::coefficients(*degree) - 1) == values);
        let degree = degree.ok_or_else(|| {
            Malformed(format!(
                "{values} coefficients match no spherical-harmonics degree; expected 9, 24, 45 or 72"
            ))
        })?;
        if rows.len() < count {
            return Err(Malformed(format!(
                "{count} splats need as many rows of `sh`, and the file declares {}; the file is damaged",
                rows.len()
            )));
        }
        let rest = sh::coefficients(degree) - 1;
        let mut columns = Vec::with_capacity(3 * rest);
        for coefficient in 0..rest {
            for channel in 0..3 {
                let name = format!("f_rest_{}", channel * rest + coefficient);
                columns.extend(rows.columns([name.as_str()])?);
            }
        }
        Ok(Some(Self { rows, columns, degree }))
    }

    fn decode(&self, i: usize, to: &mut [f32]) {
        let row = self.rows.row(i);
        for (to, column) in to.iter_mut().zip(&self.columns) {
            *to = coefficient(column.u32(row).min(255) as u8);
        }
    }
}

/// The centre of the byte's step, except at the ends of the range.
fn coefficient(byte: u8) -> f32 {
    let t = match byte {
        0 => 0.0,
        255 => 1.0,
        byte => (f32::from(byte) + 0.5) / 256.0,
    };
    (t - 0.5) * 2.0 * SH_RANGE
}

fn coefficient_byte(value: f32) -> u8 {
    // `as u8` saturates.
    ((value / (2.0 * SH_RANGE) + 0.5) * 256.0) as u8
}

/// Lower and upper bounds of three values in a chunk.
#[derive(Clone, Copy)]
struct Range {
    low: [f32; 3],
    high: [f32; 3],
}

impl Range {
    fn of(values: impl Iterator<Item = [f32; 3]>) -> Self {
        let empty = Self {
            low: [f32::INFINITY; 3],
            high: [f32::NEG_INFINITY; 3],
        };
        values.fold(empty, |range, value| Self {
            low: std::array::from_fn(|c| range.low[c].min(value[c])),
            high: std::array::from_fn(|c| range.high[c].max(value[c])),
        })
    }

    fn clamped(self, max: f32) -> Self {
        Self {
            low: self.low.map(|v| v.clamp(-max, max)),
            high: self.high.map(|v| v.clamp(-max, max)),
        }
    }

    /// Where `value` lies between the bounds, from 0 to 1.
    fn fraction_of(&self, value: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| {
            let extent = self.high[c] - self.low[c];
            if extent > 0.0 {
                ((value[c] - self.low[c]) / extent).clamp(0.0, 1.0)
            } else {
                0.0
            }
        })
    }
}

/// Writes `cloud` along a Morton curve, so that chunks are compact, and with bounds of colours.
pub(crate) fn write(out: &mut dyn Write, cloud: &GaussianCloud) -> io::Result<()> {
    // The format stops at degree 3.
    let (degree, width) = (cloud.sh_degree.min(3), 3 * cloud.sh_coefficients());
    let rest = sh::coefficients(degree) - 1;
    let order = morton_order(&cloud.means);
    let color = |i: u32| std::array::from_fn(|c| sh::color_from_dc(cloud.sh[i as usize * width + c]));
    let ranges: Vec<[Range; 3]> = order
        .par_chunks(CHUNK_SIZE)
        .map(|chunk| {
            // Splats that are never seen do not make the steps of the others coarser.
            let is_seen = |i: &&u32| opacity_byte(cloud.opacity_logits[**i as usize]) > 0;
            let any_seen = chunk.iter().any(|i| is_seen(&i));
            let members = || chunk.iter().filter(|i| !any_seen || is_seen(i));
            [
                Range::of(members().map(|i| cloud.means[*i as usize])),
                Range::of(members().map(|i| cloud.log_scales[*i as usize])).clamped(MAX_LOG_SCALE),
                Range::of(members().map(|i| color(*i))),
            ]
        })
        .collect();

    let count = cloud.len();
    writeln!(
        out,
        "ply\nformat binary_little_endian 1.0\ncomment written by Irradia\nelement chunk {}",
        ranges.len()
    )?;
    for name in BOUND_PROPERTIES.iter().chain(&COLOR_BOUND_PROPERTIES) {
        writeln!(out, "property float {name}")?;
    }
    writeln!(out, "element vertex {count}")?;
    for name in PACKED_PROPERTIES {
        writeln!(out, "property uint {name}")?;
    }
    if rest > 0 {
        writeln!(out, "element sh {count}")?;
        for i in 0..3 * rest {
            writeln!(out, "property uchar f_rest_{i}")?;
        }
    }
    writeln!(out, "end_header")?;

    for range in ranges.as_flattened() {
        for value in range.low.iter().chain(&range.high) {
            out.write_all(&value.to_le_bytes())?;
        }
    }
    out.write_all(&encode_rows(count, 16, |at, row| {
        let i = order[at] as usize;
        let [means, scales, colors] = &ranges[at / CHUNK_SIZE];
        let spatial = |[x, y, z]: [f32; 3]| unorm(x, 11) << 21 | unorm(y, 10) << 11 | unorm(z, 11);
        let (largest, others) = smallest_three(cloud.quats[i]);
        let rotation = others.into_iter().fold(largest as u32, |bits, v| {
            bits << 10 | unorm(v * std::f32::consts::FRAC_1_SQRT_2 + 0.5, 10)
        });
        let [r, g, b] = colors.fraction_of(color(order[at])).map(|v| unorm(v, 8) as u8);
        let words = [
            spatial(means.fraction_of(cloud.means[i])),
            rotation,
            spatial(scales.fraction_of(cloud.log_scales[i])),
            u32::from_be_bytes([r, g, b, opacity_byte(cloud.opacity_logits[i])]),
        ];
        row.copy_from_slice(words.map(u32::to_le_bytes).as_flattened());
    }))?;
    out.write_all(&encode_rows(count, 3 * rest, |at, row| {
        let sh = &cloud.sh[order[at] as usize * width..];
        for channel in 0..3 {
            for coefficient in 0..rest {
                row[channel * rest + coefficient] = coefficient_byte(sh[3 * (coefficient + 1) + channel]);
            }
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_of_a_coefficient_survives() {
        for byte in 0..=255 {
            assert_eq!(coefficient_byte(coefficient(byte)), byte);
        }
        assert_eq!((coefficient_byte(-9.0), coefficient_byte(9.0)), (0, 255));
    }
}
