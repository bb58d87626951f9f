//! The quadrature of volume rendering along one ray (Max 1995; NeRF, equation 3), and its vector-Jacobian product.
//!
//! Symbols: `e_i = exp(-sigma_i delta_i)` the transmittance of an interval, `T_i` the product of all `e` before it,
//! `w_i = T_i (1 - e_i)` its weight. Every composite is a sum over `w`, so that only `w` needs a gradient.

use irradia_compute::simd::Scalar;

/// A ray ends where its transmittance falls below this; the rest changes a pixel by less than 1/2000.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;

/// The number of leading intervals, after an initial `transmittance`, that begin above [`TRANSMITTANCE_MIN`], and the
/// transmittance behind them. [`weights`] counts the same intervals.
#[inline(always)]
pub fn counted<T: Scalar>(transmittances: &[T], mut transmittance: T) -> (usize, T) {
    let end = T::from_f64(TRANSMITTANCE_MIN);
    for (i, e) in transmittances.iter().enumerate() {
        if transmittance < end {
            return (i, transmittance);
        }
        transmittance = transmittance * *e;
    }
    (transmittances.len(), transmittance)
}

/// Writes the weights of intervals of transmittance `transmittances`, front to back, and returns how many count (the rest have weight
/// zero) and the transmittance behind them.
#[inline(always)]
pub fn weights<T: Scalar>(transmittances: &[T], weights: &mut [T]) -> (usize, T) {
    let one = T::from_f64(1.0);
    let (count, remaining) = counted(transmittances, one);
    let mut transmittance = one;
    for (w, e) in weights.iter_mut().zip(&transmittances[..count]) {
        let next = transmittance * *e;
        *w = transmittance - next;
        transmittance = next;
    }
    weights[count..transmittances.len()].fill(T::default());
    (count, remaining)
}

/// The gradient of `sigma_i delta_i` for the `counted` intervals of [`weights`], given the gradient of the weights.
///
/// The transmittance of the ray is 1 minus all weights, and `v_weights` must include its gradient.
/// `dw_i = T_i e_i`, and for every later interval `dw_j = -w_j`.
#[inline(always)]
pub fn weights_vjp<T: Scalar>(
    transmittances: &[T],
    weights: &[T],
    v_weights: &[T],
    counted: usize,
    v_optical_depth: &mut [T],
) {
    let mut later = T::default();
    for i in 0..counted {
        later = later + v_weights[i] * weights[i];
    }
    let mut transmittance = T::from_f64(1.0);
    for i in 0..counted {
        later = later - v_weights[i] * weights[i];
        let next = transmittance * transmittances[i];
        v_optical_depth[i] = v_weights[i] * next - later;
        transmittance = next;
    }
    for v in &mut v_optical_depth[counted..] {
        *v = T::default();
    }
}

/// Discrete compositing of a whole ray, for experiments with the formula: from densities `[n]`, interval lengths `[n]` and
/// values (a colour channel, a depth) `[n]` to the composite and alpha.
pub fn composite(densities: &[f64], lengths: &[f64], values: &[f64]) -> (f64, f64) {
    let transmittances: Vec<f64> = densities.iter().zip(lengths).map(|(s, d)| (-s * d).exp()).collect();
    let mut w = vec![0.0; transmittances.len()];
    let (_, transmittance) = weights(&transmittances, &mut w);
    (w.iter().zip(values).map(|(w, v)| w * v).sum(), 1.0 - transmittance)
}
