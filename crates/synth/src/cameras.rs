//! The cameras of the demo dataset: all around the table, near and far, low and high.

use glam::Vec3;
use irradia_scene::{Camera, Intrinsics, Pose, Rng};
use std::f32::consts::TAU;

/// Horizontal field of view, radians.
pub const FOV_X: f32 = 0.84;
/// Distance from the table's centre to the camera, world units. The table's edge is at 2.
const DISTANCE: [f32; 2] = [3.6, 4.4];
/// Elevation of the camera above its target, radians.
const ELEVATION: [f32; 2] = [0.20, 0.80];
/// The cameras' approximate target.
const TARGET: Vec3 = Vec3::new(0.0, 0.0, 0.36);

/// The part of the dataset that a view belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Training.
    Train,
    /// Validation.
    Val,
    /// Held out.
    Test,
}

impl Part {
    /// All parts, in the order of tracing.
    pub const ALL: [Part; 3] = [Part::Train, Part::Val, Part::Test];

    /// Name used in file names.
    pub fn name(self) -> &'static str {
        match self {
            Part::Train => "train",
            Part::Val => "val",
            Part::Test => "test",
        }
    }
}

/// Places `count` cameras. Those of [`Part::Val`] and [`Part::Test`] are well within the elevations and distances of
/// [`Part::Train`], and between its azimuths.
pub fn cameras(part: Part, count: u32, width: u32, height: u32, seed: u64) -> Vec<Camera> {
    let (stream, inset, turn) = match part {
        Part::Train => (0, 0.0, 0.0),
        Part::Val => (1, 0.2, 0.3),
        Part::Test => (2, 0.2, 0.7),
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
            let (elevation, distance) = (within(ELEVATION, 0.618_034), within(DISTANCE, 0.754_878));
            let level = azimuth.sin_cos();
            let away = Vec3::new(level.1 * elevation.cos(), level.0 * elevation.cos(), elevation.sin());
            let mut aside = || rng.range(-0.12, 0.12);
            let target = TARGET + Vec3::new(aside(), aside(), aside());
            Camera::new(
                Pose::look_at(TARGET + distance * away, target, Vec3::Z),
                Intrinsics::from_fov_x(width, height, FOV_X),
            )
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spans(part: Part, count: u32) -> ([f32; 2], [f32; 2]) {
        let mut spans = ([f32::MAX, f32::MIN], [f32::MAX, f32::MIN]);
        for camera in cameras(part, count, 64, 64, 0) {
            let away = camera.pose.position - TARGET;
            let widen = |span: &mut [f32; 2], v: f32| *span = [span[0].min(v), span[1].max(v)];
            widen(&mut spans.0, away.length());
            widen(&mut spans.1, (away.z / away.length()).asin());
        }
        spans
    }

    #[test]
    fn held_out_cameras_are_within_the_span_of_the_training_cameras() {
        let (distance, elevation) = spans(Part::Train, 40);
        for part in [Part::Val, Part::Test] {
            let (d, e) = spans(part, 5);
            assert!(d[0] > distance[0] && d[1] < distance[1]);
            assert!(e[0] > elevation[0] && e[1] < elevation[1]);
        }
    }

    #[test]
    fn no_surface_is_close_to_a_camera() {
        let scene = crate::demo_scene();
        for camera in cameras(Part::Train, 40, 8, 8, 3) {
            let frame = scene.trace(&camera, 1, 0);
            assert!(frame.depth.data.iter().all(|depth| *depth > 0.5));
        }
    }
}
