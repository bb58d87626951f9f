//! The contraction of unbounded space into a cube of half size 2 (mip-NeRF 360, equation 10), with the maximum
//! norm, so that a grid's cube is filled: `c(x) = x` inside, `(2 - 1 / m) x / m` with `m = max |x_i|` outside.

use irradia_compute::simd::Scalar;

/// The coordinate of largest magnitude and that magnitude.
#[inline(always)]
fn largest<T: Scalar>(x: [T; 3]) -> (usize, T) {
    let zero = T::default();
    let mut at = (0, zero);
    for c in 0..3 {
        let magnitude = if x[c] < zero { zero - x[c] } else { x[c] };
        if at.1 < magnitude {
            at = (c, magnitude);
        }
    }
    at
}

/// `c(x)`.
#[inline(always)]
pub fn contract<T: Scalar>(x: [T; 3]) -> [T; 3] {
    let (one, two) = (T::from_f64(1.0), T::from_f64(2.0));
    let (_, m) = largest(x);
    if m < one {
        return x;
    }
    let scale = (two - one / m) / m;
    [x[0] * scale, x[1] * scale, x[2] * scale]
}

/// The point whose contraction is `y`; the coordinates of `y` are below 2 in magnitude.
#[inline(always)]
pub fn uncontract<T: Scalar>(y: [T; 3]) -> [T; 3] {
    let (one, two) = (T::from_f64(1.0), T::from_f64(2.0));
    let (_, k) = largest(y);
    if k < one {
        return y;
    }
    // k = 2 - 1 / m; kept below 2, so that the boundary maps to a large but finite distance.
    let k_inside = if k < T::from_f64(1.9999) {
        k
    } else {
        T::from_f64(1.9999)
    };
    let scale = one / ((two - k_inside) * k);
    [y[0] * scale, y[1] * scale, y[2] * scale]
}

/// The gradient of `x` through [`contract`].
#[inline(always)]
pub fn contract_vjp<T: Scalar>(x: [T; 3], v: [T; 3]) -> [T; 3] {
    let (one, two) = (T::from_f64(1.0), T::from_f64(2.0));
    let (at, m) = largest(x);
    if m < one {
        return v;
    }
    let scale = (two - one / m) / m;
    // d scale / dm = (2 / m - 2) / m^2
    let slope = (two / m - two) / (m * m);
    let along = x[0] * v[0] + x[1] * v[1] + x[2] * v[2];
    let mut out = [v[0] * scale, v[1] * scale, v[2] * scale];
    let sign = if x[at] < T::default() { T::default() - one } else { one };
    out[at] = out[at] + along * slope * sign;
    out
}
