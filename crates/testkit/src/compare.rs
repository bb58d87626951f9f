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

/// The largest `|got - want|` divided by the largest `|want|` of the array.
pub fn relative_difference(got: &[f64], want: &[f64]) -> Difference {
    let scale = want.iter().fold(0.0f64, |m, v| m.max(v.abs())).max(1e-30);
    let difference = max_abs_difference(got, want, |_| true);
    Difference {
        worst: difference.worst / scale,
        ..difference
    }
}
