//! Gradients against central differences in double precision.

use irradia_scene::Rng;

/// How far apart two evaluations lie and how well a gradient must agree with their difference d:
/// `|v - d| <= relative |d| + of_largest max |v| + absolute`.
#[derive(Clone, Copy, Debug)]
pub struct Differences {
    /// Distance to either side.
    pub step: f64,
    /// Of the difference.
    pub relative: f64,
    /// Of the gradient's largest coordinate.
    pub of_largest: f64,
    /// Whatever the gradient.
    pub absolute: f64,
}

impl Differences {
    /// Agreement within `of_largest` of the largest coordinate.
    pub fn of_largest(step: f64, of_largest: f64) -> Self {
        Self {
            step,
            relative: 0.0,
            of_largest,
            absolute: 1e-9,
        }
    }

    /// Holds the coordinates `which` of the gradient `v` of `value` at `at`; what lies behind the end of `v` may stay constant.
    ///
    /// # Panics
    /// When one does not agree.
    pub fn hold(
        &self,
        what: &str,
        at: &[f64],
        v: &[f64],
        which: impl IntoIterator<Item = usize>,
        value: impl Fn(&[f64]) -> f64,
    ) {
        let largest = v.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let mut moved = at.to_vec();
        for i in which {
            let mut beside = |by: f64| {
                moved[i] = at[i] + by;
                let value = value(&moved);
                moved[i] = at[i];
                value
            };
            let numeric = (beside(self.step) - beside(-self.step)) / (2.0 * self.step);
            let allowed = self.relative * numeric.abs() + self.of_largest * largest + self.absolute;
            // A gradient that is not a number must fail too.
            assert!(
                (numeric - v[i]).abs() <= allowed,
                "{what}, value {i}: gradient {} and difference {numeric}; the largest is {largest}",
                v[i]
            );
        }
    }
}

/// Some 200 of `n` coordinates, or all.
pub fn some_of(n: usize) -> impl Iterator<Item = usize> {
    (0..n).step_by(1 + n / 200)
}

/// Holds the gradient `v` of `value` at `at` along eight random directions; `tolerance` is relative to the gradient's
/// length, the steps are `step` in every coordinate.
///
/// # Panics
/// When one does not agree.
pub fn directional(at: &[f64], v: &[f64], value: impl Fn(&[f64]) -> f64, step: f64, tolerance: f64) {
    assert_eq!(at.len(), v.len(), "a gradient has as many values as what it is of");
    let length = v.iter().map(|v| v * v).sum::<f64>().sqrt();
    for seed in 0..8 {
        let mut rng = Rng::new(seed, 17);
        let along: Vec<f64> = at.iter().map(|_| f64::from(rng.normal())).collect();
        let moved = |by: f64| at.iter().zip(&along).map(|(x, d)| x + by * d).collect::<Vec<_>>();
        let numeric = (value(&moved(step)) - value(&moved(-step))) / (2.0 * step);
        let analytic: f64 = v.iter().zip(&along).map(|(v, d)| v * d).sum();
        assert!(
            (numeric - analytic).abs() <= tolerance * length,
            "direction {seed}: {analytic} and not {numeric}, of a gradient {length} long"
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
    fn a_right_gradient_holds() {
        Differences::of_largest(1e-5, 1e-9).hold("it", &AT, &GRADIENT, 0..2, value);
        directional(&AT, &GRADIENT, value, 1e-5, 1e-9);
    }

    #[test]
    #[should_panic(expected = "it, value 0: gradient 1.1")]
    fn a_wrong_coordinate_does_not() {
        Differences::of_largest(1e-5, 1e-3).hold("it", &AT, &[1.1, 6.0], 0..2, value);
    }

    #[test]
    #[should_panic(expected = "direction 0")]
    fn nor_a_gradient_that_is_not_a_number() {
        directional(&AT, &[f64::NAN, 6.0], value, 1e-5, 1e-3);
    }
}
