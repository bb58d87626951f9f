/// Where two arrays differ most.
#[derive(Clone, Copy, Debug)]
pub struct Difference {
    /// Largest difference, absolute or relative as the function says.
    pub worst: f64,
    /// Where it is.
    pub index: usize,
    /// Value there.
    pub got: f64,
    /// Expected value there.
    pub want: f64,
}

/// The largest `|got - want|` over the indices for which `counts` is true.
///
/// # Panics
/// When lengths differ.
pub fn max_abs_difference(got: &[f64], want: &[f64], counts: impl Fn(usize) -> bool) -> Difference {
    assert_eq!(got.len(), want.len(), "as many values as expected");
    let mut worst = Difference {
        worst: 0.0,
        index: 0,
        got: 0.0,
        want: 0.0,
    };
    for (index, (got, want)) in got.iter().zip(want).enumerate().filter(|(i, _)| counts(*i)) {
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

/// The largest `|got - want| / (|want| + floor max |want|)` for a `floor` above 0: relative element by element, and relative to `floor` of the
/// array's largest where an element is smaller than that, since a sum of many rounded terms that cancel is no more exact.
///
/// # Panics
/// When lengths differ.
pub fn relative_difference(got: &[f64], want: &[f64], floor: f64) -> Difference {
    let least = floor * want.iter().fold(1e-30f64, |m, v| m.max(v.abs()));
    let scaled = |values: &[f64]| -> Vec<f64> {
        let pairs = values.iter().zip(want);
        pairs.map(|(value, want)| value / (want.abs() + least)).collect()
    };
    assert_eq!(got.len(), want.len(), "as many values as expected");
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
    fn small_elements_count_by_their_own_size_down_to_the_floor() {
        let want = [1000.0, 1.0, 0.0];
        // Of 1 beside 1000: an error of a tenth is a tenth above the floor, and 0.1 / (1 + 100) with a floor of a tenth.
        let d = relative_difference(&[1000.0, 1.1, 0.0], &want, 1e-9);
        assert!((d.worst - 0.1).abs() < 1e-6 && d.index == 1 && d.got == 1.1);
        assert!((relative_difference(&[1000.0, 1.1, 0.0], &want, 0.1).worst - 0.1 / 101.0).abs() < 1e-12);
        assert!((relative_difference(&[1000.0, 1.0, 2.0], &want, 0.01).worst - 0.2).abs() < 1e-12);
        assert!(
            relative_difference(&[1000.0, f64::NAN, 0.0], &want, 0.1)
                .worst
                .is_infinite()
        );
    }
}
