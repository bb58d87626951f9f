//! How many pixels are drawn: as many as fit into a frame's time while the camera moves, then step by step all of them.

use crate::message::{MAX_PIXELS, Shot};

/// Seconds of drawing and encoding a picture of a moving camera: 25 pictures a second.
const MOVING: f32 = 0.04;
/// Seconds within which a camera at rest gets a better picture.
const RESTING: f32 = 0.2;
/// Least share of the window's pixels.
const LEAST: f32 = 0.03;

/// The cost of pictures as measured, as `fixed + per_pixel * pixels`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    /// Seconds per pixel, with the fixed part; of the last pictures.
    per_pixel: f32,
    /// Share of the window's pixels drawn while moving.
    share: f32,
}

impl Default for Pace {
    fn default() -> Self {
        Self {
            per_pixel: 1e-7,
            share: 0.1,
        }
    }
}

/// The largest share of the window's pixels.
fn most(shot: &Shot) -> f32 {
    let k = &shot.camera.intrinsics;
    (MAX_PIXELS / (k.width as f32 * k.height as f32)).min(1.0)
}

impl Pace {
    /// The share of pixels for the next picture, and whether it is the final one. `last`: the share of the last picture of the same
    /// camera at rest, if there is one.
    pub fn share(&self, shot: &Shot, moving: bool, last: Option<f32>) -> (f32, bool) {
        let most = most(shot);
        if moving {
            return (self.share.min(most), false);
        }
        let k = &shot.camera.intrinsics;
        let affordable = RESTING / (self.per_pixel * k.width as f32 * k.height as f32);
        // Four times as many pixels cost at most four times as much.
        let next = affordable.max(last.map_or(0.0, |last| 4.0 * last)).max(self.share);
        if next >= most { (most, true) } else { (next, false) }
    }

    /// Learns from a picture of `pixels` that took `seconds`.
    pub fn learn(&mut self, pixels: f32, seconds: f32, moving: bool) {
        self.per_pixel = seconds / pixels.max(1.0);
        if moving {
            // The fixed part makes the cost grow slower than the pixels: several pictures find the share.
            let factor = (MOVING / seconds.max(1e-4)).clamp(0.4, 1.4);
            self.share = (self.share * factor).clamp(LEAST, 1.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::Mode;
    use irradia_scene::{Camera, Intrinsics, Pose};

    fn shot(width: u32, height: u32) -> Shot {
        let pose = Pose {
            rotation: glam::Quat::IDENTITY,
            position: glam::Vec3::ZERO,
        };
        Shot {
            id: 1,
            camera: Camera::new(pose, Intrinsics::from_fov_x(width, height, 1.0)),
            mode: Mode::Color,
            background: None,
            clip: None,
            view: None,
        }
    }

    #[test]
    fn moving_pictures_find_the_size_that_fits() {
        let (mut pace, shot) = (Pace::default(), shot(1000, 1000));
        let cost = |share: f32| 0.01 + 1e-7 * 1e6 * share;
        for _ in 0..20 {
            let (share, sharp) = pace.share(&shot, true, None);
            assert!(!sharp);
            pace.learn(1e6 * share, cost(share), true);
        }
        let (share, _) = pace.share(&shot, true, None);
        assert!((cost(share) - MOVING).abs() < 0.004, "{share}");
    }

    #[test]
    fn a_camera_at_rest_gets_every_pixel_at_once_or_in_steps() {
        let (mut pace, shot) = (Pace::default(), shot(1000, 1000));
        pace.learn(1e6, 0.1, false);
        assert_eq!(pace.share(&shot, false, None), (1.0, true));
        // A field of 10 microseconds a pixel.
        pace.learn(1e5, 1.0, true);
        let (mut share, mut sharp) = pace.share(&shot, false, None);
        assert!(share < 0.2 && !sharp);
        for _ in 0..4 {
            (share, sharp) = pace.share(&shot, false, Some(share));
        }
        assert_eq!((share, sharp), (1.0, true));
    }

    #[test]
    fn huge_windows_get_a_smaller_picture() {
        let (share, sharp) = Pace::default().share(&shot(4096, 4096), false, Some(0.1));
        assert!(sharp && share * 4096.0 * 4096.0 <= MAX_PIXELS * 1.001);
    }
}
