use crate::image_file::{Colour, decode, read_header};
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
    /// Size after orientation, from the header when the dataset was read.
    pub upright: (u32, u32),
    pub undistortion: Option<Undistortion>,
    /// Size of the resulting photograph.
    pub size: (u32, u32),
}

impl PhotoSource for PhotoFile {
    fn load(&self) -> Result<Photo, LoadError> {
        self.read().map_err(|error| LoadError(error.to_string()))
    }
}

impl PhotoFile {
    fn read(&self) -> Result<Photo, FormatError> {
        let pixels = decode(&self.image, self.orientation, Colour::Keep)?;
        if (pixels.width, pixels.height) != self.upright {
            return Err(FormatError::malformed(
                &self.image,
                format!(
                    "is now {}x{}, but was {}x{} when the dataset was read; start again",
                    pixels.width, pixels.height, self.upright.0, self.upright.1
                ),
            ));
        }
        let pixels = self.bring_to_size(pixels);
        let mask = self.mask.as_deref().map(|path| self.read_mask(path)).transpose()?;
        Ok(Photo {
            width: pixels.width,
            height: pixels.height,
            channels: pixels.channels,
            data: pixels.data,
            mask,
        })
    }

    fn bring_to_size(&self, mut pixels: Pixels) -> Pixels {
        if let Some(undistortion) = &self.undistortion {
            pixels = undistortion.apply(&pixels);
        }
        if (pixels.width, pixels.height) != self.size {
            pixels = resized(pixels, self.size);
        }
        pixels
    }

    fn read_mask(&self, path: &Path) -> Result<Vec<u8>, FormatError> {
        // Masks are made from the pixels as displayed by some tool and rarely have EXIF data: one with the aspect of the stored
        // photograph gets the same orientation.
        let header = read_header(path)?;
        let matches_upright = (header.width > header.height) == (self.upright.0 > self.upright.1);
        let orientation = if matches_upright {
            Orientation::NoTransforms
        } else {
            self.orientation
        };
        let mut mask = decode(path, orientation, Colour::Grey)?;
        if (mask.width, mask.height) != self.upright {
            mask = resized(mask, self.upright);
        }
        let mut mask = self.bring_to_size(mask).data;
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
