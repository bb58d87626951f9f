//! From verified matches to cameras and points: the incremental mapper.
//!
//! [`reconstruct`] verifies pairs (`verify`), guesses focal lengths (`focal`), joins matches to tracks (`tracks`) and grows
//! models from seed pairs (`grow`), adjusting as they grow (`refine`). It depends on nothing but its input: no clock, no
//! threads, no order of hashing.

mod agree;
mod finish;
mod focal;
mod grow;
mod model;
mod refine;
mod seed;
mod tracks;
mod triangulation;
mod types;
mod verify;

use agree::{CONTRADICTS, near_in_tree, spanning_tree};
pub use agree::{agreement, contradictions, strengths};
pub(crate) use finish::up;
pub use focal::Source;
pub use types::{
    LeftOut, MapOptions, Model, ModelPoint, PairKind, PhotoInfo, Progress, Reason, Reconstruction, VerifiedPair,
};
pub use verify::{Cameras, verify};

use crate::{Features, PairMatches};
use tracks::Tracks;

/// Cameras, poses and points from matched features.
///
/// `features` and `photos` have the same order; `pairs` holds matches before any verification. `progress` is called on the
/// calling thread.
///
/// # Panics
/// When `features` and `photos` differ in length, or a match names a photograph or keypoint that does not exist.
pub fn reconstruct(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    assert_eq!(photos.len(), features.len(), "one set of features a photograph");
    let (cameras, verified) = verify(photos, features, pairs, options, progress);
    let mut found = grown(photos, features, &cameras, &verified, options, progress);
    // Parts that look alike share less than what is the same: the strongest pairs must agree with the model.
    let strengths = strengths(photos, features, &verified);
    let tree = spanning_tree(photos.len(), &verified, &strengths);
    let folds = |found: &Grown| {
        let agreement = found
            .models
            .first()
            .map_or(Vec::new(), |model| agreement(photos, features, &verified, model));
        let contradicts = |i: &&usize| agreement.get(**i).is_some_and(|a| a.is_some_and(|a| a < CONTRADICTS));
        tree.iter().filter(contradicts).count()
    };
    let folded = folds(&found);
    if folded >= FOLDED {
        let chosen = |keep: &dyn Fn(usize) -> bool| -> Vec<VerifiedPair> {
            (0..verified.len())
                .filter(|i| keep(*i))
                .map(|i| verified[i].clone())
                .collect()
        };
        let near = near_in_tree(photos.len(), &verified, &tree);
        let skeleton = grown(photos, features, &cameras, &chosen(&|i| near[i]), options, progress);
        let registered = |found: &Grown| found.models.first().map_or(0, Model::registered) as f64;
        let least = KEEPS * registered(&found);
        let unfolds = |other: &Grown| registered(other) >= least && 2 * folds(other) <= folded;
        let again = skeleton.models.first().map(|model| {
            let agreement = agreement(photos, features, &verified, model);
            let agrees = |i: usize| agreement[i].is_none_or(|fraction| fraction > AGREES);
            grown(photos, features, &cameras, &chosen(&agrees), options, progress)
        });
        if let Some(unfolded) = again.into_iter().chain([skeleton]).find(unfolds) {
            found = unfolded;
        }
    }
    let Grown { models, taken, tried } = found;
    let left_out = finish::left_out(photos, features, pairs, &verified, &taken, &tried, options);
    Reconstruction {
        models,
        left_out,
        pairs: verified,
        cameras,
    }
}

/// Neighbours that contradict a model from which on it is mapped again.
const FOLDED: usize = 2;
/// Fraction of the matches of a pair that agree with the model of neighbours, from which on it is used.
const AGREES: f64 = 0.8;
/// Photographs that the second model must hold, of those of the first.
const KEEPS: f64 = 0.9;

/// Models, and what was tried.
struct Grown {
    /// Largest first.
    models: Vec<Model>,
    /// `[photos]` whether a photograph is in a model.
    taken: Vec<bool>,
    /// `[photos]` failed registrations.
    tried: Vec<usize>,
}

/// All models from the matches of `pairs`.
fn grown(
    photos: &[PhotoInfo],
    features: &[Features],
    cameras: &Cameras,
    pairs: &[VerifiedPair],
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Grown {
    let tracks = Tracks::new(features, pairs);
    let mut models = Vec::new();
    let mut taken = vec![false; photos.len()];
    let mut tried = vec![0; photos.len()];
    while models.len() < options.max_models {
        let Some(model) = grow::model(photos, cameras, pairs, &tracks, &taken, &mut tried, options, progress) else {
            break;
        };
        for (photo, pose) in model.poses.iter().enumerate() {
            taken[photo] |= pose.is_some();
        }
        models.push(model);
    }
    let mut models: Vec<Model> = models.into_iter().map(|model| finish::finish(model, photos)).collect();
    // Stable: models of equal size stay in the order of their seeds.
    models.sort_by_key(|model| std::cmp::Reverse(model.registered()));
    Grown { models, taken, tried }
}
