//! Arithmetic at the peak of one core, for the benchmarks to compare with.

use irradia_compute::simd::{Kernel, Lanes, Simd};

/// Rounds of twelve independent multiply-adds: about a tenth of a second.
const ROUNDS: u32 = 4_000_000;

/// Independent multiply-adds in registers; returns their number of operations, two each.
pub struct Peak;

impl Kernel for Peak {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f64
    where
        S::F: Lanes<Scalar = f32>,
    {
        let (a, b) = (
            simd.set(std::hint::black_box(0.999)),
            simd.set(std::hint::black_box(0.001)),
        );
        let mut sums = [simd.splat(1.0); 12];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = sum.mul_add(a, b);
            }
        }
        std::hint::black_box(sums);
        f64::from(ROUNDS) * 12.0 * 2.0 * S::LANES as f64
    }
}
