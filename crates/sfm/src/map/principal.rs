//! Principal points away from the centre, as in photographs cropped from larger ones.
//!
//! Holding them at the centre bends a model: focal lengths differ, tangential coefficients compensate, and poses are off by degrees. A
//! finished model is therefore adjusted twice on some of its observations: with tangential coefficients, and with free principal points
//! instead. For sixteen unmodified captures, the cost falls by at most 1.5 % (reflex and ray-traced cameras 0.1 %; phones, whose
//! principal points are up to 1 % of the long side away, 1 %), for squares cropped from upright photographs by 6 %, for a film by a drone
//! by 9 %, and for photographs cropped on purpose by 6 to 64 %. Where it falls enough, the model is refined once more with free principal
//! points. Otherwise they stay where they are: fox's would come within 3 px of the published ones, but the splats of three phones gain
//! only 0.05 dB on average, and the principal points of small photographs and narrow views are not determined (1 and 0.5 %, 20 px wrong).
//! Leaving them free from the start is worse where photographs were cropped around the centre.

use super::finish;
use super::model::GrowingModel;
use super::readjust::{self, posed};
use super::refine::{camera_prior, final_freedom};
use super::tracks::Tracks;
use super::types::{MapOptions, Model, PhotoInfo, Progress, Reconstruction};
use crate::Features;
use crate::adjust::{AdjustedCamera, Focal, Freedom};

/// Minimum fraction by which the cost falls with free principal points.
const MIN_COST_REDUCTION: f64 = 0.03;

/// The first model of `found` with free principal points; `photos` have its groups. `None` if principal points at the centre fit well
/// enough, or if photographs or observations would be lost.
pub(super) fn with_free_principal_points(
    photos: &[PhotoInfo],
    features: &[Features],
    found: &Reconstruction,
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Option<Model> {
    let model = found.models.first()?;
    if cost_reduction(photos, features, model, options) < MIN_COST_REDUCTION {
        return None;
    }
    let tracks = Tracks::new(features, &found.pairs);
    let mut growing = GrowingModel::new(photos, &found.cameras, &tracks, options);
    growing.resume(model);
    growing.free_principal_points();
    growing.refine_fully(progress);
    let free = finish::finish(&growing, photos);
    (free.registered() >= model.registered() && free.observations() >= model.observations()).then_some(free)
}

/// The fraction by which the cost of `model` falls with free principal points.
fn cost_reduction(photos: &[PhotoInfo], features: &[Features], model: &Model, options: &MapOptions) -> f64 {
    let groups = model.cameras.len();
    let (mut count, mut known) = (vec![0; groups], vec![false; groups]);
    for photo in posed(model).map(|photo| &photos[photo]) {
        count[photo.group] += 1;
        known[photo.group] |= photo.camera.is_some();
    }
    let mut number = vec![usize::MAX; groups];
    let mut cameras = Vec::new();
    for (group, camera) in model.cameras.iter().enumerate() {
        let Some(camera) = camera else { continue };
        number[group] = cameras.len();
        let freedom = if known[group] {
            Freedom::HELD
        } else {
            final_freedom(camera, count[group], model.focal_held[group], options)
        };
        cameras.push(AdjustedCamera {
            camera: *camera,
            freedom,
            prior: camera_prior(camera, camera.focal(), 0.5),
        });
    }
    if cameras.iter().all(|camera| camera.freedom.focal == Focal::Held) {
        return 0.0;
    }
    let mut problem = readjust::problem(photos, features, model, cameras, |photo| number[photos[photo].group]);
    let held = problem.solve(&readjust::OPTIONS);
    for camera in &mut problem.cameras {
        if camera.freedom.focal != Focal::Held {
            camera.freedom = camera.freedom.with_principal();
            camera.camera = camera.camera.without_tangential();
        }
    }
    let free = problem.solve(&readjust::OPTIONS);
    readjust::cost_reduction(held.final_cost, free.final_cost)
}
