//! Full-sphere panoramas among photographs: recognised by their metadata or pixels, and cut into the faces of a cube.

use super::PhotoEntry;
use crate::faces::panorama_faces;
use crate::{FormatError, Pixels, write_atomic, write_png};
use glam::DQuat;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};
use irradia_scene::{Intrinsics, resize_area};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read};
use std::path::Path;

/// Size of the small copy by which a panorama is recognised, px.
const THUMBNAIL_SIZE: [usize; 2] = [256, 128];
/// Minimum width of a panorama, px: smaller images are thumbnails.
const MIN_WIDTH: u32 = 512;
/// Maximum difference between the width and twice the height, relative to the width: some programs are off by a few pixels (4098 x 2048).
const MAX_ASPECT_ERROR: f64 = 0.004;
/// The value of XMP's `GPano:ProjectionType` in panoramas, and the number of bytes at the beginning of a file in which it is searched.
const PROJECTION_TYPE: &[u8] = b"equirectangular";
const MAX_METADATA_BYTES: u64 = 1 << 18;
/// Maximum difference between the two ends of a row, relative to that between opposite directions. The median of 47 panoramas is 0.1;
/// photographs have about 1.
const MAX_SEAM: f64 = 0.25;
/// Maximum spread of a pole's row relative to the mean of all rows, at the pole where it is smaller.
const MAX_POLE: f64 = 0.25;
/// Minimum spread of the first column relative to the mean of all columns: the border of an image of an object on a plain background has
/// none.
const MIN_BORDER: f64 = 0.5;
/// JPEG quality of the faces.
const JPEG_QUALITY: u8 = 95;

/// A face of a panorama.
#[derive(Clone, Debug, PartialEq)]
pub struct PanoramaFace {
    /// File name: the panorama's with `_front`, `_left`, ..
    pub name: String,
    /// Its camera: a pinhole.
    pub camera: Intrinsics,
    /// Rotation from its axes to the panorama's, whose z axis points at the panorama's centre.
    pub rotation: DQuat,
}

/// Which of `photos` are full-sphere equirectangular panoramas: twice as wide as high, and either declared so by their metadata or
/// recognised by their pixels: the right edge continues at the left one, and the row of a pole shows a single direction. Pixels are
/// judged by the median of all such photographs of the same width.
pub fn find_panoramas(photos: &[PhotoEntry]) -> Vec<bool> {
    let mut measures: BTreeMap<u32, Vec<PanoramaMeasures>> = BTreeMap::new();
    let has_panorama_size = |photo: &PhotoEntry| {
        let aspect_error = f64::from(photo.width.abs_diff(2 * photo.height)) / f64::from(photo.width);
        aspect_error <= MAX_ASPECT_ERROR && photo.width >= MIN_WIDTH
    };
    let measured: Vec<Option<PanoramaMeasures>> = photos
        .par_iter()
        // Photographs that cannot be decoded are reported elsewhere.
        .map(|photo| {
            has_panorama_size(photo)
                .then(|| photo.read(THUMBNAIL_SIZE[0] as u32).ok())
                .flatten()
        })
        .map(|pixels| pixels.map(|pixels| PanoramaMeasures::of(&pixels)))
        .collect();
    for (photo, measured) in photos.iter().zip(measured) {
        measures.entry(photo.width).or_default().extend(measured);
    }
    let panorama_widths: BTreeMap<u32, bool> = (measures.iter())
        .map(|(width, measures)| (*width, PanoramaMeasures::median(measures).is_panorama()))
        .collect();
    photos
        .iter()
        .map(|photo| has_panorama_size(photo) && (panorama_widths[&photo.width] || is_declared(photo)))
        .collect()
}

/// Whether the metadata of a photograph declare the projection.
fn is_declared(photo: &PhotoEntry) -> bool {
    let mut start = Vec::new();
    let read = fs::File::open(&photo.path).and_then(|file| file.take(MAX_METADATA_BYTES).read_to_end(&mut start));
    read.is_ok()
        && start
            .windows(PROJECTION_TYPE.len())
            .any(|bytes| bytes == PROJECTION_TYPE)
}

