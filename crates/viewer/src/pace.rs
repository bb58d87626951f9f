//! How much is drawn: as many pixels and splats as fit into a frame's time while the camera moves, then all of them step by step.

use crate::message::{MAX_PIXELS, Shot};

/// Seconds of drawing and encoding a picture of a moving camera: 25 pictures a second.
const MOVING_SECONDS: f32 = 0.04;
/// The same while a training shares the processor: smaller pictures, so that the rate stays the same beside its steps.
const TRAINING_MOVING_SECONDS: f32 = 0.015;
/// Seconds within which a camera at rest gets a better picture.
const RESTING_SECONDS: f32 = 0.2;
/// Minimum share of the window's pixels.
const MIN_PIXEL_SHARE: f32 = 0.03;
/// All splats are drawn while moving if half of them, at all pixels, take less than this share of a moving picture's time: all take less
/// than twice the time.
const MAX_HALF_COST_SHARE: f32 = 0.5;

/// How much of a picture is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Detail {
    /// Share of the window's pixels.
    pub pixels: f32,
    /// Share of the splats, most important first: 1, or at most [`Detail::MAX_PARTIAL_SPLATS`].
    pub splats: f32,
    /// Whether the camera moves.
    pub moving: bool,
    /// Seconds that drawing it should take.
    pub seconds: f32,
    /// Whether nothing better follows.
    pub sharp: bool,
}

impl Detail {
    /// The largest share of splats below all of them.
    pub const MAX_PARTIAL_SPLATS: f32 = 0.5;
}

/// The measured cost of pictures.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    /// Seconds per pixel of the last picture, fixed cost included.
    per_pixel: f32,
    /// Share of the window's pixels drawn while moving.
    share: f32,
    /// Whether all splats are drawn while moving.
    all: bool,
}

impl Default for Pace {
    fn default() -> Self {
        Self {
            per_pixel: 1e-7,
            share: 0.1,
            all: false,
        }
    }
}

/// The largest share of the window's pixels.
fn max_pixel_share(shot: &Shot) -> f32 {
    let k = &shot.camera.intrinsics;
    (MAX_PIXELS / (k.width as f32 * k.height as f32)).min(1.0)
}

impl Pace {
    /// How the next picture of a moving camera is drawn.
    pub fn moving(&self, shot: &Shot, training: bool) -> Detail {
        Detail {
            seconds: if training {
                TRAINING_MOVING_SECONDS
            } else {
                MOVING_SECONDS
            },
            pixels: self.share.min(max_pixel_share(shot)),
            // Coarser pixels hide the missing splats.
            splats: if self.all {
                1.0
            } else {
                Detail::MAX_PARTIAL_SPLATS * self.share.sqrt()
            },
            moving: true,
            sharp: false,
        }
    }

    /// How the next picture of a camera at rest is drawn. `last`: the pixels' share of its last picture, if it had all splats.
    pub fn resting(&self, shot: &Shot, last: Option<f32>) -> Detail {
        let max_pixel_share = max_pixel_share(shot);
        let k = &shot.camera.intrinsics;
        let affordable = RESTING_SECONDS / (self.per_pixel * k.width as f32 * k.height as f32);
        // Four times as many pixels cost at most four times as much.
        let next = affordable.max(last.map_or(0.0, |last| 4.0 * last)).max(self.share);
        Detail {
            seconds: RESTING_SECONDS,
            pixels: next.min(max_pixel_share),
            splats: 1.0,
            moving: false,
            sharp: next >= max_pixel_share,
        }
    }

    /// Learns from a picture of `pixels` that took `seconds`.
    pub fn update(&mut self, detail: &Detail, pixels: f32, seconds: f32) {
        self.per_pixel = seconds / pixels.max(1.0);
        if detail.moving {
            // Part of the cost is fixed, so it grows more slowly than the share: finding the share takes several pictures.
            let factor = (detail.seconds / seconds.max(1e-4)).clamp(0.4, 1.4);
            self.share = (self.share * factor).clamp(MIN_PIXEL_SHARE, 1.0);
            self.all = if self.all {
                seconds <= detail.seconds
            } else {
                self.share == 1.0 && seconds < MAX_HALF_COST_SHARE * detail.seconds
            };
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
            highlight: false,
            light: None,
        }
    }

    #[test]
    fn moving_pictures_find_what_fits() {
        let (mut pace, shot) = (Pace::default(), shot(1000, 1000));
        let cost = |detail: &Detail| 0.05 * detail.splats + 1e-7 * 1e6 * detail.pixels;
        for _ in 0..20 {
            let detail = pace.moving(&shot, false);
            assert!(!detail.sharp && detail.splats <= Detail::MAX_PARTIAL_SPLATS);
            pace.update(&detail, 1e6 * detail.pixels, cost(&detail));
        }
        let found = cost(&pace.moving(&shot, false));
        assert!((found - MOVING_SECONDS).abs() < 0.004, "{found}");
    }

    #[test]
    fn all_splats_are_drawn_while_moving_where_they_fit_and_it_stays_so() {
        for (cost, all) in [(0.02, true), (0.039, true), (0.07, false)] {
            let (mut pace, shot) = (Pace::default(), shot(1000, 1000));
            let seconds = |detail: &Detail| cost * (0.1 + 0.9 * detail.splats * detail.pixels);
            let mut drawn = Vec::new();
            for _ in 0..40 {
                let detail = pace.moving(&shot, false);
                drawn.push(detail.splats == 1.0);
                pace.update(&detail, 1e6 * detail.pixels, seconds(&detail));
            }
            assert!(drawn[20..].iter().all(|drawn| *drawn == all), "{cost}: {drawn:?}");
        }
    }

    #[test]
    fn a_camera_at_rest_gets_every_pixel_at_once_or_in_steps() {
        let (mut pace, shot) = (Pace::default(), shot(1000, 1000));
        let full = pace.resting(&shot, None);
        pace.update(&full, 1e6, 0.1);
        let detail = pace.resting(&shot, None);
        assert_eq!((detail.pixels, detail.splats, detail.sharp), (1.0, 1.0, true));
        // A field of 10 microseconds a pixel.
        pace.update(&pace.moving(&shot, false), 1e5, 1.0);
        let mut detail = pace.resting(&shot, None);
        assert!(detail.pixels < 0.2 && !detail.sharp);
        for _ in 0..4 {
            detail = pace.resting(&shot, Some(detail.pixels));
        }
        assert_eq!((detail.pixels, detail.sharp), (1.0, true));
    }

    #[test]
    fn huge_windows_get_a_smaller_picture() {
        let detail = Pace::default().resting(&shot(4096, 4096), Some(0.1));
        assert!(detail.sharp && detail.pixels * 4096.0 * 4096.0 <= MAX_PIXELS * 1.001);
    }
}
