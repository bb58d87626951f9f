//! Adjusts a finished model once more with other cameras, on some of its observations, to see whether these cameras fit better.

use super::covering::covering;
use super::types::{Model, PhotoInfo};
use crate::Features;
use crate::adjust::{AdjustOptions, AdjustedCamera, Loss, Observation, Problem, View};

/// Number of observations of each photograph, from long tracks, that are adjusted.
const MIN_PHOTO_OBSERVATIONS: usize = 200;

/// The fraction by which the cost falls; 0 where that is not defined.
pub(super) fn cost_reduction(before: f64, after: f64) -> f64 {
    let fraction = 1.0 - after / before;
    if fraction.is_finite() { fraction } else { 0.0 }
}

/// The photographs of `model` with a pose.
pub(super) fn posed(model: &Model) -> impl Iterator<Item = usize> {
    (0..model.poses.len()).filter(|photo| model.poses[*photo].is_some())
}

/// The adjustment problem of `model` with other cameras; `camera_of` returns the index of each posed photograph's camera in `cameras`.
pub(super) fn problem(
    photos: &[PhotoInfo],
    features: &[Features],
    model: &Model,
    cameras: Vec<AdjustedCamera>,
    camera_of: impl Fn(usize) -> usize,
) -> Problem {
    let mut problem = Problem {
        cameras,
        starts: vec![0],
        ..Problem::default()
    };
    let mut number = vec![u32::MAX; photos.len()];
    for photo in posed(model) {
        number[photo] = problem.poses.len() as u32;
        problem.views.push(View::new(number[photo], camera_of(photo) as u32));
        problem.poses.push(model.poses[photo].expect("posed"));
        problem.held_poses.push(false);
    }
    let photos_of = |point: usize| model.points[point].track.iter().map(|(photo, _)| *photo as usize);
    for point in covering(0..model.points.len(), photos.len(), MIN_PHOTO_OBSERVATIONS, photos_of) {
        let point = &model.points[point];
        for (photo, keypoint) in &point.track {
            problem.observations.push(Observation {
                view: number[*photo as usize],
                at: features[*photo as usize].keypoints[*keypoint as usize].at(),
            });
        }
        problem.points.push(point.position);
        problem.held_points.push(false);
        problem.starts.push(problem.observations.len() as u32);
    }
    problem
}

/// Options for such a problem: it is solved until costs can be compared.
pub(super) const OPTIONS: AdjustOptions = AdjustOptions {
    loss: Loss::Cauchy(1.0),
    iterations: 40,
    tolerance: 3e-4,
};
