//! The incremental mapper: from matches to cameras and points.
//!
//! [`reconstruct`] verifies pairs (`verify`), guesses focal lengths (`focal`), joins matches to tracks (`tracks`) and grows
//! models from seed pairs (`grow`), adjusting as they grow (`refine`). Matches that stand still while others move are left out (`still`).
//! The result depends only on the input, not on clocks, threads or hash order.

mod agreement;
mod contradicted;
mod covering;
mod distance;
mod finish;
mod fisheye;
mod focal;
mod fold;
mod grow;
mod guide;
mod loops;
mod metric;
mod missing;
mod model;
mod observable;
mod principal;
mod readjust;
mod refine;
mod seed;
mod split;
mod still;
mod tracks;
mod triangulation;
mod turning;
mod turntable;
mod types;
mod unfold;
mod verify;
mod zoom;

pub(crate) use agreement::normalized_matches;
pub use agreement::{agreement, agrees, contradictions, evidence_pairs, strengths};
pub use contradicted::contradicted_pairs;
pub(crate) use contradicted::explains_matches;
pub use distance::{Distance, DistanceFit, scale_to_distances};
pub use focal::FocalSource;
pub use fold::folded_pairs;
pub use guide::add_guided_points;
pub(crate) use loops::closed_loop_fractions;
pub use metric::{ScaleFit, scale_to_locations};
pub use missing::{MIN_MISSING_PAIRS, missing_matches};
pub use observable::determines_focal;
pub(crate) use still::{MAX_INLIER_ERROR_LONG_SIDES, pairs_with_value, ransac_limits};
pub use still::{StillRegion, duplicate_pairs, find_still_region, moving_matches};
pub use turning::{Sensor, Turning};
pub use turntable::turntable_rings;
pub(crate) use types::rigs;
pub use types::{
    FEW_PHOTOS, GroupCamera, KnownGeometry, LeftOut, MapOptions, MissingMatches, Model, ModelPoint, PairKind,
    PhotoInfo, Progress, Reason, Reconstruction, RigMount, VerifiedPair, Zoom,
};
pub(crate) use verify::centered_points;
pub use verify::{Cameras, verify};

use crate::geometry::camera::DCamera;
use crate::{Features, PairMatches};
use split::Split;
use tracks::Tracks;

/// A model with less than this fraction of the photographs is in doubt, and is mapped again with this focal length, relative to the long
/// side. Models of a rendered medal with a field of view of 14 degrees are correct with initial values of 2, 3, 4 and 6, and wrong from
/// 0.5 (the value from its pairs) to 1.2.
const MIN_TRUSTED_FRACTION: f64 = 0.8;
const NARROW_VIEW_FOCAL: f64 = 3.0;

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
    assert_eq!(photos.len(), features.len(), "one set of features per photograph");
    let moving = &still::without_still_matches(photos, features, pairs)[..];
    let input = Unverified {
        photos,
        features,
        pairs: moving,
        with_still: pairs,
        options,
    };
    let mut known = known_cameras(photos);
    let mut found = map_with_cameras(&input, &known, progress);
    // The focal length that the pairs of few photographs suggest may be wrong, and so may a model that starts with it.
    if photos.len() <= FEW_PHOTOS
        && let Some(usual) = with_usual_focal(photos, &found.cameras)
    {
        let again = map_with_cameras(&input, &usual, progress);
        if again.split_models.is_none() && model_size(&again) > model_size(&found) {
            found = again;
            known = usual;
        }
    }
    let is_doubtful = found.split_models.is_some()
        || (found.registered() as f64) < MIN_TRUSTED_FRACTION * photos.len() as f64
        || is_far_from_initial_focals(&found);
    if options.narrow
        && is_doubtful
        && !zoom::is_confirmed(photos, features, &found.models)
        && let Some(narrow) = with_narrow_view(photos, &found.cameras)
    {
        let again = map_with_cameras(&input, &narrow, progress);
        // Parts that look alike are joined with any focal length, so contradictions decide as well.
        let contradicted = |found: &Reconstruction| found.contradictions(photos, features);
        let more = model_size(&again) > model_size(&found);
        if again.split_models.is_none() && more && contradicted(&again) <= contradicted(&found) {
            found = again;
            known = narrow;
        }
    }
    let fisheyes = found.models.first().map(|model| fisheye::find(photos, features, model));
    if let Some(fisheyes) = fisheyes.filter(|fisheyes| !fisheyes.is_empty()) {
        for (group, camera) in fisheyes {
            known[group] = Some(GroupCamera {
                camera,
                source: FocalSource::Pairs,
            });
        }
        let again = map_with_cameras(&input, &known, progress);
        if model_size(&again) > model_size(&found) {
            found = again;
        }
    }
    found = zoom::split_cameras(&input, found, progress);
    // Puts each photograph into the group of its own camera, where it has one.
    let grouped = found.regrouped(photos);
    if let Some(model) = principal::with_free_principal_points(&grouped, features, &found, options, progress) {
        found.models[0] = model;
    }
    // The focal lengths after adjustment.
    for zoom in &mut found.zooms {
        for (focal, group) in zoom.focals.iter_mut().zip([zoom.previous_group, zoom.group]) {
            *focal = zoom::camera(&found.models, group).map_or(*focal, DCamera::focal);
        }
    }
    found
}

