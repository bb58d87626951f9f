//! IEEE 754 half-precision numbers as their bits.

/// The nearest half-precision number, ties to even; values beyond the range become the largest one. NaN stays NaN.
pub fn half(value: f32) -> u16 {
    let bits = value.to_bits();
    let sign = (bits >> 16 & 0x8000) as u16;
    let value = f32::from_bits(bits & 0x7fff_ffff);
    if value.is_nan() {
        return sign | 0x7e00;
    }
    if value >= 65504.0 {
        return sign | 0x7bff;
    }
    if value < 2f32.powi(-14) {
        // Subnormal: a whole number of 2^-24.
        return sign | (value * 2f32.powi(24)).round_ties_even() as u16;
    }
    // Rebias the exponent from 127 to 15, and round 13 bits to even.
    let bits = value.to_bits() - (112 << 23);
    sign | ((bits + 0x0fff + (bits >> 13 & 1)) >> 13) as u16
}

/// The value of a half-precision number, infinities and NaNs included.
pub fn from_half(bits: u16) -> f32 {
    let (sign, magnitude) = (f32::from(1 - 2 * (bits >> 15) as i16), u32::from(bits & 0x7fff));
    let value = match magnitude {
        0..0x0400 => magnitude as f32 * 2f32.powi(-24),
        0x0400..0x7c00 => f32::from_bits((magnitude << 13) + (112 << 23)),
        0x7c00 => f32::INFINITY,
        _ => f32::NAN,
    };
    sign * value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_the_nearest() {
        for (value, bits) in [
            (0.0, 0),
            (1.0, 0x3c00),
            (-2.0, 0xc000),
            (65504.0, 0x7bff),
            (1e9, 0x7bff),
            (6.103_515_6e-5, 0x0400),
            (5.960_464_5e-8, 1),
            (0.1, 0x2e66),
            (1.0 + 2f32.powi(-11), 0x3c00),
            (1.0 + 3.0 * 2f32.powi(-11), 0x3c02),
        ] {
            assert_eq!(half(value), bits, "{value}");
        }
        for bits in (0..0x7c00).step_by(7) {
            assert_eq!(half(from_half(bits)), bits);
            assert_eq!(half(-from_half(bits)), bits | 0x8000);
        }
        assert!(from_half(0x7c00).is_infinite() && from_half(0xfe01).is_nan());
        assert_eq!(half(f32::NAN), 0x7e00);
    }
}
