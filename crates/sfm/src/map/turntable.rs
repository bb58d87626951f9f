//! Detection of turntables by their poses: the scene turns about one axis that stands still in front of the camera.
//!
//! A background without texture has no matches that stand still, yet the poses are those relative to the object. But a camera that is
//! carried around an object never keeps the axis so exactly: in seven captures by hand (21 to 290 photographs) no four photographs share
//! one, while of a toy on a turntable 79 of 97 do, at six heights.

use super::types::Model;
use crate::geometry::pose::DPose;
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Minimum number of photographs in a ring, which is at one height, and minimum fraction of all photographs that are in rings.
const MIN_RING_PHOTOS: usize = 6;
const MIN_RING_FRACTION: f64 = 0.5;
/// Angles of rotation between two photographs that determine an axis, radians.
const ROTATION_RANGE_RADIANS: std::ops::Range<f64> = 8.0 * PI / 180.0..170.0 * PI / 180.0;
/// How much the axes of one ring may differ: cosine of the maximum angle between them, and their maximum distance relative to the
/// distance from the camera; and the maximum shift along an axis, also relative to that distance.
const MIN_AXIS_COSINE: f64 = 0.99985;
const MAX_AXIS_DISTANCE: f64 = 0.02;
const MAX_AXIS_SHIFT: f64 = 0.01;
/// Maximum number of photographs from which rings are searched: each ring has many.
const MAX_ANCHORS: usize = 64;

/// The axis about which the scene turns, in camera axes.
struct Axis {
    direction: DVec3,
    /// Its point nearest to the camera.
    point: DVec3,
}

impl Axis {
    /// The axis about which the scene turns between the cameras at `b` and `a`, in the axes of `a`, if it turns enough and does not shift
    /// along the axis.
    fn between(a: &DPose, b: &DPose) -> Option<Self> {
        let rotation = (a.rotation.inverse() * b.rotation).normalize();
        let rotation = if rotation.w < 0.0 { -rotation } else { rotation };
        let (direction, angle) = rotation.to_axis_angle();
        let shift = a.camera_from_world(b.position);
        let along = direction.dot(shift);
        let across = shift - along * direction;
        let point = 0.5 * (across + direction.cross(across) / (0.5 * angle).tan());
        (ROTATION_RANGE_RADIANS.contains(&angle) && along.abs() < MAX_AXIS_SHIFT * point.length())
            .then_some(Self { direction, point })
    }

    fn is_near(&self, other: &Self) -> bool {
        self.direction.dot(other.direction).abs() > MIN_AXIS_COSINE
            && self.point.distance(other.point) < MAX_AXIS_DISTANCE * self.point.length()
    }
}

/// The photographs of each ring, largest first, if the model is that of a turntable; otherwise empty.
pub fn turntable_rings(model: &Model) -> Vec<Vec<usize>> {
    let posed = model.poses.iter().enumerate().filter(|(_, pose)| pose.is_some());
    let mut remaining: Vec<usize> = posed.map(|(photo, _)| photo).collect();
    let all = remaining.len();
    let mut rings = Vec::new();
    while let Some(ring) = largest_ring(model, &remaining) {
        remaining.retain(|photo| !ring.contains(photo));
        rings.push(ring);
    }
    let in_rings: usize = rings.iter().map(Vec::len).sum();
    if in_rings as f64 >= MIN_RING_FRACTION * all as f64 {
        rings
    } else {
        Vec::new()
    }
}

fn largest_ring(model: &Model, of: &[usize]) -> Option<Vec<usize>> {
    let pose = |photo: usize| model.poses[photo].as_ref().expect("selected");
    let around = |anchor: usize| -> Vec<usize> {
        let others = of.iter().filter(|photo| **photo != anchor);
        let axes: Vec<(usize, Axis)> = others
            .filter_map(|photo| Some((*photo, Axis::between(pose(anchor), pose(*photo))?)))
            .collect();
        let best = axes.iter().rev().max_by_key(|(_, axis)| near(axis, &axes).count());
        best.map_or(Vec::new(), |(_, axis)| near(axis, &axes).chain([anchor]).collect())
    };
    let rings: Vec<Vec<usize>> = of
        .par_iter()
        .step_by(of.len().div_ceil(MAX_ANCHORS).max(1))
        .map(|anchor| around(*anchor))
        .collect();
    // The first of several rings of equal size.
    let ring = rings.into_iter().rev().max_by_key(Vec::len)?;
    (ring.len() >= MIN_RING_PHOTOS).then_some(ring)
}

/// The photographs of those `axes` that are near `axis`.
fn near<'a>(axis: &'a Axis, axes: &'a [(usize, Axis)]) -> impl Iterator<Item = usize> + 'a {
    axes.iter().filter(|of| axis.is_near(&of.1)).map(|of| of.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DQuat};
    use irradia_scene::Rng;

    /// Poses on two rings around the origin; each camera is turned and shifted at random by `error`, in radians and distances.
    fn rings(error: f64) -> Model {
        let mut rng = Rng::new(7, 0);
        let mut random = || error * f64::from(rng.normal());
        let pose = |i: usize| {
            let angle = 2.0 * PI * i as f64 / 12.0;
            let height = if i < 12 { 0.5 } else { 1.5 };
            let shift = DVec3::new(random(), random(), random());
            let position = DVec3::new(2.0 * angle.cos(), 2.0 * angle.sin(), height) + shift;
            let forward = (DVec3::new(0.0, 0.0, 0.2) - position).normalize();
            let right = forward.cross(DVec3::Z).normalize();
            let rotation = DQuat::from_mat3(&DMat3::from_cols(right, forward.cross(right), forward));
            let turn = DVec3::new(random(), random(), random());
            Some(DPose { rotation, position }.moved(turn, DVec3::ZERO))
        };
        Model {
            cameras: Vec::new(),
            poses: (0..24).map(pose).collect(),
            points: Vec::new(),
            focal_held: Vec::new(),
        }
    }

    #[test]
    fn an_axis_is_that_of_the_turn() {
        let direction = DVec3::new(0.2, 0.9, 0.3).normalize();
        let place = DVec3::new(0.1, 0.0, 2.0);
        let place = place - direction * direction.dot(place);
        let turn = DQuat::from_axis_angle(direction, 0.8);
        let a = DPose::IDENTITY;
        let b = DPose {
            rotation: turn,
            position: place - turn * place,
        };
        let axis = Axis::between(&a, &b).expect("turned");
        assert!(axis.direction.dot(direction).abs() > 1.0 - 1e-12);
        assert!(axis.point.distance(place) < 1e-9, "{}", axis.point);
    }

    #[test]
    fn each_height_is_a_ring() {
        let mut found = turntable_rings(&rings(0.0));
        found.iter_mut().for_each(|ring| ring.sort_unstable());
        found.sort_unstable();
        // The photograph on the opposite side is turned too far to determine an axis.
        assert_eq!(found.len(), 2, "{found:?}");
        for (ring, first) in found.iter().zip([0, 12]) {
            assert!(ring.len() >= 11, "{ring:?}");
            assert!(ring.iter().all(|photo| (first..first + 12).contains(photo)), "{ring:?}");
        }
    }

    #[test]
    fn hands_hold_no_axis() {
        assert_eq!(turntable_rings(&rings(0.03)), Vec::<Vec<usize>>::new());
    }
}
