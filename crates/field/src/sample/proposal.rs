//! The losses that train proposal networks and favour compact densities (mip-NeRF 360).
//!
//! Symbols: `s` edges, `w` weights of the last round; `s_hat`, `w_hat` those of a proposal.

use irradia_compute::simd::Scalar;

/// The interlevel loss (equation 13): how far the last round's weights, held constant, exceed the bound given by the
/// proposal's overlapping intervals. Adds the gradient of `w_hat` to `v`.
pub fn interlevel<T: Scalar>(s: &[T], w: &[T], s_hat: &[T], w_hat: &[T], scale: T, v: &mut [T]) -> T {
    let mut loss = T::default();
    let (two, tiny) = (T::from_f64(2.0), T::from_f64(1e-7));
    let mut first = 0;
    for i in 0..w.len() {
        while first + 1 < w_hat.len() && s_hat[first + 1] <= s[i] {
            first += 1;
        }
        let mut bound = T::default();
        let mut end = first;
        while end < w_hat.len() && (end == first || s_hat[end] < s[i + 1]) {
            bound = bound + w_hat[end];
            end += 1;
        }
        if bound < w[i] {
            let (over, under) = (w[i] - bound, w[i] + tiny);
            loss = loss + scale * over * over / under;
            for v in &mut v[first..end] {
                *v = *v - scale * two * over / under;
            }
        }
    }
    loss
}

/// The distortion loss (equation 15): `sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (s_{i+1} - s_i)` with `m` the
/// middles, in one pass since the middles ascend. Adds the gradient of `w` to `v`.
pub fn distortion<T: Scalar>(s: &[T], w: &[T], scale: T, v: &mut [T]) -> T {
    let (half, third, two) = (T::from_f64(0.5), T::from_f64(1.0 / 3.0), T::from_f64(2.0));
    let middle = |i: usize| (s[i] + s[i + 1]) * half;
    let (mut total, mut moment) = (T::default(), T::default());
    for i in 0..w.len() {
        total = total + w[i];
        moment = moment + w[i] * middle(i);
    }
    let mut loss = T::default();
    // Weight and moment of the preceding intervals.
    let (mut before, mut moment_before) = (T::default(), T::default());
    for i in 0..w.len() {
        let (m, length) = (middle(i), s[i + 1] - s[i]);
        let (after, moment_after) = (total - before - w[i], moment - moment_before - w[i] * m);
        let pull = m * before - moment_before + moment_after - m * after;
        loss = loss + scale * (w[i] * pull + third * w[i] * w[i] * length);
        v[i] = v[i] + scale * (two * pull + two * third * w[i] * length);
        before = before + w[i];
        moment_before = moment_before + w[i] * m;
    }
    loss
}
