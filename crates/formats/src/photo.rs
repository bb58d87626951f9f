use crate::DEFAULT_MAX_SIDE;
use crate::image_file::{decode, decode_jpeg_scaled, decode_mask, read_header};
use crate::undistort::Undistortion;
use crate::valid_region::ValidRegion;
use crate::{FormatError, Pixels};
use image::metadata::Orientation;
use irradia_scene::{LoadError, Part, Photo, PhotoSource, resize_area, resize_part};
use std::path::{Path, PathBuf};

/// Minimum mask value of pixels that are included in training.
const MASK_THRESHOLD: u8 = 128;

/// Sets the pixels of a mask to 255, included in training, or 0.
pub(crate) fn binarize(mask: &mut [u8]) {
    mask.iter_mut()
        .for_each(|v| *v = if *v >= MASK_THRESHOLD { 255 } else { 0 });
}

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
    pub upright_size: (u32, u32),
    pub undistortion: Option<Undistortion>,
    /// The usable part of a photograph that is not undistorted; `None` if all of it is usable.
    pub valid_region: Option<ValidRegion>,
    /// Size of the resulting photograph.
    pub size: (u32, u32),
    /// Whether alpha counts even if all of it is opaque, as in rendered scenes. Otherwise such a photograph is one without alpha: programs
    /// that write screenshots and frames add the channel without a meaning.
    pub keeps_alpha: bool,
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
        let pixels = self.upright_size.0 as usize * self.upright_size.1 as usize / (divisor * divisor);
        // The file, the decoded pixels with their planes, and the undistorted pixels.
        10 * pixels
    }
}

impl PhotoFile {
    /// The divisor of both sides at which the file is decoded for a photograph of `size`: more than 1 only for JPEG above
    /// [`DEFAULT_MAX_SIDE`], to save time. It depends on sizes alone.
    fn divisor(&self, size: (u32, u32)) -> u32 {
        if !self.jpeg || self.upright_size.0.max(self.upright_size.1) <= DEFAULT_MAX_SIDE {
            return 1;
        }
        let (width, height) = self.undistortion.map_or(self.upright_size, |plan| {
            let pinhole = plan.pinhole();
            (pinhole.width, pinhole.height)
        });
        let wraps = self.undistortion.is_some_and(|plan| plan.wraps());
        let keeps_seam = |divisor: &u32| !wraps || self.upright_size.0.is_multiple_of(*divisor);
        let is_sufficient =
            |divisor: &u32| keeps_seam(divisor) && width / divisor >= size.0 && height / divisor >= size.1;
        [8, 4, 2].into_iter().find(is_sufficient).unwrap_or(1)
    }

    /// The photograph at `size`.
    fn read(&self, size: (u32, u32)) -> Result<Photo, FormatError> {
        let divisor = self.divisor(size);
        let pixels = if divisor == 1 {
            decode(&self.image, self.orientation)?
        } else {
            decode_jpeg_scaled(&self.image, divisor, self.orientation)?
        };
        let (width, height) = self.upright_size;
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
        let pixels = if !self.keeps_alpha && pixels.has_opaque_alpha() {
            pixels.without_alpha()
        } else {
            pixels
        };
        let pixels = self.undistort_and_resize(pixels, self.part(divisor), size);
        let mut mask = self
            .mask
            .as_deref()
            .map(|path| self.read_mask(path, size))
            .transpose()?;
        if let Some(region) = &self.valid_region {
            region.restrict_mask(size.0, size.1, &mut mask);
        }
        Ok(Photo {
            width: pixels.width,
            height: pixels.height,
            channels: pixels.channels,
            data: pixels.data,
            mask,
        })
    }

    /// Where the photograph lies in the file decoded at 1 / `divisor` of its size: if the divisor does not divide the sides, pixels at
    /// the right and the lower edge of the file lie partly beyond the photograph.
    fn part(&self, divisor: u32) -> Part {
        let size = [self.upright_size.0, self.upright_size.1].map(|side| f64::from(side) / f64::from(divisor));
        let padding = size.map(|side| side.ceil() - side);
        use Orientation::{FlipHorizontal, FlipVertical, Rotate90, Rotate180, Rotate270, Rotate270FlipH};
        let flipped = [
            matches!(self.orientation, Rotate90 | Rotate180 | FlipHorizontal | Rotate270FlipH),
            matches!(self.orientation, Rotate180 | Rotate270 | FlipVertical | Rotate270FlipH),
        ];
        let start = [0, 1].map(|axis| if flipped[axis] { padding[axis] } else { 0.0 });
        Part { start, size }
    }