/// Measures that distinguish a panorama from an ordinary photograph.
#[derive(Clone, Copy, Debug, Default)]
struct PanoramaMeasures {
    /// Mean difference between the first and the last column, relative to that between columns half the width apart.
    seam: f64,
    /// The smaller spread of the first and the last row, relative to the mean of all rows.
    pole: f64,
    /// Spread of the first column, relative to the mean of all columns.
    border: f64,
}

impl PanoramaMeasures {
    fn of(pixels: &Pixels) -> Self {
        let [width, height] = THUMBNAIL_SIZE;
        let channels = pixels.channels as usize;
        let to = THUMBNAIL_SIZE.map(|side| side as u32);
        let data = resize_area(&pixels.data, pixels.channels, [pixels.width, pixels.height], to);
        let at = |x: usize, y: usize| f64::from(data[(y * width + x) * channels + 1]);
        let ratio = |a: f64, b: f64| if b > 0.0 { a / b } else { f64::INFINITY };
        let column_difference = |a: usize, b: usize| (0..height).map(|y| (at(a, y) - at(b, y)).abs()).sum::<f64>();
        let opposite = (0..width / 2).map(|x| column_difference(x, x + width / 2)).sum::<f64>() / (width / 2) as f64;
        let row = |y: usize| mean_deviation(&mut (0..width).map(|x| at(x, y)));
        let column = |x: usize| mean_deviation(&mut (0..height).map(|y| at(x, y)));
        let rows = (0..height).map(row).sum::<f64>() / height as f64;
        let columns = (0..width).map(column).sum::<f64>() / width as f64;
        Self {
            seam: ratio(column_difference(0, width - 1), opposite),
            pole: ratio(row(0).min(row(height - 1)), rows),
            border: ratio(column(0), columns),
        }
    }

    fn median(all: &[Self]) -> Self {
        let median_of = |measure: fn(&Self) -> f64| {
            let mut values: Vec<f64> = all.iter().map(measure).collect();
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
        };
        Self {
            seam: median_of(|s| s.seam),
            pole: median_of(|s| s.pole),
            border: median_of(|s| s.border),
        }
    }

    fn is_panorama(&self) -> bool {
        self.seam <= MAX_SEAM && self.pole <= MAX_POLE && self.border >= MIN_BORDER
    }
}

/// Mean absolute deviation of values from their mean.
fn mean_deviation(values: &mut dyn Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    values.iter().map(|value| (value - mean).abs()).sum::<f64>() / count
}

impl PhotoEntry {
    /// Writes the faces of a panorama into the folder `images` of `folder`, which is created, and those of its mask, if it has one, into
    /// `masks`.
    ///
    /// # Errors
    /// When a file cannot be read, decoded or written.
    pub fn cut_panorama(&self, folder: &Path) -> Result<Vec<PanoramaFace>, FormatError> {
        let pixels = self.read(self.width.max(self.height))?.without_alpha();
        let mask = self.read_mask(pixels.width, pixels.height)?.map(|data| Pixels {
            channels: 1,
            data,
            ..pixels
        });
        let stem = Path::new(&self.name).file_stem().unwrap_or_default().to_string_lossy();
        let [images, masks] = ["images", "masks"].map(|name| folder.join(name));
        let mut faces = Vec::new();
        for (side, plan) in panorama_faces(pixels.width, pixels.height) {
            let name = format!("{stem}_{side}.jpg");
            write_jpeg(&images.join(&name), &plan.apply(&pixels))?;
            if let Some(mask) = &mask {
                let mask = plan.apply(mask);
                let path = masks.join(format!("{name}.png"));
                write_png(&path, mask.width, mask.height, 1, &mask.data)?;
            }
            faces.push(PanoramaFace {
                name,
                camera: plan.pinhole(),
                rotation: plan.rotation(),
            });
        }
        Ok(faces)
    }
}

fn write_jpeg(path: &Path, pixels: &Pixels) -> Result<(), FormatError> {
    write_atomic(path, |out| {
        JpegEncoder::new_with_quality(out, JPEG_QUALITY)
            .write_image(&pixels.data, pixels.width, pixels.height, ExtendedColorType::Rgb8)
            .map_err(io::Error::other)
    })
}
