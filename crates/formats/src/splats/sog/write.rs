use super::palette::{Codebook, Palette};
use super::{ENTRIES_PER_ROW, LARGEST_W, META_FILE};
use crate::splats::quantize::{MAX_LOG_SCALE, opacity_byte, smallest_three};
use crate::splats::rows::{bounds, encode_rows, morton_order};
use crate::splats::{SogDetail, WriteOptions};
use crate::zip::Writer;
use image_webp::{ColorType, EncoderParams, WebPEncoder};
use irradia_scene::{GaussianCloud, sh, with_f32_digits};
use rayon::prelude::*;
use serde_json::json;
use std::io::{self, Write};

/// Names and contents of a scene's files.
type Files = Vec<(&'static str, Vec<u8>)>;

/// An image to be encoded: name, width, height, channels (3 or 4), pixels.
type Image = (&'static str, usize, usize, usize, Vec<u8>);

/// Writes `cloud` as one archive.
pub(crate) fn write(out: &mut dyn Write, cloud: &GaussianCloud, options: &WriteOptions) -> io::Result<()> {
    let mut archive = Writer::new(out);
    for (name, content) in encode(cloud, options)? {
        archive.add_file(name, &content)?;
    }
    archive.finish()
}

/// The files of `cloud` in version 2. A scene that was read from such files becomes equal files, except for the order of the splats:
/// codebooks and palettes that can hold all values exactly do so.
///
/// # Errors
/// When an image cannot be encoded: more than 16,384 pixels a side.
pub(crate) fn encode(cloud: &GaussianCloud, options: &WriteOptions) -> io::Result<Files> {
    let count = cloud.len();
    let detail = options.sog.unwrap_or_else(|| SogDetail::of(options.quality, count));
    let (position_bits, rotation_bits) = (detail.position_bits.clamp(1, 16), detail.rotation_bits.clamp(1, 8));
    let width = 3 * cloud.sh_coefficients();
    let order = morton_order(&cloud.means);
    // Sides are multiples of four, as other writers make them.
    let columns = ((count as f64).sqrt() / 4.0).ceil().max(1.0) as usize * 4;
    let image_rows = (count as f64 / columns as f64 / 4.0).ceil().max(1.0) as usize * 4;
    let image = |name, channels: usize, encode: &(dyn Fn(usize, &mut [u8]) + Sync)| -> Image {
        let mut pixels = encode_rows(count, channels, |at, pixel| encode(order[at] as usize, pixel));
        pixels.resize(columns * image_rows * channels, 0);
        (name, columns, image_rows, channels, pixels)
    };

    let logarithm = |v: f32| v.abs().ln_1p().copysign(v);
    let (low, high) = bounds(&cloud.means);
    let (low, high) = (low.map(logarithm), high.map(logarithm));
    let position_bytes = |i: usize, c: usize| {
        let extent = f64::from(high[c]) - f64::from(low[c]);
        let t = (f64::from(logarithm(cloud.means[i][c])) - f64::from(low[c])) / extent.max(f64::MIN_POSITIVE);
        (round_to_multiple(t * 65535.0, 16 - position_bits, 65535) as u16).to_le_bytes()
    };
    let log_scales: Vec<[f32; 3]> = cloud
        .log_scales
        .iter()
        .map(|scales| scales.map(|scale| scale.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)))
        .collect();
    let scales = Codebook::of(log_scales.as_flattened(), detail.codebook.clamp(2, 256));
    let colors: Vec<f32> = cloud
        .sh
        .chunks_exact(width)
        .flat_map(|sh| [sh[0], sh[1], sh[2]])
        .collect();
    let colors = Codebook::of(&colors, detail.codebook.clamp(2, 256));
    let dc = |i: usize, c: usize| cloud.sh[i * width + c];
    let mut images = vec![
        image("means_l.webp", 3, &|i, pixel| {
            (0..3).for_each(|c| pixel[c] = position_bytes(i, c)[0])
        }),
        image("means_u.webp", 3, &|i, pixel| {
            (0..3).for_each(|c| pixel[c] = position_bytes(i, c)[1])
        }),
        image("scales.webp", 3, &|i, pixel| {
            (0..3).for_each(|c| pixel[c] = scales.index(log_scales[i][c]))
        }),
        image("quats.webp", 4, &|i, pixel| {
            let (largest, others) = smallest_three(cloud.quats[i]);
            let others = others.map(|v| {
                round_to_multiple(
                    f64::from(v * std::f32::consts::FRAC_1_SQRT_2 + 0.5) * 255.0,
                    8 - rotation_bits,
                    255,
                ) as u8
            });
            pixel[..3].copy_from_slice(&others);
            pixel[3] = LARGEST_W + largest as u8;
        }),
        image("sh0.webp", 4, &|i, pixel| {
            (0..3).for_each(|c| pixel[c] = colors.index(dc(i, c)));
            pixel[3] = opacity_byte(cloud.opacity_logits[i]);
        }),
    ];
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": "Irradia" },
        "antialias": cloud.antialiased,
        "count": count,
        "means": { "mins": low.map(with_f32_digits), "maxs": high.map(with_f32_digits), "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": scales.0.map(with_f32_digits)[..], "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": colors.0.map(with_f32_digits)[..], "files": ["sh0.webp"] },
    });

    // The format stops at degree 3.
    let degree = cloud.sh_degree.min(3);
    if degree > 0 && count > 0 {
        let rest = 3 * (sh::coefficients(degree) - 1);
        let vectors: Vec<f32> = order
            .par_iter()
            .flat_map_iter(|i| cloud.sh[*i as usize * width + 3..][..rest].iter().copied())
            .collect();
        let palette = Palette::of(&vectors, rest, detail.palette.clamp(2, 65_536));
        let codebook = Codebook::of(&palette.entries, 256);
        let has_zero = palette
            .entries
            .chunks_exact(rest)
            .any(|entry| entry.iter().all(|v| *v == 0.0));
        // Harmonics of zero stay zero.
        let codebook = if has_zero { codebook.with_zero() } else { codebook };
        let entries = palette.entries.len() / rest;
        let mut pixels: Vec<u8> = palette.entries.iter().map(|v| codebook.index(*v)).collect();
        let rows = entries.div_ceil(ENTRIES_PER_ROW);
        pixels.resize(rows * ENTRIES_PER_ROW * rest, 0);
        images.push(("shN_centroids.webp", ENTRIES_PER_ROW * rest / 3, rows, 3, pixels));
        let mut labels: Vec<u8> = palette
            .labels
            .iter()
            .flat_map(|label| {
                let [low, high] = label.to_le_bytes();
                [low, high, 0]
            })
            .collect();
        labels.resize(columns * image_rows * 3, 0);
        images.push(("shN_labels.webp", columns, image_rows, 3, labels));
        meta["shN"] = json!({
            "count": entries,
            "bands": degree,
            "codebook": codebook.0.map(with_f32_digits)[..],
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    let mut files: Files = images
        .into_par_iter()
        .map(|(name, width, height, channels, pixels)| Ok((name, webp(&pixels, width, height, channels)?)))
        .collect::<io::Result<_>>()?;
    // Last, so that a folder with it is complete.
    files.push((META_FILE, serde_json::to_vec(&meta).map_err(io::Error::other)?));
    Ok(files)
}

/// `value` rounded to a multiple of `2^bits`, at most `max`: the lowest bits are zero, and take no bytes.
fn round_to_multiple(value: f64, bits: u32, max: u32) -> u32 {
    let step = f64::from(1u32 << bits);
    let value = ((value / step).round() * step).max(0.0) as u32;
    value.min(max >> bits << bits)
}

/// An image in lossless WebP, the smaller of two encodings: differences from neighbours suit smooth images, plain values suit indices.
fn webp(pixels: &[u8], width: usize, height: usize, channels: usize) -> io::Result<Vec<u8>> {
    let color = if channels == 4 {
        ColorType::Rgba8
    } else {
        ColorType::Rgb8
    };
    let encode = |use_predictor: bool| {
        let mut bytes = Vec::new();
        let mut encoder = WebPEncoder::new(&mut bytes);
        let mut params = EncoderParams::default();
        params.use_predictor_transform = use_predictor;
        encoder.set_params(params);
        match encoder.encode(pixels, width as u32, height as u32, color) {
            Ok(()) => Ok(bytes),
            Err(error) => Err(io::Error::other(format!("{width}x{height} pixels: {error}"))),
        }
    };
    let (plain, predicted) = rayon::join(|| encode(false), || encode(true));
    let (plain, predicted) = (plain?, predicted?);
    Ok(if predicted.len() < plain.len() {
        predicted
    } else {
        plain
    })
}
