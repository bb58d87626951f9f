//! Further points of a model with known poses, from matches along epipolar lines.
//!
//! A feature has few candidates along a line, so more features match than among all features of a photograph, and more of these matches
//! are wrong. A point on which three photographs agree is correct; a point of two photographs is accepted if points beside it, in both
//! photographs, have a similar depth.

use super::model::GrowingModel;
use super::tracks::Tracks;
use super::types::{KnownGeometry, MapOptions, Model, ModelPoint, PairKind, PhotoInfo, VerifiedPair};
use super::verify::inverse_calibration;
use super::{exact_camera, finish, verify};
use crate::geometry::camera::DCamera;
use crate::geometry::essential::Motion;
use crate::geometry::pose::DPose;
use crate::matching::{MatchOptions, match_guided};
use crate::{Features, Keypoint};
use glam::{DMat3, DVec2, DVec3};
use irradia_scene::Lens;
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::HashSet;

/// Maximum distance of a match from its epipolar line, px: small, because the poses are known.
const MAX_LINE_DISTANCE_PIXELS: f64 = 1.0;
/// [`MatchOptions::ratio`] for matches along lines.
const MATCH_RATIO: f32 = 0.75;
/// Maximum angle between the axes of photographs that are matched, degrees.
const MAX_AXIS_ANGLE_DEGREES: f64 = 70.0;
/// Minimum number of photographs of a point that is accepted without points beside it.
const MIN_CERTAIN_PHOTOS: usize = 3;
/// Points beside another are within this distance of it, relative to the photograph's longer side; how many of the nearest ones are used
/// at most, and how many are needed to predict its depth.
const NEIGHBOUR_RADIUS: f64 = 0.1;
const MAX_NEIGHBOURS: usize = 5;
const MIN_NEIGHBOURS: usize = 3;
/// The fraction by which a depth may be outside the range of the depths beside it.
const DEPTH_TOLERANCE: f64 = 0.1;

/// Adds points to `model`, which was made from `photos`, `features` and `pairs`. Existing points are replaced by those of three or more
/// photographs that share an observation with them; cameras and poses stay as they are.
///
/// # Panics
/// When `features` and `photos` differ in length, or are not those of `model`.
pub fn add_guided_points(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[VerifiedPair],
    model: &mut Model,
    options: &MapOptions,
) {
    assert_eq!(photos.len(), features.len(), "one set of features per photograph");
    let guided = guided_pairs(photos, features, model);
    let tracks = Tracks::complete(features, &[&guided, pairs].concat());
    // Groups without a camera have no photograph in the model.
    let camera = |camera: &Option<DCamera>| exact_camera(camera.unwrap_or(DCamera::centered(1, 1, 1.0)));
    let cameras: verify::Cameras = model.cameras.iter().map(camera).collect();
    let mut growing = GrowingModel::new(photos, &cameras, &tracks, options);
    growing.hold(&KnownGeometry::from(&*model));
    let found = finish::extract_model(&growing).points;
    let (certain, of_two): (Vec<_>, Vec<_>) = found
        .into_iter()
        .partition(|point| point.track.len() >= MIN_CERTAIN_PHOTOS);
    let before = std::mem::replace(&mut model.points, certain);
    let new = without_shared_observations(&model.points, before);
    model.points.extend(new);
    let depths = known_depths(photos, features, model);
    let is_consistent = |point: &ModelPoint| has_consistent_depth(point, photos, features, model, &depths);
    let new: Vec<ModelPoint> = without_shared_observations(&model.points, of_two)
        .into_iter()
        .filter(is_consistent)
        .collect();
    model.points.extend(new);
}

/// Those of `more` that share no observation with `points`.
fn without_shared_observations(points: &[ModelPoint], more: Vec<ModelPoint>) -> Vec<ModelPoint> {
    let seen: HashSet<&(u32, u32)> = points.iter().flat_map(|point| &point.track).collect();
    more.into_iter()
        .filter(|point| !point.track.iter().any(|observation| seen.contains(observation)))
        .collect()
}

/// A photograph of the model as if taken by a pinhole camera.
struct PinholePhoto {
    photo: u32,
    pose: DPose,
    /// From pixels to the plane z = 1.
    inverse: DMat3,
    features: Features,
}

impl PinholePhoto {
    fn new(photo: usize, features: &Features, camera: &DCamera, pose: DPose) -> Self {
        Self {
            photo: photo as u32,
            pose,
            inverse: inverse_calibration(camera),
            features: pinhole_features(features, camera).into_owned(),
        }
    }

    /// A keypoint on the plane z = 1.
    fn on_plane(&self, keypoint: u32) -> DVec2 {
        let at = self.features.keypoints[keypoint as usize].at();
        (self.inverse * at.extend(1.0)).truncate()
    }
}

/// Features at the pixels at which a camera without distortion would show them; not a number, which matches nothing, where none would.
pub(super) fn pinhole_features<'a>(features: &'a Features, camera: &DCamera) -> Cow<'a, Features> {
    if camera.lens() == Lens::Pinhole {
        return Cow::Borrowed(features);
    }
    let [fx, fy, cx, cy, ..] = camera.parameters;
    let place = |keypoint: &Keypoint| {
        // Not far away: the epipolar line of a point at infinity crosses the other photograph.
        let at = camera.unproject(keypoint.at()).unwrap_or(DVec2::NAN);
        Keypoint {
            x: (at.x * fx + cx) as f32,
            y: (at.y * fy + cy) as f32,
            ..*keypoint
        }
    };
    Cow::Owned(Features {
        keypoints: features.keypoints.iter().map(place).collect(),
        descriptors: features.descriptors.clone(),
        frontal: features.frontal.clone(),
    })
}

