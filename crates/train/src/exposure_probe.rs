//! Whether photographs differ in exposure beyond what a scene can explain, decided early in a run.
//!
//! After the first tenth of a run splats show every view's mean colour, in an exposure common to all photographs. What both halves of a
//! photograph share of its brightness relative to its frame is then its relative exposure; by how much they differ is the error of early
//! frames. Automatic exposure that follows the view changes smoothly from camera to camera: splats reproduce it, by spherical harmonics, in
//! held-out views as well. What remains after a prediction by the nearest cameras, beyond that error, fits no scene; splats explain it by
//! veils in front of the cameras.

use crate::audit::nearest;
use crate::event::Event;
use crate::photos::Prepared;
use crate::recipe::Choice;
use crate::robust::spread;
use crate::schedule::{plan, upcoming_views};
use crate::socket::Exposure;
use crate::trainer::{TrainError, Trainer};
use irradia_scene::{Camera, Pose};
use std::collections::BTreeSet;

/// Fraction of a run after which the decision is made. Later ones cost more than they gain, since splats have to unlearn the exposures:
/// a courthouse, 249 photographs, 1,500 steps, decided after 150 and 498, 20.35 and 19.74 dB after colour correction.
const PROBE_AT: f64 = 0.1;
/// Number of training views to measure in a run too short to measure all: enough for a standard deviation accurate to a tenth.
const SAMPLED_VIEWS: usize = 64;
/// Minimum number of views for a decision.
const MIN_VIEWS: usize = 8;
/// Number of cameras that predict a view's exposure.
const NEIGHBOURS: usize = 3;
/// Number of cameras whose mean exposure a photograph's first gain is relative to: splats reproduce what changes smoothly from camera to
/// camera, also in held-out views. Courthouse, 249 photographs, 1,500 steps, gains relative to the mean of all and to this: 17.30 and 18.62 dB,
/// 20.28 and 20.60 after colour correction (no exposures 18.65 and 20.44); fox with random exposures 24.47 and 24.51, 32.08 and 32.04.
const GAIN_NEIGHBOURS: usize = 8;
/// Minimum standard deviation of ln exposure, beyond its prediction, at which exposures are learned.
const MIN_DEVIATION: f64 = 0.1;
/// Usable colours: those outside are clipped in the photograph, or too dark for a ratio.
const USABLE_COLORS: std::ops::RangeInclusive<f32> = 8.0 / 255.0..=250.0 / 255.0;
/// Opacity from which on a pixel shows the scene, not what is missing from it.
const MIN_ALPHA: f32 = 0.95;
/// Minimum number of usable pixels of each half of a view; a view with fewer is skipped.
const MIN_PIXELS: usize = 100;

/// Mean ln exposure of the left and the right half of `photo` relative to its frame, `color` `[3, H, W]` of opacity `alpha` `[H, W]`; `None`
/// if too few pixels of both can be compared.
fn log_exposures(color: &[f32], alpha: &[f32], photo: &Prepared) -> Option<[f64; 2]> {
    let (width, pixels) = (photo.width as usize, photo.rgb.len() / 3);
    let counts = |i: &usize| {
        let opaque = photo.alpha.as_ref().is_none_or(|alpha| alpha[*i] == 255);
        opaque && alpha[*i] >= MIN_ALPHA && photo.mask.as_ref().is_none_or(|mask| mask[*i] != 0)
    };
    let mut sums = [(0usize, 0.0f64, 0.0f64); 2];
    for i in (0..pixels).filter(counts) {
        let truth: [f32; 3] = std::array::from_fn(|c| f32::from(photo.rgb[3 * i + c]) / 255.0);
        let frame: [f32; 3] = std::array::from_fn(|c| color[c * pixels + i]);
        if truth.iter().chain(&frame).all(|v| USABLE_COLORS.contains(v)) {
            let (count, of_photo, of_frame) = &mut sums[usize::from(2 * (i % width) >= width)];
            *count += 1;
            *of_photo += f64::from(truth.iter().sum::<f32>());
            *of_frame += f64::from(frame.iter().sum::<f32>());
        }
    }
    let is_measured = sums.iter().all(|(count, ..)| *count >= MIN_PIXELS);
    is_measured.then(|| sums.map(|(_, photo, frame)| (photo / frame).ln()))
}

