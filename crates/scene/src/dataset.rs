use crate::{Camera, PointCloud, Similarity, resize_area};
use glam::Vec3;
use std::sync::{Arc, OnceLock};

/// Why a photograph could not be loaded, in one line: what, where and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct LoadError(pub String);

/// An undistorted photograph as 8-bit pixels, at the size of its view's camera.
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
    /// `[H, W]`, 0 for pixels excluded from training, 255 for the others.
    pub mask: Option<Vec<u8>>,
}

impl Photo {
    /// Memory used, bytes.
    pub fn bytes(&self) -> usize {
        self.data.len() + self.mask.as_ref().map_or(0, Vec::len)
    }

    /// The same photograph resized to `width` x `height` by area; a mask pixel is kept where at least half of its area is.
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

    /// `[H, W, 3]` composited over `background` (sRGB in \[0, 1\]), as 8 bits.
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

    /// Indices of the outermost pixels: upper and lower row, left and right column, the corners twice; `2 * (width + height)` in all.
    pub fn border(&self) -> impl Iterator<Item = usize> {
        let (width, height) = (self.width as usize, self.height as usize);
        let rows = (0..width).flat_map(move |x| [x, (height - 1) * width + x]);
        let columns = (0..height).flat_map(move |y| [y * width, (y + 1) * width - 1]);
        rows.chain(columns)
    }

    /// The share of the outermost pixels that the mask leaves out.
    pub fn border_left_out(&self) -> f64 {
        let left_out = |mask: &Vec<u8>| self.border().filter(|at| mask[*at] == 0).count();
        self.mask.as_ref().map_or(0, left_out) as f64 / self.border().count().max(1) as f64
    }

    /// The alpha channel `[H, W]`, if any.
    pub fn alpha(&self) -> Option<Vec<u8>> {
        (self.channels == 4).then(|| self.data.iter().skip(3).step_by(4).copied().collect())
    }
}

/// A source of a view's photograph that can be loaded repeatedly: a file, or pixels in memory.
pub trait PhotoSource: Send + Sync {
    /// Decodes, undistorts, crops and resizes. Called from several threads.
    ///
    /// # Errors
    /// One line that names the file and the remedy.
    fn load(&self) -> Result<Photo, LoadError>;

    /// The photograph at `width` x `height`, which are at most those of [`Self::load`].
    ///
    /// # Errors
    /// Those of [`Self::load`].
    fn load_at(&self, width: u32, height: u32) -> Result<Photo, LoadError> {
        Ok(self.load()?.resized(width, height))
    }

    /// Whether [`Self::load_at`] returns the result of [`Self::load`] resized, so that the latter can replace the file; otherwise it
    /// decodes fewer pixels.
    fn is_shrunk_from_full(&self, _width: u32, _height: u32) -> bool {
        true
    }

    /// Memory used by [`Self::load`] beyond its result, bytes.
    fn working_bytes(&self) -> usize {
        0
    }
}

/// A photograph that stays in memory once it has been loaded.
pub struct Kept {
    source: Arc<dyn PhotoSource>,
    photo: OnceLock<Photo>,
}

impl Kept {
    /// Keeps the photograph of `source`, which is not loaded yet.
    pub fn new(source: Arc<dyn PhotoSource>) -> Self {
        Self {
            source,
            photo: OnceLock::new(),
        }
    }
}

impl PhotoSource for Kept {
    fn load(&self) -> Result<Photo, LoadError> {
        if let Some(photo) = self.photo.get() {
            return Ok(photo.clone());
        }
        let photo = self.source.load()?;
        Ok(self.photo.get_or_init(|| photo).clone())
    }

    fn load_at(&self, width: u32, height: u32) -> Result<Photo, LoadError> {
        match self.photo.get().filter(|_| self.is_shrunk_from_full(width, height)) {
            Some(photo) => Ok(photo.resized(width, height)),
            None => self.source.load_at(width, height),
        }
    }

    fn is_shrunk_from_full(&self, width: u32, height: u32) -> bool {
        self.source.is_shrunk_from_full(width, height)
    }

    fn working_bytes(&self) -> usize {
        self.source.working_bytes()
    }
}

impl PhotoSource for Photo {
    fn load(&self) -> Result<Photo, LoadError> {
        Ok(self.clone())
    }
}

/// Values that were measured or estimated all over a photograph and come with it, on a regular grid over the view.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid<T> {
    /// Cells from left to right.
    pub columns: u32,
    /// Cells from top to bottom.
    pub rows: u32,
    /// `[rows, columns]`, at the centres of the cells.
    pub values: Vec<T>,
}

impl<T> Grid<T> {
    /// Column and row of the pixel at the middle of each cell, in an image of `width` x `height` pixels, and its value.
    pub fn pixels(&self, width: u32, height: u32) -> impl Iterator<Item = ([u32; 2], &T)> {
        let middle = |cell: u32, cells: u32, side: u32| ((2 * cell + 1) * side / (2 * cells)).min(side - 1);
        (0u32..).zip(&self.values).map(move |(i, value)| {
            let (column, row) = (i % self.columns, i / self.columns);
            (
                [middle(column, self.columns, width), middle(row, self.rows, height)],
                value,
            )
        })
    }
}

