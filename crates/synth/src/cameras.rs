//! The cameras of the scenes.

use glam::{Vec2, Vec3};
use irradia_scene::{Camera, Intrinsics, Pose, Rng};
use std::f32::consts::TAU;

/// How the cameras of a scene are placed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rig {
    /// Where the cameras are and where they look.
    pub path: Path,
    /// Horizontal field of view, radians.
    pub fov_x: f32,
}

/// Where cameras are and where they look; lengths in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Path {
    /// All around a target, near and far, low and high.
    Around {
        /// The cameras' approximate target.
        target: Vec3,
        /// Distance from the target.
        distance: [f32; 2],
        /// Elevation above the target, radians.
        elevation: [f32; 2],
        /// How far each camera's target deviates along each axis.
        aside: f32,
    },
    /// In a plane in front of a target, facing forward along +Y.
    InFront {
        /// The cameras' approximate target.
        target: Vec3,
        /// Distance of the plane.
        distance: f32,
        /// Half the width and half the height of the part of the plane that contains the cameras.
        half: Vec2,
    },
    /// On an ellipse about the z axis, each looking across it.
    Within {
        /// Half the width and half the length of the ellipse.
        half: Vec2,
        /// Height of the cameras.
        height: [f32; 2],
    },
}

/// The rig of the demo scene. The table's edge is at 2.
pub(crate) const DEMO: Rig = Rig {
    path: Path::Around {
        target: Vec3::new(0.0, 0.0, 0.36),
        distance: [3.6, 4.4],
        elevation: [0.20, 0.80],
        aside: 0.12,
    },
    fov_x: 0.84,
};

/// The split of the dataset to which a view belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Training.
    Train,
    /// Validation.
    Val,
    /// Held out.
    Test,
}

impl Split {
    /// All splits, in the order of tracing.
    pub const ALL: [Split; 3] = [Split::Train, Split::Val, Split::Test];

    /// Name used in file names.
    pub fn name(self) -> &'static str {
        match self {
            Split::Train => "train",
            Split::Val => "val",
            Split::Test => "test",
        }
    }
}

/// Places `count` cameras. Those of [`Split::Val`] and [`Split::Test`] are well within the span of [`Split::Train`], and between its
/// azimuths.
pub fn cameras(rig: &Rig, split: Split, count: u32, width: u32, height: u32, seed: u64) -> Vec<Camera> {
    let (stream, inset, turn) = match split {
        Split::Train => (0, 0.0, 0.0),
        Split::Val => (1, 0.2, 0.3),
        Split::Test => (2, 0.2, 0.7),
    };
    let mut rng = Rng::new(seed, stream);
    (0..count)
        .map(|number| {
            let azimuth = TAU * (number as f32 + turn) / count as f32;
            // Multiples of the golden ratio fill an interval evenly for any count; a second irrational decorrelates
            // distance from elevation.
            let within = |[low, high]: [f32; 2], irrational: f32| {
                let t = (number as f32 * irrational + 0.5).fract();
                low + (high - low) * (inset + (1.0 - 2.0 * inset) * t)
            };
            let level = azimuth.sin_cos();
            let pose = match rig.path {
                Path::Around {
                    target,
                    distance,
                    elevation,
                    aside,
                } => {
                    let (elevation, distance) = (within(elevation, 0.618_034), within(distance, 0.754_878));
                    let away = Vec3::new(level.1 * elevation.cos(), level.0 * elevation.cos(), elevation.sin());
                    let mut aside = || rng.range(-aside, aside);
                    let aimed = target + Vec3::new(aside(), aside(), aside());
                    Pose::look_at(target + distance * away, aimed, Vec3::Z)
                }
                Path::InFront { target, distance, half } => {
                    let x = within([-half.x, half.x], 0.618_034);
                    let z = within([-half.y, half.y], 0.754_878);
                    let mut aside = || rng.range(-0.06, 0.06) * distance;
                    let eye = target + Vec3::new(x, aside() - distance, z);
                    // Their axes meet well behind the target: hand-held captures turn a little inwards.
                    let aimed = target + Vec3::new(0.4 * x + aside(), 0.0, 0.4 * z + aside());
                    Pose::look_at(eye, aimed, Vec3::Z)
                }
                Path::Within { half, height } => {
                    let eye = Vec3::new(half.x * level.1, half.y * level.0, within(height, 0.618_034));
                    let mut aside = || rng.range(-0.5, 0.5);
                    let aimed = Vec3::new(-0.8 * eye.x + aside(), -0.8 * eye.y + aside(), 0.75 + 0.6 * aside());
                    Pose::look_at(eye, aimed, Vec3::Z)
                }
            };
            Camera::new(pose, Intrinsics::from_fov_x(width, height, rig.fov_x))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spans(split: Split, count: u32) -> ([f32; 2], [f32; 2]) {
        let mut spans = ([f32::MAX, f32::MIN], [f32::MAX, f32::MIN]);
        for camera in cameras(&DEMO, split, count, 64, 64, 0) {
            let away = camera.pose.position - Vec3::new(0.0, 0.0, 0.36);
            let widen = |span: &mut [f32; 2], v: f32| *span = [span[0].min(v), span[1].max(v)];
            widen(&mut spans.0, away.length());
            widen(&mut spans.1, (away.z / away.length()).asin());
        }
        spans
    }

    #[test]
    fn held_out_cameras_are_within_the_span_of_the_training_cameras() {
        let (distance, elevation) = spans(Split::Train, 40);
        for split in [Split::Val, Split::Test] {
            let (d, e) = spans(split, 5);
            assert!(d[0] > distance[0] && d[1] < distance[1]);
            assert!(e[0] > elevation[0] && e[1] < elevation[1]);
        }
    }

    #[test]
    fn no_surface_is_close_to_a_camera() {
        let scene = crate::demo_scene();
        for camera in cameras(&DEMO, Split::Train, 40, 8, 8, 3) {
            let frame = scene.trace(&camera, 1, 0);
            assert!(frame.depth.data.iter().all(|depth| *depth > 0.5));
        }
    }
}
