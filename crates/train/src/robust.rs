//! Statistics that a few odd values do not move.

/// The middle of the sorted `values`; the upper one of an even number. At least one value.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The standard deviation of the normal distribution whose `deviations` have this median absolute value.
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
