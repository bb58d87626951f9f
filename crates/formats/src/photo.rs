use crate::image_file::{Colour, decode, read_header};
use crate::undistort::Undistortion;
use crate::{FormatError, Pixels};
use image::metadata::Orientation;
use irradia_scene::{LoadError, Photo, PhotoSource, resize_area};
use std::path::{Path, PathBuf};

/// A mask's pixel counts as "train on this" from here up.
const MASK_THRESHOLD: u8 = 128;

/// A photograph on disk with all that must be done to it when it is loaded.
#[derive(Clone, Debug)]
pub(crate) struct PhotoFile {
    pub image: PathBuf,
    pub mask: Option<PathBuf>,
    /// What to do first; [`Orientation::NoTransforms`] when the poses belong to the pixels as stored.
    pub orientation: Orientation,
    /// Size after turning: what the header said when the dataset was read.
    pub turned: (u32, u32),
    pub undistortion: Option<Undistortion>,
    /// Size of the photograph that comes out.
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
        if (pixels.width, pixels.height) != self.turned {
            return Err(FormatError::malformed(
                &self.image,
                format!(
                    "is now {}x{} and was {}x{} when the dataset was read; start again",
                    pixels.width, pixels.height, self.turned.0, self.turned.1
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
        // Masks are made from the pixels as some tool saw them and rarely carry EXIF themselves: one whose shape is
        // that of the stored photograph is turned with it.
        let header = read_header(path)?;
        let lies_as_turned = (header.width > header.height) == (self.turned.0 > self.turned.1);
        let orientation = if lies_as_turned {
            Orientation::NoTransforms
        } else {
            self.orientation
        };
        let mut mask = decode(path, orientation, Colour::Grey)?;
        if (mask.width, mask.height) != self.turned {
            mask = resized(mask, self.turned);
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
