//! Statistics that are robust to a few outliers.

/// The median of `values`; the upper of the two middle ones if their number is even. There must be at least one value.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The standard deviation, estimated from the median absolute value of `deviations` as for a normal distribution.
pub(crate) fn spread(deviations: impl Iterator<Item = f64>) -> f64 {
    1.4826 * median(deviations.map(f64::abs).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    #[test]
    fn the_spread_of_a_normal_distribution_with_outliers_is_its_standard_deviation() {
        let mut rng = Rng::new(1, 1);
        let mut values: Vec<f64> = (0..10_001).map(|_| 3.0 * f64::from(rng.normal())).collect();
        values.extend([1e9; 100]);
        assert!((spread(values.iter().copied()) - 3.0).abs() < 0.1);
        assert!(median(values).abs() < 0.1);
        assert_eq!(median(vec![4.0]), 4.0);
    }
}
