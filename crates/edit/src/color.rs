use crate::Operation;
use irradia_scene::sh::C0;

/// An affine map of sRGB-encoded colours: `to = matrix from + offset`. It applies to harmonics exactly, except that colours are clamped
/// at 0 after the map instead of before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ColorMap {
    matrix: [[f64; 3]; 3],
    offset: [f64; 3],
}

/// Rec. 709 luma.
const LUMA: [f64; 3] = [0.2126, 0.7152, 0.0722];
/// Ratio of the gain of red to that of blue at a temperature of 1. A tint of 1 divides the gain of green by its square root.
const MAX_GAIN_RATIO: f64 = 1.5;
/// sRGB is close to a power law with this exponent: a stop doubles the light, not the encoded value.
const GAMMA: f64 = 2.2;

impl ColorMap {
    const IDENTITY: Self = Self {
        matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        offset: [0.0; 3],
    };

    /// The map of [`Operation::Recolor`]; the identity for other operations.
    pub fn of(op: &Operation) -> Self {
        let Operation::Recolor {
            exposure,
            temperature,
            tint,
            saturation,
            contrast,
        } = *op
        else {
            return Self::IDENTITY;
        };
        let light = (exposure / GAMMA).exp2();
        let gains = [
            light * MAX_GAIN_RATIO.powf(0.5 * temperature),
            light * MAX_GAIN_RATIO.powf(-0.5 * tint),
            light * MAX_GAIN_RATIO.powf(-0.5 * temperature),
        ];
        let mut map = Self::IDENTITY;
        for row in 0..3 {
            for column in 0..3 {
                let same = f64::from(u8::from(row == column));
                // Written such that 1 is exactly the identity.
                let mixed = saturation * same + (1.0 - saturation) * LUMA[column];
                map.matrix[row][column] = contrast * mixed * gains[column];
            }
            map.offset[row] = 0.5 * (1.0 - contrast);
        }
        map
    }

    pub fn is_identity(&self) -> bool {
        *self == Self::IDENTITY
    }

    /// Maps one splat's coefficients `[(degree + 1)^2, 3]`.
    pub fn apply(&self, coefficients: &mut [f32]) {
        for (k, triple) in coefficients.chunks_exact_mut(3).enumerate() {
            let from: [f64; 3] = std::array::from_fn(|c| f64::from(triple[c]));
            for (row, to) in triple.iter_mut().enumerate() {
                let mut value: f64 = (0..3).map(|c| self.matrix[row][c] * from[c]).sum();
                if k == 0 {
                    // The colour is SH + 0.5.
                    let grey: f64 = self.matrix[row].iter().sum::<f64>() * 0.5;
                    value += (grey + self.offset[row] - 0.5) / C0;
                }
                *to = value as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::sh;

    fn recolor(exposure: f64, temperature: f64, tint: f64, saturation: f64, contrast: f64) -> ColorMap {
        ColorMap::of(&Operation::Recolor {
            exposure,
            temperature,
            tint,
            saturation,
            contrast,
        })
    }

    fn mapped(map: ColorMap, color: [f32; 3]) -> [f32; 3] {
        let mut dc = color.map(sh::dc_from_color);
        map.apply(&mut dc);
        dc.map(sh::color_from_dc)
    }

    #[test]
    fn neutral_values_are_the_identity() {
        assert!(recolor(0.0, 0.0, 0.0, 1.0, 1.0).is_identity());
    }

    #[test]
    fn colours_change_as_said() {
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        // 2.2 stops double the encoded value.
        assert!(near(
            mapped(recolor(2.2, 0.0, 0.0, 1.0, 1.0), [0.1, 0.2, 0.4]),
            [0.2, 0.4, 0.8]
        ));
        let grey = 0.2126 * 0.1 + 0.7152 * 0.2 + 0.0722 * 0.4;
        assert!(near(
            mapped(recolor(0.0, 0.0, 0.0, 0.0, 1.0), [0.1, 0.2, 0.4]),
            [grey; 3]
        ));
        assert!(near(
            mapped(recolor(0.0, 0.0, 0.0, 1.0, 2.0), [0.5, 0.6, 0.2]),
            [0.5, 0.7, -0.1]
        ));
        let warm = mapped(recolor(0.0, 1.0, 0.0, 1.0, 1.0), [0.5; 3]);
        assert!(warm[0] > 0.5 && warm[2] < 0.5 && (warm[1] - 0.5).abs() < 1e-6);
        let pink = mapped(recolor(0.0, 0.0, 1.0, 1.0, 1.0), [0.5; 3]);
        assert!(pink[1] < 0.5 && (pink[0] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn bands_above_dc_scale_without_offset() {
        let mut coefficients = vec![0.0, 0.0, 0.0, 1.0, 1.0, 1.0];
        recolor(0.0, 0.0, 0.0, 1.0, 3.0).apply(&mut coefficients);
        assert!(coefficients[3..].iter().all(|v| (v - 3.0).abs() < 1e-6));
        assert!(coefficients[..3].iter().all(|v| v.abs() < 1e-6), "middle grey stays");
    }
}
