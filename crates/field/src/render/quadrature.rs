//! The quadrature of volume rendering along one ray (Max 1995; NeRF, equation 3), and its vector-Jacobian product.
//!
//! Symbols: `e_i = exp(-sigma_i delta_i)` what an interval lets through, `T_i` the product of all `e` before it,
//! `w_i = T_i (1 - e_i)` its weight. Whatever is composited is a sum over `w`, so that only `w` needs a gradient.

use irradia_compute::simd::Scalar;

/// A ray ends where its transmittance falls below this; what lies behind moves a pixel by less than 1/2000.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;

/// How many of the intervals behind `transmittance` count, front to back, and the transmittance behind those: an interval counts
/// where what lies before it lets enough through, in [`weights`] too.
#[inline(always)]
pub fn counted<T: Scalar>(through: &[T], mut transmittance: T) -> (usize, T) {
    let end = T::from_f64(TRANSMITTANCE_MIN);
    for (i, e) in through.iter().enumerate() {
        if transmittance < end {
            return (i, transmittance);
        }
        transmittance = transmittance * *e;
    }
    (through.len(), transmittance)
}

/// Writes the weights of intervals that let `through` pass, front to back, and returns how many count (the rest have
/// weight zero) and the transmittance behind them.
#[inline(always)]
pub fn weights<T: Scalar>(through: &[T], weights: &mut [T]) -> (usize, T) {
    let one = T::from_f64(1.0);
    let (count, behind) = counted(through, one);
    let mut transmittance = one;
    for (w, e) in weights.iter_mut().zip(&through[..count]) {
        let next = transmittance * *e;
        *w = transmittance - next;
        transmittance = next;
    }
    weights[count..through.len()].fill(T::default());
    (count, behind)
}

/// The gradient of `sigma_i delta_i` for the `counted` intervals of [`weights`], given the gradient of the weights.
///
/// The transmittance behind is 1 less all weights, and its gradient must have been put on them.
/// `dw_i = T_i e_i`, and every weight behind shrinks by itself: `dw_j = -w_j`.
#[inline(always)]
pub fn weights_vjp<T: Scalar>(through: &[T], weights: &[T], v_weights: &[T], counted: usize, v_thickness: &mut [T]) {
    let mut behind = T::default();
    for i in 0..counted {
        behind = behind + v_weights[i] * weights[i];
    }
    let mut transmittance = T::from_f64(1.0);
    for i in 0..counted {
        behind = behind - v_weights[i] * weights[i];
        let next = transmittance * through[i];
        v_thickness[i] = v_weights[i] * next - behind;
        transmittance = next;
    }
    for v in &mut v_thickness[counted..] {
        *v = T::default();
    }
}

/// The discrete compositing of a whole ray, plainly: densities `[n]`, interval lengths `[n]`, values (a colour's channel, a
/// depth) `[n]` to the composite and alpha. The lab in which the formula can be looked at.
pub fn composite(densities: &[f64], lengths: &[f64], values: &[f64]) -> (f64, f64) {
    let through: Vec<f64> = densities.iter().zip(lengths).map(|(s, d)| (-s * d).exp()).collect();
    let mut w = vec![0.0; through.len()];
    let (_, behind) = weights(&through, &mut w);
    (w.iter().zip(values).map(|(w, v)| w * v).sum(), 1.0 - behind)
}