    fn undistort_and_resize(&self, mut pixels: Pixels, mut part: Part, size: (u32, u32)) -> Pixels {
        if let Some(undistortion) = &self.undistortion {
            pixels = undistortion.apply_to_part(&pixels, part);
            part = Part::whole([pixels.width, pixels.height]);
        }
        let to = [size.0, size.1];
        if part != Part::whole(to) {
            let from = [pixels.width, pixels.height];
            pixels.data = resize_part(&pixels.data, pixels.channels, from, part, to);
            [pixels.width, pixels.height] = to;
        }
        pixels
    }

    fn read_mask(&self, path: &Path, size: (u32, u32)) -> Result<Vec<u8>, FormatError> {
        let orientation = read_header(path)?.orientation_from_photo(self.orientation, self.upright_size);
        let mut mask = decode_mask(path, orientation)?;
        let upright = [self.upright_size.0, self.upright_size.1];
        if [mask.width, mask.height] != upright {
            mask.data = resize_area(&mask.data, mask.channels, [mask.width, mask.height], upright);
            [mask.width, mask.height] = upright;
        }
        let mut mask = self.undistort_and_resize(mask, Part::whole(upright), size).data;
        binarize(&mut mask);
        Ok(mask)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::write_png;
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
                upright_size: (2000, 1400),
                undistortion,
                valid_region: None,
                size: (960, 672),
                keeps_alpha: false,
            };
            let (file, whole) = (photo(true), photo(false));
            assert!([(960, 672), (480, 336), (240, 168)].map(|size| file.divisor(size)) == [2, 4, 8]);
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

    #[test]
    fn sides_that_no_fraction_divides_keep_their_pixels_in_place_in_every_orientation() {
        use Orientation::*;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("odd.jpg");
        let (stored_width, stored_height) = (2003, 1389);
        let wave = |v: u32, length: f32| (127.0 + 100.0 * (v as f32 / length).sin()) as u8;
        let color = |x, y| image::Rgb([wave(x, 25.0), wave(y, 30.0), wave(x + y, 50.0)]);
        image::RgbImage::from_fn(stored_width, stored_height, color)
            .save(&path)
            .unwrap();
        for orientation in [
            NoTransforms,
            Rotate90,
            Rotate180,
            Rotate270,
            FlipHorizontal,
            FlipVertical,
            Rotate90FlipH,
            Rotate270FlipH,
        ] {
            let turned = matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH);
            let upright = if turned {
                (stored_height, stored_width)
            } else {
                (stored_width, stored_height)
            };
            let bent = Intrinsics {
                lens: Lens::Opencv {
                    k: [0.05, 0.0, 0.0, 0.0, 0.0, 0.0],
                    p: [0.0; 2],
                },
                ..Intrinsics::from_fov_x(upright.0, upright.1, 1.0)
            };
            for undistortion in [None, Undistortion::plan(&bent)] {
                let photo = |jpeg: bool| PhotoFile {
                    image: path.clone(),
                    mask: None,
                    orientation,
                    jpeg,
                    upright_size: upright,
                    undistortion,
                    valid_region: None,
                    size: (upright.0 / 9, upright.1 / 9),
                    keeps_alpha: false,
                };
                let (file, whole) = (photo(true), photo(false));
                assert_eq!((file.divisor(file.size), whole.divisor(whole.size)), (8, 1));
                let [a, b] = [&file, &whole].map(|photo| photo.load().unwrap());
                let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b));
                let mean = a.data.iter().zip(&b.data).map(off).sum::<f64>() / a.data.len() as f64;
                // With the partial pixels on the wrong side, they would differ by 10.
                assert!(mean < 1.5, "{orientation:?}: {mean}");
            }
        }
    }

    #[test]
    fn opaque_alpha_counts_only_in_rendered_scenes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let channels = |alpha: u8, keeps_alpha: bool| {
            write_png(&path, 2, 1, 4, &[9, 8, 7, 255, 6, 5, 4, alpha]).unwrap();
            let photo = PhotoFile {
                image: path.clone(),
                mask: None,
                orientation: Orientation::NoTransforms,
                jpeg: false,
                upright_size: (2, 1),
                undistortion: None,
                valid_region: None,
                size: (2, 1),
                keeps_alpha,
            };
            let photo = photo.load().unwrap();
            (photo.channels, photo.data)
        };
        assert_eq!(channels(255, false), (3, vec![9, 8, 7, 6, 5, 4]));
        assert_eq!((channels(255, true).0, channels(254, false).0), (4, 4));
    }
}