/// Cameras with the usual focal length, if there are no metadata and the pairs suggest another one.
fn with_usual_focal(photos: &[PhotoInfo], cameras: &Cameras) -> Option<Vec<Option<GroupCamera>>> {
    let is_guess = cameras.iter().all(|of| of.source == FocalSource::Guess);
    with_guessed_focal(photos, cameras, focal::DEFAULT_FOCAL).filter(|_| !is_guess)
}

/// Cameras with a narrow field of view, if there are no metadata: all focal lengths fit the pairs of such photographs nearly equally
/// well, and a model that starts with a much shorter one becomes flat and breaks.
fn with_narrow_view(photos: &[PhotoInfo], cameras: &Cameras) -> Option<Vec<Option<GroupCamera>>> {
    let shorter = |of: &GroupCamera| of.camera.focal() < NARROW_VIEW_FOCAL / 2.0 * of.camera.long_side();
    with_guessed_focal(photos, cameras, NARROW_VIEW_FOCAL).filter(|_| cameras.iter().all(shorter))
}

/// `[groups]` cameras with the focal length `focal`, relative to the long side, if there are no metadata.
fn with_guessed_focal(photos: &[PhotoInfo], cameras: &Cameras, focal: f64) -> Option<Vec<Option<GroupCamera>>> {
    let has_metadata = |photo: &PhotoInfo| photo.focal_prior_px.is_some() || photo.camera.is_some();
    if photos.iter().any(has_metadata) {
        return None;
    }
    let camera = |GroupCamera { camera, .. }: &GroupCamera| {
        let focal = focal * camera.long_side();
        let (width, height) = (camera.width, camera.height);
        Some(GroupCamera::centered(width, height, focal, FocalSource::Guess))
    };
    Some(cameras.iter().map(camera).collect())
}

/// Whether a focal length in the largest model ended far from where it began.
fn is_far_from_initial_focals(found: &Reconstruction) -> bool {
    let first = found.models.first().map_or(&[][..], |model| &model.cameras);
    let mut of_both = first.iter().zip(&found.cameras);
    of_both.any(|(camera, began)| camera.is_some_and(|c| focal::are_far_apart(c.focal(), began.camera.focal())))
}

/// Number of photographs and of observations in the largest model.
fn model_size(found: &Reconstruction) -> (usize, usize) {
    let model = found.models.first();
    model.map_or((0, 0), |model| (model.registered(), model.observations()))
}

/// `[groups]` the cameras that are known exactly.
fn known_cameras(photos: &[PhotoInfo]) -> Vec<Option<GroupCamera>> {
    let groups = photos.iter().map(|photo| photo.group + 1).max().unwrap_or(0);
    let mut cameras = vec![None; groups];
    for photo in photos {
        let camera = &mut cameras[photo.group];
        *camera = camera.or(photo.camera.map(exact_camera));
    }
    cameras
}

/// A camera that is known exactly.
fn exact_camera(camera: DCamera) -> GroupCamera {
    GroupCamera {
        camera,
        source: FocalSource::Prior,
    }
}

/// Like [`reconstruct`], with the given groups, and with the cameras of some of them given.
fn map_with_cameras(
    unverified: &Unverified,
    cameras: &[Option<GroupCamera>],
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    let Unverified {
        photos,
        features,
        options,
        ..
    } = *unverified;
    let (cameras, verified) = verify::verify_with(unverified, cameras, progress);
    let input = Input {
        photos,
        features,
        cameras: &cameras,
        pairs: &verified,
        options,
    };
    let found = unfold::unfold(&input, grow_models(&input, &verified, progress), progress);
    let Split {
        found,
        missing,
        split_models,
    } = split::split(&input, found, progress);
    let GrownModels {
        models,
        assigned,
        failed_registrations,
    } = found;
    let left_out = finish::left_out(&input, unverified, &assigned, &failed_registrations);
    Reconstruction {
        models,
        left_out,
        pairs: verified,
        cameras,
        zooms: Vec::new(),
        own_focals: false,
        missing,
        split_models,
    }
}

