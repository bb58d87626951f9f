//! Principal points away from the middle, as of photographs cut out of larger ones.
//!
//! Held in the middle, they bend a model: focal lengths differ, tangential coefficients stand in for them, and poses are off by degrees. So a finished
//! model is adjusted twice on some of its observations: with tangential coefficients, and with free principal points in their place. Of sixteen captures as they are, the cost
//! falls by at most 1.5 % (reflex cameras and ray-traced ones 0.1 %, phones 1 %, whose principal points are up to 1 % of the long side away); by 6 % for squares
//! cut out of upright photographs, by 9 % for a film by drone, by 6 to 64 % for photographs cut on purpose. There the model is settled once more
//! with free principal points. Below, they stay where they are: fox's come to within 3 px of those published, but the splats of three phones gain 0.05 dB by it in the
//! mean, and those of small pictures and narrow views are not told (1 and 0.5 %, 20 px wrong). Free from the start they are worse, where photographs were cut around the middle.

use super::finish;
use super::model::Working;
use super::readjust::{self, posed};
use super::refine::{belief, finished};
use super::tracks::Tracks;
use super::types::{MapOptions, Model, PhotoInfo, Progress, Reconstruction};
use crate::Features;
use crate::adjust::{AdjustedCamera, Focal, Freedom};

/// Fraction by which the cost falls with free principal points, at least.
const BETTER: f64 = 0.03;

/// The first model of `found`, whose groups `photos` have, with free principal points; `None` if the middles do, or photographs would be lost.
pub(super) fn freed(
    photos: &[PhotoInfo],
    features: &[Features],
    found: &Reconstruction,
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Option<Model> {
    let model = found.models.first()?;
    if gain(photos, features, model, options) < BETTER {
        return None;
    }
    let tracks = Tracks::new(features, &found.pairs);
    let mut working = Working::new(photos, &found.cameras, &tracks, options);
    working.resume(model);
    working.free_principal_points();
    working.settle_fully(progress);
    let free = finish::finish(&working, photos);
    (free.registered() >= model.registered() && free.observations() >= model.observations()).then_some(free)
}

/// The fraction by which the cost of `model` falls with free principal points.
fn gain(photos: &[PhotoInfo], features: &[Features], model: &Model, options: &MapOptions) -> f64 {
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
        let freedom = match known[group] {
            true => Freedom::HELD,
            false => finished(camera, count[group], model.focal_held[group], options),
        };
        cameras.push(AdjustedCamera {
            camera: *camera,
            freedom,
            belief: belief(camera, camera.focal(), 0.5),
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
    let gain = 1.0 - free.final_cost / held.final_cost;
    if gain.is_finite() { gain } else { 0.0 }
}
