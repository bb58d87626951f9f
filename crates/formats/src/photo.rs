use crate::DEFAULT_MAX_SIDE;
use crate::image_file::{Colour, decode, decode_jpeg_at, read_header};
use crate::undistort::Undistortion;
use crate::{FormatError, Pixels};
use image::metadata::Orientation;
use irradia_scene::{LoadError, Photo, PhotoSource, resize_area};
use std::path::{Path, PathBuf};

/// Mask values from here on include the pixel in training.
const MASK_THRESHOLD: u8 = 128;

/// A photograph on disk with the operations to apply when it is loaded.
#[derive(Clone, Debug)]
pub(crate) struct PhotoFile {
    pub image: PathBuf,
    pub mask: Option<PathBuf>,
    /// Applied first; [`Orientation::NoTransforms`] when the poses belong to the pixels as stored.
    pub orientation: Orientation,
    /// Whether `image` is a JPEG.
    pub jpeg: bool,
    /// Size after orientation, from the header when the dataset was read.
    pub upright: (u32, u32),
    pub undistortion: Option<Undistortion>,
    /// Size of the resulting photograph.
    pub size: (u32, u32),
}

impl PhotoSource for PhotoFile {
    fn load(&self) -> Result<Photo, LoadError> {
        self.read(self.size).map_err(|error| LoadError(error.to_string()))
    }

    fn load_at(&self, width: u32, height: u32) -> Result<Photo, LoadError> {
        if self.is_shrunk_from_full(width, height) {
            return Ok(self.load()?.resized(width, height));
        }
        self.read((width, height)).map_err(|error| LoadError(error.to_string()))
    }

    fn is_shrunk_from_full(&self, width: u32, height: u32) -> bool {
        self.divisor((width, height)) == self.divisor(self.size)
    }

    fn working_bytes(&self) -> usize {
        let divisor = self.divisor(self.size) as usize;
        let pixels = self.upright.0 as usize * self.upright.1 as usize / (divisor * divisor);
        // The file, the pixels as decoded with their planes, and undistorted.
        10 * pixels
    }
}

impl PhotoFile {
    /// The fraction of its size, as a divisor of both sides, at which the file is decoded for a photograph of `size`: more than 1 only
    /// for JPEG above [`DEFAULT_MAX_SIDE`], so that it takes less time. It depends on sizes alone.
    fn divisor(&self, size: (u32, u32)) -> u32 {
        if !self.jpeg || self.upright.0.max(self.upright.1) <= DEFAULT_MAX_SIDE {
            return 1;
        }
        let (width, height) = self.undistortion.map_or(self.upright, |plan| {
            let pinhole = plan.pinhole();
            (pinhole.width, pinhole.height)
        });
        let is_whole = |divisor: u32| self.upright.0.is_multiple_of(divisor) && self.upright.1.is_multiple_of(divisor);
        let suffices = |divisor: &u32| is_whole(*divisor) && width / divisor >= size.0 && height / divisor >= size.1;
        [8, 4, 2].into_iter().find(suffices).unwrap_or(1)
    }

    /// The photograph at `size`.
    fn read(&self, size: (u32, u32)) -> Result<Photo, FormatError> {
        let divisor = self.divisor(size);
        let pixels = if divisor == 1 {
            decode(&self.image, self.orientation, Colour::Keep)?
        } else {
            decode_jpeg_at(&self.image, divisor, self.orientation)?
        };
        let (width, height) = self.upright;
        if (pixels.width, pixels.height) != (width.div_ceil(divisor), height.div_ceil(divisor)) {
            return Err(FormatError::malformed(
                &self.image,
                format!(
                    "is now {}x{}, but was {width}x{height} when the dataset was read; start again",
                    pixels.width * divisor,
                    pixels.height * divisor
                ),
            ));
        }
        let pixels = self.bring_to_size(pixels, size);
        let mask = self
            .mask
            .as_deref()
            .map(|path| self.read_mask(path, size))
            .transpose()?;
        Ok(Photo {
            width: pixels.width,
            height: pixels.height,
            channels: pixels.channels,
            data: pixels.data,
            mask,
        })
    }

    fn bring_to_size(&self, mut pixels: Pixels, size: (u32, u32)) -> Pixels {
        if let Some(undistortion) = &self.undistortion {
            pixels = undistortion.apply(&pixels);
        }
        if (pixels.width, pixels.height) != size {
            pixels = resized(pixels, size);
        }
        pixels
    }

    fn read_mask(&self, path: &Path, size: (u32, u32)) -> Result<Vec<u8>, FormatError> {
        let orientation = read_header(path)?.turned_with(self.orientation, self.upright);
        let mut mask = decode(path, orientation, Colour::Grey)?;
        if (mask.width, mask.height) != self.upright {
            mask = resized(mask, self.upright);
        }
        let mut mask = self.bring_to_size(mask, size).data;
        mask.iter_mut()
            .for_each(|v| *v = if *v >= MASK_THRESHOLD { 255 } else { 0 });
        Ok(mask)
    }
}

fn resized(from: Pixels, (width, height): (u32, u32)) -> Pixels {
    Pixels {
        width,
        height,
        channels: from.channels,
        data: resize_area(&from.data, from.channels, [from.width, from.height], [width, height]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Intrinsics, Lens};

    #[test]
    fn a_large_jpeg_is_decoded_at_a_fraction_of_its_size_and_looks_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("large.jpg");
        let wave = |v: u32, length: f32| (127.0 + 100.0 * (v as f32 / length).sin()) as u8;
        let color = |x, y| image::Rgb([wave(x, 60.0), wave(y, 90.0), wave(x + y, 150.0)]);
        image::RgbImage::from_fn(2000, 1400, color).save(&path).unwrap();
        let bent = Intrinsics {
            lens: Lens::Opencv {
                k: [0.05, 0.0, 0.0, 0.0, 0.0, 0.0],
                p: [0.0; 2],
            },
            ..Intrinsics::from_fov_x(2000, 1400, 1.0)
        };
        for undistortion in [None, Undistortion::plan(&bent)] {
            let photo = |jpeg: bool| PhotoFile {
                image: path.clone(),
                mask: None,
                orientation: Orientation::NoTransforms,
                jpeg,
                upright: (2000, 1400),
                undistortion,
                size: (960, 672),
            };
            let (file, whole) = (photo(true), photo(false));
            assert!([(960, 672), (480, 336), (240, 168)].map(|size| file.divisor(size)) == [2, 4, 8]);
            let odd = PhotoFile {
                upright: (2001, 1400),
                ..file.clone()
            };
            assert_eq!(odd.divisor((240, 168)), 1);
            assert!(whole.divisor((240, 168)) == 1 && whole.is_shrunk_from_full(240, 168));
            assert!(!file.is_shrunk_from_full(480, 336) && file.is_shrunk_from_full(900, 630));
            for (width, height) in [(960, 672), (480, 336), (240, 168), (900, 630)] {
                let [a, b] = [&file, &whole].map(|photo| photo.load_at(width, height).unwrap());
                assert_eq!((a.width, a.height), (width, height));
                let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b));
                let mean = a.data.iter().zip(&b.data).map(off).sum::<f64>() / a.data.len() as f64;
                // A shift by half a pixel of the coarsest would be 2 to 3.
                assert!(mean < 1.0, "{width}x{height}: {mean}");
            }
        }
    }
}
