//! Absolute orientation: the similarity between two sets of points.

use super::linear::svd3;
use super::pose::DPose;
use glam::{DMat3, DQuat, DVec3};

/// A similarity: `to = scale rotation from + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    /// Units of the target per unit of the source.
    pub scale: f64,
    /// From the source's axes to the target's.
    pub rotation: DQuat,
    /// The source's origin in the target.
    pub translation: DVec3,
}

impl Alignment {
    /// A point of the source in the target.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// A pose of the source in the target.
    pub fn pose(&self, pose: &DPose) -> DPose {
        DPose {
            rotation: (self.rotation * pose.rotation).normalize(),
            position: self.point(pose.position),
        }
    }
}

/// The least-squares similarity from pairs (source, target) (Umeyama 1991); `None` for fewer than two distinct points.
///
/// For points on a line the rotation about it is undefined; the result is then an arbitrary one.
pub fn align(pairs: &[(DVec3, DVec3)]) -> Option<Alignment> {
    let n = pairs.len() as f64;
    let from_mean = pairs.iter().map(|p| p.0).sum::<DVec3>() / n;
    let to_mean = pairs.iter().map(|p| p.1).sum::<DVec3>() / n;
    let mut covariance = DMat3::ZERO;
    let mut variance = 0.0;
    for (from, to) in pairs {
        let (from, to) = (*from - from_mean, *to - to_mean);
        covariance += DMat3::from_cols(to * from.x, to * from.y, to * from.z);
        variance += from.length_squared();
    }
    let (u, s, v) = svd3(covariance);
    let sign = (u.determinant() * v.determinant()).signum();
    let rotation = DMat3::from_cols(u.x_axis, u.y_axis, sign * u.z_axis) * v.transpose();
    let scale = (s.x + s.y + sign * s.z) / variance;
    let rotation = DQuat::from_mat3(&rotation).normalize();
    (scale.is_finite() && scale > 0.0).then(|| Alignment {
        scale,
        rotation,
        translation: to_mean - scale * (rotation * from_mean),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_similarity_is_recovered() {
        let truth = Alignment {
            scale: 2.5,
            rotation: DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.0, 2.0),
            translation: DVec3::new(1.0, -5.0, 0.3),
        };
        let points = [
            DVec3::ZERO,
            DVec3::X,
            DVec3::new(0.2, 1.0, 0.1),
            DVec3::new(-1.0, 0.5, 2.0),
        ];
        let found = align(&points.map(|p| (p, truth.point(p)))).expect("distinct points");
        assert!((found.scale - 2.5).abs() < 1e-12);
        assert!(found.rotation.angle_between(truth.rotation) < 1e-7);
        assert!((found.translation - truth.translation).length() < 1e-12);
        assert!(align(&[(DVec3::X, DVec3::Y), (DVec3::X, DVec3::Y)]).is_none());
    }
}
