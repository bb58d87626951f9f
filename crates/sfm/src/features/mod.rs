//! Features of a photograph: keypoints and their descriptors.
//!
//! [`Sift`] follows Lowe (2004) with the settings of COLMAP and VLFeat. Arithmetic is in single precision without fused operations,
//! so that every instruction set gives the same bytes.

mod descriptor;
mod extrema;
mod frontal;
mod gradients;
mod orientation;
mod scale_space;
mod sift;
mod spread;

use crate::Features;

pub use sift::Sift;

/// A greyscale photograph, 8 bits per pixel.
#[derive(Clone, Copy, Debug)]
pub struct GreyPhoto<'a> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[H, W]` grey levels.
    pub data: &'a [u8],
    /// `[H, W]`; pixels below 128 have no features.
    pub mask: Option<&'a [u8]>,
}

/// Finds the features of photographs. An extractor is serial: callers process several photographs in parallel.
pub trait Extractor: Sync {
    /// The features of `photo`, largest scale first.
    ///
    /// # Panics
    /// When the length of the pixels or of the mask is not width times height.
    fn extract(&self, photo: &GreyPhoto) -> Features;
}
