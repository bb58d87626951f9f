//! The up direction of a scene, from the orientation of its photographs.

use crate::geometry::linear::{scatter, symmetric_eigen};
use glam::{DQuat, DVec3};

/// The up direction, from the rotation of each camera to the world and the up direction in its own axes, if known: most photographs are
/// level, so all their x axes are in one horizontal plane.
///
/// The result is the normal of this plane if the x axes determine it clearly and it agrees with the mean of the photographs' own up
/// directions; otherwise it is that mean.
pub fn up(cameras: impl Iterator<Item = (DQuat, Option<DVec3>)>) -> DVec3 {
    let mut mean = DVec3::ZERO;
    let rights = cameras.map(|(rotation, own)| {
        let own = own.unwrap_or(DVec3::NEG_Y);
        mean += rotation * own;
        rotation * own.cross(DVec3::NEG_Z).normalize_or_zero()
    });
    let (values, vectors) = symmetric_eigen(scatter(rights));
    let mean = mean.normalize_or(DVec3::NEG_Y);
    let normal = DVec3::from_array(vectors[0]);
    let normal = normal * normal.dot(mean).signum();
    // The normal is within 30 degrees of the mean, and the second axis spreads at least five times as much as the normal.
    if values[1] > 5.0 * values[0] && values[1] > 0.02 * values[2] && normal.dot(mean) > 0.866 {
        normal
    } else {
        mean
    }
}
