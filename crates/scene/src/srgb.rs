//! The transfer function of sRGB (IEC 61966-2-1).

/// Linear values up to this one are multiplied, those above it follow a power.
const LINEAR: f32 = 0.003_130_8;

/// The sRGB-encoded value of a linear one; both are 1 for white.
pub fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= LINEAR {
        12.92 * linear
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    }
}

/// The derivative of [`srgb_from_linear`].
pub fn srgb_slope(linear: f32) -> f32 {
    if linear <= LINEAR {
        12.92
    } else {
        1.055 / 2.4 * linear.powf(1.0 / 2.4 - 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values_and_their_slopes() {
        for (linear, encoded) in [(0.0, 0.0), (0.002, 0.025_84), (0.214_041_14, 0.5), (1.0, 1.0)] {
            assert!((srgb_from_linear(linear) - encoded).abs() < 1e-6, "{linear}");
        }
        for linear in [0.001f32, 0.01, 0.3, 0.9] {
            let difference = (srgb_from_linear(linear + 1e-4) - srgb_from_linear(linear - 1e-4)) / 2e-4;
            assert!((srgb_slope(linear) / difference - 1.0).abs() < 2e-3, "{linear}");
        }
    }
}
