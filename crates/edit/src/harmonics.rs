//! Rotation of spherical harmonics, so that the colours of a splat turn with it.
//!
//! Each band is closed under rotation, so that its matrix follows from samples: with the band's basis `b` at enough directions `d`,
//! `b(d) c' = b(R^-1 d) c` for all `c` is a least-squares problem with an exact solution. In `f64` it agrees with the recursion of
//! Ivanic and Ruedenberg 1996 to rounding, for any signs and order of the basis.

use glam::{DQuat, DVec3};
use irradia_scene::sh::{C0, C1, C2, C3};

/// Highest degree of a cloud.
const MAX_DEGREE: usize = 4;
/// Basis functions up to [`MAX_DEGREE`].
const COEFFICIENTS: usize = 25;
/// Number of directions at which bands are sampled, more than twice the number of functions in a band.
const SAMPLED_DIRECTIONS: usize = 32;

/// Band 4, with the signs of the Inria code's basis as gsplat extends it.
const C4: [f64; 9] = [
    2.503_342_941_796_704_6,
    -1.770_130_769_779_930_4,
    0.946_174_695_757_560_1,
    -0.669_046_543_557_289_2,
    0.105_785_546_915_204_31,
    -0.669_046_543_557_289_2,
    0.473_087_347_878_780_04,
    -1.770_130_769_779_930_4,
    0.625_835_735_449_176_1,
];

/// The basis of splat files up to degree 4 at a unit direction.
pub(crate) fn basis(direction: DVec3) -> [f64; COEFFICIENTS] {
    let DVec3 { x, y, z } = direction;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        C2[1] * y * z,
        C2[2] * (2.0 * zz - xx - yy),
        C2[3] * x * z,
        C2[4] * (xx - yy),
        C3[0] * y * (3.0 * xx - yy),
        C3[1] * x * y * z,
        C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * (xx + yy)),
        C3[4] * x * (4.0 * zz - xx - yy),
        C3[5] * z * (xx - yy),
        C3[6] * x * (xx - 3.0 * yy),
        C4[0] * x * y * (xx - yy),
        C4[1] * y * z * (3.0 * xx - yy),
        C4[2] * x * y * (7.0 * zz - 1.0),
        C4[3] * y * z * (7.0 * zz - 3.0),
        C4[4] * (zz * (35.0 * zz - 30.0) + 3.0),
        C4[5] * x * z * (7.0 * zz - 3.0),
        C4[6] * (xx - yy) * (7.0 * zz - 1.0),
        C4[7] * x * z * (xx - 3.0 * yy),
        C4[8] * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    ]
}

/// The matrices by which a rotation maps the coefficients of each band.
pub(crate) struct BandRotation {
    /// The matrices of bands 1 to 4, row-major, `[2 l + 1, 2 l + 1]`.
    bands: [Vec<f64>; MAX_DEGREE],
}

impl BandRotation {
    /// The matrices of a rotation of the scene.
    pub fn new(rotation: DQuat) -> Self {
        // Evenly distributed over the sphere: a Fibonacci lattice.
        let directions: Vec<DVec3> = (0..SAMPLED_DIRECTIONS)
            .map(|i| {
                let z = 1.0 - (2 * i + 1) as f64 / SAMPLED_DIRECTIONS as f64;
                let angle = i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt());
                let radius = (1.0 - z * z).sqrt();
                DVec3::new(radius * angle.cos(), radius * angle.sin(), z)
            })
            .collect();
        let inverse = rotation.inverse();
        let here: Vec<_> = directions.iter().map(|d| basis(*d)).collect();
        let before: Vec<_> = directions.iter().map(|d| basis(inverse * *d)).collect();
        Self {
            bands: std::array::from_fn(|band| {
                let (l, width) = (band + 1, 2 * band + 3);
                let product = |a: &[[f64; COEFFICIENTS]], b: &[[f64; COEFFICIENTS]]| -> Vec<f64> {
                    let entry = |row: usize, column: usize| -> f64 {
                        let pairs = a.iter().zip(b);
                        pairs.map(|(a, b)| a[l * l + row] * b[l * l + column]).sum()
                    };
                    (0..width * width).map(|i| entry(i / width, i % width)).collect()
                };
                solve(product(&here, &here), product(&here, &before), width)
            }),
        }
    }

    /// Rotates one splat's coefficients `[(degree + 1)^2, 3]`.
    pub fn apply(&self, coefficients: &mut [f32]) {
        for (band, matrix) in self.bands.iter().enumerate() {
            let (l, width) = (band + 1, 2 * band + 3);
            let Some(values) = coefficients.get_mut(3 * l * l..3 * (l + 1) * (l + 1)) else {
                return;
            };
            let mut rotated = [0.0f32; 3 * (2 * MAX_DEGREE + 1)];
            for (i, to) in rotated[..3 * width].iter_mut().enumerate() {
                let (row, channel) = (i / 3, i % 3);
                let terms = (0..width).map(|k| matrix[row * width + k] * f64::from(values[3 * k + channel]));
                *to = terms.sum::<f64>() as f32;
            }
            values.copy_from_slice(&rotated[..3 * width]);
        }
    }
}

