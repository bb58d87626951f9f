use super::*;
use crate::Malformed;
use crate::bytes::ByteReader;
use crate::splats::axes::Signs;
use crate::splats::quantize::{from_smallest_three, logits_of_bytes};
use crate::splats::rows::{decode_splats, plausible_count};
use crate::unpack::{Gunzip, unzstd};
use irradia_scene::GaussianCloud;
use irradia_scene::half::from_half;
use rayon::prelude::*;

/// The extension that declares the axes of the file: a number for right, up, back and their alternatives.
const ADOBE_AXES_EXTENSION: u32 = 0xadbe_0003;

/// Parses an SPZ file of version 1 to 4, compressed or as the bare stream of the versions up to 3.
///
/// # Errors
/// When it is not an SPZ file, is damaged or truncated, or has an unknown version, degree or axes.
pub fn parse(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    if bytes.starts_with(&[0x1f, 0x8b]) {
        let mut stream = Gunzip::new(bytes);
        let header = legacy_header(&stream.take(16)?)?;
        let count = plausible_count(header.count.into(), bytes.len())?;
        let widths = header.widths();
        let arrays = stream.take(count * widths.iter().sum::<usize>())?;
        let signs = signs_after_arrays(&header, &stream.finish()?)?;
        return Ok(decode(&header, split_arrays(&arrays, count, widths), signs));
    }
    let Some([a, b, c, d]) = bytes.strip_prefix(MAGIC).and_then(|rest| rest.first_chunk::<4>()) else {
        return Err(Malformed(
            "not an SPZ file: it begins with neither gzip's bytes nor NGSP".into(),
        ));
    };
    if u32::from_le_bytes([*a, *b, *c, *d]) >= 4 {
        return parse_streams(bytes);
    }
    let mut rest = ByteReader::new(bytes);
    let header = legacy_header(rest.take(16)?)?;
    let count = plausible_count(header.count.into(), bytes.len())?;
    let widths = header.widths();
    let arrays = rest.take(count * widths.iter().sum::<usize>())?;
    let signs = signs_after_arrays(&header, &bytes[16 + arrays.len()..])?;
    Ok(decode(&header, split_arrays(arrays, count, widths), signs))
}

/// The axes that extensions behind the arrays declare; without its flag, what follows the arrays is ignored.
fn signs_after_arrays(header: &Header, rest: &[u8]) -> Result<Signs, Malformed> {
    match header.flags & EXTENSIONS_FLAG {
        0 => Ok(Signs::HALF_TURN_X),
        _ => signs_of_extensions(rest),
    }
}

/// The fields that every version has, in this order.
fn header_fields(rest: &mut ByteReader) -> Result<Header, Malformed> {
    Ok(Header {
        version: rest.u32()?,
        count: rest.u32()?,
        degree: rest.u8()?,
        fraction_bits: rest.u8()?,
        flags: rest.u8()?,
    })
}

fn legacy_header(bytes: &[u8]) -> Result<Header, Malformed> {
    let mut rest = ByteReader::new(bytes);
    if rest.take(4)? != MAGIC {
        return Err(Malformed("not an SPZ file: its stream does not begin with NGSP".into()));
    }
    let header = header_fields(&mut rest)?;
    match header.version {
        1..=3 => validated(header),
        version => Err(Malformed(format!(
            "SPZ version {version} is not known in a gzip stream; expected 1 to 3"
        ))),
    }
}

fn validated(header: Header) -> Result<Header, Malformed> {
    if header.degree > 4 {
        return Err(Malformed(format!(
            "declares spherical harmonics of degree {}; expected 0 to 4",
            header.degree
        )));
    }
    if header.fraction_bits > 24 {
        return Err(Malformed(format!(
            "declares {} fractional bits of 24-bit positions",
            header.fraction_bits
        )));
    }
    Ok(header)
}

/// Version 4.
fn parse_streams(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    let mut rest = ByteReader::new(&bytes[4..]);
    let header = header_fields(&mut rest)?;
    let (streams, table_offset) = (usize::from(rest.u8()?), rest.u32()? as usize);
    if header.version != 4 {
        return Err(Malformed(format!(
            "SPZ version {} is not known; expected 1 to 4",
            header.version
        )));
    }
    let header = validated(header)?;
    let count = plausible_count(header.count.into(), bytes.len())?;
    let body = bytes.get(table_offset..).filter(|_| table_offset >= 32);
    let body = body.ok_or_else(|| Malformed("its table of streams is outside of the file".into()))?;
    let signs = match header.flags & EXTENSIONS_FLAG {
        0 => Signs::HALF_TURN_X,
        _ => signs_of_extensions(&bytes[32..table_offset])?,
    };

    // Arrays without content have no stream.
    let widths = header.widths();
    let expected: Vec<usize> = widths
        .into_iter()
        .map(|width| width * count)
        .filter(|size| *size > 0)
        .collect();
    if streams != expected.len() {
        return Err(Malformed(format!(
            "declares {streams} streams where {} are expected",
            expected.len()
        )));
    }
    let mut body = ByteReader::new(body);
    let mut sizes = Vec::with_capacity(streams);
    for (i, expected) in expected.iter().enumerate() {
        let [packed, size] = [body.u64()?, body.u64()?];
        if size != *expected as u64 {
            return Err(Malformed(format!(
                "its stream {i} declares {size} bytes where {count} splats need {expected}"
            )));
        }
        sizes.push(usize::try_from(packed).unwrap_or(usize::MAX));
    }
    let packed: Vec<&[u8]> = sizes
        .into_iter()
        .map(|size| body.take(size))
        .collect::<Result<_, _>>()?;
    let unpacked: Vec<Vec<u8>> = packed
        .par_iter()
        .zip(&expected)
        .map(|(packed, size)| unzstd(packed, *size))
        .collect::<Result<_, _>>()?;
    let mut unpacked = unpacked.iter();
    let arrays = widths.map(|width| match width * count {
        0 => &[][..],
        _ => unpacked.next().map_or(&[][..], |array| array),
    });
    Ok(decode(&header, arrays, signs))
}

