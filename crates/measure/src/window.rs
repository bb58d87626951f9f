//! The Gaussian window of SSIM and its constants (Wang, Bovik, Sheikh, Simoncelli 2004, section III.B).

/// Taps of the window along one axis.
pub(crate) const TAPS: usize = 11;
/// Taps on either side of the centre.
pub(crate) const RADIUS: usize = TAPS / 2;
/// Standard deviation, pixels.
const SIGMA: f64 = 1.5;
/// `(K1 L)^2` with K1 = 0.01 and values in \[0, 1\].
pub(crate) const C1: f64 = 0.01 * 0.01;
/// `(K2 L)^2` with K2 = 0.03.
pub(crate) const C2: f64 = 0.03 * 0.03;

/// Weights at distances 0 to [`RADIUS`] from the centre; the whole window sums to 1.
pub(crate) fn half_window() -> [f64; RADIUS + 1] {
    let raw: [f64; RADIUS + 1] = std::array::from_fn(|k| (-((k * k) as f64) / (2.0 * SIGMA * SIGMA)).exp());
    let total = raw[0] + 2.0 * raw[1..].iter().sum::<f64>();
    raw.map(|w| w / total)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_sums_to_one_and_matches_published_weights() {
        let w = half_window();
        assert!((w[0] + 2.0 * w[1..].iter().sum::<f64>() - 1.0).abs() < 1e-15);
        // 0.2660 in other implementations of SSIM.
        assert!((w[0] - 0.266_011_7).abs() < 1e-6, "{}", w[0]);
        assert!((w[5] - 0.001_028_38).abs() < 1e-7, "{}", w[5]);
    }
}
