//! L1 between rendered depth and the depth of sparse points (L_depth of CurriculumGS), namely the structure-from-motion points
//! visible in the view.
//!
//! Symbols, for each sample: D rendered expected depth, accumulated depth A over alpha; z the point's depth; w its weight.
//!
//! ```text
//! metric:    loss = sum w |z - D| / sum w z
//! relative:  loss = sum w |a z + b - D| / sum w D,   (a, b) = argmin sum w (a z + b - D)^2;  0 unless a > 0
//! ```
//!
//! Both are independent of the scene's unit, so one weight suits every scene. The relative kind fits the *given* depth to the
//! render: its spread does not change during training, so the fit is well conditioned and the residual linear in D; dividing
//! by the mean of D removes the gain from shrinking the scene. The gradient includes the fit and that mean. Depths whose fit would
//! invert them (a <= 0) have no loss: with a = 0 it would pull the whole view to one depth.

use super::{DepthGradient, DepthPlanes};
use irradia_compute::simd::Scalar;

/// The known depth of one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthSample {
    /// `y * width + x`.
    pub pixel: u32,
    /// Depth along the camera's +Z, in world units if metric. Ignored unless positive and finite.
    pub depth: f32,
    /// Weight. Ignored unless positive and finite.
    pub weight: f32,
}

/// Meaning of the given depths.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DepthKind {
    /// World units.
    #[default]
    Metric,
    /// Known up to scale and shift, such as a network's estimate.
    Relative,
}

/// The value of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthValues {
    /// The unweighted loss; 0 if no sample counted.
    pub loss: f64,
    /// Number of samples that counted.
    pub samples: usize,
    /// Scale applied to the given depths.
    pub scale: f64,
    /// Shift then added to them.
    pub shift: f64,
}

/// Computes the loss and its gradient; reuses its working memory.
#[derive(Clone, Debug)]
pub struct DepthLoss {
    /// Pixels less opaque than this do not count, since their depth is unreliable. 0.5 by default.
    pub min_alpha: f32,
    counted: Vec<Counted>,
}

