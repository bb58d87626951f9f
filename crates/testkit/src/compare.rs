/// The largest difference between two arrays.
#[derive(Clone, Copy, Debug)]
pub struct Difference {
    /// The difference, absolute or relative depending on the function.
    pub worst: f64,
    /// Its index.
    pub index: usize,
    /// The value there.
    pub got: f64,
    /// The expected value there.
    pub want: f64,
}

/// The largest `|got - want|` over the indices for which `is_included` is true.
///
/// # Panics
/// When lengths differ.
pub fn max_abs_difference(got: &[f64], want: &[f64], is_included: impl Fn(usize) -> bool) -> Difference {
    assert_eq!(got.len(), want.len(), "lengths match");
    let mut worst = Difference {
        worst: 0.0,
        index: 0,
        got: 0.0,
        want: 0.0,
    };
    for (index, (got, want)) in got.iter().zip(want).enumerate().filter(|(i, _)| is_included(*i)) {
        let difference = (got - want).abs();
        if difference > worst.worst || difference.is_nan() {
            worst = Difference {
                worst: difference,
                index,
                got: *got,
                want: *want,
            };
            if difference.is_nan() {
                return Difference {
                    worst: f64::INFINITY,
                    ..worst
                };
            }
        }
    }
    worst
}

/// The largest `|got - want| / (|want| + floor max |want|)`: relative per element, and for small elements relative to the
/// fraction `floor` of the array's largest, since sums of cancelling rounded terms are no more exact than that.
///
/// # Panics
/// When lengths differ.
pub fn relative_difference(got: &[f64], want: &[f64], floor: f64) -> Difference {
    // Positive even without a floor, so that two zeros differ by zero.
    let min_scale = (floor * want.iter().fold(0.0f64, |m, v| m.max(v.abs()))).max(f64::MIN_POSITIVE);
    let scaled = |values: &[f64]| -> Vec<f64> {
        let pairs = values.iter().zip(want);
        pairs.map(|(value, want)| value / (want.abs() + min_scale)).collect()
    };
    assert_eq!(got.len(), want.len(), "lengths match");
    let difference = max_abs_difference(&scaled(got), &scaled(want), |_| true);
    Difference {
        got: got[difference.index],
        want: want[difference.index],
        ..difference
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_relative_per_element_down_to_the_floor() {
        let want = [1000.0, 1.0, 0.0];
        // 1 beside 1000: an error of 0.1 is a relative 0.1 without a floor, and 0.1 / (1 + 100) with a floor of a tenth.
        let d = relative_difference(&[1000.0, 1.1, 0.0], &want, 0.0);
        assert!((d.worst - 0.1).abs() < 1e-12 && d.index == 1 && d.got == 1.1);
        assert!((relative_difference(&[1000.0, 1.1, 0.0], &want, 0.1).worst - 0.1 / 101.0).abs() < 1e-12);
        assert!((relative_difference(&[1000.0, 1.0, 2.0], &want, 0.01).worst - 0.2).abs() < 1e-12);
        assert!(
            relative_difference(&[1000.0, f64::NAN, 0.0], &want, 0.1)
                .worst
                .is_infinite()
        );
    }
}
