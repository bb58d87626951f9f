//! Whether a capture faces forward, as judged by its cameras.

use glam::Vec3;
use irradia_scene::Camera;

/// Largest angle between a forward-facing camera's axis and the mean axis, degrees. Normalised device coordinates are the mean
/// camera's perspective: their cells are stretched sideways by `1 / cos^2` of the angle, twofold at 45 degrees, which the edges of
/// a photograph of 60 degrees reach if the camera is turned by 15 more, and they end at 90. The forward-facing scenes of LLFF
/// stay below 20; a capture that goes around its object by a quarter of a circle has 45.
pub const FORWARD_CONE: f32 = 30.0;

/// Orientation of the cameras of a capture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Facing {
    /// Largest angle between a camera's axis and the mean axis, degrees.
    pub cone: f32,
    /// Depth along the mean axis of the foremost camera from the mean position, world units.
    pub foremost: f32,
}

impl Facing {
    /// The orientation of `cameras`; `None` without cameras or if their axes cancel out.
    pub fn of(cameras: &[Camera]) -> Option<Self> {
        let axis = |camera: &Camera| camera.pose.rotation * Vec3::Z;
        let mean = cameras.iter().map(axis).sum::<Vec3>().try_normalize()?;
        let center = cameras.iter().map(|c| c.pose.position).sum::<Vec3>() / cameras.len() as f32;
        let cosine = cameras.iter().map(|c| axis(c).dot(mean)).fold(1.0, f32::min);
        Some(Self {
            cone: cosine.clamp(-1.0, 1.0).acos().to_degrees(),
            foremost: cameras
                .iter()
                .map(|c| (c.pose.position - center).dot(mean))
                .fold(f32::NEG_INFINITY, f32::max),
        })
    }

    /// Whether all cameras face forward and are in front of a scene that begins at depth `near` from their mean, world units.
    pub fn is_forward(&self, near: f32) -> bool {
        self.cone <= FORWARD_CONE && self.foremost < near
    }
}
