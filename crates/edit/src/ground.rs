//! The ground: the densest plane below the cameras.

use crate::Draft;
use glam::{DMat3, DQuat, DVec3, Vec3};
use irradia_scene::{Camera, Rng, survey};
use irradia_splat::sigmoid;
use rayon::prelude::*;

/// Number of planes that are scored, among those through three points that can be the ground.
const MAX_CANDIDATE_PLANES: usize = 2000;
/// Number of triples of points that are drawn: few of them lie on a plane below the cameras.
const MAX_DRAWS: usize = 200_000;
/// Number of splats sampled, at random in proportion to opacity times area.
const SAMPLED_SPLATS: usize = 20_000;
/// Half the thickness of the plane, as a fraction of the median distance of splats from their centre.
const HALF_THICKNESS: f64 = 0.02;
/// Cosine of the largest angle between the ground's normal and the cameras' up: people tilt their cameras.
const MIN_UP_COSINE: f64 = 0.7;
/// Sizes are clamped to this fraction of the scene's: the background's splats are huge.
const MAX_SPLAT_SIZE: f64 = 0.05;
/// Minimum share of the sampled splats that a ground contains.
const MIN_INLIER_SHARE: f64 = 0.05;

/// The up direction of a scene, and its ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// Unit vector that points up.
    pub up: [f64; 3],
    /// A point on the ground; `None` if no plane was found.
    pub point: Option<[f64; 3]>,
}

/// Finds the up direction and the ground in the coordinates of the dataset: up is near the cameras' mean up, and the ground is the plane
/// that contains the most opacity and has the cameras above it. Without such a plane, up is the cameras' mean up. Cameras that look straight
/// down, as in a survey, have up behind them instead. `None` without cameras.
pub fn ground(draft: &Draft) -> Option<Ground> {
    if draft.cameras.is_empty() {
        return None;
    }
    let of = |camera: &Camera| (camera.pose.rotation.as_dquat(), camera.pose.position.as_dvec3());
    let cameras: Vec<(DQuat, DVec3)> = draft.cameras.iter().map(of).collect();
    let points = sample_points(draft);
    let mean_up = || {
        let ups = draft.cameras.iter().map(|camera| camera.pose.rotation * Vec3::NEG_Y);
        ups.map(|up| up.as_dvec3()).sum::<DVec3>()
    };
    let up = survey(&cameras, points.iter().copied()).map_or_else(mean_up, |survey| survey.up);
    let up = up.normalize_or(DVec3::NEG_Y);
    let eyes: Vec<DVec3> = cameras.iter().map(|(_, position)| *position).collect();
    let plane = densest_plane(&points, &eyes, up);
    let world = draft.cloud.world_from_dataset;
    Some(Ground {
        up: plane.map_or(up, |(normal, _)| normal).to_array(),
        point: plane.map(|(_, point)| world.invert(point).to_array()),
    })
}

/// Centres of splats that are not hidden, world, drawn with replacement in proportion to opacity and area.
fn sample_points(draft: &Draft) -> Vec<DVec3> {
    let cloud = &draft.cloud;
    let mut sums = Vec::with_capacity(draft.len());
    let mut sum = 0.0f64;
    let largest = MAX_SPLAT_SIZE * draft.extent();
    for (i, opacity_logit) in cloud.opacity_logits.iter().enumerate() {
        let mut sizes = cloud.log_scales[i].map(|scale| f64::from(scale).exp().min(largest));
        sizes.sort_unstable_by(f64::total_cmp);
        sum += if draft.hidden.contains(i) {
            0.0
        } else {
            f64::from(sigmoid(*opacity_logit)) * sizes[1] * sizes[2]
        };
        sums.push(sum);
    }
    if sum <= 0.0 {
        return Vec::new();
    }
    let mut rng = Rng::new(1, 0);
    (0..SAMPLED_SPLATS)
        .map(|_| {
            let at = f64::from(rng.uniform()) * sum;
            let i = sums.partition_point(|sum| *sum <= at).min(sums.len() - 1);
            DVec3::from(cloud.means[i].map(f64::from))
        })
        .collect()
}

/// Unit normal and a point of the plane with most of `points` within its thickness (RANSAC, Fischler and Bolles 1981), refined by least
/// squares over them.
fn densest_plane(points: &[DVec3], eyes: &[DVec3], up: DVec3) -> Option<(DVec3, DVec3)> {
    if points.len() < 3 {
        return None;
    }
    let center = points.iter().copied().sum::<DVec3>() / points.len() as f64;
    let mut distances: Vec<f64> = points.iter().map(|p| p.distance(center)).collect();
    let middle = distances.len() / 2;
    let thickness = HALF_THICKNESS * *distances.select_nth_unstable_by(middle, f64::total_cmp).1;
    let is_near = |(normal, origin): &(DVec3, DVec3), p: &DVec3| (*p - *origin).dot(*normal).abs() <= thickness;
    let is_ground = |(normal, origin): &(DVec3, DVec3)| {
        let above = eyes.iter().filter(|eye| (**eye - *origin).dot(*normal) > 0.0).count();
        normal.dot(up) >= MIN_UP_COSINE && 10 * above >= 9 * eyes.len()
    };
    let mut rng = Rng::new(2, 0);
    let candidates: Vec<(DVec3, DVec3)> = (0..MAX_DRAWS)
        .filter_map(|_| {
            let [a, b, c] = [(); 3].map(|()| points[rng.below(points.len() as u32) as usize]);
            let normal = (b - a).cross(c - a).try_normalize()?;
            let plane = (normal * normal.dot(up).signum(), a);
            is_ground(&plane).then_some(plane)
        })
        .take(MAX_CANDIDATE_PLANES)
        .collect();
    let score = |plane: &(DVec3, DVec3)| points.iter().filter(|p| is_near(plane, p)).count();
    let scores: Vec<usize> = candidates.par_iter().map(score).collect();
    // The first of those with equal scores.
    let best = (0..candidates.len()).max_by_key(|i| (scores[*i], usize::MAX - i))?;
    let mut plane = candidates[best];
    for _ in 0..3 {
        let inliers: Vec<DVec3> = points.iter().copied().filter(|p| is_near(&plane, p)).collect();
        let Some(refined) = fit_plane(&inliers, plane.0).filter(is_ground) else {
            break;
        };
        plane = refined;
    }
    (score(&plane) as f64 >= MIN_INLIER_SHARE * points.len() as f64).then_some(plane)
}

/// The least-squares plane, with its normal on the side of `toward`.
fn fit_plane(points: &[DVec3], toward: DVec3) -> Option<(DVec3, DVec3)> {
    if points.len() < 3 {
        return None;
    }
    let center = points.iter().copied().sum::<DVec3>() / points.len() as f64;
    let mut covariance = DMat3::ZERO;
    for p in points {
        let d = *p - center;
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    // The direction of least variance, by power iteration on the inverse, from the normal so far.
    let trace = covariance.col(0).x + covariance.col(1).y + covariance.col(2).z;
    let inverse = (covariance + DMat3::from_diagonal(DVec3::splat(1e-9 * trace))).inverse();
    let mut normal = toward;
    for _ in 0..30 {
        normal = (inverse * normal).try_normalize()?;
    }
    Some((normal * normal.dot(toward).signum(), center))
}
