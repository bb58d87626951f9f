//! Poses in double precision.

use glam::{DMat3, DQuat, DVec3};

/// Position and orientation of a camera in double precision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DPose {
    /// Rotation of camera axes (OpenCV: x right, y down, z forward) into the world.
    pub rotation: DQuat,
    /// Camera centre, world units.
    pub position: DVec3,
}

impl DPose {
    /// A camera at the world's origin with the world's axes.
    pub const IDENTITY: Self = Self {
        rotation: DQuat::IDENTITY,
        position: DVec3::ZERO,
    };

    /// From `x_camera = rotation x_world + translation`.
    pub fn from_camera_from_world(rotation: DQuat, translation: DVec3) -> Self {
        let world_from_camera = rotation.inverse();
        Self {
            rotation: world_from_camera,
            position: -(world_from_camera * translation),
        }
    }

    /// Transforms a point from world space to camera space.
    pub fn camera_from_world(&self, point: DVec3) -> DVec3 {
        self.rotation.inverse() * (point - self.position)
    }

    /// The pose of the camera whose image is this one's, turned clockwise by `turns` quarter turns.
    pub fn turned(&self, turns: u8) -> Self {
        Self {
            rotation: self.rotation * quarter_turns(turns).inverse(),
            ..*self
        }
    }

    /// The rotation matrix from world to camera axes.
    pub fn camera_rotation(&self) -> DMat3 {
        DMat3::from_quat(self.rotation.inverse())
    }

    /// The pose moved by the small rotation `turn` (camera axes, radians: `x_camera` becomes `exp(turn) x_camera`) and by `shift` (world).
    pub fn moved(&self, turn: DVec3, shift: DVec3) -> Self {
        Self {
            rotation: (self.rotation * DQuat::from_scaled_axis(-turn)).normalize(),
            position: self.position + shift,
        }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite() && self.position.is_finite()
    }
}

/// The rotation from camera axes to those of an image that is turned clockwise by `turns` quarter turns.
pub fn quarter_turns(turns: u8) -> DQuat {
    DQuat::from_rotation_z(f64::from(turns) * std::f64::consts::FRAC_PI_2)
}
