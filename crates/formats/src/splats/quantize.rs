//! Quantisation of numbers to a few bits and back, as far as several formats share it.

use irradia_scene::sh;

/// Opacities of 0 and 1 have no finite logit; other readers use the same bound.
const MIN_OPACITY: f64 = 1e-6;

/// Bounds of ln scale in formats whose steps depend on the bounds: a scale of 0 has no finite logarithm.
pub(crate) const MAX_LOG_SCALE: f32 = 20.0;

/// `1 / (1 + exp(-x))`.
pub(crate) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The logit of an opacity; finite also for 0 and 1.
pub(crate) fn logit(opacity: f32) -> f32 {
    let p = f64::from(opacity).clamp(MIN_OPACITY, 1.0 - MIN_OPACITY);
    (p / (1.0 - p)).ln() as f32
}

/// The logits of the 256 opacities that a byte can hold.
pub(crate) fn logits_of_bytes() -> [f32; 256] {
    std::array::from_fn(|byte| logit(byte as f32 / 255.0))
}

/// The nearest of the 256 opacities.
pub(crate) fn opacity_byte(logit: f32) -> u8 {
    round_to_byte(sigmoid(logit) * 255.0)
}

/// The nearest byte, clamped to the range; 0 for NaN.
pub(crate) fn round_to_byte(value: f32) -> u8 {
    value.round() as u8
}

/// The nearest of `2^bits` steps from 0 to 1.
pub(crate) fn unorm(value: f32, bits: u32) -> u32 {
    let steps = ((1u32 << bits) - 1) as f32;
    (value * steps).round().clamp(0.0, steps) as u32
}

/// The inverse of [`unorm`], for the lowest `bits` of `value`.
pub(crate) fn from_unorm(value: u32, bits: u32) -> f32 {
    let steps = (1u32 << bits) - 1;
    (value & steps) as f32 / steps as f32
}

/// The byte of a DC coefficient's colour.
pub(crate) fn color_byte(dc: f32) -> u8 {
    round_to_byte(sh::color_from_dc(dc) * 255.0)
}

/// The DC coefficient of a byte's colour.
pub(crate) fn dc_of_byte(color: u8) -> f32 {
    sh::dc_from_color(f32::from(color) / 255.0)
}

/// The quaternion at length 1; one of zero or infinite length becomes the identity.
pub(crate) fn normalized(quat: [f32; 4]) -> [f32; 4] {
    let length = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 && length.is_finite() {
        quat.map(|v| v / length)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

/// A unit quaternion without its largest component, which is made positive: its index in `w, x, y, z`, and the other three in
/// that order, each between `-1/sqrt(2)` and `1/sqrt(2)`.
pub(crate) fn smallest_three(quat: [f32; 4]) -> (usize, [f32; 3]) {
    let quat = normalized(quat);
    let largest = (1..4).fold(0, |best, c| if quat[c].abs() > quat[best].abs() { c } else { best });
    let sign = if quat[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut others = [0.0; 3];
    for (to, c) in others.iter_mut().zip((0..4).filter(|c| *c != largest)) {
        *to = quat[c] * sign;
    }
    (largest, others)
}

/// The inverse of [`smallest_three`].
pub(crate) fn from_smallest_three(largest: usize, others: [f32; 3]) -> [f32; 4] {
    let mut quat = [0.0; 4];
    for (from, c) in others.into_iter().zip((0..4).filter(|c| *c != largest)) {
        quat[c] = from;
    }
    quat[largest] = (1.0 - others.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    quat
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_of_opacity_and_colour_survives() {
        let logits = logits_of_bytes();
        for value in 0..=255u8 {
            assert_eq!(opacity_byte(logits[usize::from(value)]), value);
            assert_eq!(color_byte(dc_of_byte(value)), value);
        }
        assert!(logits.iter().all(|logit| logit.is_finite()));
        assert_eq!(
            (
                round_to_byte(f32::NAN),
                round_to_byte(-3.0),
                round_to_byte(1e9),
                round_to_byte(1.6)
            ),
            (0, 0, 255, 2)
        );
        for bits in [8, 10, 11] {
            for value in [0, 1, 77, (1 << bits) - 1] {
                assert_eq!(unorm(from_unorm(value, bits), bits), value);
            }
        }
    }

    #[test]
    fn the_three_smallest_components_give_the_rotation() {
        for quat in [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, -3.0],
            [0.5, -0.5, 0.5, -0.5],
            [0.1, 0.9, -0.3, 0.2],
        ] {
            let (largest, others) = smallest_three(quat);
            let back = from_smallest_three(largest, others);
            let length = quat.iter().map(|v: &f32| v * v).sum::<f32>().sqrt();
            // Either sign is the same rotation.
            let dot: f32 = quat.iter().zip(back).map(|(a, b)| a * b / length).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-6, "{quat:?} {back:?}");
        }
        assert_eq!(from_smallest_three(0, smallest_three([0.0; 4]).1), [1.0, 0.0, 0.0, 0.0]);
    }
}
