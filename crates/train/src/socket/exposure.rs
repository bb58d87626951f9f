//! After blending: an affine colour map per photograph.
//!
//! It models a camera's automatic exposure and white balance (Kerbl et al., "Hierarchical 3D Gaussians", 2024, train the same
//! 3 x 4 matrix): `y = A x + b` in the photograph's own, sRGB-encoded colours. Photographs saturate at 1, and so does `y`.

use super::per_view::PerViewAdam;
use super::{Occupant, pixel_chunks, sum_of};
use crate::tensor_file::{NamedTensor, TensorSource, to_bytes};
use irradia_measure::Affine;
use rayon::prelude::*;
use safetensors::SafeTensors;

/// Parameters of a view: A row by row, then b.
const N: usize = 12;
/// The map that changes nothing.
pub(super) const IDENTITY: [f32; N] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
/// Pixels whose gradients are summed together: a fixed number, so that the sum does not depend on threads.
const PIXELS_PER_TASK: usize = 4096;

/// An affine colour map per view, initially the identity. The mean over the training views stays the identity: a change common
/// to all photographs belongs to the scene, which would otherwise drift to an exposure that no photograph has.
#[derive(Clone, Debug, PartialEq)]
pub struct Exposure {
    /// `[views][N]`.
    maps: Vec<[f32; N]>,
    /// The training views.
    train: Vec<usize>,
    adam: PerViewAdam<N>,
}

impl Exposure {
    /// Name of the file beside the scene.
    pub const FILE: &str = "exposure.safetensors";

    /// For `views` views, of which `train` are the training views.
    pub fn new(views: usize, train: &[usize]) -> Self {
        Self {
            maps: vec![IDENTITY; views],
            train: train.to_vec(),
            adam: PerViewAdam::new(views),
        }
    }

    /// The same with the gains exp(`logs`) of some views, relative to their mean.
    pub fn with_gains(mut self, logs: &[(usize, f64)]) -> Self {
        let mean = logs.iter().map(|(_, log)| log).sum::<f64>() / logs.len().max(1) as f64;
        for (view, log) in logs {
            let gain = (log - mean).exp() as f32;
            self.maps[*view] = IDENTITY.map(|v| v * gain);
        }
        let mut common = [0.0f32; N];
        for view in &self.train {
            for ((sum, value), identity) in common.iter_mut().zip(self.maps[*view]).zip(IDENTITY) {
                *sum += (value - identity) / self.train.len() as f32;
            }
        }
        for view in &self.train {
            for (value, common) in self.maps[*view].iter_mut().zip(common) {
                *value -= common;
            }
        }
        self
    }

    /// From the file of [`Occupant::export`].
    ///
    /// # Errors
    /// One line, when it is damaged.
    pub(crate) fn from_file(bytes: &[u8]) -> Result<Self, String> {
        let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let values = TensorSource::new(&file, "").f32s("maps");
        let values = values.filter(|values| values.len() % N == 0 && values.iter().all(|v| v.is_finite()));
        let maps = values.ok_or("maps is missing or has the wrong length")?;
        let mut exposure = Self::new(maps.len() / N, &[]);
        exposure.maps.copy_from_slice(maps.as_chunks::<N>().0);
        Ok(exposure)
    }

    /// Number of views.
    pub(crate) fn views(&self) -> usize {
        self.maps.len()
    }

    /// The map of `view`.
    pub fn map(&self, view: usize) -> Affine {
        let m = self.maps[view].map(f64::from);
        Affine {
            matrix: std::array::from_fn(|i| std::array::from_fn(|j| m[3 * i + j])),
            offset: [m[9], m[10], m[11]],
        }
    }

    /// Applies the map of `view` to `color` `[3, H, W]`; results are at most 1.
    pub fn apply(&self, view: usize, color: &[f32], to: &mut Vec<f32>) {
        let (m, pixels) = (&self.maps[view], color.len() / 3);
        to.resize(color.len(), 0.0);
        to.par_chunks_mut(pixels.max(1)).enumerate().for_each(|(c, plane)| {
            let row = [m[3 * c], m[3 * c + 1], m[3 * c + 2]];
            for (i, y) in plane.iter_mut().enumerate() {
                let x = [color[i], color[pixels + i], color[2 * pixels + i]];
                *y = affine(row, m[9 + c], x).min(1.0);
            }
        });
    }

