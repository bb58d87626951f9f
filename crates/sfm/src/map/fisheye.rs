//! Cameras whose lens is a fisheye, which no metadata tell.
//!
//! Under a perspective lens, a fisheye of 120 degrees and more bends by more than two radial coefficients can follow: the middle of the pictures is posed
//! to a few degrees, and what is near the rim is dropped. An adjustment of the same observations with a fisheye then has a much lower cost, and the
//! scene is mapped again with it.

use super::types::{Model, PhotoInfo};
use super::zoom::covering;
use crate::Features;
use crate::adjust::{AdjustOptions, AdjustedCamera, Focal, Freedom, Loss, Observation, Problem, View};
use crate::geometry::camera::DCamera;
use glam::DVec2;

/// Focal length in long sides above which no fisheye is tried: that of 71 degrees along the long side.
const WIDE: f64 = 0.7;
/// The cost with a fisheye by that with a perspective lens, at most: 0.52 and 0.81 where a lens is a fisheye, 1.85 where it is not.
const BETTER: f64 = 0.9;
/// Photographs that determine a lens, at least.
const LEAST: usize = 5;

/// The cameras of a model that are rather fisheyes: groups, and the cameras that fit.
pub(super) fn find(photos: &[PhotoInfo], features: &[Features], model: &Model) -> Vec<(usize, DCamera)> {
    let is_wide = |camera: &DCamera| camera.focal() < WIDE * f64::from(camera.width.max(camera.height));
    let count = |group: usize| {
        (0..photos.len())
            .filter(|p| photos[*p].group == group && model.poses[*p].is_some())
            .count()
    };
    let is_known = |group: usize| {
        photos
            .iter()
            .any(|photo| photo.group == group && photo.camera.is_some())
    };
    let groups = (0..model.cameras.len()).filter(|group| {
        let wide = model.cameras[*group].as_ref().is_some_and(is_wide);
        wide && count(*group) >= LEAST && !is_known(*group)
    });
    let groups: Vec<usize> = groups.collect();
    if groups.is_empty() {
        return Vec::new();
    }
    let adjusted = |fisheye: bool| {
        let mut problem = problem(photos, features, model, &groups, fisheye);
        let report = problem.solve(&AdjustOptions {
            loss: Loss::Cauchy(1.0),
            iterations: 50,
            tolerance: 1e-4,
        });
        (report.final_cost, problem)
    };
    let ((perspective, _), (fisheye, found)) = (adjusted(false), adjusted(true));
    if fisheye.is_nan() || fisheye > BETTER * perspective {
        return Vec::new();
    }
    groups
        .into_iter()
        .map(|group| (group, found.cameras[group].camera))
        .collect()
}

/// The adjustment of a model, in which the lenses of `groups` are free.
fn problem(photos: &[PhotoInfo], features: &[Features], model: &Model, groups: &[usize], fisheye: bool) -> Problem {
    let mut problem = Problem::default();
    for (group, camera) in model.cameras.iter().enumerate() {
        let camera = camera.unwrap_or(DCamera::centered(1, 1, 1.0));
        problem.cameras.push(if groups.contains(&group) {
            let freedom = Freedom {
                focal: Focal::Tied,
                radial: 2,
                ..Freedom::HELD
            };
            AdjustedCamera::new(if fisheye { as_fisheye(&camera) } else { camera }, freedom)
        } else {
            AdjustedCamera::new(camera, Freedom::HELD)
        });
    }
    let mut number = vec![u32::MAX; photos.len()];
    for (photo, pose) in model.poses.iter().enumerate() {
        let Some(pose) = pose else { continue };
        number[photo] = problem.poses.len() as u32;
        problem.views.push(View::new(number[photo], photos[photo].group as u32));
        problem.poses.push(*pose);
        problem.held_poses.push(false);
    }
    problem.starts.push(0);
    for point in covering(model, photos.len()) {
        let point = &model.points[point];
        for (photo, keypoint) in &point.track {
            let k = &features[*photo as usize].keypoints[*keypoint as usize];
            problem.observations.push(Observation {
                view: number[*photo as usize],
                at: DVec2::new(k.x.into(), k.y.into()),
            });
        }
        problem.points.push(point.position);
        problem.held_points.push(false);
        problem.starts.push(problem.observations.len() as u32);
    }
    problem
}

/// The fisheye that shows the angles up to 45 degrees from the axis where the perspective camera does: of its two radial coefficients, 1 / 3 is what
/// the tangent has more than the angle.
fn as_fisheye(camera: &DCamera) -> DCamera {
    let [fx, fy, cx, cy, ..] = camera.parameters;
    DCamera {
        parameters: [fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0],
        fisheye: true,
        ..*camera
    }
}
