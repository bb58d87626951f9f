//! The inputs of one band, and how its rows are loaded.

use super::{LossWeights, Truth};
use irradia_compute::simd::{Lanes, Scalar, Simd};
use std::ops::Range;

/// Rows per band of an image of `height` rows: about 128, since each band computes ten extra rows for the windows, and as equal
/// as possible.
pub(super) fn rows_per_band(height: usize) -> usize {
    height.div_ceil(height.div_ceil(128))
}

/// Rows of one channel.
pub(super) struct Job<'a, T> {
    /// The render's channel, `[H, W]`.
    pub(super) render: &'a [T],
    /// All channels.
    pub(super) truth: Truth<'a, T>,
    pub(super) channel: usize,
    /// `[H, W]`.
    pub(super) mask: Option<&'a [u8]>,
    /// The colour of each of the 256 8-bit values.
    pub(super) shades: &'a [T; 256],
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) rows: Range<usize>,
    pub(super) gains: Gains,
}

/// Factors of the gradient of each part: its weight over the number of values, with its sign.
#[derive(Clone, Copy)]
pub(crate) struct Gains {
    pub(crate) l1: f64,
    pub(crate) ssim: f64,
    pub(crate) mse: f64,
}

impl Gains {
    /// For losses that scale their own gradients.
    pub(crate) const NONE: Self = Self {
        l1: 0.0,
        ssim: 0.0,
        mse: 0.0,
    };

    pub(crate) fn of(weights: &LossWeights, count: f64) -> Self {
        Self {
            l1: f64::from(weights.l1) / count,
            ssim: -f64::from(weights.ssim) / count,
            mse: 2.0 * f64::from(weights.mse) / count,
        }
    }
}

/// Sums over values, weighted by the mask.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sums {
    pub(super) l1: f64,
    pub(super) mse: f64,
    /// Of `1 - SSIM`.
    pub(super) dissimilarity: f64,
}

impl Sums {
    pub(super) fn plus(&self, other: &Self) -> Self {
        Self {
            l1: self.l1 + other.l1,
            mse: self.mse + other.mse,
            dissimilarity: self.dissimilarity + other.dissimilarity,
        }
    }
}

impl<T: Scalar> Job<'_, T> {
    /// Loads row `row` of render, truth and weights into `[x, y, m]`, each at least `width` long; values past `width` are not
    /// written.
    #[inline(always)]
    pub(super) fn load_row<S: Simd>(&self, simd: S, row: usize, [x, y, m]: [&mut [T]; 3])
    where
        S::F: Lanes<Scalar = T>,
    {
        let (width, span) = (self.width, row * self.width..(row + 1) * self.width);
        x[..width].copy_from_slice(&self.render[span.clone()]);
        match self.truth {
            Truth::Rgb8(truth) => {
                let pixels = truth[3 * span.start..3 * span.end].chunks_exact(3);
                for (y, pixel) in y[..width].iter_mut().zip(pixels) {
                    *y = self.shades[usize::from(pixel[self.channel])];
                }
            }
            Truth::Planar(truth) => {
                let first = self.channel * (truth.len() / 3);
                y[..width].copy_from_slice(&truth[first + span.start..first + span.end]);
            }
        }
        let Some(mask) = self.mask else {
            m[..width].fill(T::from_f64(1.0));
            return;
        };
        for (m, value) in m[..width].iter_mut().zip(&mask[span]) {
            *m = self.shades[usize::from(*value)];
        }
        for at in (0..x.len()).step_by(S::LANES) {
            let (weight, truth) = (simd.load(&m[at..]), simd.load(&y[at..]));
            // Selected, not just multiplied: a non-finite render must not pass through a weight of 0.
            let counted = simd.splat(0.0).lt(weight);
            let difference = ((simd.load(&x[at..]) - truth) * weight).masked(counted);
            (truth + difference).store(&mut x[at..]);
        }
    }
}
