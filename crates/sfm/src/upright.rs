//! Which way is up in a scene, from how its photographs were held.

use crate::geometry::linear::{scatter, symmetric_eigen};
use crate::geometry::pose::DPose;
use crate::median;
use glam::{DQuat, DVec3};

/// Standard deviation of the viewing directions of a survey about their mean at most, degrees.
const PARALLEL: f64 = 15.0;
/// Standard deviation of the positions of its cameras across their views at least, in the direction in which it is less, by the distance of the points.
/// Of 50 captures those by kite and by drone have 0.27 and 0.47 (12 and 3 degrees); those that look ahead so nearly in parallel up to 0.21.
const SPREAD: f64 = 0.25;

/// The direction up, from the rotation of each camera to the world and the direction up in its own axes, if known: photographs are
/// held level more often than not, so that all their x axes lie in one horizontal plane.
///
/// Its normal is the answer if the x axes leave no doubt about it and it agrees with the mean of the photographs' own up
/// directions; otherwise that mean.
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
    // Within 30 degrees, and the second axis at least five times as wide as what is left over.
    if values[1] > 5.0 * values[0] && values[1] > 0.02 * values[2] && normal.dot(mean) > 0.866 {
        normal
    } else {
        mean
    }
}

/// A scene that is photographed straight from above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Survey {
    /// Against the cameras' common direction, a unit vector.
    pub up: DVec3,
    /// Of the ground, below the mean of the cameras.
    pub center: DVec3,
}

/// The survey that `cameras` made of `points`, if they look straight down as those of one do: in one direction, from all over a plane across it,
/// farther apart than handheld photographs of a wall are. None of its photographs has an up of its own.
pub fn survey(cameras: &[DPose], points: impl Iterator<Item = DVec3>) -> Option<Survey> {
    let n = cameras.len() as f64;
    let forward = (cameras.iter().map(|pose| pose.rotation * DVec3::Z).sum::<DVec3>()).try_normalize()?;
    let off = |pose: &DPose| (pose.rotation * DVec3::Z).angle_between(forward).to_degrees().powi(2);
    let apart = (cameras.iter().map(off).sum::<f64>() / n).sqrt();
    if apart >= PARALLEL {
        return None;
    }
    let mean = cameras.iter().map(|pose| pose.position).sum::<DVec3>() / n;
    let depth = median(points.map(|point| (point - mean).dot(forward)).collect())?;
    let across = (cameras.iter()).map(|pose| (pose.position - mean).reject_from_normalized(forward));
    // The first eigenvalue is that along the views.
    let ([_, narrow, _], _) = symmetric_eigen(scatter(across));
    (depth > 0.0 && (narrow / n).sqrt() > SPREAD * depth).then_some(Survey {
        up: -forward,
        center: mean + depth * forward,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras on a grid, `step` apart, that look nearly along +Z.
    fn grid(step: f64) -> Vec<DPose> {
        let places = (0..20).map(|i| DVec3::new(step * f64::from(i % 5), step * f64::from(i / 5), 0.0));
        let pose = |position| DPose {
            rotation: DQuat::from_rotation_y(0.05),
            position,
        };
        places.map(pose).collect()
    }

    #[test]
    fn a_survey_looks_down_and_a_few_steps_before_a_wall_do_not() {
        let points = || (0..9).map(|i| DVec3::new(f64::from(i), 1.0, 4.0));
        let found = survey(&grid(1.0), points()).expect("a survey");
        assert!(found.up.angle_between(DVec3::NEG_Z) < 0.06, "{found:?}");
        assert!((found.center - DVec3::new(2.0, 1.5, 4.0)).length() < 0.3, "{found:?}");
        assert_eq!(survey(&grid(0.5), points()), None);
        // Around something.
        let mut around = grid(1.0);
        for (i, pose) in around.iter_mut().enumerate() {
            pose.rotation = DQuat::from_rotation_y(0.1 * i as f64 - 1.0);
        }
        assert_eq!(survey(&around, points()), None);
    }
}
