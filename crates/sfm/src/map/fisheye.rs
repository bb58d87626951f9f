//! Detection of cameras with a fisheye lens, which is not in the metadata.
//!
//! Two radial coefficients of a perspective lens cannot model the distortion of a fisheye of 120 degrees and more: the poses, from the
//! centre of the photographs, are off by a few degrees, and observations near the rim are dropped. An adjustment of the same observations
//! with a fisheye lens then has a much lower cost, and the scene is mapped again with it.

use super::readjust;
use super::types::{Model, PhotoInfo};
use crate::Features;
use crate::adjust::{AdjustedCamera, Focal, Freedom};
use crate::geometry::camera::DCamera;

/// Focal length, relative to the long side, above which no fisheye is tried: it is that of a 71 degree field of view along the long side.
const MAX_FOCAL: f64 = 0.7;
/// Maximum cost with a fisheye relative to that with a perspective lens: 0.52 and 0.81 for fisheye lenses, 1.85 for another lens.
const MAX_COST_RATIO: f64 = 0.9;
/// Minimum number of photographs to determine a lens.
const MIN_PHOTOS: usize = 5;

/// The groups of a model whose lens is rather a fisheye, each with the camera that fits.
pub(super) fn find(photos: &[PhotoInfo], features: &[Features], model: &Model) -> Vec<(usize, DCamera)> {
    let is_wide = |camera: &DCamera| camera.focal() < MAX_FOCAL * camera.long_side();
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
        wide && count(*group) >= MIN_PHOTOS && !is_known(*group)
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
    if fisheye.is_nan() || fisheye > MAX_COST_RATIO * perspective {
        return Vec::new();
    }
    groups
        .into_iter()
        .map(|group| (group, found.cameras[group].camera))
        .collect()
}

/// `[groups]` the cameras of a model; the lenses of `groups` are free, the others are held fixed.
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

/// The fisheye that projects directions near the axis as the perspective camera does.
fn as_fisheye(camera: &DCamera) -> DCamera {
    let [fx, fy, cx, cy, ..] = camera.parameters;
    DCamera {
        parameters: [fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0],
        fisheye: true,
        ..*camera
    }
}
