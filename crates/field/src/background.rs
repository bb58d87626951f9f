//! A background learnt with the field: a colour for every direction, behind everything else.
//!
//! Symbols: d unit direction in the world; Y_k real harmonics; c `[(degree + 1)^2, 3]` learnt coefficients; C the colour.
//!
//! ```text
//! C = sigmoid(sum_k c_k Y_k(d))
//! ```
//!
//! The sigmoid keeps C a valid sRGB colour, which cannot cancel light by being negative, and has a slope everywhere. Sums are
//! in double precision: one colour per ray costs little beside the networks of all its samples.

use crate::encoding::direction::harmonics;
use irradia_compute::simd::{Double, Lanes, Scalar, Simd};

/// The highest degree.
pub(crate) const MAX_DEGREE: u32 = 3;

/// Number of coefficients of a background of `degree`, 0 for none.
pub(crate) fn coefficient_count(degree: Option<u32>) -> usize {
    degree.map_or(0, |degree| 3 * (degree as usize + 1).pow(2))
}

fn basis<T: Scalar>(direction: [T; 3]) -> [f64; 16] {
    harmonics(direction.map(|d| Double.set(d.to_f64()))).map(Lanes::sum)
}

/// The colour in the unit world `direction`, sRGB in \[0, 1\]; `coefficients [(degree + 1)^2, 3]`.
pub fn background_color<T: Scalar>(coefficients: &[T], direction: [T; 3]) -> [T; 3] {
    let mut sums = [0.0; 3];
    for (row, y) in coefficients.as_chunks::<3>().0.iter().zip(basis(direction)) {
        for c in 0..3 {
            sums[c] += row[c].to_f64() * y;
        }
    }
    sums.map(|x| T::from_f64(1.0 / (1.0 + (-x).exp())))
}

/// The VJP of [`background_color`], which returned `color`: adds the gradient of the coefficients to `v_coefficients`.
pub fn background_vjp<T: Scalar>(color: [T; 3], direction: [T; 3], v_color: [T; 3], v_coefficients: &mut [T]) {
    let v_sum: [f64; 3] = std::array::from_fn(|c| {
        let color = color[c].to_f64();
        v_color[c].to_f64() * color * (1.0 - color)
    });
    for (row, y) in v_coefficients.as_chunks_mut::<3>().0.iter_mut().zip(basis(direction)) {
        for c in 0..3 {
            row[c] = row[c] + T::from_f64(v_sum[c] * y);
        }
    }
}
