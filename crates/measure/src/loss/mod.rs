//! Losses with their gradients. This module has the photometric loss: L1, D-SSIM and squared error, fused into one pass over
//! the image. It overwrites the gradient; all others ([`coarse`], [`depth`], [`normal`], [`perceptual`], [`smooth`]) add their weighted
//! gradient to it, so that a sum of losses needs no further pass.
//!
//! `total = l1 L1 + ssim (1 - SSIM) + mse MSE`, each a mean over the H W 3 values. With a mask m in \[0, 1\] the render x is
//! first replaced by `y + m (x - y)`, y being the truth, so that a pixel of weight 0 has neither loss nor
//! gradient; means are then weighted by m. SSIM is that of [`crate::ssim`].
//!
//! The image is split into bands of rows of one channel, whose number depends only on its height, and their sums are added in
//! order: the result does not depend on the number of threads.

pub mod coarse;
pub mod depth;
pub(crate) mod job;
pub mod normal;
pub mod perceptual;
mod pointwise;
mod rows;
pub mod smooth;
mod ssim;

use irradia_compute::simd::{Kernel, Lanes, Level, Scalar, Simd};
use job::{Gains, Job, Sums};
use rayon::prelude::*;
use std::sync::Mutex;

/// Weights of the parts of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Weight of the mean absolute difference.
    pub l1: f32,
    /// Weight of `1 - SSIM`; 0 skips its computation, which takes most of the time.
    pub ssim: f32,
    /// Weight of the mean squared difference.
    pub mse: f32,
}

impl LossWeights {
    /// `(1 - ssim) L1 + ssim (1 - SSIM)`, the loss of 3D Gaussian Splatting (Kerbl et al. 2023, eq. 7).
    pub fn photometric(ssim: f32) -> Self {
        Self {
            l1: 1.0 - ssim,
            ssim,
            mse: 0.0,
        }
    }
}

/// The value of the loss, and its unweighted parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossValues {
    /// The weighted sum.
    pub total: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean structural similarity; `None` if its weight is 0.
    pub ssim: Option<f64>,
    /// Mean squared difference; `-10 log10` of it is the PSNR.
    pub mse: f64,
}

/// A photograph's colours.
#[derive(Clone, Copy, Debug)]
pub enum Truth<'a, T = f32> {
    /// `[H, W, 3]`, 8 bits.
    Rgb8(&'a [u8]),
    /// `[3, stride]` with `stride >= H * W`.
    Planar(&'a [T]),
}

/// The photograph a render is compared with.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a, T = f32> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The photograph.
    pub truth: Truth<'a, T>,
    /// Pixel weights `[H, W]`, with 255 for a weight of 1; `None` is 1 everywhere.
    pub mask: Option<&'a [u8]>,
}

/// The depth of a frame, as blending accumulates it.
#[derive(Clone, Copy, Debug)]
pub struct DepthPlanes<'a, T = f32> {
    /// Accumulated depth, `[H * W]`: the expected depth times the opacity.
    pub depth: &'a [T],
    /// Opacity, `[H * W]`.
    pub alpha: &'a [T],
}

/// The gradient of [`DepthPlanes`], to which losses add theirs.
#[derive(Debug)]
pub struct DepthGradient<'a, T = f32> {
    /// Of the accumulated depth, `[H * W]`.
    pub depth: &'a mut [T],
    /// Of the opacity, `[H * W]`.
    pub alpha: &'a mut [T],
}

impl<T> DepthPlanes<'_, T> {
    fn assert_lengths(&self, gradient: &DepthGradient<T>, pixels: usize) {
        for length in [
            self.depth.len(),
            self.alpha.len(),
            gradient.depth.len(),
            gradient.alpha.len(),
        ] {
            assert_eq!(length, pixels, "depth, alpha and their gradients are [H, W]");
        }
    }
}

/// Computes the loss and its gradient; reuses its working memory, so that only the first call allocates.
///
/// `T` is `f32`; tests run the same code in double precision.
pub struct PhotometricLoss<T = f32> {
    level: Level,
    scratch: Mutex<Vec<ssim::Scratch<T>>>,
    sums: Vec<Sums>,
    shades: [T; 256],
}

impl Default for PhotometricLoss {
    fn default() -> Self {
        Self::new()
    }
}

impl PhotometricLoss {
    /// Runs at the widest SIMD level of this processor.
    pub fn new() -> Self {
        Self::with_level(Level::detect())
    }

    /// The loss of `render [3, stride]`, `stride >= H * W`; sets `v_render`, of the same shape, to its gradient. Values past H * W
    /// in a plane are neither read nor written.
    ///
    /// The gradient of L1 is 0 at equal values. With nothing to compare (no pixels, or a mask of zeros) loss and gradient are 0
    /// and SSIM is 1.
    ///
    /// # Panics
    /// When a length does not match the target's size: a bug in the caller.
    pub fn evaluate(
        &mut self,
        render: &[f32],
        target: &Target,
        weights: &LossWeights,
        v_render: &mut [f32],
    ) -> LossValues {
        let level = self.level;
        self.run_bands(render, target, weights, v_render, |job, scratch, v_render| {
            level.run(BandKernel { job, scratch, v_render })
        })
    }
}

struct BandKernel<'a, 'b> {
    job: &'a Job<'b, f32>,
    scratch: &'a mut ssim::Scratch<f32>,
    v_render: &'a mut [f32],
}

impl Kernel for BandKernel<'_, '_> {
    type Output = Sums;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Sums
    where
        S::F: Lanes<Scalar = f32>,
    {
        band(simd, self.job, self.scratch, self.v_render)
    }
}

