use super::{ENTRIES_PER_ROW, LARGEST_W, META_FILE};
use crate::splats::quantize::{from_smallest_three, logits_of_bytes};
use crate::splats::rows::{decode_splats, plausible_count};
use crate::{FormatError, Malformed, zip};
use image_webp::WebPDecoder;
use irradia_scene::{GaussianCloud, sh};
use rayon::prelude::*;
use serde::Deserialize;
use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap};
use std::io::Cursor;
use std::path::Path;

/// `meta.json` holds a few codebooks of 256 numbers.
pub(crate) const MAX_META_BYTES: usize = 1 << 20;
/// Pixels that an image may have beyond four per splat: writers round its sides up.
const SPARE_PIXELS: usize = 65_536;
/// Maximum number of entries of a palette: labels have 16 bits.
const MAX_PALETTE: usize = 65_536;

#[derive(Deserialize)]
struct Meta {
    version: Option<u32>,
    count: Option<u64>,
    #[serde(default)]
    antialias: bool,
    means: Attribute,
    scales: Attribute,
    quats: Attribute,
    sh0: Attribute,
    #[serde(rename = "shN")]
    harmonics: Option<Harmonics>,
}

/// Images of an attribute, and their codebook (version 2) or bounds.
#[derive(Deserialize)]
struct Attribute {
    #[serde(default)]
    shape: Vec<u64>,
    #[serde(default)]
    codebook: Vec<f32>,
    #[serde(default)]
    mins: Vec<f32>,
    #[serde(default)]
    maxs: Vec<f32>,
    files: Vec<String>,
}

/// The palette of the coefficients above DC.
#[derive(Deserialize)]
struct Harmonics {
    #[serde(default)]
    bands: u32,
    #[serde(default)]
    codebook: Vec<f32>,
    mins: Option<f32>,
    maxs: Option<f32>,
    files: Vec<String>,
}

/// Parses a `.sog` archive.
///
/// # Errors
/// When it is not a zip archive, an image is missing, damaged or of the wrong size, or an index is out of range.
pub fn parse_zip(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    let files = zip::files(bytes)?;
    // Some tools put a folder around the files. Of several scenes, such as levels of detail, the one with the shortest path is read, the
    // first by name if there are more.
    let is_meta = |name: &&String| {
        name.strip_suffix(META_FILE)
            .is_some_and(|rest| rest.is_empty() || rest.ends_with('/'))
    };
    let meta = files.keys().filter(is_meta).min_by_key(|name| name.len());
    let meta = meta.ok_or_else(|| Malformed(format!("the archive contains no {META_FILE}; it is not a SOG scene")))?;
    let folder = &meta[..meta.len() - META_FILE.len()];
    let max_bytes = bytes.len().saturating_mul(64).max(1 << 20);
    let get = |name: &str| -> Result<Cow<[u8]>, Malformed> {
        let entry = files.get(&format!("{folder}{name}"));
        let entry = entry.ok_or_else(|| Malformed(format!("the archive contains no {}", zip::printable(name))))?;
        let content = entry.content(if name == META_FILE { MAX_META_BYTES } else { max_bytes });
        content.map_err(|error| Malformed(format!("{}: {error}", zip::printable(name))))
    };
    parse(&get)
}

/// Reads a scene from the folder of `meta`, its `meta.json`.
pub(crate) fn read_folder(meta: &Path) -> Result<GaussianCloud, FormatError> {
    let folder = meta.parent().unwrap_or(Path::new(""));
    let mut unreadable = None;
    let mut contents = HashMap::new();
    let text = crate::error::read_file(meta)?;
    let mut read_all = || -> Result<(), Malformed> {
        for name in file_names(&parse_meta(&text)?) {
            // A file may only refer to files in its folder.
            if name.contains(['/', '\\', ':']) || name.starts_with("..") {
                return Err(Malformed(format!(
                    "refers to the image {}, which is not a file beside it",
                    zip::printable(name)
                )));
            }
            match crate::error::read_file(&folder.join(name)) {
                Ok(bytes) => drop(contents.insert(name.to_owned(), bytes)),
                Err(error) => {
                    unreadable = Some(error);
                    break;
                }
            }
        }
        Ok(())
    };
    let result = read_all();
    if let Some(error) = unreadable {
        return Err(error);
    }
    let parsed = result.and_then(|()| {
        parse(&|name| match name {
            META_FILE => Ok(Cow::Borrowed(&text)),
            _ => Ok(Cow::Borrowed(&contents[name])),
        })
    });
    parsed.map_err(|source| FormatError::Malformed {
        path: meta.to_owned(),
        source,
    })
}