    /// The vector-Jacobian product of [`Self::apply`]: `v` `[3, H, W]` becomes the gradient of `color`; returns that of the
    /// view's parameters. Where the output is saturated, only gradients that darken it pass.
    pub fn vjp(&self, view: usize, color: &[f32], v: &mut [f32]) -> [f32; N] {
        let (m, pixels) = (&self.maps[view], color.len() / 3);
        let sums: Vec<[f64; N]> = pixel_chunks(v, PIXELS_PER_TASK)
            .enumerate()
            .map(|(piece, [red, green, blue])| {
                let mut sum = [0.0f64; N];
                for i in 0..red.len() {
                    let at = piece * PIXELS_PER_TASK + i;
                    let x = [color[at], color[pixels + at], color[2 * pixels + at]];
                    let mut v_y = [red[i], green[i], blue[i]];
                    for c in 0..3 {
                        let y = affine([m[3 * c], m[3 * c + 1], m[3 * c + 2]], m[9 + c], x);
                        if y > 1.0 {
                            v_y[c] = v_y[c].max(0.0);
                        }
                        for k in 0..3 {
                            sum[3 * c + k] += f64::from(v_y[c] * x[k]);
                        }
                        sum[9 + c] += f64::from(v_y[c]);
                    }
                    let v_x: [f32; 3] = std::array::from_fn(|k| m[k] * v_y[0] + m[3 + k] * v_y[1] + m[6 + k] * v_y[2]);
                    (red[i], green[i], blue[i]) = (v_x[0], v_x[1], v_x[2]);
                }
                sum
            })
            .collect();
        sum_of(&sums)
    }

    /// [`Self::vjp`] and a step of Adam on `view` at `rate`, regularised to the identity by `weight` times the mean squared difference.
    pub fn step(&mut self, view: usize, color: &[f32], v: &mut [f32], rate: f32, weight: f32) {
        let mut gradient = self.vjp(view, color, v);
        for ((g, value), identity) in gradient.iter_mut().zip(self.maps[view]).zip(IDENTITY) {
            *g += weight * 2.0 / N as f32 * (value - identity);
        }
        let change = self.adam.step(view, gradient, [rate; N]);
        let common = change.map(|change| change / self.train.len() as f32);
        for other in &self.train {
            for (value, common) in self.maps[*other].iter_mut().zip(common) {
                *value -= common;
            }
        }
        for (value, change) in self.maps[view].iter_mut().zip(change) {
            *value += change;
        }
    }
}

fn affine(row: [f32; 3], offset: f32, x: [f32; 3]) -> f32 {
    row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + offset
}