#[inline(always)]
fn band<S: Simd>(
    simd: S,
    job: &Job<<S::F as Lanes>::Scalar>,
    scratch: &mut ssim::Scratch<<S::F as Lanes>::Scalar>,
    v_render: &mut [<S::F as Lanes>::Scalar],
) -> Sums {
    scratch.reshape(job.width);
    if job.gains.ssim == 0.0 {
        pointwise::band(simd, job, &mut scratch.moments, v_render)
    } else {
        ssim::band(simd, job, scratch, v_render)
    }
}

impl<T: Scalar> PhotometricLoss<T> {
    /// As [`PhotometricLoss::new`], at SIMD `level`.
    pub fn with_level(level: Level) -> Self {
        Self {
            level,
            scratch: Mutex::default(),
            sums: Vec::new(),
            shades: std::array::from_fn(|i| T::from_f64(i as f64 / 255.0)),
        }
    }

    fn run_bands(
        &mut self,
        render: &[T],
        target: &Target<T>,
        weights: &LossWeights,
        v_render: &mut [T],
        run: impl Fn(&Job<T>, &mut ssim::Scratch<T>, &mut [T]) -> Sums + Sync,
    ) -> LossValues {
        let (width, height) = (target.width, target.height);
        let (pixels, stride) = (width * height, render.len() / 3);
        target.assert_lengths(render.len(), v_render.len());
        let count = 3.0 * target.weight();
        if count == 0.0 {
            v_render
                .chunks_mut(stride.max(1))
                .for_each(|v| v[..pixels].fill(T::default()));
            return LossValues::of(&Sums::default(), weights, 1.0);
        }
        let rows = job::rows_per_band(height);
        let bands = height.div_ceil(rows);
        self.sums.resize(3 * bands, Sums::default());
        let (scratch, shades) = (&self.scratch, &self.shades);
        let channels = v_render
            .par_chunks_mut(stride)
            .zip(self.sums.par_chunks_mut(bands))
            .enumerate();
        channels.for_each(|(channel, (v_plane, sums))| {
            let each_band = v_plane[..pixels].par_chunks_mut(rows * width).zip(sums).enumerate();
            each_band.for_each(|(band, (v_rows, sums))| {
                let job = Job {
                    render: &render[channel * stride..channel * stride + pixels],
                    truth: target.truth,
                    channel,
                    mask: target.mask,
                    shades,
                    width,
                    height,
                    rows: band * rows..((band + 1) * rows).min(height),
                    gains: Gains::of(weights, count),
                };
                // At most one scratch per thread is ever made; the lock is held only for a push or a pop.
                let kept = scratch.lock().expect("no band panics").pop();
                let mut mine = kept.unwrap_or_default();
                *sums = run(&job, &mut mine, v_rows);
                scratch.lock().expect("no band panics").push(mine);
            });
        });
        let sums = self.sums.iter().fold(Sums::default(), |total, band| total.plus(band));
        LossValues::of(&sums, weights, count)
    }
}

impl LossValues {
    /// From sums over `count` values: absolute and squared differences, and `1 - SSIM`.
    #[cfg(feature = "gpu")]
    pub(crate) fn of_sums([l1, mse, dissimilarity]: [f64; 3], weights: &LossWeights, count: f64) -> Self {
        Self::of(&Sums { l1, mse, dissimilarity }, weights, count)
    }

    fn of(sums: &Sums, weights: &LossWeights, count: f64) -> Self {
        let (l1, mse) = (sums.l1 / count, sums.mse / count);
        // Sums of `1 - SSIM`, which are 0 where there is nothing to compare.
        let dissimilarity = sums.dissimilarity / count;
        Self {
            total: f64::from(weights.l1) * l1 + f64::from(weights.ssim) * dissimilarity + f64::from(weights.mse) * mse,
            l1,
            ssim: (weights.ssim != 0.0).then_some(1.0 - dissimilarity),
            mse,
        }
    }
}

impl<T: Scalar> Target<'_, T> {
    /// Channel `c` of the photograph at a pixel.
    #[inline(always)]
    fn color(&self, pixel: usize, c: usize) -> T {
        match self.truth {
            Truth::Rgb8(truth) => T::from_f64(f64::from(truth[3 * pixel + c]) / 255.0),
            Truth::Planar(truth) => truth[c * (truth.len() / 3) + pixel],
        }
    }
}

impl<T> Target<'_, T> {
    /// Sum of the pixels' weights.
    pub(crate) fn weight(&self) -> f64 {
        match self.mask {
            Some(mask) => mask.iter().map(|m| u64::from(*m)).sum::<u64>() as f64 / 255.0,
            None => (self.width * self.height) as f64,
        }
    }

    fn assert_lengths(&self, render: usize, v_render: usize) {
        let pixels = self.width * self.height;
        let planar = |len: usize| len.is_multiple_of(3) && len / 3 >= pixels;
        assert!(planar(render), "the render is [3, stride] and covers every pixel");
        assert_eq!(render, v_render, "the gradient has the render's shape");
        self.assert_truth();
    }

    fn assert_truth(&self) {
        let pixels = self.width * self.height;
        let planar = |len: usize| len.is_multiple_of(3) && len / 3 >= pixels;
        match self.truth {
            Truth::Rgb8(truth) => assert_eq!(truth.len(), 3 * pixels, "the truth is [H, W, 3]"),
            Truth::Planar(truth) => assert!(planar(truth.len()), "the truth is [3, stride] and covers every pixel"),
        }
        if let Some(mask) = self.mask {
            assert_eq!(mask.len(), pixels, "the mask is [H, W]");
        }
    }
}

#[cfg(test)]
mod picture;
#[cfg(test)]
mod tests;