fn parse_meta(text: &[u8]) -> Result<Meta, Malformed> {
    let meta: Meta = serde_json::from_slice(text)
        .map_err(|error| Malformed(format!("{META_FILE} is not that of a SOG scene: {error}")))?;
    match meta.version {
        None | Some(1 | 2) => Ok(meta),
        Some(version) => Err(Malformed(format!(
            "SOG version {version} is not known; expected 1 or 2"
        ))),
    }
}

/// The names of the images in the `meta.json` with this text.
pub(crate) fn image_names(text: &[u8]) -> Result<BTreeSet<String>, Malformed> {
    Ok(file_names(&parse_meta(text)?).cloned().collect())
}

/// Whether `text` is the `meta.json` of a scene of any version.
pub(crate) fn is_meta(text: &[u8]) -> bool {
    serde_json::from_slice::<Meta>(text).is_ok()
}

fn file_names(meta: &Meta) -> impl Iterator<Item = &String> {
    let attributes = [&meta.means, &meta.scales, &meta.quats, &meta.sh0].into_iter();
    let files = attributes.map(|attribute| &attribute.files);
    files
        .chain(meta.harmonics.as_ref().map(|harmonics| &harmonics.files))
        .flatten()
}

type ReadFile<'a> = &'a dyn Fn(&str) -> Result<Cow<'a, [u8]>, Malformed>;

/// The scene whose files `get` provides.
fn parse(get: ReadFile) -> Result<GaussianCloud, Malformed> {
    let meta = parse_meta(&get(META_FILE)?)?;
    let names = [
        ("means", &meta.means.files, 2),
        ("scales", &meta.scales.files, 1),
        ("quats", &meta.quats.files, 1),
        ("sh0", &meta.sh0.files, 1),
    ];
    let mut files: Vec<(String, Cow<[u8]>)> = Vec::new();
    let mut fetch = |attribute: &str, names: &[String], count: usize| {
        if names.len() < count {
            return Err(Malformed(format!(
                "{META_FILE} names {} images for {attribute}; expected {count}",
                names.len()
            )));
        }
        for name in &names[..count] {
            files.push((name.clone(), get(name)?));
        }
        Ok(())
    };
    for (attribute, names, count) in names {
        fetch(attribute, names, count)?;
    }
    if let Some(harmonics) = &meta.harmonics {
        fetch("shN", &harmonics.files, 2)?;
    }
    let bytes = files.iter().map(|(_, content)| content.len()).sum();
    let declared = meta.count.or(meta.means.shape.first().copied());
    let declared = declared.ok_or_else(|| Malformed(format!("{META_FILE} does not say how many splats there are")))?;
    let count = plausible_count(declared, bytes)?;

    // Image 5, if there is one, is the palette; all others have a pixel per splat.
    let images: Vec<Pixels> = files
        .par_iter()
        .enumerate()
        .map(|(i, (name, content))| {
            let (min_pixels, max_pixels) = match i {
                5 => (0, 15 * MAX_PALETTE + SPARE_PIXELS),
                _ => (count, 4 * count + SPARE_PIXELS),
            };
            Pixels::decode(content, min_pixels, max_pixels)
                .map_err(|error| Malformed(format!("{}: {error}", zip::printable(name))))
        })
        .collect::<Result<_, _>>()?;
    decode(&meta, count, &images)
}

/// A decoded image.
struct Pixels {
    width: usize,
    height: usize,
    channels: usize,
    data: Vec<u8>,
}