/// A measured view: its camera, and the ln exposures of its halves.
type Measured = (Camera, [f64; 2]);

/// The ln exposures of the halves of view `i` of `views`, less the means of the `count` views nearest to it. A move by `unit` counts as much
/// as a turn by one radian.
fn unpredicted(views: &[Measured], i: usize, count: usize, unit: f32) -> [f64; 2] {
    let (camera, own) = &views[i];
    let others = views.iter().enumerate().filter(|(k, _)| *k != i);
    let others = others.map(|(_, (other, logs))| (other.pose, logs));
    let near = nearest(&camera.pose, others, count, unit);
    let predicted = |half: usize| near.iter().map(|logs| logs[half]).sum::<f64>() / near.len() as f64;
    [0, 1].map(|half| own[half] - predicted(half))
}

/// Standard deviation of the ln exposures of `views` beyond what the nearest cameras predict; `None` for too few views. An exposure is the
/// same in both halves of a photograph; by how much they differ shows how far frames of early splats are off.
fn unpredicted_spread(views: &[Measured], unit: f32) -> Option<f64> {
    if views.len() < MIN_VIEWS {
        return None;
    }
    let residuals: Vec<[f64; 2]> = (0..views.len())
        .map(|i| unpredicted(views, i, NEIGHBOURS, unit))
        .collect();
    // The spread is robust, since a few odd photographs are no reason for exposures; the mean of k independent values adds 1/k to the
    // variance.
    let common = spread(residuals.iter().map(|[left, right]| 0.5 * (left + right)));
    let error = spread(residuals.iter().map(|[left, right]| 0.5 * (left - right)));
    let variance = (common * common - error * error).max(0.0);
    Some((variance / (1.0 + 1.0 / NEIGHBOURS as f64)).sqrt())
}

impl Trainer {
    /// Whether exposures are to be decided after a step that began at `before`, in steps of the recipe.
    pub(crate) fn is_exposure_due(&self, before: f64) -> bool {
        // A bilateral grid contains an exposure: there is nothing to decide.
        let is_open = self.recipe.exposure == Choice::Auto && self.sockets.bilateral.is_none() && self.field.is_none();
        is_open && self.passes(before, PROBE_AT)
    }

    /// The training views to measure: all, or in a short run some with the nearest to each.
    fn probed_views(&self, image_scale: f32) -> Vec<usize> {
        if self.trained.len() <= SAMPLED_VIEWS || self.can_render_all_views(image_scale) {
            return self.trained.clone();
        }
        let upcoming = upcoming_views(&self.trained, self.options.seed, &self.clock);
        let groups = upcoming.iter().take(SAMPLED_VIEWS / (1 + NEIGHBOURS));
        let pose = |view: &usize| self.camera(*view).pose;
        let poses: Vec<(Pose, usize)> = self.trained.iter().map(|view| (pose(view), *view)).collect();
        let near = |view: &usize| nearest(&pose(view), poses.iter().copied(), 1 + NEIGHBOURS, self.length_unit);
        let views: BTreeSet<usize> = groups.flat_map(near).collect();
        views.into_iter().collect()
    }