/// `x` with `a x = b`, all `[n, n]` row-major, `a` positive definite: Gaussian elimination, pivots on the diagonal.
fn solve(mut a: Vec<f64>, mut b: Vec<f64>, n: usize) -> Vec<f64> {
    for pivot in 0..n {
        let scale = 1.0 / a[pivot * n + pivot];
        for column in 0..n {
            a[pivot * n + column] *= scale;
            b[pivot * n + column] *= scale;
        }
        for row in (0..n).filter(|row| *row != pivot) {
            let factor = a[row * n + pivot];
            for column in 0..n {
                a[row * n + column] -= factor * a[pivot * n + column];
                b[row * n + column] -= factor * b[pivot * n + column];
            }
        }
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    fn unit(rng: &mut Rng) -> DVec3 {
        DVec3::from(std::array::from_fn(|_| f64::from(rng.normal()))).normalize()
    }

    fn rotation(rng: &mut Rng) -> DQuat {
        DQuat::from_xyzw(
            f64::from(rng.normal()),
            f64::from(rng.normal()),
            f64::from(rng.normal()),
            f64::from(rng.normal()),
        )
        .normalize()
    }

    fn value(coefficients: &[f32], direction: DVec3) -> f64 {
        let basis = basis(direction);
        basis
            .iter()
            .zip(coefficients.chunks(3))
            .map(|(b, c)| b * f64::from(c[1]))
            .sum()
    }

    #[test]
    fn the_basis_is_orthonormal() {
        // Monte Carlo would need many samples; the product of a Fibonacci lattice and polynomials of degree 8 converges fast.
        let n = 20_000;
        let mut gram = vec![0.0; COEFFICIENTS * COEFFICIENTS];
        for i in 0..n {
            let z = 1.0 - (2 * i + 1) as f64 / n as f64;
            let angle = i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt());
            let radius = (1.0 - z * z).sqrt();
            let b = basis(DVec3::new(radius * angle.cos(), radius * angle.sin(), z));
            for (at, value) in gram.iter_mut().enumerate() {
                *value += b[at / COEFFICIENTS] * b[at % COEFFICIENTS] * 4.0 * std::f64::consts::PI / n as f64;
            }
        }
        for (at, value) in gram.iter().enumerate() {
            let expected = f64::from(u8::from(at / COEFFICIENTS == at % COEFFICIENTS));
            // 1e-3: the integration error of the lattice.
            assert!((value - expected).abs() < 1e-3, "{at}: {value}");
        }
    }

    #[test]
    fn rotated_harmonics_are_those_of_the_direction_rotated_back() {
        let mut rng = Rng::new(3, 0);
        for degree in 0..=4usize {
            let rotation = rotation(&mut rng);
            let before: Vec<f32> = (0..3 * (degree + 1) * (degree + 1)).map(|_| rng.normal()).collect();
            let mut after = before.clone();
            BandRotation::new(rotation).apply(&mut after);
            assert_eq!(after[..3], before[..3], "DC has no direction");
            for _ in 0..50 {
                let d = unit(&mut rng);
                // The coefficients are f32 after the rotation.
                assert!((value(&after, rotation * d) - value(&before, d)).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn rotations_compose_and_have_inverses() {
        let mut rng = Rng::new(4, 0);
        let (a, b) = (rotation(&mut rng), rotation(&mut rng));
        let before: Vec<f32> = (0..75).map(|_| rng.normal()).collect();
        let apply = |rotations: &[DQuat]| {
            let mut values = before.clone();
            rotations.iter().for_each(|r| BandRotation::new(*r).apply(&mut values));
            values
        };
        let near = |x: Vec<f32>, y: Vec<f32>| x.iter().zip(&y).all(|(x, y)| (x - y).abs() < 1e-5);
        assert!(near(apply(&[a, b]), apply(&[b * a])));
        assert!(near(apply(&[a, a.inverse()]), before.clone()));
        assert!(near(apply(&[DQuat::IDENTITY]), before.clone()));
        assert!(!near(apply(&[a]), before.clone()));
    }
}