impl Pixels {
    /// Decodes an image whose header declares between `min_pixels` and `max_pixels` pixels.
    fn decode(bytes: &[u8], min_pixels: usize, max_pixels: usize) -> Result<Self, Malformed> {
        let webp_error = |error: image_webp::DecodingError| Malformed(format!("not a usable WebP image ({error})"));
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(webp_error)?;
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        let count = width.saturating_mul(height);
        if !(min_pixels..=max_pixels).contains(&count) {
            return Err(Malformed(format!(
                "has {width}x{height} pixels, which does not match the number of splats"
            )));
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut data = vec![0; count * channels];
        decoder.read_image(&mut data).map_err(webp_error)?;
        Ok(Self {
            width,
            height,
            channels,
            data,
        })
    }

    /// The first three channels of pixel `i`.
    fn rgb(&self, i: usize) -> [u8; 3] {
        let pixel = &self.data[i * self.channels..];
        [pixel[0], pixel[1], pixel[2]]
    }

    /// The fourth channel of pixel `i`.
    fn alpha(&self, i: usize) -> u8 {
        match self.channels {
            4 => self.data[4 * i + 3],
            _ => 255,
        }
    }
}

/// The values that the bytes of a channel stand for: a table of 256.
#[derive(Clone, Copy)]
struct Table([f32; 256]);

impl Table {
    /// From a codebook; indices beyond its end are invalid.
    fn codebook(codebook: &[f32], attribute: &str) -> Result<Self, Malformed> {
        if codebook.is_empty() || codebook.len() > 256 {
            return Err(Malformed(format!(
                "{META_FILE} has a codebook of {} values for {attribute}; expected 1 to 256",
                codebook.len()
            )));
        }
        // NaN marks invalid indices.
        let mut table = [f32::NAN; 256];
        table[..codebook.len()].copy_from_slice(codebook);
        Ok(Self(table))
    }

    /// Whether some indices are beyond the end of the codebook.
    fn has_gaps(&self) -> bool {
        self.0.iter().any(|value| value.is_nan())
    }

    fn bounds(low: f32, high: f32) -> Self {
        Self(std::array::from_fn(|byte| low + (high - low) * (byte as f32 / 255.0)))
    }
}

/// Decodes the coordinates of an axis from their 16 bits.
struct PositionDecoder {
    bounds: (f32, f32),
    /// All 65,536 values if there are more splats than that, else empty: a table takes an eighth of the exponential's time.
    table: Vec<f32>,
}

impl PositionDecoder {
    fn new(bounds: (f32, f32), count: usize) -> Self {
        let mut positions = Self {
            bounds,
            table: Vec::new(),
        };
        if count > 1 << 16 {
            positions.table = (0..=u16::MAX)
                .into_par_iter()
                .map(|step| positions.decode(step))
                .collect();
        }
        positions
    }