impl Default for DepthLoss {
    fn default() -> Self {
        Self {
            min_alpha: 0.5,
            counted: Vec::new(),
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Counted {
    pixel: usize,
    /// D.
    rendered: f64,
    /// z.
    given: f64,
    weight: f64,
}

impl DepthLoss {
    /// The loss of `frame`; `weight` times its gradient is added to `gradient`. Samples beyond the image do not count.
    ///
    /// # Panics
    /// When the lengths differ: a bug in the caller.
    pub fn evaluate(
        &mut self,
        frame: DepthPlanes,
        samples: &[DepthSample],
        kind: DepthKind,
        weight: f32,
        gradient: &mut DepthGradient,
    ) -> DepthValues {
        self.run(frame, samples, kind, f64::from(weight), gradient)
    }

    // Single-threaded: a view has a few thousand samples, which take microseconds.
    fn run<T: Scalar>(
        &mut self,
        frame: DepthPlanes<T>,
        samples: &[DepthSample],
        kind: DepthKind,
        weight: f64,
        gradient: &mut DepthGradient<T>,
    ) -> DepthValues {
        frame.assert_lengths(gradient, frame.depth.len());
        self.collect(frame, samples);
        let (fit, norm) = match kind {
            DepthKind::Metric => (Some(Fit::NONE), self.sum(|s| s.weight * s.given)),
            DepthKind::Relative => (Fit::least_squares(&self.counted), self.sum(|s| s.weight * s.rendered)),
        };
        // Also false for NaN; without samples the loss stays 0.
        let Some(fit) = fit.filter(|_| norm > 0.0 && norm.is_finite()) else {
            return DepthValues {
                loss: 0.0,
                samples: 0,
                scale: 1.0,
                shift: 0.0,
            };
        };
        let loss = self.sum(|s| s.weight * fit.residual(s).abs()) / norm;
        let signed = |s: &Counted| s.weight * sign(fit.residual(s));
        let (by_shift, by_scale) = (self.sum(signed), self.sum(|s| signed(s) * (s.given - fit.mean_given)));
        for s in &self.counted {
            let mut v_rendered = -signed(s);
            if kind == DepthKind::Relative {
                let through_fit = by_shift + by_scale * (s.given - fit.mean_given) * fit.inverse_variance;
                v_rendered += s.weight / fit.weight * through_fit - s.weight * loss;
            }
            let v_rendered = weight * v_rendered / norm;
            let opacity = frame.alpha[s.pixel].to_f64();
            let (v_d, v_a) = (&mut gradient.depth[s.pixel], &mut gradient.alpha[s.pixel]);
            *v_d = *v_d + T::from_f64(v_rendered / opacity);
            *v_a = *v_a + T::from_f64(-v_rendered * s.rendered / opacity);
        }
        DepthValues {
            loss,
            samples: self.counted.len(),
            scale: fit.scale,
            shift: fit.shift,
        }
    }

    fn collect<T: Scalar>(&mut self, frame: DepthPlanes<T>, samples: &[DepthSample]) {
        self.counted.clear();
        let good = |value: f32| value > 0.0 && value.is_finite();
        for sample in samples.iter().filter(|s| good(s.depth) && good(s.weight)) {
            let pixel = sample.pixel as usize;
            let Some(opacity) = frame.alpha.get(pixel).map(|a| a.to_f64()) else {
                continue;
            };
            let rendered = frame.depth[pixel].to_f64() / opacity;
            if opacity > 0.0 && opacity >= f64::from(self.min_alpha) && rendered.is_finite() {
                self.counted.push(Counted {
                    pixel,
                    rendered,
                    given: f64::from(sample.depth),
                    weight: f64::from(sample.weight),
                });
            }
        }
    }

    fn sum(&self, of: impl Fn(&Counted) -> f64) -> f64 {
        self.counted.iter().map(of).sum()
    }
}

fn sign(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

/// The fit of given depths to the render: `scale z + shift`.
struct Fit {
    scale: f64,
    shift: f64,
    mean_given: f64,
    /// Variance term of z; 0 if the scale does not depend on the render.
    inverse_variance: f64,
    /// Sum of w.
    weight: f64,
}

impl Fit {
    const NONE: Self = Self {
        scale: 1.0,
        shift: 0.0,
        mean_given: 0.0,
        inverse_variance: 0.0,
        weight: 1.0,
    };

    /// By weighted least squares; `None` unless the scale is positive. Depths that rise where the render falls show something else: a scale
    /// of 0 would pull the whole view to one depth.
    fn least_squares(samples: &[Counted]) -> Option<Self> {
        let sum = |of: &dyn Fn(&Counted) -> f64| samples.iter().map(|s| s.weight * of(s)).sum::<f64>();
        let weight = sum(&|_| 1.0);
        let (mean_given, mean_rendered) = (sum(&|s| s.given) / weight, sum(&|s| s.rendered) / weight);
        let variance = sum(&|s| (s.given - mean_given).powi(2)) / weight;
        let covariance = sum(&|s| (s.given - mean_given) * (s.rendered - mean_rendered)) / weight;
        // A spread that is only rounding error determines no scale.
        let fits = covariance > 0.0 && variance > 1e-12 * mean_given * mean_given;
        let scale = covariance / variance;
        fits.then(|| Self {
            scale,
            shift: mean_rendered - scale * mean_given,
            mean_given,
            inverse_variance: 1.0 / variance,
            weight,
        })
    }

    fn residual(&self, s: &Counted) -> f64 {
        self.scale * s.given + self.shift - s.rendered
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::picture::depth_gradient;
    use irradia_scene::Rng;
    use irradia_testkit::finite_differences::{FiniteDifferences, sample_indices};

    const PIXELS: usize = 60;

    /// Accumulated depth and alpha of every pixel, and samples on most of them (some pixels twice).
    fn random(seed: u64) -> (Vec<f64>, Vec<f64>, Vec<DepthSample>) {
        let mut rng = Rng::new(seed, 0);
        let alpha: Vec<f64> = (0..PIXELS).map(|_| f64::from(rng.uniform())).collect();
        let depth = alpha
            .iter()
            .map(|a| a * f64::from(2.0 + 3.0 * rng.uniform()))
            .collect::<Vec<_>>();
        let samples = (0..50)
            .map(|_| {
                let pixel = rng.below(PIXELS as u32);
                let rendered = depth[pixel as usize] / alpha[pixel as usize];
                DepthSample {
                    pixel,
                    depth: rendered as f32 + 0.5 * rng.normal(),
                    weight: 0.5 + rng.uniform(),
                }
            })
            .collect();
        (depth, alpha, samples)
    }

    fn value(depth: &[f64], alpha: &[f64], samples: &[DepthSample], kind: DepthKind) -> (DepthValues, [Vec<f64>; 2]) {
        depth_gradient(depth.len(), 0.0, |gradient| {
            DepthLoss::default().run(DepthPlanes { depth, alpha }, samples, kind, 1.0, gradient)
        })
    }

    #[test]
    fn gradients_of_both_kinds_match_finite_differences() {
        for seed in 0..4 {
            for kind in [DepthKind::Metric, DepthKind::Relative] {
                let (depth, alpha, mut samples) = random(seed);
                if seed == 3 {
                    // Inverted depth.
                    samples.iter_mut().for_each(|s| s.depth = 10.0 - s.depth);
                }
                let (values, [v_depth, v_alpha]) = value(&depth, &alpha, &samples, kind);
                if seed == 3 && kind == DepthKind::Relative {
                    assert_eq!((values.samples, values.loss), (0, 0.0), "no fit, no loss");
                    assert!(v_depth.iter().chain(&v_alpha).all(|v| *v == 0.0));
                    continue;
                }
                assert!(values.samples > 10 && values.loss > 0.0);
                // For these seeds no residual lies within a step of its kink, and no alpha within a step of the threshold.
                let differences = FiniteDifferences::relative_to_max(1e-6, 1e-6);
                let by_depth = |d: &[f64]| value(d, &alpha, &samples, kind).0.loss;
                differences.check("depth", &depth, &v_depth, sample_indices(depth.len()), by_depth);
                let by_alpha = |a: &[f64]| value(&depth, a, &samples, kind).0.loss;
                differences.check("alpha", &alpha, &v_alpha, sample_indices(alpha.len()), by_alpha);
            }
        }
    }

    fn sample(pixel: u32, depth: f32) -> DepthSample {
        DepthSample {
            pixel,
            depth,
            weight: 1.0,
        }
    }

    #[test]
    fn an_error_of_half_a_unit_at_depth_two_costs_a_quarter() {
        let samples = [sample(0, 2.0), sample(1, 2.0)];
        let (values, [v_depth, v_alpha]) = value(&[2.5, 0.75], &[1.0, 0.5], &samples, DepthKind::Metric);
        assert_eq!((values.loss, values.samples), (0.25, 2));
        // D is 2.5 and 1.5; a unit of D costs 1 / 4.
        assert_eq!(v_depth, [0.25, -0.5]);
        assert_eq!(v_alpha, [-0.625, 0.75]);
    }

    #[test]
    fn relative_depth_is_invariant_to_scale_shift_and_scene_unit() {
        let (depth, alpha, samples) = random(5);
        let (first, _) = value(&depth, &alpha, &samples, DepthKind::Relative);
        let larger: Vec<f64> = depth.iter().map(|d| 7.0 * d).collect();
        let other: Vec<DepthSample> = samples
            .iter()
            .map(|s| DepthSample {
                depth: 4.0 * s.depth + 3.0,
                ..*s
            })
            .collect();
        let (second, _) = value(&larger, &alpha, &other, DepthKind::Relative);
        // The samples are in single precision.
        assert!((first.loss - second.loss).abs() < 1e-6, "{first:?} {second:?}");
        assert!(
            (second.scale - first.scale * 7.0 / 4.0).abs() < 1e-5,
            "{first:?} {second:?}"
        );
        let exact = [sample(0, 1.0), sample(1, 2.0), sample(2, 4.0)];
        let (values, _) = value(&[5.0, 7.0, 11.0], &[1.0; 3], &exact, DepthKind::Relative);
        assert!(values.loss < 1e-12 && (values.scale - 2.0).abs() < 1e-12 && (values.shift - 3.0).abs() < 1e-12);
    }

    #[test]
    fn invalid_samples_are_ignored() {
        let poison = [
            sample(9, 1.0),
            sample(u32::MAX, 1.0),
            sample(0, f32::NAN),
            sample(0, -1.0),
            sample(0, f32::INFINITY),
            sample(1, 1.0),
            sample(2, 1.0),
            DepthSample {
                weight: f32::NAN,
                ..sample(0, 1.0)
            },
        ];
        for kind in [DepthKind::Metric, DepthKind::Relative] {
            // Pixel 1 is nearly transparent, pixel 2 is NaN.
            let (values, v) = value(&[1.0, 0.1, f64::NAN], &[1.0, 0.1, 1.0], &poison, kind);
            assert_eq!((values.loss, values.samples), (0.0, 0));
            assert!(v.iter().flatten().all(|v| *v == 0.0));
            // One sample, or equal ones, determine no scale.
            let (values, v) = value(&[1.0, 0.1, 1.5], &[1.0; 3], &[sample(0, 3.0)], kind);
            assert_eq!(values.loss == 0.0, kind == DepthKind::Relative);
            assert!(v.iter().flatten().all(|v| v.is_finite()));
        }
    }

    #[test]
    fn weighted_gradients_accumulate_in_single_precision() {
        let (depth, alpha, samples) = random(6);
        let (want, [v_want, _]) = value(&depth, &alpha, &samples, DepthKind::Relative);
        let single = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let frame = DepthPlanes {
            depth: &single(&depth),
            alpha: &single(&alpha),
        };
        let (got, [v_depth, _]) = depth_gradient(PIXELS, 1.0, |gradient| {
            DepthLoss::default().evaluate(frame, &samples, DepthKind::Relative, 2.0, gradient)
        });
        assert!((got.loss - want.loss).abs() < 1e-6);
        for (got, want) in v_depth.iter().zip(&v_want) {
            assert!((f64::from(*got) - 1.0 - 2.0 * want).abs() < 1e-5, "{got} {want}");
        }
    }
}
