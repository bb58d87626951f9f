//! From verified matches to cameras and points: the incremental mapper.
//!
//! [`reconstruct`] verifies pairs (`verify`), guesses focal lengths (`focal`), joins matches to tracks (`tracks`) and grows
//! models from seed pairs (`grow`), adjusting as they grow (`refine`). It depends on nothing but its input: no clock, no
//! threads, no order of hashing.

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
    let guessed = cameras.iter().map(|camera| camera.1 == Source::Guess).collect();
    let tracks = Tracks::new(features, &verified);
    let mut models = Vec::new();
    let mut taken = vec![false; photos.len()];
    let mut tried = vec![0; photos.len()];
    while models.len() < options.max_models {
        let Some(model) = grow::model(
            photos, &cameras, &verified, &tracks, &taken, &mut tried, options, progress,
        ) else {
            break;
        };
        for (photo, pose) in model.poses.iter().enumerate() {
            taken[photo] |= pose.is_some();
        }
        models.push(model);
    }
    let left_out = finish::left_out(photos, features, pairs, &verified, &taken, &tried, options);
    let mut models: Vec<Model> = models.into_iter().map(|model| finish::finish(model, photos)).collect();
    // Stable: models of equal size stay in the order of their seeds.
    models.sort_by_key(|model| std::cmp::Reverse(model.registered()));
    Reconstruction {
        models,
        left_out,
        pairs: verified,
        guessed,
    }
}
