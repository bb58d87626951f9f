use glam::{Mat3, Quat, Vec3};

/// Position and orientation of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation of camera axes (OpenCV: x right, y down, z forward) into the world.
    pub rotation: Quat,
    /// Camera centre, world units.
    pub position: Vec3,
}

impl Pose {
    /// A camera at `eye` looking at `target`; `up` is the world's up and need not be orthogonal to the view direction.
    ///
    /// When `up` is parallel to the view direction, any perpendicular up is used.
    pub fn look_at(eye: Vec3, target: Vec3, up: Vec3) -> Self {
        let forward = (target - eye).normalize_or(Vec3::Z);
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let down = forward.cross(right);
        Self {
            rotation: Quat::from_mat3(&Mat3::from_cols(right, down, forward)),
            position: eye,
        }
    }

    /// From a `camera_from_world` rotation and translation (COLMAP's convention: `x_cam = R x + t`).
    pub fn from_camera_from_world(rotation: Quat, translation: Vec3) -> Self {
        let world_from_camera = rotation.normalize().inverse();
        Self {
            rotation: world_from_camera,
            position: -(world_from_camera * translation),
        }
    }

    /// Transforms a point from camera space to world space.
    pub fn world_from_camera(&self, point: Vec3) -> Vec3 {
        self.rotation * point + self.position
    }

    /// Transforms a point from world space to camera space.
    pub fn camera_from_world(&self, point: Vec3) -> Vec3 {
        self.rotation.inverse() * (point - self.position)
    }

    /// The 3x3 rotation and translation of `x_cam = R x + t`.
    pub fn camera_from_world_parts(&self) -> (Mat3, Vec3) {
        let rotation = Mat3::from_quat(self.rotation.normalize()).transpose();
        (rotation, -(rotation * self.position))
    }

    /// How far `other` is: the distance of the positions in units of `unit`, plus the angle of the rotations.
    pub fn distance(&self, other: &Self, unit: f32) -> f32 {
        self.position.distance(other.position) / unit + self.rotation.angle_between(other.rotation)
    }

    /// Whether every number is finite and the rotation is not the zero quaternion.
    pub fn is_valid(&self) -> bool {
        self.rotation.is_finite() && self.position.is_finite() && self.rotation.length_squared() > 1e-12
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn look_at_centres_the_target_and_keeps_up() {
        let pose = Pose::look_at(Vec3::new(3.0, -2.0, 1.0), Vec3::ZERO, Vec3::Z);
        let target = pose.camera_from_world(Vec3::ZERO);
        assert!(target.x.abs() < 1e-5 && target.y.abs() < 1e-5);
        assert!((target.z - 14f32.sqrt()).abs() < 1e-5);
        let above = pose.camera_from_world(Vec3::Z * 0.1);
        assert!(above.y < 0.0, "up is -y in OpenCV axes");
        assert!((pose.rotation.length() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn world_and_camera_transforms_are_inverse() {
        let pose = Pose::from_camera_from_world(Quat::from_xyzw(0.1, 0.5, -0.3, 0.8), Vec3::new(1.0, 2.0, 3.0));
        let p = Vec3::new(0.3, -0.7, 2.0);
        assert!((pose.world_from_camera(pose.camera_from_world(p)) - p).length() < 1e-5);
        let (r, t) = pose.camera_from_world_parts();
        assert!((r * p + t - pose.camera_from_world(p)).length() < 1e-5);
        assert!((t - Vec3::new(1.0, 2.0, 3.0)).length() < 1e-5);
    }

    #[test]
    fn look_at_along_the_up_axis_is_a_valid_rotation() {
        let pose = Pose::look_at(Vec3::Z, Vec3::ZERO, Vec3::Z);
        assert!(pose.is_valid() && (pose.rotation.length() - 1.0).abs() < 1e-5);
    }
}
