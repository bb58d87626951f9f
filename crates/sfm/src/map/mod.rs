//! The incremental mapper: from matches to cameras and points.
//!
//! [`reconstruct`] verifies pairs (`verify`), guesses focal lengths (`focal`), joins matches to tracks (`tracks`) and grows
//! models from seed pairs (`grow`), adjusting as they grow (`refine`). Matches that stand still while others move are left out (`still`).
//! The result depends only on the input, not on clocks, threads or hash order.

mod absent;
mod agree;
mod apart;
mod distance;
mod finish;
mod fisheye;
mod focal;
mod grow;
mod guide;
mod metric;
mod model;
mod observable;
mod principal;
mod readjust;
mod refine;
mod seed;
mod still;
mod tracks;
mod triangulation;
mod turntable;
mod types;
mod unfold;
mod verify;
mod zoom;

pub use absent::{ABSENT_PAIRS, absent};
pub(crate) use agree::on_planes;
pub use agree::{agreement, contradictions, strengths, telling};
pub use distance::{Distance, DistanceFit, to_distances};
pub use focal::Source;
pub use guide::add_guided_points;
pub use metric::{Metric, to_metres};
pub use observable::determines_focal;
pub(crate) use still::{AGREES, limits, showing};
pub use still::{StandsStill, moving, same_place, stands_still};
pub use turntable::turntable;
pub(crate) use types::rigs;
pub use types::{
    Absent, FEW_PHOTOS, Known, LeftOut, MapOptions, Model, ModelPoint, Mount, PairKind, PhotoInfo, Progress, Reason,
    Reconstruction, VerifiedPair, Zoom,
};
pub(crate) use verify::centered_points;
pub use verify::{Cameras, verify};

use crate::geometry::camera::DCamera;
use crate::{Features, PairMatches};
use apart::Parted;
use tracks::Tracks;
use zoom::Focals;

/// A model with less than this fraction of the photographs is in doubt, and is mapped again with this focal length, relative to the long
/// side. Models of a rendered medal with a field of view of 14 degrees are correct with initial values of 2, 3, 4 and 6, and wrong from
/// 0.5 (the value from its pairs) to 1.2.
const IN_DOUBT: f64 = 0.8;
const NARROW: f64 = 3.0;
/// Maximum number of zoom settings that are distinguished besides the first.
const MOST_ZOOMS: usize = 3;
/// Maximum mean error of a model in which each photograph has its own focal length, relative to that of the model with shared ones.
const OWN_ERROR: f64 = 0.8;

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
    let pairs = &still::without(photos, features, pairs)[..];
    let mut known = known_cameras(photos);
    let mut found = mapped(photos, features, pairs, &known, options, progress);
    // The focal length that the pairs of few photographs suggest may be wrong, and so may a model that starts with it.
    if photos.len() <= FEW_PHOTOS
        && let Some(usual) = usual(photos, &found.cameras)
    {
        let again = mapped(photos, features, pairs, &usual, options, progress);
        if again.apart.is_none() && explained(&again) > explained(&found) {
            found = again;
            known = usual;
        }
    }
    let in_doubt = found.apart.is_some()
        || (found.registered() as f64) < IN_DOUBT * photos.len() as f64
        || is_far_from_first_focals(&found);
    if options.narrow
        && in_doubt
        && !zoom::is_confirmed(photos, features, &found.models)
        && let Some(narrow) = narrow(photos, &found.cameras)
    {
        let again = mapped(photos, features, pairs, &narrow, options, progress);
        // Parts that look alike are joined with any focal length, so contradictions decide as well.
        let contradicted = |found: &Reconstruction| found.contradictions(photos, features);
        let more = explained(&again) > explained(&found);
        if again.apart.is_none() && more && contradicted(&again) <= contradicted(&found) {
            found = again;
            known = narrow;
        }
    }
    let fisheyes = found.models.first().map(|model| fisheye::find(photos, features, model));
    if let Some(fisheyes) = fisheyes.filter(|fisheyes| !fisheyes.is_empty()) {
        for (group, camera) in fisheyes {
            known[group] = Some((camera, Source::Pairs));
        }
        let again = mapped(photos, features, pairs, &known, options, progress);
        if explained(&again) > explained(&found) {
            found = again;
        }
    }
    let mut grouped = photos.to_vec();
    while found.zooms.len() < MOST_ZOOMS {
        let within = match found.models.first().map(|m| zoom::find(&grouped, features, m)) {
            Some(Focals::Own) if found.zooms.is_empty() => {
                let own = with_own_focals(photos, features, pairs, &found, options, progress);
                found = own.unwrap_or(found);
                break;
            }
            Some(Focals::Parted(zoom)) => Some(zoom),
            _ => None,
        };
        let Some(zoom) = within.or_else(|| zoom::between(&grouped, &found.models)) else {
            break;
        };
        let mut apart = grouped.clone();
        zoom.photos.iter().for_each(|photo| apart[*photo].group = zoom.group);
        let mut cameras: Vec<_> = found.cameras.iter().copied().map(Some).collect();
        let lens = cameras[zoom.of].expect("listed").0;
        cameras.push(None);
        for (group, focal) in [zoom.of, zoom.group].into_iter().zip(zoom.focals) {
            cameras[group] = Some((DCamera::centered(lens.width, lens.height, focal), Source::Pairs));
        }
        let again = mapped(&apart, features, pairs, &cameras, options, progress);
        if again.registered() < found.registered() || !zoom::holds(&zoom, &again.models) {
            break;
        }
        let zooms = [std::mem::take(&mut found.zooms), vec![zoom]].concat();
        found = Reconstruction { zooms, ..again };
        grouped = apart;
    }
    // Puts each photograph into the group of its own camera, where it has one.
    found.regroup(&mut grouped);
    if let Some(model) = principal::freed(&grouped, features, &found, options, progress) {
        found.models[0] = model;
    }
    // The focal lengths after adjustment.
    for zoom in &mut found.zooms {
        for (focal, group) in zoom.focals.iter_mut().zip([zoom.of, zoom.group]) {
            *focal = zoom::camera(&found.models, group).map_or(*focal, DCamera::focal);
        }
    }
    found
}

