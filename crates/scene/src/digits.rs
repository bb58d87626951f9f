//! Numbers as texts.

/// An `f64` with the digits of an `f32`, so that texts have no digits beyond its precision.
pub fn with_f32_digits(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}