impl Occupant for Exposure {
    fn name(&self) -> &'static str {
        "exposure"
    }

    fn tensors(&self) -> Vec<NamedTensor> {
        let maps = NamedTensor::f32s("maps", vec![self.maps.len(), N], self.maps.as_flattened());
        std::iter::once(maps).chain(self.adam.tensors()).collect()
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        self.maps = tensors.rows::<N>("maps", self.maps.len())?;
        self.adam.restore(tensors, "")
    }

    fn export(&self) -> Option<Vec<u8>> {
        let maps = NamedTensor::f32s("maps", vec![self.maps.len(), N], self.maps.as_flattened());
        Some(to_bytes(&[maps], ("irradia_exposure", "1".into())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    const PIXELS: usize = 37;

    fn example() -> (Exposure, Vec<f32>, Vec<f32>) {
        let mut rng = Rng::new(3, 3);
        let mut exposure = Exposure::new(2, &[0, 1]);
        for value in &mut exposure.maps[1] {
            *value += rng.range(-0.2, 0.2);
        }
        let color = (0..3 * PIXELS).map(|_| rng.range(0.0, 0.6)).collect();
        let weights = (0..3 * PIXELS).map(|_| rng.range(-1.0, 1.0)).collect();
        (exposure, color, weights)
    }

    fn loss(exposure: &Exposure, color: &[f32], weights: &[f32]) -> f64 {
        let mut y = Vec::new();
        exposure.apply(1, color, &mut y);
        y.iter().zip(weights).map(|(y, w)| f64::from(*y) * f64::from(*w)).sum()
    }

    #[test]
    fn an_untrained_view_is_unchanged() {
        let (exposure, color, _) = example();
        let mut y = Vec::new();
        exposure.apply(0, &color, &mut y);
        assert_eq!(y, color);
    }

    #[test]
    fn given_gains_are_relative_to_the_training_views() {
        let exposure = Exposure::new(4, &[0, 1, 3]).with_gains(&[(0, 0.3), (1, 0.3), (3, -0.3)]);
        let gain = |view: usize| exposure.map(view).apply([0.5; 3])[1] / 0.5;
        assert!((gain(0) + gain(1) + gain(3) - 3.0).abs() < 1e-5);
        assert!((gain(0) - gain(3) - (0.2f32.exp() - (-0.4f32).exp())).abs() < 1e-5);
        assert_eq!(gain(2), 1.0);
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let (exposure, color, weights) = example();
        let mut v = weights.clone();
        let of_map = exposure.vjp(1, &color, &mut v);
        // Colours stay below 1, so that the map is linear and a large step costs only rounding.
        let h = 1e-2f32;
        for i in 0..N {
            let at = |sign: f32| {
                let mut moved = exposure.clone();
                moved.maps[1][i] += sign * h;
                loss(&moved, &color, &weights)
            };
            let want = (at(1.0) - at(-1.0)) / f64::from(2.0 * h);
            assert!(
                (f64::from(of_map[i]) - want).abs() < 1e-3,
                "{i}: {} and {want}",
                of_map[i]
            );
        }
        for i in (0..color.len()).step_by(7) {
            let at = |sign: f32| {
                let mut moved = color.clone();
                moved[i] += sign * h;
                loss(&exposure, &moved, &weights)
            };
            let want = (at(1.0) - at(-1.0)) / f64::from(2.0 * h);
            assert!((f64::from(v[i]) - want).abs() < 1e-3, "{i}: {} and {want}", v[i]);
        }
    }

    #[test]
    fn saturated_pixels_are_only_darkened() {
        let exposure = Exposure::new(1, &[0]);
        let color = [1.5, 1.5, 0.5];
        let mut y = Vec::new();
        exposure.apply(0, &color, &mut y);
        assert_eq!(y, [1.0, 1.0, 0.5]);
        let mut v = [-1.0, 2.0, -1.0];
        exposure.vjp(0, &color, &mut v);
        assert_eq!(v, [0.0, 2.0, -1.0]);
    }

    #[test]
    fn steps_recover_relative_gains_and_preserve_their_mean() {
        let mut rng = Rng::new(4, 4);
        let color: Vec<f32> = (0..3 * PIXELS).map(|_| rng.range(0.0, 0.6)).collect();
        let mut exposure = Exposure::new(3, &[0, 2]);
        for step in 0..600 {
            // The last steps are small, as in a run.
            let rate = if step < 400 { 0.02 } else { 0.001 };
            for (view, gain) in [(0, 0.7), (2, 1.3)] {
                let mut y = Vec::new();
                exposure.apply(view, &color, &mut y);
                let mut v: Vec<f32> = y.iter().zip(&color).map(|(y, x)| y - gain * x).collect();
                exposure.step(view, &color, &mut v, rate, 0.0);
            }
        }
        for (view, gain) in [(0, 0.7), (1, 1.0), (2, 1.3)] {
            let got = exposure.map(view).apply([0.5; 3]);
            assert!(got.iter().all(|v| (v - gain * 0.5).abs() < 0.01), "{view}: {got:?}");
        }
    }
}
