//! Vectorised gradients of a row of pixels in polar form. No operation is fused, so that all instruction sets agree to the bit.

use super::scale_space::Plane;
use irradia_compute::simd::{Lanes, Simd};

/// Magnitude and direction of the gradients at columns `x..x + LANES` of the middle row, by central differences. The direction is in
/// \[0, 8\], in eighths of a turn from +x towards +y. The pixels' neighbours must exist in all lanes that are used.
#[inline(always)]
pub(super) fn polar<S: Simd>(simd: S, rows: [&[f32]; 3], x: usize) -> [S::F; 2]
where
    S::F: Lanes<Scalar = f32>,
{
    let half = simd.splat(0.5);
    let gx = (simd.load(&rows[1][x + 1..]) - simd.load(&rows[1][x - 1..])) * half;
    let gy = (simd.load(&rows[2][x..]) - simd.load(&rows[0][x..])) * half;
    [(gx * gx + gy * gy).sqrt(), atan2_eighths(simd, gy, gx)]
}

/// The rows above, at and below `y`.
#[inline(always)]
pub(super) fn rows_around(plane: &Plane, y: usize) -> [&[f32]; 3] {
    [plane.row(y - 1), plane.row(y), plane.row(y + 1)]
}

/// `atan2(y, x)` in eighths of a turn, in \[0, 8\], within 1e-5; 0 where both are 0.
#[inline(always)]
fn atan2_eighths<S: Simd>(simd: S, y: S::F, x: S::F) -> S::F
where
    S::F: Lanes<Scalar = f32>,
{
    let (ax, ay) = (x.abs(), y.abs());
    let steep = ax.lt(ay);
    let (short, long) = (ax.min(ay), ax.max(ay));
    let t = short / long.max(simd.splat(1e-30));
    let t2 = t * t;
    // atan(t) * 4 / pi for t in [0, 1]: an odd polynomial, fitted by least squares at Chebyshev nodes.
    let mut a = simd.splat(ATAN[5]);
    for i in (0..5).rev() {
        a = a * t2 + simd.splat(ATAN[i]);
    }
    let a = a * t;
    let a = (simd.splat(2.0) - a).select(steep, a);
    let zero = simd.splat(0.0);
    let a = (simd.splat(4.0) - a).select(x.lt(zero), a);
    (simd.splat(8.0) - a).select(y.lt(zero), a)
}

/// Coefficients of t, t^3, .., t^11.
const ATAN: [f64; 6] = [
    1.2732105392,
    -0.4235085386,
    0.2464232615,
    -0.1482388005,
    0.0670326873,
    -0.0149212656,
];

/// `e^-t` for t in \[0, 4.6\], within 1e-5: the 16th power of a polynomial.
#[inline(always)]
pub(super) fn exp_minus<S: Simd>(simd: S, t: S::F) -> S::F
where
    S::F: Lanes<Scalar = f32>,
{
    // The Taylor series of e^(-t/16), then four squarings.
    let u = t * simd.splat(-1.0 / 16.0);
    let mut e = simd.splat(1.0 / 120.0);
    for coefficient in [1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        e = e * u + simd.splat(coefficient);
    }
    for _ in 0..4 {
        e = e * e;
    }
    e
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_compute::Level;
    use irradia_compute::simd::Kernel;

    #[test]
    fn the_angle_and_the_exponential_are_within_their_bounds_at_every_level() {
        struct Sweep;
        impl Kernel for Sweep {
            type Output = Vec<[f32; 2]>;
            #[inline(always)]
            fn run<S: Simd>(self, simd: S) -> Self::Output
            where
                S::F: Lanes<Scalar = f32>,
            {
                let mut out = [[0.0; 16]; 2];
                (0..3600)
                    .map(|i| {
                        let angle = f64::from(i).to_radians() * 0.1;
                        let (y, x) = (simd.splat(3.0 * angle.sin()), simd.splat(3.0 * angle.cos()));
                        atan2_eighths(simd, y, x).store(&mut out[0]);
                        exp_minus(simd, simd.splat(f64::from(i) * 4.6 / 3600.0)).store(&mut out[1]);
                        [out[0][0], out[1][0]]
                    })
                    .collect()
            }
        }
        let all: Vec<_> = Level::all().into_iter().map(|level| level.run(Sweep)).collect();
        for (i, [angle, e]) in all[0].iter().enumerate() {
            let off = (angle - i as f32 * 8.0 / 3600.0).abs();
            // A result of a full turn is equivalent to 0.
            assert!(off.min((off - 8.0).abs()) < 1e-5, "{i}: {angle}");
            assert!((e - (-(i as f32) * 4.6 / 3600.0).exp()).abs() < 1e-5, "{i}: {e}");
        }
        assert!(all.iter().all(|other| *other == all[0]));
    }
}