    /// Adds an exposure per photograph if the photographs need it, and reports it.
    pub(crate) fn decide_exposure(&mut self) -> Result<Option<Event>, TrainError> {
        let plan = plan(&self.recipe, &self.clock);
        let probed = self.probed_views(plan.image_scale);
        let mut measured = Vec::new();
        self.render_training_views(&probed, &plan, false, |trainer, view, photo| {
            let color = trainer.sockets.frame_color(&trainer.engine);
            measured.extend(log_exposures(color, trainer.engine.frame().alpha, photo).map(|logs| (view, logs)));
        })?;
        let views: Vec<Measured> = measured
            .iter()
            .map(|(view, logs)| (self.camera(*view), *logs))
            .collect();
        let Some(spread) = unpredicted_spread(&views, self.length_unit) else {
            return Ok(None);
        };
        if spread < MIN_DEVIATION {
            return Ok(None);
        }
        let gain = |(i, (view, _)): (usize, &(usize, [f64; 2]))| {
            let [left, right] = unpredicted(&views, i, GAIN_NEIGHBOURS, self.length_unit);
            (*view, 0.5 * (left + right))
        };
        let gains: Vec<(usize, f64)> = measured.iter().enumerate().map(gain).collect();
        let exposure = Exposure::new(self.dataset.views.len(), &self.dataset.train).with_gains(&gains);
        self.sockets.exposure = Some(exposure);
        Ok(Some(Event::Decided {
            message: format!(
                "photographs differ in exposure by {:.0} % beyond what adjacent ones predict: each has its own from here on (--set exposure=false for none)",
                100.0 * spread
            ),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_scene::{Intrinsics, Pose, Rng};

    fn camera(angle: f32) -> Camera {
        let rotation = Quat::from_rotation_y(angle);
        let pose = Pose {
            rotation,
            position: rotation * Vec3::NEG_Z,
        };
        Camera::new(pose, Intrinsics::from_fov_x(8, 8, 1.0))
    }

    #[test]
    fn exposures_that_follow_the_view_are_predicted_and_random_ones_are_not() {
        let mut rng = Rng::new(1, 1);
        let around = |logs: &mut dyn FnMut(f32) -> [f64; 2]| -> Vec<Measured> {
            let angles = (0..60).map(|i| i as f32 * 0.1);
            angles.map(|angle| (camera(angle), logs(angle))).collect()
        };
        let smooth = around(&mut |angle| [0.3 * f64::from(angle.sin()); 2]);
        let measured = unpredicted_spread(&smooth, 1.0).unwrap();
        assert!(measured < 0.03, "{measured}");
        let random = around(&mut |_| [f64::from(rng.normal()) * 0.2; 2]);
        let measured = unpredicted_spread(&random, 1.0).unwrap();
        assert!((measured - 0.2).abs() < 0.06, "{measured}");
        assert_eq!(unpredicted_spread(&random[..7], 1.0), None);
        let unlearned = around(&mut |_| [0, 1].map(|_| f64::from(rng.normal()) * 0.2));
        let measured = unpredicted_spread(&unlearned, 1.0).unwrap();
        assert!(measured < 0.08, "halves that differ show no exposure: {measured}");
    }

    #[test]
    fn an_exposure_is_the_ratio_of_the_pixels_that_both_show() {
        let pixels = 400;
        let color: Vec<f32> = (0..3 * pixels)
            .map(|i| 0.2 + 0.3 * (i % pixels) as f32 / 400.0)
            .collect();
        let rgb = (0..3 * pixels).map(|i| (color[i % 3 * pixels + i / 3] * 1.3 * 255.0).round() as u8);
        let mut photo = Prepared {
            width: 20,
            height: 20,
            rgb: rgb.collect(),
            alpha: None,
            mask: None,
            background: [0.0; 3],
        };
        for value in &mut photo.rgb[..300] {
            *value = 255;
        }
        // Where the frame is empty, it is darker than the scene.
        let mut alpha = vec![1.0; pixels];
        let mut color = color;
        for i in 300..pixels {
            alpha[i] = 0.5;
            for c in 0..3 {
                color[c * pixels + i] *= 0.5;
            }
        }
        let measured = log_exposures(&color, &alpha, &photo).unwrap();
        let is_right = |log: f64| (log - 1.3f64.ln()).abs() < 0.01;
        assert!(measured.into_iter().all(is_right), "{measured:?}");
        photo.mask = Some(vec![0; pixels]);
        assert_eq!(log_exposures(&color, &alpha, &photo), None);
    }
}
