//! Edge-aware smoothness of rendered depth (L_smooth; Godard, Mac Aodha, Brostow 2017, eq. 5).
//!
//! Symbols: A accumulated depth, alpha opacity; q disparity alpha / A (or depth A / alpha); I the photograph, whose
//! difference |dI| between two pixels is the mean over channels; k the sensitivity to edges of the photograph.
//!
//! ```text
//! loss = sum over pairs of neighbours |dq| exp(-k |dI|) / sum q
//! ```
//!
//! which is the published loss with q divided by its mean, as in the authors' later work (Godard et al. 2019, section 3.3):
//! otherwise a scene could become smooth by moving away. The gradient includes the mean. k = 0 is total variation. Pixels that
//! are masked or nearly transparent are excluded.

use super::{DepthGradient, DepthPlanes, Target, Truth};
use crate::real::{Real, sum_over};
use rayon::prelude::*;

/// The quantity to smooth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Smoothed {
    /// Inverse depth: distant, poorly known surfaces count little.
    #[default]
    Disparity,
    /// Depth.
    Depth,
}

/// Computes the loss and its gradient; reuses its working memory.
pub struct SmoothLoss {
    /// Pixels less opaque than this are excluded. 0.5 by default.
    pub min_alpha: f32,
    memory: Memory<f32>,
}

impl Default for SmoothLoss {
    fn default() -> Self {
        Self {
            min_alpha: 0.5,
            memory: Memory::default(),
        }
    }
}

impl SmoothLoss {
    /// The loss of `frame`, guided by the photograph `target` (with colours in \[0, 1\], so that with k = 10 an edge of 0.1 has a
    /// weight of 1 / e); `weight` times its gradient is added to `gradient`.
    ///
    /// # Panics
    /// When a length does not match the target's size: a bug in the caller.
    pub fn evaluate(
        &mut self,
        frame: DepthPlanes,
        target: &Target,
        of: Smoothed,
        k: f32,
        weight: f32,
        gradient: &mut DepthGradient,
    ) -> f64 {
        let settings = SmoothSettings {
            of,
            k: f64::from(k),
            min_alpha: self.min_alpha,
            weight: f64::from(weight),
        };
        self.memory.evaluate(frame, target, &settings, gradient)
    }
}

/// How a frame is smoothed; the arguments and fields of [`SmoothLoss`].
struct SmoothSettings {
    of: Smoothed,
    k: f64,
    min_alpha: f32,
    weight: f64,
}

#[derive(Default)]
struct Memory<T> {
    /// q, 0 for excluded pixels.
    q: Vec<T>,
    /// `exp(-k |dI|) sign(dq)` to the right and downwards, 0 if either pixel is excluded, `[2, H, W]` row by row.
    slopes: Vec<T>,
    /// Sums per row.
    sums: Vec<f64>,
    /// `exp(-k |dI|)`, indexed by the sum of three channels' 8-bit differences.
    edges: Vec<T>,
}

/// Largest sum of three channels' 8-bit differences.
const MAX_DIFFERENCE: usize = 3 * 255;

