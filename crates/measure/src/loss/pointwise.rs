//! The per-pixel parts of the loss: absolute and squared differences.

use super::job::{Job, Sums};
use super::rows::Rows;
use irradia_compute::simd::{Lanes, Scalar, Simd};

/// Sums of absolute and squared differences per lane.
#[derive(Clone, Copy)]
pub(super) struct Differences<F> {
    absolute: F,
    squared: F,
}

impl<F: Lanes> Differences<F> {
    #[inline(always)]
    pub(super) fn zero<S: Simd<F = F>>(simd: S) -> Self {
        Self {
            absolute: simd.splat(0.0),
            squared: simd.splat(0.0),
        }
    }

    /// Adds `x - y` and returns its gradient: `l1 sign(x - y) + mse (x - y)`.
    #[inline(always)]
    pub(super) fn add(&mut self, x: F, y: F, gain_l1: F, gain_mse: F) -> F {
        let zero = x.splat(0.0);
        let d = x - y;
        self.absolute += d.abs();
        self.squared = d.mul_add(d, self.squared);
        let positive = gain_l1.masked(zero.lt(d));
        let l1 = (-gain_l1).select(d.lt(zero), positive);
        d.mul_add(gain_mse, l1)
    }

    #[inline(always)]
    pub(super) fn add_to(self, sums: &mut Sums) {
        sums.l1 += self.absolute.sum().to_f64();
        sums.mse += self.squared.sum().to_f64();
    }
}

/// The loss without SSIM.
#[inline(always)]
pub(super) fn band<S: Simd>(
    simd: S,
    job: &Job<<S::F as Lanes>::Scalar>,
    rows: &mut Rows<<S::F as Lanes>::Scalar>,
    v_render: &mut [<S::F as Lanes>::Scalar],
) -> Sums {
    let (gain_l1, gain_mse) = (simd.splat(job.gains.l1), simd.splat(job.gains.mse));
    let mut sums = Sums::default();
    for (row, v_row) in job.rows.clone().zip(v_render.chunks_exact_mut(job.width)) {
        let [x, y, m, v] = rows.columns_mut(0);
        job.load_row(simd, row, [&mut *x, &mut *y, &mut *m]);
        let mut differences = Differences::zero(simd);
        for at in (0..x.len()).step_by(S::LANES) {
            let (x, y, m) = (simd.load(&x[at..]), simd.load(&y[at..]), simd.load(&m[at..]));
            (m * differences.add(x, y, gain_l1, gain_mse)).store(&mut v[at..]);
        }
        differences.add_to(&mut sums);
        v_row.copy_from_slice(&v[..job.width]);
    }
    sums
}
