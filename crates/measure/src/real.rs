//! Floats that plain loops are generic over: single precision trains, double precision is for finite differences, and
//! both run the same code.

use irradia_compute::simd::Scalar;
use ndarray::NdFloat;

/// `f32` or `f64`.
pub(crate) trait Real: Scalar + NdFloat {}

impl Real for f32 {}
impl Real for f64 {}

/// The sum of `f(0) .. f(n)` in eight interleaved parts, which the compiler makes vectors of.
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
