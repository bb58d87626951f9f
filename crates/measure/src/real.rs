//! The float types that scalar loops are generic over: `f32` for training and `f64` for finite differences, in the same
//! code.

use irradia_compute::simd::Scalar;
use ndarray::NdFloat;

/// `f32` or `f64`.
pub(crate) trait Real: Scalar + NdFloat {}

impl Real for f32 {}
impl Real for f64 {}

/// The sum of `f(0) .. f(n)` in eight interleaved parts, which the compiler vectorises.
#[inline(always)]
pub(crate) fn sum_over<T: Real>(n: usize, f: impl Fn(usize) -> T) -> T {
    const PARTS: usize = 8;
    let mut parts = [T::zero(); PARTS];
    let whole = n / PARTS * PARTS;
    for first in (0..whole).step_by(PARTS) {
        for (part, sum) in parts.iter_mut().enumerate() {
            *sum += f(first + part);
        }
    }
    let mut total = T::zero();
    for part in parts {
        total += part;
    }
    for rest in whole..n {
        total += f(rest);
    }
    total
}
