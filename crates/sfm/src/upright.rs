//! The up direction of a scene, from the orientation of its photographs.

use crate::geometry::linear::{scatter, symmetric_eigen};
use crate::geometry::pose::DPose;
use crate::median;
use glam::{DQuat, DVec3};

/// Maximum standard deviation of the viewing directions of a survey about their mean, degrees.
const MAX_VIEW_DEVIATION_DEGREES: f64 = 15.0;
/// Minimum standard deviation of the positions of its cameras perpendicular to their views, in the direction in which it is smallest,
/// relative to the distance of the points. Of 50 captures, those by kite and by drone have 0.27 and 0.47 (12 and 3 degrees); those that
/// look ahead almost as much in parallel have up to 0.21.
const MIN_POSITION_SPREAD: f64 = 0.25;

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

/// A scene that was photographed from straight above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Survey {
    /// Unit vector opposite to the cameras' common direction.
    pub up: DVec3,
    /// Centre of the ground, below the mean of the cameras.
    pub center: DVec3,
}

/// The survey of `points` by `cameras`, if these look straight down as in a survey: in one direction, from positions all over a plane
/// perpendicular to it, farther apart than handheld photographs of a wall. No photograph of a survey determines up on its own.
pub fn survey(cameras: &[DPose], points: impl Iterator<Item = DVec3>) -> Option<Survey> {
    let n = cameras.len() as f64;
    let forward = (cameras.iter().map(|pose| pose.rotation * DVec3::Z).sum::<DVec3>()).try_normalize()?;
    let squared_deviation = |pose: &DPose| (pose.rotation * DVec3::Z).angle_between(forward).to_degrees().powi(2);
    let deviation = (cameras.iter().map(squared_deviation).sum::<f64>() / n).sqrt();
    if deviation >= MAX_VIEW_DEVIATION_DEGREES {
        return None;
    }
    let mean = cameras.iter().map(|pose| pose.position).sum::<DVec3>() / n;
    let depth = median(points.map(|point| (point - mean).dot(forward)).collect())?;
    let offsets = (cameras.iter()).map(|pose| (pose.position - mean).reject_from_normalized(forward));
    // The first eigenvalue is the one along the views.
    let ([_, minor_variance, _], _) = symmetric_eigen(scatter(offsets));
    (depth > 0.0 && (minor_variance / n).sqrt() > MIN_POSITION_SPREAD * depth).then_some(Survey {
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
        // Cameras that look around.
        let mut around = grid(1.0);
        for (i, pose) in around.iter_mut().enumerate() {
            pose.rotation = DQuat::from_rotation_y(0.1 * i as f64 - 1.0);
        }
        assert_eq!(survey(&around, points()), None);
    }
}
