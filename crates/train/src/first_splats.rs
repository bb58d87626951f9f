//! The splats with which a training begins: the dataset's points, or random points in the frusta of its cameras.

use crate::field_step::is_field;
use crate::recipe::Recipe;
use crate::stream::Stream;
use crate::trainer::{TrainError, Trainer};
use glam::Vec2;
use irradia_scene::{Camera, Dataset, LoadError, PointCloud, View, sh};
use irradia_splat::Splats;
use irradia_splat::init::{self, InitOptions, PixelClass};

/// Fewer points than these are not used as first splats.
const MIN_POINTS: usize = 10;

/// Maximum number of training views from which random first splats get their colours, evenly spaced.
const MAX_COLOR_VIEWS: usize = 256;
/// Scale at which photographs are read for these colours, if that takes less time than at full size.
const COLOR_SCALE: f32 = 0.25;

impl Trainer {
    /// Options of the first splats.
    pub(crate) fn init_options(&self) -> InitOptions {
        InitOptions {
            opacity: self.recipe.init.opacity,
            scale: self.recipe.init.scale,
            sh_degree: sh::MAX_DEGREE,
        }
    }

    pub(crate) fn first_splats(&mut self) -> Result<Splats, TrainError> {
        let options = self.init_options();
        let dataset = self.dataset.clone();
        let max_splats = self.recipe.max_splats;
        let splats = match enough_points(&dataset) {
            // Evenly over the file: SfM writes points in the order in which it finds them, region by region.
            Some(points) if points.len() > max_splats => {
                let chosen = (0..max_splats).map(|i| i * points.len() / max_splats);
                let (positions, colors) = chosen.map(|i| (points.positions[i], points.colors[i])).unzip();
                init::from_points(&PointCloud { positions, colors }, &options)
            }
            Some(points) => init::from_points(points, &options),
            None => {
                let stride = dataset.train.len().div_ceil(MAX_COLOR_VIEWS);
                let chosen: Vec<usize> = dataset.train.iter().copied().step_by(stride).collect();
                let views: Vec<&View> = chosen.iter().map(|i| &dataset.views[*i]).collect();
                let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
                let bounds: Vec<Option<[f32; 2]>> = views.iter().map(|v| v.depth_bounds).collect();
                let mut rng = Stream::FirstSplats.rng(self.options.seed);
                let points = init::random_points(
                    &cameras,
                    &bounds,
                    self.recipe.init.random_points.min(max_splats),
                    &mut rng,
                    |view| {
                        let k = cameras[view].intrinsics;
                        let small = k.scaled(COLOR_SCALE);
                        let is_quick = !views[view].photo.is_shrunk_from_full(small.width, small.height);
                        let scale = if is_quick { COLOR_SCALE } else { 1.0 };
                        let photo = self.photos.get(&chosen[view..], scale)?;
                        Ok::<_, LoadError>(move |pixel: Vec2| {
                            let x = pixel.x as usize * photo.width as usize / k.width as usize;
                            let y = pixel.y as usize * photo.height as usize / k.height as usize;
                            let at = y * photo.width as usize + x;
                            let zero = |plane: &Option<Vec<u8>>| plane.as_ref().is_some_and(|plane| plane[at] == 0);
                            if zero(&photo.mask) {
                                PixelClass::Masked
                            } else if zero(&photo.alpha) {
                                PixelClass::Empty
                            } else {
                                PixelClass::Color([0, 1, 2].map(|c| photo.rgb[3 * at + c]))
                            }
                        })
                    },
                )?;
                let opacity = self.recipe.init.random_opacity.unwrap_or(options.opacity);
                init::from_points(&points, &InitOptions { opacity, ..options })
            }
        };
        if splats.is_empty() {
            return Err(TrainError::NoPoints);
        }
        Ok(splats)
    }
}

/// Whether a dataset has enough points for the first splats.
pub(crate) fn has_points(dataset: &Dataset) -> bool {
    enough_points(dataset).is_some()
}

fn enough_points(dataset: &Dataset) -> Option<&PointCloud> {
    dataset.points.as_ref().filter(|points| points.len() >= MIN_POINTS)
}

/// Number of splats with which a training begins.
pub(crate) fn first_count(dataset: &Dataset, recipe: &Recipe) -> usize {
    let first = enough_points(dataset).map_or(recipe.init.random_points, PointCloud::len);
    if is_field(recipe, 0) {
        0
    } else {
        first.min(recipe.max_splats)
    }
}