impl<T: Real> Memory<T> {
    fn evaluate(
        &mut self,
        frame: DepthPlanes<T>,
        target: &Target<T>,
        settings: &SmoothSettings,
        gradient: &mut DepthGradient<T>,
    ) -> f64 {
        let (width, height) = (target.width, target.height);
        frame.assert_lengths(gradient, width * height);
        target.assert_truth();
        let DepthPlanes { depth, alpha } = frame;
        self.q.resize(width * height, T::zero());
        self.slopes.resize(2 * width * height, T::zero());
        self.sums.resize(height, 0.0);
        self.edges.clear();
        let weight = |i| T::from_f64((-settings.k * f64::from(i) / MAX_DIFFERENCE as f64).exp());
        self.edges.extend((0..=MAX_DIFFERENCE as u16).map(weight));
        if width * height == 0 {
            return 0.0;
        }

        let rows = self.q.par_chunks_mut(width).zip(&mut self.sums).enumerate();
        rows.for_each(|(y, (q, sum))| {
            let row = y * width..(y + 1) * width;
            let mask = target.mask.map(|mask| &mask[row.clone()]);
            *sum = quantities(&depth[row.clone()], &alpha[row], mask, settings, q);
        });
        let total: f64 = self.sums.iter().sum();
        let sound = total > 0.0 && total.is_finite();
        if !sound {
            return 0.0;
        }

        let (q, edges) = (&self.q, &self.edges);
        let rows = self.slopes.par_chunks_mut(2 * width).zip(&mut self.sums).enumerate();
        rows.for_each(|(y, (slopes, sum))| {
            let (right, down) = slopes.split_at_mut(width);
            let here = y * width;
            let row = &q[here..here + width];
            for x in 1..width {
                right[x - 1] = edge(target, here + x - 1, here + x, edges, settings.k);
            }
            right[width - 1] = T::zero();
            *sum = slopes_between(&row[..width - 1], &row[1..], &mut right[..width - 1]);
            if y + 1 == height {
                down.fill(T::zero());
                return;
            }
            for x in 0..width {
                down[x] = edge(target, here + x, here + width + x, edges, settings.k);
            }
            *sum += slopes_between(row, &q[here + width..here + 2 * width], down);
        });
        let loss = self.sums.iter().sum::<f64>() / total;

        let slopes = &self.slopes;
        let gain = T::from_f64(settings.weight / total);
        let by_mean = T::from_f64(loss);
        let sign = match settings.of {
            Smoothed::Disparity => -T::one(),
            Smoothed::Depth => T::one(),
        };
        let (v_depth, v_alpha) = (&mut *gradient.depth, &mut *gradient.alpha);
        let rows = v_depth.par_chunks_mut(width).zip(v_alpha.par_chunks_mut(width));
        rows.enumerate().for_each(|(y, (v_depth, v_alpha))| {
            let (right, down) = slopes[2 * y * width..2 * (y + 1) * width].split_at(width);
            let above = y
                .checked_sub(1)
                .map(|y| &slopes[(2 * y + 1) * width..2 * (y + 1) * width]);
            let row = y * width..(y + 1) * width;
            let (q, depth, alpha) = (&q[row.clone()], &depth[row.clone()], &alpha[row]);
            let (v_depth, v_alpha) = (&mut v_depth[..width], &mut v_alpha[..width]);
            let mut before = T::zero();
            for x in 0..width {
                // In each pair the gradient of the later pixel is the slope, that of the earlier its negative.
                let above = above.map_or(T::zero(), |above| above[x]);
                let v_q = gain * (before + above - right[x] - down[x] - by_mean);
                before = right[x];
                // q is the quotient of depth and alpha: up to sign, its derivative with respect to either is q divided by that one.
                let (v_q, counts) = (sign * v_q * q[x], q[x] != T::zero());
                v_depth[x] += if counts { v_q / depth[x] } else { T::zero() };
                v_alpha[x] += if counts { -v_q / alpha[x] } else { T::zero() };
            }
        });
        loss
    }
}

/// q of a row, and its sum.
fn quantities<T: Real>(depth: &[T], alpha: &[T], mask: Option<&[u8]>, settings: &SmoothSettings, q: &mut [T]) -> f64 {
    let min_alpha = T::from_f64(f64::from(settings.min_alpha)).max(T::min_positive_value());
    let mut sum = 0.0;
    for x in 0..q.len() {
        let quantity = match settings.of {
            Smoothed::Disparity => alpha[x] / depth[x],
            Smoothed::Depth => depth[x] / alpha[x],
        };
        let counts =
            alpha[x] >= min_alpha && depth[x] > T::zero() && quantity.is_finite() && mask.is_none_or(|m| m[x] != 0);
        q[x] = if counts { quantity } else { T::zero() };
        sum += q[x].to_f64();
    }
    sum
}

