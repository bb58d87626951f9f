//! Cameras whose lens is a fisheye, which no metadata tell.
//!
//! Under a perspective lens, a fisheye of 120 degrees and more bends by more than two radial coefficients can follow: the middle of the pictures is posed
//! to a few degrees, and what is near the rim is dropped. An adjustment of the same observations with a fisheye then has a much lower cost, and the
//! scene is mapped again with it.

use super::readjust;
use super::types::{Model, PhotoInfo};
use crate::Features;
use crate::adjust::{AdjustedCamera, Focal, Freedom};
use crate::geometry::camera::DCamera;

/// Focal length in long sides above which no fisheye is tried: that of 71 degrees along the long side.
const WIDE: f64 = 0.7;
/// The cost with a fisheye by that with a perspective lens, at most: 0.52 and 0.81 where a lens is a fisheye, 1.85 where it is not.
const BETTER: f64 = 0.9;
/// Photographs that determine a lens, at least.
const LEAST: usize = 5;

/// The cameras of a model that are rather fisheyes: groups, and the cameras that fit.
pub(super) fn find(photos: &[PhotoInfo], features: &[Features], model: &Model) -> Vec<(usize, DCamera)> {
    let is_wide = |camera: &DCamera| camera.focal() < WIDE * camera.long_side();
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
        let cameras = cameras(model, &groups, fisheye);
        let mut problem = readjust::problem(photos, features, model, cameras, |photo| photos[photo].group);
        (problem.solve(&readjust::OPTIONS).final_cost, problem)
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

/// `[groups]` the cameras of a model, of which the lenses of `groups` are free.
fn cameras(model: &Model, groups: &[usize], fisheye: bool) -> Vec<AdjustedCamera> {
    let camera = |(group, camera): (usize, &Option<DCamera>)| {
        let camera = camera.unwrap_or(DCamera::centered(1, 1, 1.0));
        if !groups.contains(&group) {
            return AdjustedCamera::new(camera, Freedom::HELD);
        }
        let freedom = Freedom {
            focal: Focal::Tied,
            radial: 2,
            ..Freedom::HELD
        };
        AdjustedCamera::new(if fisheye { as_fisheye(&camera) } else { camera }, freedom)
    };
    model.cameras.iter().enumerate().map(camera).collect()
}

/// The fisheye that shows what is near the axis where the perspective camera does.
fn as_fisheye(camera: &DCamera) -> DCamera {
    let [fx, fy, cx, cy, ..] = camera.parameters;
    DCamera {
        parameters: [fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0],
        fisheye: true,
        ..*camera
    }
}
