//! For the tests of the losses: pictures, and finite differences.

use super::{Target, Truth};
use irradia_scene::{Image, Rng};

/// A render, a truth and perhaps a mask, planar.
pub(super) struct Picture {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) render: Vec<f64>,
    pub(super) truth: Vec<f64>,
    pub(super) mask: Option<Vec<u8>>,
}

impl Picture {
    /// Smooth colours with noise; the render a little off the truth. In single precision, for both precisions to see the
    /// same values.
    pub(super) fn random(width: usize, height: usize, masked: bool, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 0);
        let pixels = width * height;
        let truth: Vec<f64> = (0..3 * pixels)
            .map(|i| {
                let wave = (i % width) as f32 * 0.3 + (i / width) as f32 * 0.17;
                f64::from(0.5 + 0.3 * wave.sin() + 0.1 * rng.normal())
            })
            .collect();
        let render = truth
            .iter()
            .map(|t| f64::from(*t as f32 + 0.1 * rng.normal()))
            .collect();
        let mask = masked.then(|| (0..pixels).map(|_| [0, 255, 255, 100][rng.below(4) as usize]).collect());
        Self {
            width,
            height,
            render,
            truth,
            mask,
        }
    }

    pub(super) fn target(&self) -> Target<'_, f64> {
        Target {
            width: self.width,
            height: self.height,
            truth: Truth::Planar(&self.truth),
            mask: self.mask.as_deref(),
        }
    }

    /// The planes as an image.
    pub(super) fn image(&self, planar: &[f64]) -> Image {
        let pixels = self.width * self.height;
        let data = (0..3 * pixels).map(|i| planar[i % 3 * pixels + i / 3] as f32).collect();
        Image::new(self.width as u32, self.height as u32, 3, data)
    }
}

/// Holds the gradient `v` of `value` at `at` against central differences along eight random directions; `tolerance` is
/// relative to the gradient's length, the steps are `step` in every coordinate.
pub(super) fn directional(at: &[f64], v: &[f64], value: impl Fn(&[f64]) -> f64, step: f64, tolerance: f64) {
    let length = v.iter().map(|v| v * v).sum::<f64>().sqrt();
    for seed in 0..8 {
        let mut rng = Rng::new(seed, 17);
        let along: Vec<f64> = at.iter().map(|_| f64::from(rng.normal())).collect();
        let moved = |by: f64| at.iter().zip(&along).map(|(x, d)| x + by * d).collect::<Vec<_>>();
        let numeric = (value(&moved(step)) - value(&moved(-step))) / (2.0 * step);
        let analytic: f64 = v.iter().zip(&along).map(|(v, d)| v * d).sum();
        assert!(
            (numeric - analytic).abs() < tolerance * length,
            "direction {seed}: {analytic} and not {numeric}, of a gradient {length} long"
        );
    }
}

/// Holds every coordinate of the gradient `v`, or some 200 of them, against central differences; `tolerance` is relative
/// to the largest.
pub(super) fn coordinates(at: &[f64], v: &[f64], value: impl Fn(&[f64]) -> f64, step: f64, tolerance: f64) {
    let largest = v.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let mut moved = at.to_vec();
    for i in (0..at.len()).step_by(1 + at.len() / 200) {
        let mut beside = |by: f64| {
            moved[i] = at[i] + by;
            let value = value(&moved);
            moved[i] = at[i];
            value
        };
        let numeric = (beside(step) - beside(-step)) / (2.0 * step);
        assert!(
            (numeric - v[i]).abs() <= tolerance * largest + 1e-9,
            "value {i}: {} and not {numeric}, the largest is {largest}",
            v[i]
        );
    }
}