/// Like [`reconstruct`], for one model that keeps what is `known` unchanged, in its world: photographs without a pose are registered in
/// it.
///
/// # Panics
/// Like [`reconstruct`], and when `known` differs from `photos` in the number of photographs or groups.
pub fn extend(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    known: &KnownGeometry,
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    assert_eq!(photos.len(), known.poses.len(), "a pose or none per photograph");
    let moving = &still::without_still_matches(photos, features, pairs)[..];
    // A group without a known pose may have an exact camera nevertheless.
    let held: Vec<_> = (known.cameras.iter().zip(known_cameras(photos)))
        .map(|(camera, exact)| camera.map(exact_camera).or(exact))
        .collect();
    let unverified = Unverified {
        photos,
        features,
        pairs: moving,
        with_still: pairs,
        options,
    };
    let (cameras, verified) = verify::verify_with(&unverified, &held, progress);
    assert_eq!(cameras.len(), known.cameras.len(), "a camera or none per group");
    let input = Input {
        photos,
        features,
        cameras: &cameras,
        pairs: &verified,
        options,
    };
    let tracks = Tracks::new(features, &verified);
    let mut growing = model::GrowingModel::new(photos, &cameras, &tracks, options);
    growing.hold(known);
    growing.grow(&vec![false; photos.len()], progress);
    let assigned: Vec<bool> = growing.poses.iter().map(Option::is_some).collect();
    let left_out = finish::left_out(&input, &unverified, &assigned, &growing.failures);
    let model = finish::extract_model(&growing);
    Reconstruction {
        missing: missing_matches(photos, &model),
        models: vec![model],
        left_out,
        pairs: verified,
        cameras,
        zooms: Vec::new(),
        own_focals: false,
        split_models: None,
    }
}

/// `found` with further photographs, those that can be registered with `options`, in its largest model, which is otherwise unchanged. Its
/// other models stay unless they now share photographs with it.
///
/// # Panics
/// Like [`reconstruct`], and when `found` has no model.
pub fn complete(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    found: &Reconstruction,
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    let photos = found.regrouped(photos);
    let (largest, others) = found.models.split_first().expect("a model");
    let mut completed = extend(&photos, features, pairs, &largest.into(), options, progress);
    completed.models[0].focal_held.clone_from(&largest.focal_held);
    let poses = &completed.models[0].poses;
    let shares = |other: &&Model| poses.iter().zip(&other.poses).any(|(a, b)| a.is_some() && b.is_some());
    let others: Vec<Model> = others.iter().filter(|other| !shares(other)).cloned().collect();
    completed
        .left_out
        .retain(|left| others.iter().all(|other| other.poses[left.photo].is_none()));
    completed.models.extend(others);
    // They were held, but not because they were known.
    for (camera, before) in completed.cameras.iter_mut().zip(&found.cameras) {
        camera.source = before.source;
    }
    Reconstruction {
        zooms: found.zooms.clone(),
        own_focals: found.own_focals,
        ..completed
    }
}

/// Models, and the photographs that are in them or failed.
struct GrownModels {
    /// Largest first.
    models: Vec<Model>,
    /// `[photos]` whether a photograph is in a model.
    assigned: Vec<bool>,
    /// `[photos]` number of failed registrations.
    failed_registrations: Vec<usize>,
}

/// The input before verification.
#[derive(Clone, Copy)]
struct Unverified<'a> {
    photos: &'a [PhotoInfo],
    features: &'a [Features],
    /// Matches of all pairs, without those that stand still while others move.
    pairs: &'a [PairMatches],
    /// The same with those that stand still.
    with_still: &'a [PairMatches],
    options: &'a MapOptions,
}

/// The input from which models are grown.
struct Input<'a> {
    photos: &'a [PhotoInfo],
    features: &'a [Features],
    cameras: &'a Cameras,
    /// All verified pairs.
    pairs: &'a [VerifiedPair],
    options: &'a MapOptions,
}

/// All models from the matches of `pairs`, which may be a subset of those of `input`.
fn grow_models(input: &Input, pairs: &[VerifiedPair], progress: &mut dyn FnMut(Progress)) -> GrownModels {
    let Input { photos, options, .. } = *input;
    let tracks = Tracks::new(input.features, pairs);
    let mut models = Vec::new();
    let mut assigned = vec![false; photos.len()];
    let mut failed_registrations = vec![0; photos.len()];
    while models.len() < options.max_models {
        let Some(model) = grow::grow_model(input, pairs, &tracks, &assigned, &mut failed_registrations, progress)
        else {
            break;
        };
        for (photo, pose) in model.poses.iter().enumerate() {
            assigned[photo] |= pose.is_some();
        }
        models.push(model);
    }
    let mut models: Vec<Model> = models.into_iter().map(|model| finish::finish(&model, photos)).collect();
    // The sort is stable: models of equal size stay in the order of their seeds.
    models.sort_by_key(|model| std::cmp::Reverse(model.registered()));
    GrownModels {
        models,
        assigned,
        failed_registrations,
    }
}
