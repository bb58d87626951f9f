use crate::{Camera, PointCloud, resize_area};
use std::sync::Arc;

/// Why a photograph could not be loaded: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct LoadError(pub String);

/// A photograph as 8-bit pixels, undistorted, at the size its view's camera has.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// 3 (sRGB) or 4 (sRGB and straight alpha).
    pub channels: u32,
    /// `[H, W, channels]`.
    pub data: Vec<u8>,
    /// `[H, W]`, 0 where the pixel must not be trained on, 255 where it may.
    pub mask: Option<Vec<u8>>,
}

impl Photo {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.data.len() + self.mask.as_ref().map_or(0, Vec::len)
    }

    /// The same photograph at `width` x `height`, averaged over area; a mask counts a pixel that is kept by half or more.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let (from, to) = ([self.width, self.height], [width, height]);
        Self {
            width,
            height,
            channels: self.channels,
            data: resize_area(&self.data, self.channels, from, to),
            mask: self.mask.as_ref().map(|mask| {
                let mean = resize_area(mask, 1, from, to);
                mean.into_iter().map(|v| if v >= 128 { 255 } else { 0 }).collect()
            }),
        }
    }

    /// `[H, W, 3]` laid over `background` (sRGB in \[0, 1\]), as 8 bits.
    pub fn over(&self, background: [f32; 3]) -> Vec<u8> {
        if self.channels == 3 {
            return self.data.clone();
        }
        let pixel = |p: &[u8]| -> [u8; 3] {
            let alpha = f32::from(p[3]) / 255.0;
            std::array::from_fn(|c| (f32::from(p[c]) * alpha + 255.0 * background[c] * (1.0 - alpha)).round() as u8)
        };
        self.data.chunks_exact(4).flat_map(pixel).collect()
    }

    /// `[H, W]`, where there is an alpha channel.
    pub fn alpha(&self) -> Option<Vec<u8>> {
        (self.channels == 4).then(|| self.data.iter().skip(3).step_by(4).copied().collect())
    }
}

/// Something that can produce a view's photograph again and again: a file, or pixels in memory.
pub trait PhotoSource: Send + Sync {
    /// Decodes, undistorts, crops and resizes. Called from several threads.
    ///
    /// # Errors
    /// One line that names the file and says what to do.
    fn load(&self) -> Result<Photo, LoadError>;
}

impl PhotoSource for Photo {
    fn load(&self) -> Result<Photo, LoadError> {
        Ok(self.clone())
    }
}

/// One posed photograph.
#[derive(Clone)]
pub struct View {
    /// Name within the dataset, relative and with forward slashes, such as `images/0001.jpg`.
    pub name: String,
    /// The undistorted camera at the size [`PhotoSource::load`] returns.
    pub camera: Camera,
    /// The pixels, loaded when needed.
    pub photo: Arc<dyn PhotoSource>,
    /// How near and how far this view's scene lies along +Z, world units, where the source says so.
    pub depth_bounds: Option<[f32; 2]>,
    /// When it was taken, in the source's own unit (0 to 1 over the capture where transforms.json follows D-NeRF); `None`
    /// where the source does not say.
    pub time: Option<f32>,
    /// Indices into [`Dataset::points`] of the points this view is known to see; empty where the source does not say.
    pub points_seen: Vec<u32>,
}

/// Posed photographs of one scene.
#[derive(Clone, Default)]
pub struct Dataset {
    /// All views, sorted by name.
    pub views: Vec<View>,
    /// Indices of the views to train on.
    pub train: Vec<usize>,
    /// Indices of the held-out views.
    pub test: Vec<usize>,
    /// Points to start from, where the dataset has some.
    pub points: Option<PointCloud>,
    /// What kind of dataset it is, for people: `COLMAP (text)`, `Blender`, ..
    pub kind: String,
    /// One line each about what was left out or assumed; the reader does not print.
    pub warnings: Vec<String>,
}

/// The held-out rule of the field: of `count` views in name order every 8th is held out (`index % 8 == 0`).
///
/// Returns `(train, test)`.
pub fn every_eighth(count: usize) -> (Vec<usize>, Vec<usize>) {
    (0..count).partition(|index| !index.is_multiple_of(8))
}