/// The matches along epipolar lines, in front of both cameras, of all pairs of the model's photographs that look in similar directions.
fn guided_pairs(photos: &[PhotoInfo], features: &[Features], model: &Model) -> Vec<VerifiedPair> {
    let pinhole = |photo: usize| {
        let camera = model.cameras[photos[photo].group].as_ref()?;
        Some(PinholePhoto::new(photo, &features[photo], camera, model.poses[photo]?))
    };
    let posed: Vec<PinholePhoto> = (0..photos.len()).into_par_iter().filter_map(pinhole).collect();
    let options = MatchOptions {
        ratio: MATCH_RATIO,
        ..MatchOptions::default()
    };
    let all: Vec<[&PinholePhoto; 2]> = posed
        .iter()
        .enumerate()
        .flat_map(|(i, a)| posed[i + 1..].iter().map(move |b| [a, b]))
        .collect();
    all.into_par_iter()
        .filter_map(|pair| guided_pair(pair, &options))
        .collect()
}

/// The matches of one pair; `None` for photographs taken from one place, or in directions that differ too much.
fn guided_pair([a, b]: [&PinholePhoto; 2], options: &MatchOptions) -> Option<VerifiedPair> {
    let [axis_a, axis_b] = [a, b].map(|photo| photo.pose.rotation * DVec3::Z);
    if axis_a.dot(axis_b) < MAX_AXIS_ANGLE_DEGREES.to_radians().cos() {
        return None;
    }
    let motion = Motion {
        rotation: (b.pose.rotation.inverse() * a.pose.rotation).normalize(),
        translation: b.pose.camera_from_world(a.pose.position).try_normalize()?,
    };
    let lines = b.inverse.transpose() * motion.essential() * a.inverse;
    let mut matches = match_guided(&a.features, &b.features, &lines, MAX_LINE_DISTANCE_PIXELS, options);
    matches.retain(|[i, j]| {
        motion
            .depths([a.on_plane(*i), b.on_plane(*j)])
            .iter()
            .all(|depth| *depth > 0.0)
    });
    Some(VerifiedPair {
        photos: [a.photo, b.photo],
        matches,
        kind: PairKind::General,
        motion,
        // The angle between the axes: tracks only use the matches.
        angle: axis_a.angle_between(axis_b),
    })
}

/// `[photos]` the positions at which each shows points of the model, px, and their depths.
fn known_depths(photos: &[PhotoInfo], features: &[Features], model: &Model) -> Vec<Vec<(DVec2, f64)>> {
    let mut depths = vec![Vec::new(); photos.len()];
    for point in &model.points {
        for observation in &point.track {
            let known = position_and_depth(point, *observation, features, model);
            depths[observation.0 as usize].extend(known);
        }
    }
    depths
}

/// The position at which a photograph shows `point`, px, and its depth.
fn position_and_depth(
    point: &ModelPoint,
    (photo, keypoint): (u32, u32),
    features: &[Features],
    model: &Model,
) -> Option<(DVec2, f64)> {
    let at = features[photo as usize].keypoints[keypoint as usize].at();
    let pose = model.poses[photo as usize].as_ref()?;
    Some((at, pose.camera_from_world(point.position).z))
}

/// Whether the depth of `point` is within the range of the points beside it in each photograph.
fn has_consistent_depth(
    point: &ModelPoint,
    photos: &[PhotoInfo],
    features: &[Features],
    model: &Model,
    depths: &[Vec<(DVec2, f64)>],
) -> bool {
    point.track.iter().all(|observation| {
        let photo = &photos[observation.0 as usize];
        let Some((at, depth)) = position_and_depth(point, *observation, features, model) else {
            return false;
        };
        let radius = NEIGHBOUR_RADIUS * photo.long_side();
        let mut neighbours: Vec<(f64, f64)> = depths[observation.0 as usize]
            .iter()
            .map(|(other, depth)| (other.distance_squared(at), *depth))
            .filter(|(distance2, _)| *distance2 < radius * radius)
            .collect();
        neighbours.sort_by(|a, b| a.0.total_cmp(&b.0));
        neighbours.truncate(MAX_NEIGHBOURS);
        let range = neighbours.iter().fold([f64::INFINITY, 0.0], |[low, high], (_, depth)| {
            [depth.min(low), depth.max(high)]
        });
        let within = range[0] * (1.0 - DEPTH_TOLERANCE)..range[1] * (1.0 + DEPTH_TOLERANCE);
        neighbours.len() >= MIN_NEIGHBOURS && within.contains(&depth)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DESCRIPTOR_BYTES;

    #[test]
    fn keypoints_that_no_pinhole_camera_shows_match_nothing() {
        let mut camera = DCamera::centered(1000, 750, 600.0);
        camera.parameters[4] = -0.5;
        let at = |x: f32, y: f32| Keypoint {
            x,
            y,
            scale: 2.0,
            angle: 0.0,
        };
        let features = Features {
            keypoints: vec![at(520.0, 395.0), at(990.0, 740.0)],
            descriptors: vec![[45; DESCRIPTOR_BYTES]; 2],
            frontal: Vec::new(),
        };
        assert!(camera.unproject(features.keypoints[1].at()).is_none());
        let pinhole = pinhole_features(&features, &camera);
        // A forward motion: the epipolar line of a point far away on the diagonal is the diagonal, on which the first keypoint is.
        let inverse = inverse_calibration(&camera);
        let essential = crate::geometry::essential::cross_matrix(DVec3::Z);
        let lines = inverse.transpose() * essential * inverse;
        let matches = match_guided(&pinhole, &pinhole, &lines, 2.0, &MatchOptions::default());
        assert_eq!(matches, [[0, 0]]);
    }
}
