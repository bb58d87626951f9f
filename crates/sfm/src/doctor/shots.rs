//! Poses of further photographs that would repair a capture.

use super::Diagnosis;
use crate::geometry::pose::DPose;
use crate::map::Model;
use glam::{DQuat, DVec3};

/// Angle between neighbouring photographs around a scene at which they match well, degrees.
const MAX_STEP_DEGREES: f64 = 15.0;
/// Maximum number of photographs for one fault.
const MAX_SHOTS: usize = 8;
/// Minimum angle between two cameras, seen from the centre of the model, at which the path between them is an arc around it, degrees.
const MIN_ARC_DEGREES: f64 = 10.0;

/// The pose of a photograph to be taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// In the model's world.
    pub position: DVec3,
    /// Unit viewing direction, world.
    pub forward: DVec3,
}

/// Photographs that would repair a fault between two posed photographs, from one to the other; none for other faults. In `model`, +Z is up
/// and the centre of the scene is on the vertical axis through the origin ([`Model::upright`]).
pub fn shots(diagnosis: &Diagnosis, model: &Model) -> Vec<Shot> {
    let ([a, b], min_shots) = match diagnosis {
        Diagnosis::Gap { sides: ends, .. } | Diagnosis::OpenLoop { ends, .. } => (*ends, 1),
        Diagnosis::Bridge { photos, .. } => (*photos, 2),
        Diagnosis::CutPoint { .. } | Diagnosis::FewPartners { .. } => match diagnosis.sides() {
            (a, Some(b)) => ([a, b], 2),
            _ => return Vec::new(),
        },
        _ => return Vec::new(),
    };
    match (model.poses[a], model.poses[b]) {
        (Some(a), Some(b)) => shots_between(&a, &b, min_shots),
        _ => Vec::new(),
    }
}

/// Poses between two, on an arc around the vertical axis through the centre of the model where both are on different sides of it.
fn shots_between(a: &DPose, b: &DPose, min_shots: usize) -> Vec<Shot> {
    let azimuth = |p: DVec3| p.y.atan2(p.x);
    let azimuth_difference = (azimuth(b.position) - azimuth(a.position) + std::f64::consts::PI)
        .rem_euclid(std::f64::consts::TAU)
        - std::f64::consts::PI;
    let forward = [a, b].map(|pose| pose.rotation * DVec3::Z);
    let angle_degrees = forward[0]
        .angle_between(forward[1])
        .to_degrees()
        .max(azimuth_difference.to_degrees().abs());
    let count = ((angle_degrees / MAX_STEP_DEGREES).ceil() as usize)
        .saturating_sub(1)
        .clamp(min_shots, MAX_SHOTS);
    let shot = |i: usize| {
        let t = (i + 1) as f64 / (count + 1) as f64;
        let straight = a.position.lerp(b.position, t);
        let position = if azimuth_difference.to_degrees().abs() < MIN_ARC_DEGREES {
            straight
        } else {
            let radius = |p: DVec3| p.truncate().length();
            let radius = radius(a.position) * (1.0 - t) + radius(b.position) * t;
            let (sin, cos) = (azimuth(a.position) + t * azimuth_difference).sin_cos();
            DVec3::new(radius * cos, radius * sin, straight.z)
        };
        let arc = DQuat::from_rotation_arc(forward[0], forward[1]);
        let forward = (DQuat::IDENTITY.slerp(arc, t) * forward[0]).normalize_or(DVec3::X);
        Shot { position, forward }
    };
    (0..count).map(shot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::align::Alignment;
    use crate::map::{ModelPoint, PhotoInfo};
    use glam::DMat3;

    /// A camera on the unit circle that looks at the origin.
    fn at(degrees: f64) -> DPose {
        let position = DQuat::from_rotation_z(degrees.to_radians()) * DVec3::X;
        DPose {
            rotation: DQuat::from_rotation_arc(DVec3::Z, -position),
            position,
        }
    }

    #[test]
    fn a_gap_is_filled_along_its_arc() {
        let model = Model {
            poses: vec![Some(at(0.0)), Some(at(60.0)), None],
            ..Model::default()
        };
        let gap = Diagnosis::Gap {
            sides: [0, 1],
            degrees: 60.0,
        };
        let found = shots(&gap, &model);
        assert_eq!(found.len(), 3);
        for (shot, degrees) in found.iter().zip([15.0, 30.0, 45.0]) {
            assert!((shot.position - at(degrees).position).length() < 1e-6);
            assert!((shot.forward + shot.position).length() < 1e-6);
        }
        let unposed = Diagnosis::Gap {
            sides: [0, 2],
            degrees: 60.0,
        };
        assert!(shots(&unposed, &model).is_empty());
        assert!(shots(&Diagnosis::Duplicate { photos: [0, 1] }, &model).is_empty());
    }

    #[test]
    fn a_gap_is_filled_along_its_arc_in_the_world_of_known_poses() {
        let level = |degrees: f64| {
            let back = DQuat::from_rotation_z(degrees.to_radians()) * DVec3::X;
            let axes = DMat3::from_cols(DVec3::Z.cross(back), DVec3::NEG_Z, -back);
            DPose {
                rotation: DQuat::from_mat3(&axes),
                position: back,
            }
        };
        let point = |position: DVec3| ModelPoint {
            position,
            track: Vec::new(),
            error: 0.0,
        };
        let mut model = Model {
            cameras: vec![None],
            poses: (0..11).map(|i| Some(level(31.0 * f64::from(i)))).collect(),
            points: [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(point).to_vec(),
            focal_held: vec![false],
        };
        let photos = [0; 11].map(|_| PhotoInfo::new(String::new(), 100, 100));
        // Y points down, and the scene is far from the origin.
        model.align(&Alignment {
            scale: 20.0,
            rotation: DQuat::from_rotation_x(1.6),
            translation: DVec3::new(100.0, 200.0, -50.0),
        });
        let gap = Diagnosis::Gap {
            sides: [10, 0],
            degrees: 50.0,
        };
        let found = shots(&gap, &model.upright(&photos));
        assert_eq!(found.len(), 3);
        for shot in found {
            assert!(shot.position.z.abs() < 1e-6 && (shot.position.length() - 1.0).abs() < 1e-6);
            assert!((shot.forward + shot.position).length() < 1e-6);
        }
    }
}