/// The axes that an extension declares, if one does; other extensions do not affect the splats.
fn signs_of_extensions(records: &[u8]) -> Result<Signs, Malformed> {
    let mut rest = ByteReader::new(records);
    while !rest.is_empty() {
        let [kind, length] = [rest.u32()?, rest.u32()?];
        let payload = rest.take(length as usize)?;
        if kind == ADOBE_AXES_EXTENSION {
            let axes = ByteReader::new(payload).u32()?;
            let sign = |bit: u32| {
                if (axes.wrapping_sub(1) >> bit) & 1 == 0 {
                    -1.0
                } else {
                    1.0
                }
            };
            return match axes {
                0 => Ok(Signs::HALF_TURN_X),
                // Bits 0 to 2 of the number less one: right, up, front.
                1..=8 => Ok(Signs([sign(0), -sign(1), sign(2)])),
                _ => Err(Malformed(format!(
                    "its axes (number {axes} of the Adobe extension) are not supported; convert it with the tool that wrote it"
                ))),
            };
        }
    }
    Ok(Signs::HALF_TURN_X)
}

fn split_arrays(bytes: &[u8], count: usize, widths: [usize; 6]) -> [&[u8]; 6] {
    let mut rest = bytes;
    widths.map(|width| {
        let (array, left) = rest.split_at(width * count);
        rest = left;
        array
    })
}

/// Decodes the splats in arrays of the sizes that the header implies; `signs` converts them to our axes.
fn decode(header: &Header, arrays: [&[u8]; 6], signs: Signs) -> GaussianCloud {
    let [positions, opacities, colors, scales, rotations, harmonics] = arrays;
    let widths = header.widths();
    let logits = logits_of_bytes();
    let unit = (-f32::from(header.fraction_bits)).exp2();
    let mut cloud = decode_splats(opacities.len(), header.degree.into(), |i, splat| {
        let row_range = |array: &[u8], array_index: usize| -> std::ops::Range<usize> {
            debug_assert!(array.len() >= (i + 1) * widths[array_index]);
            i * widths[array_index]..(i + 1) * widths[array_index]
        };
        let position = &positions[row_range(positions, 0)];
        for c in 0..3 {
            splat.mean[c] = match header.version {
                1 => from_half(u16::from_le_bytes([position[2 * c], position[2 * c + 1]])),
                _ => {
                    let [a, b, c] = [position[3 * c], position[3 * c + 1], position[3 * c + 2]];
                    // The sign is extended by shifting from the top.
                    (i32::from_le_bytes([0, a, b, c]) >> 8) as f32 * unit
                }
            };
            splat.sh[c] = (f32::from(colors[3 * i + c]) / 255.0 - 0.5) / COLOR_SCALE;
            splat.log_scale[c] = f32::from(scales[3 * i + c]) / SCALE_STEPS - SCALE_OFFSET;
        }
        *splat.opacity_logit = logits[usize::from(opacities[i])];
        *splat.quat = match rotations[row_range(rotations, 4)] {
            [a, b, c, d] => rotation(u32::from_le_bytes([a, b, c, d])),
            [x, y, z] => {
                let [x, y, z] = [x, y, z].map(|v| f32::from(v) / 127.5 - 1.0);
                [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
            }
            _ => unreachable!("three or four bytes"),
        };
        for (to, byte) in splat.sh[3..].iter_mut().zip(&harmonics[row_range(harmonics, 5)]) {
            *to = (f32::from(*byte) - 128.0) / 128.0;
        }
    });
    cloud.antialiased = header.flags & ANTIALIASED_FLAG != 0;
    signs.apply(&mut cloud);
    cloud
}

/// The rotation `w, x, y, z` from the index of the largest of `x, y, z, w` and three components of a sign and nine bits each.
fn rotation(bits: u32) -> [f32; 4] {
    let component = |shift: u32| {
        let (magnitude, negative) = (bits >> shift & 511, bits >> shift & 512 != 0);
        let value = magnitude as f32 / COMPONENT_STEPS * std::f32::consts::FRAC_1_SQRT_2;
        if negative { -value } else { value }
    };
    let [x, y, z, w] = from_smallest_three((bits >> 30) as usize, [component(20), component(10), component(0)]);
    [w, x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_of_the_adobe_extension() {
        let record = |axes: u32| {
            let other = [0x1234_0001u32, 3].map(u32::to_le_bytes).concat();
            let ours = [ADOBE_AXES_EXTENSION, 4, axes].map(u32::to_le_bytes).concat();
            [&other[..], &[1, 2, 3], &ours[..]].concat()
        };
        // Right down front is ours, right up back the format's own, left up front glTF's.
        for (axes, expected) in [
            (6, Signs::NONE),
            (4, Signs::HALF_TURN_X),
            (7, Signs::HALF_TURN_Z),
            (0, Signs::HALF_TURN_X),
        ] {
            assert_eq!(signs_of_extensions(&record(axes)).unwrap(), expected, "{axes}");
        }
        assert!(signs_of_extensions(&record(9)).is_err());
        assert!(signs_of_extensions(&record(4)[..20]).is_err());
    }
}
