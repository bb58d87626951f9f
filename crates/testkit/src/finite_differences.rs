//! Compares gradients with central differences in double precision.

use irradia_scene::Rng;

/// The step of central differences, and the tolerance of a gradient v compared with a difference d:
/// `|v - d| <= relative |d| + relative_to_max max |v| + absolute`.
#[derive(Clone, Copy, Debug)]
pub struct FiniteDifferences {
    /// Step to either side.
    pub step: f64,
    /// Tolerance relative to the difference.
    pub relative: f64,
    /// Tolerance relative to the gradient's largest coordinate.
    pub relative_to_max: f64,
    /// Absolute tolerance.
    pub absolute: f64,
}

impl FiniteDifferences {
    /// A tolerance of `relative_to_max` of the largest coordinate.
    pub fn relative_to_max(step: f64, relative_to_max: f64) -> Self {
        Self {
            step,
            relative: 0.0,
            relative_to_max,
            absolute: 1e-9,
        }
    }

    /// Checks the coordinates `indices` of the gradient `v` of `value` at `at`; `at` may be longer than `v`.
    ///
    /// # Panics
    /// When a difference is out of tolerance.
    pub fn check(
        &self,
        label: &str,
        at: &[f64],
        v: &[f64],
        indices: impl IntoIterator<Item = usize>,
        value: impl Fn(&[f64]) -> f64,
    ) {
        let largest = v.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let mut moved = at.to_vec();
        for i in indices {
            let mut value_at = |by: f64| {
                moved[i] = at[i] + by;
                let value = value(&moved);
                moved[i] = at[i];
                value
            };
            let numeric = (value_at(self.step) - value_at(-self.step)) / (2.0 * self.step);
            let tolerance = self.relative * numeric.abs() + self.relative_to_max * largest + self.absolute;
            // NaN gradients must fail, too.
            assert!(
                (numeric - v[i]).abs() <= tolerance,
                "{label}, value {i}: gradient {}, finite difference {numeric}; the largest gradient is {largest}",
                v[i]
            );
        }
    }
}

/// About 200 of `n` coordinates, or all of them.
pub fn sample_indices(n: usize) -> impl Iterator<Item = usize> {
    (0..n).step_by(1 + n / 200)
}

/// Checks the gradient `v` of `value` at `at` along eight random directions; `tolerance` is relative to the gradient's length,
/// and a step is `step` times a normal variate in each coordinate.
///
/// # Panics
/// When a difference is out of tolerance.
pub fn check_directional(at: &[f64], v: &[f64], value: impl Fn(&[f64]) -> f64, step: f64, tolerance: f64) {
    assert_eq!(at.len(), v.len(), "the gradient matches the input's length");
    let length = v.iter().map(|v| v * v).sum::<f64>().sqrt();
    for seed in 0..8 {
        let mut rng = Rng::new(seed, 17);
        let along: Vec<f64> = at.iter().map(|_| f64::from(rng.normal())).collect();
        let moved = |by: f64| at.iter().zip(&along).map(|(x, d)| x + by * d).collect::<Vec<_>>();
        let numeric = (value(&moved(step)) - value(&moved(-step))) / (2.0 * step);
        let analytic: f64 = v.iter().zip(&along).map(|(v, d)| v * d).sum();
        assert!(
            (numeric - analytic).abs() <= tolerance * length,
            "direction {seed}: gradient {analytic}, finite difference {numeric}; the gradient's length is {length}"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// x^2 + 3 x y.
    fn value(x: &[f64]) -> f64 {
        x[0] * x[0] + 3.0 * x[0] * x[1]
    }

    const AT: [f64; 2] = [2.0, -1.0];
    const GRADIENT: [f64; 2] = [1.0, 6.0];

    #[test]
    fn a_correct_gradient_passes() {
        FiniteDifferences::relative_to_max(1e-5, 1e-9).check("it", &AT, &GRADIENT, 0..2, value);
        check_directional(&AT, &GRADIENT, value, 1e-5, 1e-9);
    }

    #[test]
    #[should_panic(expected = "it, value 0: gradient 1.1")]
    fn a_wrong_coordinate_fails() {
        FiniteDifferences::relative_to_max(1e-5, 1e-3).check("it", &AT, &[1.1, 6.0], 0..2, value);
    }

    #[test]
    #[should_panic(expected = "direction 0")]
    fn a_nan_gradient_fails() {
        check_directional(&AT, &[f64::NAN, 6.0], value, 1e-5, 1e-3);
    }
}
