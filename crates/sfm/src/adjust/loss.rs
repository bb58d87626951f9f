//! Robust losses of squared residuals.

/// A loss `rho(s)` of the squared residual `s`, px^2, with `rho(s) ~ s` for small s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Loss {
    /// `s`.
    Squared,
    /// `2 a^2 (sqrt(1 + s / a^2) - 1)` with the scale a, px.
    SoftL1(f64),
    /// `a^2 ln(1 + s / a^2)` with the scale a, px.
    Cauchy(f64),
}

impl Loss {
    /// `rho(s)` and its derivative.
    #[inline(always)]
    pub fn evaluate(self, s: f64) -> (f64, f64) {
        match self {
            Loss::Squared => (s, 1.0),
            Loss::SoftL1(a) => {
                let root = (1.0 + s / (a * a)).sqrt();
                (2.0 * a * a * (root - 1.0), 1.0 / root)
            }
            Loss::Cauchy(a) => {
                let sum = 1.0 + s / (a * a);
                (a * a * sum.ln(), 1.0 / sum)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_match_differences_and_small_residuals_are_squared() {
        for loss in [Loss::Squared, Loss::SoftL1(2.0), Loss::Cauchy(2.0)] {
            for s in [0.01, 1.0, 50.0] {
                let numeric = (loss.evaluate(s + 1e-6).0 - loss.evaluate(s - 1e-6).0) / 2e-6;
                assert!((loss.evaluate(s).1 - numeric).abs() < 1e-7, "{loss:?} {s}");
            }
            assert!((loss.evaluate(1e-6).0 - 1e-6).abs() < 1e-10);
        }
    }
}