/// Depth along +Z, or its inverse, up to scale and shift. Unknown where it is not positive and finite.
pub type DepthGrid = Grid<f32>;

/// Normals as stored in their file, each coordinate in \[-1, 1\]. Unknown where they are shorter than a half.
pub type NormalGrid = Grid<[f32; 3]>;

/// A source of a grid: a file, or values in memory.
pub trait GridSource<T>: Send + Sync {
    /// Decodes and undistorts. Called from several threads.
    ///
    /// # Errors
    /// One line that names the file and the remedy.
    fn load(&self) -> Result<Grid<T>, LoadError>;
}

impl<T: Clone + Send + Sync> GridSource<T> for Grid<T> {
    fn load(&self) -> Result<Self, LoadError> {
        Ok(self.clone())
    }
}

/// One posed photograph.
#[derive(Clone)]
pub struct View {
    /// Name within the dataset, relative and with forward slashes, such as `images/0001.jpg`.
    pub name: String,
    /// The undistorted camera, at the image size that [`PhotoSource::load`] returns.
    pub camera: Camera,
    /// The pixels, loaded on demand.
    pub photo: Arc<dyn PhotoSource>,
    /// Nearest and farthest depth of the scene in this view along +Z, world units, if the source provides them.
    pub depth_bounds: Option<[f32; 2]>,
    /// Capture time, in the source's own unit (0 to 1 over the capture where transforms.json follows D-NeRF); `None` if the
    /// source has none.
    pub time: Option<f32>,
    /// Indices into [`Dataset::points`] of the points visible in this view, as listed by the source or computed from their occlusion; empty
    /// if neither is known.
    pub points_seen: Vec<u32>,
    /// Depth map of the view, measured or estimated, if one was given.
    pub depth_map: Option<Arc<dyn GridSource<f32>>>,
    /// Normal map of the view, if one was given.
    pub normal_map: Option<Arc<dyn GridSource<[f32; 3]>>>,
}

impl View {
    /// A view without optional data.
    pub fn new(name: impl Into<String>, camera: Camera, photo: Arc<dyn PhotoSource>) -> Self {
        Self {
            name: name.into(),
            camera,
            photo,
            depth_bounds: None,
            time: None,
            points_seen: Vec::new(),
            depth_map: None,
            normal_map: None,
        }
    }
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
    /// Initial points, if the dataset has any.
    pub points: Option<PointCloud>,
    /// From the coordinates of the dataset's files to the world of `views` and `points`.
    pub world_from_dataset: Similarity,
    /// Human-readable kind of dataset: `COLMAP (text)`, `Blender`, ..
    pub kind: String,
    /// One line for each omission or assumption; the reader does not print.
    pub warnings: Vec<String>,
}

impl Dataset {
    /// Keeps held-out photographs in memory once they have been loaded.
    pub fn keep_held_out(&mut self) {
        for view in &self.test {
            let photo = &mut self.views[*view].photo;
            *photo = Arc::new(Kept::new(photo.clone()));
        }
    }

    /// The same dataset in the world of `world_from_dataset`.
    pub fn in_world(mut self, world_from_dataset: Similarity) -> Self {
        let old = std::mem::replace(&mut self.world_from_dataset, world_from_dataset);
        if old == world_from_dataset {
            return self;
        }
        let moved = |point: &mut Vec3| *point = world_from_dataset.apply(old.invert(point.as_dvec3())).as_vec3();
        let factor = (world_from_dataset.scale / old.scale) as f32;
        for view in &mut self.views {
            moved(&mut view.camera.pose.position);
            view.depth_bounds = view.depth_bounds.map(|bounds| bounds.map(|depth| depth * factor));
            if let Some(shutter) = &mut view.camera.shutter {
                shutter.translation *= factor;
            }
        }
        self.points
            .iter_mut()
            .flat_map(|points| &mut points.positions)
            .for_each(moved);
        self
    }
}

/// The usual train/test split: of `count` views in name order every 8th is held out (`index % 8 == 0`).
///
/// Returns `(train, test)`.
pub fn every_eighth(count: usize) -> (Vec<usize>, Vec<usize>) {
    (0..count).partition(|index| !index.is_multiple_of(8))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// A photograph that can be loaded once.
    struct Once(AtomicUsize);

    impl PhotoSource for Once {
        fn load(&self) -> Result<Photo, LoadError> {
            if self.0.fetch_add(1, Ordering::Relaxed) > 0 {
                return Err(LoadError("loaded again".into()));
            }
            Ok(Photo {
                width: 2,
                height: 1,
                channels: 3,
                data: vec![10, 20, 30, 30, 40, 50],
                mask: None,
            })
        }
    }

    #[test]
    fn what_is_kept_is_loaded_once_and_shrunk_from_memory() {
        let kept = Kept::new(Arc::new(Once(AtomicUsize::new(0))));
        let first = kept.load().unwrap();
        assert_eq!(kept.load().unwrap(), first);
        assert_eq!(kept.load_at(1, 1).unwrap().data, [20, 30, 40]);
    }
}
