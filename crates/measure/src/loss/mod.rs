//! The losses with their gradients. Here the photometric one: L1, D-SSIM and squared error, fused, one pass over the image.
//! It overwrites the gradient; all others ([`coarse`], [`depth`], [`perceptual`], [`smooth`]) add to what is there, and
//! their share is multiplied by a weight on the way, so that a sum of losses needs no further pass.
//!
//! `total = l1 L1 + ssim (1 - SSIM) + mse MSE`, each a mean over the H W 3 values. With a mask m in \[0, 1\] the render x is
//! first replaced by `y + m (x - y)`, y being the truth, so that a pixel of weight 0 differs in nothing and has no
//! gradient; means are then weighted by m. SSIM is that of [`crate::ssim`].
//!
//! The image is cut into bands of rows of one channel, whose number depends on its height alone, and their sums are added
//! in order: the number of threads changes no bit of the result.

pub mod coarse;
pub mod depth;
mod job;
pub mod perceptual;
mod pointwise;
mod rows;
pub mod smooth;
mod ssim;

use irradia_compute::simd::{Kernel, Lanes, Level, Scalar, Simd};
use job::{Gains, Job, Sums};
use rayon::prelude::*;
use std::sync::Mutex;

/// How much each part of the loss counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Of the mean absolute difference.
    pub l1: f32,
    /// Of `1 - SSIM`; 0 skips its computation, which is most of the time.
    pub ssim: f32,
    /// Of the mean squared difference.
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

/// What a loss was, each part before its weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossValues {
    /// The weighted sum.
    pub total: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean structural similarity; `None` where its weight is 0.
    pub ssim: Option<f64>,
    /// Mean squared difference; `-10 log10` of it is the PSNR.
    pub mse: f64,
}

/// A photograph's colours.
#[derive(Clone, Copy, Debug)]
pub enum Truth<'a, T = f32> {
    /// `[H, W, 3]` in 256 steps.
    Rgb8(&'a [u8]),
    /// `[3, stride]` with `stride >= H * W`.
    Planar(&'a [T]),
}

/// What a render is compared with.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a, T = f32> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The photograph.
    pub truth: Truth<'a, T>,
    /// Weights `[H, W]` of the pixels, 255 counting as 1; `None` is 1 everywhere.
    pub mask: Option<&'a [u8]>,
}

/// Computes the loss and its gradient; keeps its working memory, so that nothing is allocated from the second call on.
///
/// `T` is `f32`; double precision exists for the tests, through the same code.
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
    /// With the widest instructions of this processor.
    pub fn new() -> Self {
        Self::with_level(Level::detect())
    }

    /// The loss of `render [3, stride]`, `stride >= H * W`, with respect to which `v_render`, of the same shape, becomes the
    /// gradient. What lies past H * W in a plane is neither read nor written.
    ///
    /// The L1 part's gradient is 0 where both are equal. With nothing to compare (no pixels, or a mask of zeros) the loss
    /// and the gradient are 0 and SSIM is 1.
    ///
    /// # Panics
    /// When a length does not match the target's size: that is a bug of the caller.
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
    /// As [`PhotometricLoss::new`] with the instructions of `level`.
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
        let rows = job::rows_a_band(height);
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
                // One working memory a thread at most is ever made; the lock is held for a push or a pop.
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
    fn of(sums: &Sums, weights: &LossWeights, count: f64) -> Self {
        let (l1, mse) = (sums.l1 / count, sums.mse / count);
        // Dissimilarities are summed, for they are 0 where there is nothing to compare.
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
    fn weight(&self) -> f64 {
        match self.mask {
            Some(mask) => mask.iter().map(|m| u64::from(*m)).sum::<u64>() as f64 / 255.0,
            None => (self.width * self.height) as f64,
        }
    }

    fn assert_lengths(&self, render: usize, v_render: usize) {
        let pixels = self.width * self.height;
        let planar = |len: usize| len.is_multiple_of(3) && len / 3 >= pixels;
        assert!(planar(render), "the render is [3, stride] and holds every pixel");
        assert_eq!(render, v_render, "the gradient has the render's shape");
        self.assert_truth();
    }

    fn assert_truth(&self) {
        let pixels = self.width * self.height;
        let planar = |len: usize| len.is_multiple_of(3) && len / 3 >= pixels;
        match self.truth {
            Truth::Rgb8(truth) => assert_eq!(truth.len(), 3 * pixels, "the truth is [H, W, 3]"),
            Truth::Planar(truth) => assert!(planar(truth.len()), "the truth is [3, stride] and holds every pixel"),
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
