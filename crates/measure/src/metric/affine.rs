//! Affine colour maps, which model the difference between two exposures of one scene.

use irradia_scene::Image;

/// `y = A x + b` on sRGB-encoded colours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    /// A, row-major.
    pub matrix: [[f64; 3]; 3],
    /// b.
    pub offset: [f64; 3],
}

impl Affine {
    /// The identity.
    pub const IDENTITY: Self = Self {
        matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        offset: [0.0; 3],
    };

    /// Maps one colour.
    pub fn apply(&self, x: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| {
            let sum: f64 = (0..3).map(|k| self.matrix[c][k] * f64::from(x[k])).sum();
            (sum + self.offset[c]) as f32
        })
    }

    /// Maps every pixel of `image [H, W, 3]`, clamped to \[0, 1\].
    pub fn apply_to(&self, image: &Image) -> Image {
        let pixels = image.data.as_chunks::<3>().0.iter();
        let data = pixels.flat_map(|x| self.apply(*x).map(|v| v.clamp(0.0, 1.0))).collect();
        Image::new(image.width, image.height, 3, data)
    }

    /// [`Self::fit`] without the pixels at which either image is clipped (below 1/255 or above 254/255 in any channel), which carry
    /// no information on the map.
    pub fn fit_unclipped(from: &Image, to: &Image, counts: impl Fn(usize) -> bool) -> Self {
        let (x, y) = (from.data.as_chunks::<3>().0, to.data.as_chunks::<3>().0);
        let clipped = |x: &[f32; 3]| x.iter().any(|v| *v < 1.0 / 255.0 || *v > 254.0 / 255.0);
        Self::fit(from, to, |i| counts(i) && !clipped(&x[i]) && !clipped(&y[i]))
    }

    /// The least-squares map from `from` to `to` over the pixels whose index satisfies `counts`. The identity if there are too few.
    pub fn fit(from: &Image, to: &Image, counts: impl Fn(usize) -> bool) -> Self {
        // Normal equations of four unknowns per channel: [r, g, b, 1].
        let (mut normal, mut right, mut count) = ([[0.0f64; 4]; 4], [[0.0f64; 3]; 4], 0usize);
        let pixels = from.data.as_chunks::<3>().0.iter().zip(to.data.as_chunks::<3>().0);
        for (i, (x, y)) in pixels.enumerate() {
            if !counts(i) {
                continue;
            }
            let row = [f64::from(x[0]), f64::from(x[1]), f64::from(x[2]), 1.0];
            for a in 0..4 {
                for b in 0..4 {
                    normal[a][b] += row[a] * row[b];
                }
                for c in 0..3 {
                    right[a][c] += row[a] * f64::from(y[c]);
                }
            }
            count += 1;
        }
        if count < MIN_PIXELS {
            return Self::IDENTITY;
        }
        // An image of one colour does not determine the map: a weight far below any signal then favours the identity.
        for (i, row) in normal.iter_mut().enumerate() {
            let weight = RIDGE * count as f64;
            row[i] += weight;
            if i < 3 {
                right[i][i] += weight;
            }
        }
        match solve(normal, right) {
            Some(solution) => Self {
                matrix: std::array::from_fn(|c| std::array::from_fn(|k| solution[k][c])),
                offset: solution[3],
            },
            None => Self::IDENTITY,
        }
    }
}

/// Minimum number of pixels to fit a map.
const MIN_PIXELS: usize = 64;
/// Weight of the identity, in units of squared colour per pixel: a hundredth of a grey level.
const RIDGE: f64 = 1.6e-9;

/// Gaussian elimination with partial pivoting; `None` if the matrix is singular.
fn solve(mut a: [[f64; 4]; 4], mut b: [[f64; 3]; 4]) -> Option<[[f64; 3]; 4]> {
    for column in 0..4 {
        let pivot = (column..4).max_by(|i, j| a[*i][column].abs().total_cmp(&a[*j][column].abs()))?;
        a.swap(column, pivot);
        b.swap(column, pivot);
        if a[column][column].abs() < 1e-12 {
            return None;
        }
        for row in 0..4 {
            if row == column {
                continue;
            }
            let factor = a[row][column] / a[column][column];
            for k in column..4 {
                a[row][k] -= factor * a[column][k];
            }
            for c in 0..3 {
                b[row][c] -= factor * b[column][c];
            }
        }
    }
    Some(std::array::from_fn(|i| b[i].map(|v| v / a[i][i])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    fn noise(seed: u64) -> Image {
        let mut rng = Rng::new(seed, 1);
        Image::new(16, 16, 3, (0..768).map(|_| rng.range(0.1, 0.6)).collect())
    }

    #[test]
    fn fitting_half_of_the_image_recovers_the_map() {
        let map = Affine {
            matrix: [[1.2, 0.05, 0.0], [0.0, 0.9, 0.02], [0.01, 0.0, 1.1]],
            offset: [0.02, -0.01, 0.0],
        };
        let (from, to) = (noise(1), map.apply_to(&noise(1)));
        let found = Affine::fit(&from, &to, |i| i % 16 < 8);
        for c in 0..3 {
            assert!((found.offset[c] - map.offset[c]).abs() < 1e-5);
            for k in 0..3 {
                assert!((found.matrix[c][k] - map.matrix[c][k]).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn clipped_uniform_and_empty_input_give_sensible_maps() {
        let from = noise(2);
        let mut to = from.clone();
        to.data[..384].fill(1.0);
        let found = Affine::fit_unclipped(&from, &to, |_| true);
        assert!((found.matrix[0][0] - 1.0).abs() < 1e-5, "{found:?}");
        let flat = Image::new(16, 16, 3, vec![0.5; 768]);
        let found = Affine::fit(&flat, &Image::new(16, 16, 3, vec![0.25; 768]), |_| true);
        assert!(
            found.apply([0.5; 3]).iter().all(|v| (v - 0.25).abs() < 1e-4),
            "{found:?}"
        );
        assert_eq!(Affine::fit(&from, &to, |_| false), Affine::IDENTITY);
    }
}