    fn decode(&self, step: u16) -> f32 {
        if let Some(value) = self.table.get(usize::from(step)) {
            return *value;
        }
        let (from, to) = self.bounds;
        let logarithm = from + (to - from) * (f32::from(step) / 65535.0);
        logarithm.abs().exp_m1().copysign(logarithm)
    }
}

/// A table for each channel of an attribute.
fn tables<const N: usize>(attribute: &Attribute, name: &str, is_version_2: bool) -> Result<[Table; N], Malformed> {
    if is_version_2 {
        return Ok([Table::codebook(&attribute.codebook, name)?; N]);
    }
    Ok(bounds(&attribute.mins, &attribute.maxs, name)?.map(|(low, high)| Table::bounds(low, high)))
}

/// Bounds of the channels of an attribute.
fn bounds<const N: usize>(mins: &[f32], maxs: &[f32], attribute: &str) -> Result<[(f32, f32); N], Malformed> {
    match (mins.first_chunk::<N>(), maxs.first_chunk::<N>()) {
        (Some(mins), Some(maxs)) => Ok(std::array::from_fn(|c| (mins[c], maxs[c]))),
        _ => Err(Malformed(format!("{META_FILE} lacks the {N} bounds of {attribute}"))),
    }
}

fn decode(meta: &Meta, count: usize, images: &[Pixels]) -> Result<GaussianCloud, Malformed> {
    let [low_bytes, high_bytes, scales, quats, colors, ..] = images else {
        unreachable!("five images are fetched");
    };
    let mean_bounds: [(f32, f32); 3] = bounds(&meta.means.mins, &meta.means.maxs, "means")?;
    let is_version_2 = meta.version == Some(2);
    let scale_tables: [Table; 3] = tables(&meta.scales, "scales", is_version_2)?;
    let mut color_tables: [Table; 4] = tables(&meta.sh0, "sh0", is_version_2)?;
    if is_version_2 {
        color_tables[3] = Table(logits_of_bytes());
    }

    let palette = match (&meta.harmonics, images) {
        (Some(harmonics), [.., palette, labels]) if images.len() == 7 => {
            Palette::decode(harmonics, is_version_2, palette, labels, count)?
        }
        _ => None,
    };
    let degree = palette.as_ref().map_or(0, |palette| palette.degree);
    let positions = mean_bounds.map(|bounds| PositionDecoder::new(bounds, count));
    let mut cloud = decode_splats(count, degree, |i, splat| {
        let (low, high) = (low_bytes.rgb(i), high_bytes.rgb(i));
        let (scale, color) = (scales.rgb(i), colors.rgb(i));
        for c in 0..3 {
            splat.mean[c] = positions[c].decode(u16::from_le_bytes([low[c], high[c]]));
            splat.log_scale[c] = scale_tables[c].0[usize::from(scale[c])];
            splat.sh[c] = color_tables[c].0[usize::from(color[c])];
        }
        *splat.opacity_logit = color_tables[3].0[usize::from(colors.alpha(i))];
        let component = |byte: u8| (f32::from(byte) / 255.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2;
        *splat.quat = match quats.alpha(i).checked_sub(LARGEST_W) {
            Some(largest) => from_smallest_three(largest.into(), quats.rgb(i).map(component)),
            None => [1.0, 0.0, 0.0, 0.0],
        };
        if let Some(palette) = &palette {
            splat.sh[3..].copy_from_slice(palette.entry(i));
        }
    });
    cloud.antialiased = meta.antialias;
    // Only a codebook of fewer than 256 values has invalid indices.
    let has_gaps = [&scale_tables[0], &color_tables[0]].into_iter().any(Table::has_gaps)
        || palette.as_ref().is_some_and(|palette| palette.has_gaps);
    let in_range = |value: &f32| !value.is_nan();
    if has_gaps && !(cloud.log_scales.as_flattened().iter().all(in_range) && cloud.sh.iter().all(in_range)) {
        return Err(Malformed(
            "an index of its images is beyond the end of the codebook; the file is damaged".into(),
        ));
    }
    Ok(cloud)
}

/// The coefficients above DC.
struct Palette<'a> {
    degree: u32,
    /// Entry after entry, in the order of [`GaussianCloud::sh`].
    values: Vec<f32>,
    /// Whether an index may be beyond the end of the codebook.
    has_gaps: bool,
    labels: &'a Pixels,
}

impl<'a> Palette<'a> {
    fn decode(
        harmonics: &Harmonics,
        is_version_2: bool,
        image: &Pixels,
        labels: &'a Pixels,
        count: usize,
    ) -> Result<Option<Self>, Malformed> {
        let degree = if is_version_2 {
            harmonics.bands
        } else {
            // Version 1 gives it by the width of the image.
            (1..=3)
                .find(|degree| ENTRIES_PER_ROW * (sh::coefficients(*degree) - 1) == image.width)
                .unwrap_or(9)
        };
        if degree == 0 {
            return Ok(None);
        }
        let coefficients = sh::coefficients(degree.min(3)) - 1;
        if degree > 3 || image.width != ENTRIES_PER_ROW * coefficients {
            return Err(Malformed(format!(
                "its palette is {} pixels wide, which does not fit harmonics of degree {degree}",
                image.width
            )));
        }
        let table = match (is_version_2, harmonics.mins, harmonics.maxs) {
            (true, ..) => Table::codebook(&harmonics.codebook, "shN")?,
            (false, Some(low), Some(high)) => Table::bounds(low, high),
            _ => return Err(Malformed(format!("{META_FILE} lacks the bounds of shN"))),
        };
        let entries = ENTRIES_PER_ROW * image.height;
        let max_label = (0..count).into_par_iter().map(|i| label(labels, i)).max().unwrap_or(0);
        if count > 0 && max_label >= entries {
            return Err(Malformed(format!(
                "a label of its harmonics is {max_label}, and the palette has {entries} entries; the file is damaged"
            )));
        }
        // The image holds the entries one after another, a pixel per coefficient.
        let pixels = entries * coefficients;
        let values = (0..pixels)
            .flat_map(|i| image.rgb(i))
            .map(|byte| table.0[usize::from(byte)]);
        Ok(Some(Self {
            degree,
            values: values.collect(),
            has_gaps: table.has_gaps(),
            labels,
        }))
    }

    fn entry(&self, i: usize) -> &[f32] {
        let width = 3 * (sh::coefficients(self.degree) - 1);
        &self.values[label(self.labels, i) * width..][..width]
    }
}

fn label(labels: &Pixels, i: usize) -> usize {
    let [low, high, _] = labels.rgb(i);
    usize::from(u16::from_le_bytes([low, high]))
}