/// Maps again with each photograph as its own camera, starting with the focal length of its camera in `found`; `None` unless the errors
/// fall as much as they do where focal lengths really differ.
fn with_own_focals(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    found: &Reconstruction,
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Option<Reconstruction> {
    let shared = found.models.first()?;
    let first = |photo: &PhotoInfo| {
        let focal = shared.cameras[photo.group].as_ref()?.focal();
        Some((DCamera::centered(photo.width, photo.height, focal), Source::Guess))
    };
    let cameras: Vec<_> = photos.iter().map(first).collect();
    let each = photos.iter().cloned().enumerate();
    let each: Vec<PhotoInfo> = each.map(|(group, photo)| PhotoInfo { group, ..photo }).collect();
    let own = mapped(&each, features, pairs, &cameras, options, progress);
    let model = own.models.first()?;
    let better = model.registered() >= shared.registered() && model.mean_error() < OWN_ERROR * shared.mean_error();
    better.then_some(Reconstruction {
        own_focals: true,
        ..own
    })
}

/// Cameras with the usual focal length, if there are no metadata and the pairs suggest another one.
fn usual(photos: &[PhotoInfo], cameras: &Cameras) -> Option<Vec<Option<(DCamera, Source)>>> {
    let is_guess = cameras.iter().all(|(_, source)| *source == Source::Guess);
    guessed(photos, cameras, focal::GUESS).filter(|_| !is_guess)
}

/// Cameras with a narrow field of view, if there are no metadata: all focal lengths fit the pairs of such photographs nearly equally
/// well, and a model that starts with a much shorter one becomes flat and breaks.
fn narrow(photos: &[PhotoInfo], cameras: &Cameras) -> Option<Vec<Option<(DCamera, Source)>>> {
    let shorter = |(camera, _): &(DCamera, Source)| camera.focal() < NARROW / 2.0 * camera.long_side();
    guessed(photos, cameras, NARROW).filter(|_| cameras.iter().all(shorter))
}

/// `[groups]` cameras with the focal length `focal`, relative to the long side, if there are no metadata.
fn guessed(photos: &[PhotoInfo], cameras: &Cameras, focal: f64) -> Option<Vec<Option<(DCamera, Source)>>> {
    let told = |photo: &PhotoInfo| photo.focal_prior_px.is_some() || photo.camera.is_some();
    if photos.iter().any(told) {
        return None;
    }
    let camera = |(camera, _): &(DCamera, Source)| {
        let focal = focal * camera.long_side();
        Some((DCamera::centered(camera.width, camera.height, focal), Source::Guess))
    };
    Some(cameras.iter().map(camera).collect())
}

/// Whether a focal length in the largest model ended far from where it began.
fn is_far_from_first_focals(found: &Reconstruction) -> bool {
    let first = found.models.first().map_or(&[][..], |model| &model.cameras);
    let mut of_both = first.iter().zip(&found.cameras);
    of_both.any(|(camera, (began, _))| camera.is_some_and(|c| focal::are_far(c.focal(), began.focal())))
}

/// Number of photographs and of observations in the largest model.
fn explained(found: &Reconstruction) -> (usize, usize) {
    let model = found.models.first();
    model.map_or((0, 0), |model| (model.registered(), model.observations()))
}

/// `[groups]` the cameras that are known exactly.
fn known_cameras(photos: &[PhotoInfo]) -> Vec<Option<(DCamera, Source)>> {
    let groups = photos.iter().map(|photo| photo.group + 1).max().unwrap_or(0);
    let mut cameras = vec![None; groups];
    for photo in photos {
        cameras[photo.group] = photo.camera.map(|camera| (camera, Source::Prior));
    }
    cameras
}

/// Like [`reconstruct`], with the given groups, and with the cameras of some of them given.
fn mapped(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    cameras: &[Option<(DCamera, Source)>],
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    let (cameras, verified) = verify::verify_with(photos, features, pairs, cameras, options, progress);
    let input = Input {
        photos,
        features,
        cameras: &cameras,
        pairs: &verified,
        options,
    };
    let found = unfold::unfolded(&input, grown(&input, &verified, progress), progress);
    let Parted { found, absent, apart } = apart::parted(&input, found, progress);
    let Grown { models, taken, tried } = found;
    let left_out = finish::left_out(photos, features, pairs, &verified, &taken, &tried, options);
    Reconstruction {
        models,
        left_out,
        pairs: verified,
        cameras,
        zooms: Vec::new(),
        own_focals: false,
        absent,
        apart,
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
    known: &Known,
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    assert_eq!(photos.len(), known.poses.len(), "a pose or none per photograph");
    let pairs = &still::without(photos, features, pairs)[..];
    let held: Vec<_> = known.cameras.iter().map(|c| c.map(|c| (c, Source::Prior))).collect();
    let (cameras, verified) = verify::verify_with(photos, features, pairs, &held, options, progress);
    assert_eq!(cameras.len(), known.cameras.len(), "a camera or none per group");
    let tracks = Tracks::new(features, &verified);
    let mut working = model::Working::new(photos, &cameras, &tracks, options);
    working.hold(known);
    let mut tried = vec![0; photos.len()];
    working.grow(&vec![false; photos.len()], &mut tried, progress);
    let taken: Vec<bool> = working.poses.iter().map(Option::is_some).collect();
    let left_out = finish::left_out(photos, features, pairs, &verified, &taken, &tried, options);
    let model = finish::collected(&working, photos);
    Reconstruction {
        absent: absent(photos, &model),
        models: vec![model],
        left_out,
        pairs: verified,
        cameras,
        zooms: Vec::new(),
        own_focals: false,
        apart: None,
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
    let mut photos = photos.to_vec();
    found.regroup(&mut photos);
    let (largest, others) = found.models.split_first().expect("a model");
    let mut completed = extend(&photos, features, pairs, &largest.into(), options, progress);
    let poses = &completed.models[0].poses;
    let shares = |other: &&Model| poses.iter().zip(&other.poses).any(|(a, b)| a.is_some() && b.is_some());
    let others: Vec<Model> = others.iter().filter(|other| !shares(other)).cloned().collect();
    completed
        .left_out
        .retain(|left| others.iter().all(|other| other.poses[left.photo].is_none()));
    completed.models.extend(others);
    Reconstruction {
        zooms: found.zooms.clone(),
        own_focals: found.own_focals,
        ..completed
    }
}

/// Models, and the photographs that are in them or failed.
struct Grown {
    /// Largest first.
    models: Vec<Model>,
    /// `[photos]` whether a photograph is in a model.
    taken: Vec<bool>,
    /// `[photos]` number of failed registrations.
    tried: Vec<usize>,
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
fn grown(input: &Input, pairs: &[VerifiedPair], progress: &mut dyn FnMut(Progress)) -> Grown {
    let Input {
        photos,
        features,
        cameras,
        options,
        ..
    } = *input;
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
    let mut models: Vec<Model> = models.into_iter().map(|model| finish::finish(&model, photos)).collect();
    // The sort is stable: models of equal size stay in the order of their seeds.
    models.sort_by_key(|model| std::cmp::Reverse(model.registered()));
    Grown { models, taken, tried }
}