/// Gives each of `weights` the sign of `b - a`, or 0 if either is excluded; returns the sum of weighted absolute differences.
fn slopes_between<T: Real>(a: &[T], b: &[T], weights: &mut [T]) -> f64 {
    for ((a, b), weight) in a.iter().zip(b).zip(weights.iter_mut()) {
        let both = (*a != T::zero()) & (*b != T::zero());
        let signed = if b > a { *weight } else { -*weight };
        *weight = if both & (a != b) { signed } else { T::zero() };
    }
    sum_over(weights.len(), |x| weights[x] * (b[x] - a[x])).to_f64()
}

/// `exp(-k |dI|)` between two pixels.
#[inline(always)]
fn edge<T: Real>(target: &Target<T>, a: usize, b: usize, edges: &[T], k: f64) -> T {
    match target.truth {
        Truth::Rgb8(truth) => {
            let (a, b) = (&truth[3 * a..3 * a + 3], &truth[3 * b..3 * b + 3]);
            let apart = |c: usize| usize::from(a[c].abs_diff(b[c]));
            edges[apart(0) + apart(1) + apart(2)]
        }
        Truth::Planar(_) => {
            let apart = |c: usize| (target.color(a, c) - target.color(b, c)).abs();
            let change = apart(0) + apart(1) + apart(2);
            (T::from_f64(-k / 3.0) * change).exp()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::picture::{Picture, depth_gradient};
    use super::*;
    use irradia_scene::Rng;
    use irradia_testkit::finite_differences::{FiniteDifferences, sample_indices};

    fn settings(of: Smoothed, k: f64) -> SmoothSettings {
        SmoothSettings {
            of,
            k,
            min_alpha: 0.5,
            weight: 1.0,
        }
    }

    fn value(depth: &[f64], alpha: &[f64], target: &Target<f64>, settings: &SmoothSettings) -> (f64, [Vec<f64>; 2]) {
        depth_gradient(depth.len(), 0.0, |gradient| {
            Memory::default().evaluate(DepthPlanes { depth, alpha }, target, settings, gradient)
        })
    }

    /// Alpha from 0.2 up, accumulated depth of 1 to 4.
    fn planes(pixels: usize, seed: u64) -> (Vec<f64>, Vec<f64>) {
        let mut rng = Rng::new(seed, 1);
        let alpha: Vec<f64> = (0..pixels).map(|_| f64::from(0.2 + 0.8 * rng.uniform())).collect();
        let depth = alpha.iter().map(|a| a * f64::from(1.0 + 3.0 * rng.uniform())).collect();
        (depth, alpha)
    }

    #[test]
    fn gradients_match_finite_differences() {
        for (seed, (width, height)) in [(9, 7), (1, 5), (6, 1), (13, 12)].into_iter().enumerate() {
            for of in [Smoothed::Disparity, Smoothed::Depth] {
                for (k, masked) in [(10.0, false), (0.0, true), (3.0, true)] {
                    let picture = Picture::random(width, height, masked, seed as u64);
                    let (depth, alpha) = planes(width * height, seed as u64);
                    let (target, settings) = (picture.target(), settings(of, k));
                    let (_, [v_depth, v_alpha]) = value(&depth, &alpha, &target, &settings);
                    // For these seeds no two neighbours are within a step of each other, and no alpha within a step of the threshold.
                    let by_depth = |depth: &[f64]| value(depth, &alpha, &target, &settings).0;
                    let differences = FiniteDifferences::relative_to_max(1e-7, 1e-6);
                    differences.check("depth", &depth, &v_depth, sample_indices(depth.len()), by_depth);
                    let by_alpha = |alpha: &[f64]| value(&depth, alpha, &target, &settings).0;
                    differences.check("alpha", &alpha, &v_alpha, sample_indices(alpha.len()), by_alpha);
                }
            }
        }
    }

    #[test]
    fn a_depth_step_costs_its_height_and_less_at_an_image_edge() {
        // Depth 1 on the left, 3 on the right of a 4 x 2 image: two pairs differ by 2; depths add up to 16.
        let depth = [1.0, 1.0, 3.0, 3.0].repeat(2);
        let alpha = vec![1.0; 8];
        let gray = [0.5; 24];
        let plain = Target {
            width: 4,
            height: 2,
            truth: Truth::Planar(&gray[..]),
            mask: None,
        };
        for k in [0.0, 10.0] {
            let (loss, _) = value(&depth, &alpha, &plain, &settings(Smoothed::Depth, k));
            assert!((loss - 0.25).abs() < 1e-12, "{loss}");
        }
        // A change of 0.1 in every channel where the depth changes.
        let edge = [0.5, 0.5, 0.6, 0.6].repeat(6);
        let excused = Target {
            truth: Truth::Planar(&edge[..]),
            ..plain
        };
        let (loss, _) = value(&depth, &alpha, &excused, &settings(Smoothed::Depth, 10.0));
        assert!((loss - 0.25 * (-1.0f64).exp()).abs() < 1e-12, "{loss}");
        // Disparities 1 and 1/3: two pairs of 2/3 over 16/3.
        let (loss, _) = value(&depth, &alpha, &plain, &settings(Smoothed::Disparity, 0.0));
        assert!((loss - 0.25).abs() < 1e-12, "{loss}");
        let (flat, v) = value(&[2.0; 8], &alpha, &plain, &settings(Smoothed::Disparity, 1.0));
        assert!(flat == 0.0 && v.iter().flatten().all(|v| *v == 0.0));
    }

    #[test]
    fn the_loss_is_scale_invariant_and_excludes_empty_pixels() {
        let picture = Picture::random(12, 9, false, 4);
        let (mut depth, mut alpha) = planes(108, 4);
        let (target, settings) = (picture.target(), settings(Smoothed::Disparity, 5.0));
        let (first, _) = value(&depth, &alpha, &target, &settings);
        let larger: Vec<f64> = depth.iter().map(|d| 1000.0 * d).collect();
        assert!((value(&larger, &alpha, &target, &settings).0 - first).abs() < 1e-12);

        for (i, poison) in [f64::NAN, f64::INFINITY, -1.0, 0.0].into_iter().enumerate() {
            (depth[20 * i], alpha[20 * i]) = (poison, 1.0);
            (depth[20 * i + 1], alpha[20 * i + 1]) = (1e9, 0.1);
        }
        let (loss, [v_depth, v_alpha]) = value(&depth, &alpha, &target, &settings);
        assert!(loss.is_finite() && v_depth.iter().chain(&v_alpha).all(|v| v.is_finite()));
        assert!((0..4).all(|i| v_depth[20 * i] == 0.0 && v_alpha[20 * i + 1] == 0.0));
        let (nothing, v) = value(&depth, &[0.0; 108], &target, &settings);
        assert!(nothing == 0.0 && v.iter().flatten().all(|v| *v == 0.0));
    }

    #[test]
    fn eight_bit_truths_threads_and_accumulation_agree() {
        let picture = Picture::random(31, 22, true, 9);
        let bytes = picture.image(&picture.truth).to_u8();
        let rounded: Vec<f32> = (0..3 * 682)
            .map(|i| f32::from(bytes[i % 682 * 3 + i / 682]) / 255.0)
            .collect();
        let (depth, alpha) = planes(682, 9);
        let single = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let (depth, alpha) = (single(&depth), single(&alpha));
        let run = |truth: Truth, threads: usize, first: f32| {
            let target = Target {
                width: 31,
                height: 22,
                truth,
                mask: picture.mask.as_deref(),
            };
            let frame = DepthPlanes {
                depth: &depth,
                alpha: &alpha,
            };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            depth_gradient(682, first, |gradient| {
                pool.install(|| SmoothLoss::default().evaluate(frame, &target, Smoothed::Disparity, 8.0, 3.0, gradient))
            })
        };
        let one = run(Truth::Rgb8(&bytes), 1, 0.0);
        assert_eq!(run(Truth::Rgb8(&bytes), 3, 0.0), one);
        let planar = run(Truth::Planar(&rounded), 2, 0.0);
        assert!((planar.0 - one.0).abs() < 1e-6, "{} {}", planar.0, one.0);
        let added = run(Truth::Rgb8(&bytes), 2, 0.5);
        assert!(
            added.1[0]
                .iter()
                .zip(&one.1[0])
                .all(|(a, b)| (a - 0.5 - b).abs() < 1e-6)
        );
    }
}
