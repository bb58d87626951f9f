//! From the axes of another format to ours. Most formats have the axes of the Inria code, as we do; if one has others, positions,
//! rotations and the bands of the spherical harmonics are converted.

use crate::splats::rows::SPLATS_PER_TASK;
use glam::{DMat3, DQuat, DVec3};
use irradia_scene::{GaussianCloud, sh};
use rayon::prelude::*;

/// A change of the signs of x, y and z. An even number of minus signs is a half turn and its own inverse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Signs(pub [f32; 3]);

impl Signs {
    /// Nothing changes.
    pub const NONE: Self = Self([1.0; 3]);
    /// Half a turn about x: from y down, z forward to y up, z backward (OpenGL, three.js, SPZ) and back.
    pub const HALF_TURN_X: Self = Self([1.0, -1.0, -1.0]);
    /// Half a turn about z: from y down, z forward to y up, z forward (glTF) and back.
    pub const HALF_TURN_Z: Self = Self([-1.0, -1.0, 1.0]);

    /// `position` in the other axes.
    pub fn position(self, position: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| position[c] * self.0[c])
    }

    /// A rotation `w, x, y, z` in the other axes.
    ///
    /// The Gaussian's own axes change with the world's, which has no effect since it is symmetric about them. Only signs change, so
    /// no bit is lost.
    pub fn quat(self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        let [sx, sy, sz] = self.0;
        [w, x * sy * sz, y * sx * sz, z * sx * sy]
    }

    /// The sign of each coefficient above DC, up to degree 4: the product of the signs of its basis function's odd powers.
    pub fn bands(self) -> [f32; 24] {
        let [x, y, z] = self.0;
        let one = 1.0;
        let (xy, yz, xz, xyz) = (x * y, y * z, x * z, x * y * z);
        [
            y, z, x, //
            xy, yz, one, xz, one, //
            y, xyz, y, z, x, z, x, //
            xy, yz, xy, yz, one, xz, one, xz, one,
        ]
    }

    /// All splats in the other axes.
    pub fn apply(self, cloud: &mut GaussianCloud) {
        if self == Self::NONE {
            return;
        }
        cloud.means.par_iter_mut().for_each(|mean| *mean = self.position(*mean));
        cloud.quats.par_iter_mut().for_each(|quat| *quat = self.quat(*quat));
        let (bands, width) = (self.bands(), cloud.sh_coefficients());
        if width > 1 {
            cloud.sh.par_chunks_mut(3 * width).for_each(|sh| {
                for (triple, sign) in sh[3..].chunks_exact_mut(3).zip(bands) {
                    triple.iter_mut().for_each(|value| *value *= sign);
                }
            });
        }
    }
}

/// A linear map and a translation, as a node of a scene graph has them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Affine {
    pub linear: DMat3,
    pub translation: DVec3,
}

impl Affine {
    /// Nothing changes.
    pub const IDENTITY: Self = Self {
        linear: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    };

    /// `self` after `inner`.
    pub fn after(self, inner: Self) -> Self {
        Self {
            linear: self.linear * inner.linear,
            translation: self.linear * inner.translation + self.translation,
        }
    }

    /// Transforms all splats; `None` if the map mirrors or collapses an axis, so that it has no rotation.
    pub fn apply(self, cloud: &mut GaussianCloud) -> Option<()> {
        if self == Self::IDENTITY {
            return Some(());
        }
        let lengths = [0, 1, 2].map(|c| self.linear.col(c).length());
        let finite = self.linear.is_finite() && self.translation.is_finite();
        if !finite || self.linear.determinant() <= 0.0 || lengths.iter().any(|length| *length < 1e-30) {
            return None;
        }
        let rotation = DMat3::from_cols_array_2d(&[0, 1, 2].map(|c| (self.linear.col(c) / lengths[c]).to_array()));
        let (rotation_quat, mean_length) = (
            DQuat::from_mat3(&rotation).normalize(),
            lengths.iter().sum::<f64>() / 3.0,
        );
        let is_similarity = lengths.iter().all(|length| (length / mean_length - 1.0).abs() < 1e-6)
            && (rotation.determinant() - 1.0).abs() < 1e-6;
        cloud.means.par_iter_mut().for_each(|mean| {
            let moved = self.linear * DVec3::from(mean.map(f64::from)) + self.translation;
            *mean = moved.as_vec3().to_array();
        });
        let shapes = cloud.quats.par_iter_mut().zip(&mut cloud.log_scales);
        shapes.for_each(|(quat, log_scale)| {
            let old = dquat(*quat);
            if is_similarity {
                *quat = wxyz(rotation_quat * old);
                *log_scale = log_scale.map(|scale| (f64::from(scale) + mean_length.ln()) as f32);
                return;
            }
            let scale = DVec3::from(log_scale.map(|scale| f64::from(scale).exp()));
            let axes = self.linear * DMat3::from_quat(old) * DMat3::from_diagonal(scale);
            let (rotation, squares) = eigen(axes * axes.transpose());
            *quat = wxyz(DQuat::from_mat3(&rotation));
            *log_scale = squares.map(|square| (0.5 * square.max(1e-60).ln()) as f32);
        });
        rotate_harmonics(&mut cloud.sh, cloud.sh_degree, rotation);
        Some(())
    }
}

fn dquat([w, x, y, z]: [f32; 4]) -> DQuat {
    let quat = DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
    if quat.length_squared() > 0.0 {
        quat.normalize()
    } else {
        DQuat::IDENTITY
    }
}

fn wxyz(quat: DQuat) -> [f32; 4] {
    [quat.w, quat.x, quat.y, quat.z].map(|v| v as f32)
}

/// Eigenvectors (a rotation) and eigenvalues of a symmetric matrix, by Jacobi's method.
fn eigen(mut a: DMat3) -> (DMat3, [f64; 3]) {
    let mut vectors = DMat3::IDENTITY;
    // Converges quadratically: a handful of sweeps reaches the last bit.
    for _ in 0..12 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = a.col(q)[p];
            if off.abs() <= 1e-300 {
                continue;
            }
            let theta = (a.col(q)[q] - a.col(p)[p]) / (2.0 * off);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let mut rotation = DMat3::IDENTITY;
            rotation.col_mut(p)[p] = c;
            rotation.col_mut(q)[q] = c;
            rotation.col_mut(q)[p] = t * c;
            rotation.col_mut(p)[q] = -t * c;
            a = rotation.transpose() * a * rotation;
            vectors *= rotation;
        }
    }
    (vectors, [a.col(0)[0], a.col(1)[1], a.col(2)[2]])
}

/// Rotates the colours of all splats: seen from direction `rotation * d`, a splat has the colour that it had from `d`.
///
/// A band maps to itself by the matrix of the products of old and new basis functions, integrated over the sphere.
pub(crate) fn rotate_harmonics(values: &mut [f32], degree: u32, rotation: DMat3) {
    if degree == 0 {
        return;
    }
    let width = sh::coefficients(degree);
    let inverse = rotation.transpose();
    let mut matrix = vec![[0.0f64; 25]; width];
    for (direction, weight) in sphere_quadrature() {
        let (new, old) = (sh_basis(direction), sh_basis(inverse * direction));
        for (row, new) in matrix.iter_mut().zip(new) {
            for (entry, old) in row.iter_mut().zip(old) {
                *entry += weight * new * old;
            }
        }
    }
    values.par_chunks_mut(SPLATS_PER_TASK * 3 * width).for_each(|chunk| {
        for sh in chunk.chunks_exact_mut(3 * width) {
            let mut old = [[0.0f64; 3]; 25];
            for (old, v) in old.iter_mut().zip(sh.chunks_exact(3)) {
                *old = [v[0], v[1], v[2]].map(f64::from);
            }
            for band in 1..=degree {
                let (first, last) = (sh::coefficients(band - 1), sh::coefficients(band));
                for i in first..last {
                    for c in 0..3 {
                        let sum: f64 = (first..last).map(|j| matrix[i][j] * old[j][c]).sum();
                        sh[3 * i + c] = sum as f32;
                    }
                }
            }
        }
    });
}

/// Directions and weights that integrate polynomials up to degree 9 on the sphere exactly: Gauss-Legendre in z, equal steps around.
fn sphere_quadrature() -> impl Iterator<Item = (DVec3, f64)> {
    // Abramowitz and Stegun, table 25.4, n = 5.
    const LEGENDRE: [(f64, f64); 5] = [
        (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
        (-0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
        (0.0, 0.568_888_888_888_888_9),
        (0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
        (0.906_179_845_938_664, 0.236_926_885_056_189_1),
    ];
    const LONGITUDE_STEPS: usize = 10;
    LEGENDRE.into_iter().flat_map(|(z, weight)| {
        (0..LONGITUDE_STEPS).map(move |step| {
            let (sin, cos) = (step as f64 / LONGITUDE_STEPS as f64 * std::f64::consts::TAU).sin_cos();
            let radius = (1.0 - z * z).sqrt();
            let direction = DVec3::new(radius * cos, radius * sin, z);
            (direction, weight * std::f64::consts::TAU / LONGITUDE_STEPS as f64)
        })
    })
}

/// The basis functions up to degree 4 at a unit direction, with the signs of the Inria code.
fn sh_basis(d: DVec3) -> [f64; 25] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let [a, b, c, e, f] = sh::C2;
    let [g, h, i, j, k, l, m] = sh::C3;
    // Band 4: gsplat's signs.
    [
        sh::C0,
        -sh::C1 * y,
        sh::C1 * z,
        -sh::C1 * x,
        a * x * y,
        b * y * z,
        c * (2.0 * zz - xx - yy),
        e * x * z,
        f * (xx - yy),
        g * y * (3.0 * xx - yy),
        h * x * y * z,
        i * y * (4.0 * zz - xx - yy),
        j * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        k * x * (4.0 * zz - xx - yy),
        l * z * (xx - yy),
        m * x * (xx - 3.0 * yy),
        2.503_342_941_796_704_6 * x * y * (xx - yy),
        -1.770_130_769_779_930_5 * y * z * (3.0 * xx - yy),
        0.946_174_695_757_560_1 * x * y * (7.0 * zz - 1.0),
        -0.669_046_543_557_289_2 * y * z * (7.0 * zz - 3.0),
        0.105_785_546_915_204_3 * (zz * (35.0 * zz - 30.0) + 3.0),
        -0.669_046_543_557_289_2 * x * z * (7.0 * zz - 3.0),
        0.473_087_347_878_780_1 * (xx - yy) * (7.0 * zz - 1.0),
        -1.770_130_769_779_930_5 * x * z * (xx - 3.0 * yy),
        0.625_835_735_449_176_1 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splats::rows::decode_splats;
    use irradia_scene::Rng;

    fn random_cloud(count: usize, degree: u32) -> GaussianCloud {
        decode_splats(count, degree, |i, splat| {
            let mut rng = Rng::new(9, i as u64);
            let mut f = || rng.range(-1.0, 1.0);
            *splat.mean = [f(), f(), f()];
            *splat.quat = [f(), f(), f(), f()];
            *splat.log_scale = [f(), f(), f()];
            splat.sh.iter_mut().for_each(|v| *v = f());
        })
    }

    /// Covariance of splat `i`.
    fn covariance(cloud: &GaussianCloud, i: usize) -> DMat3 {
        let scale = DVec3::from(cloud.log_scales[i].map(|s| f64::from(s).exp()));
        let axes = DMat3::from_quat(dquat(cloud.quats[i])) * DMat3::from_diagonal(scale);
        axes * axes.transpose()
    }

    fn color(cloud: &GaussianCloud, i: usize, direction: DVec3) -> f64 {
        let width = cloud.sh_coefficients();
        let sh = &cloud.sh[i * 3 * width..];
        (0..width)
            .map(|k| f64::from(sh[3 * k + 1]) * sh_basis(direction)[k])
            .sum()
    }

    fn assert_is_moved(old: &GaussianCloud, new: &GaussianCloud, map: Affine, turn: DMat3) {
        for i in 0..old.len() {
            let mean = map.linear * DVec3::from(old.means[i].map(f64::from)) + map.translation;
            assert!((mean - DVec3::from(new.means[i].map(f64::from))).length() < 1e-5);
            let expected = map.linear * covariance(old, i) * map.linear.transpose();
            let difference = (expected - covariance(new, i)).to_cols_array();
            assert!(difference.iter().all(|d| d.abs() < 2e-4), "{difference:?}");
            let direction = DVec3::new(0.3, -0.5, 0.8).normalize();
            let (before, after) = (color(old, i, direction), color(new, i, turn * direction));
            assert!((before - after).abs() < 1e-5, "{before} {after}");
        }
    }

    #[test]
    fn the_basis_is_orthonormal() {
        for i in 0..25 {
            for j in 0..25 {
                let product: f64 = sphere_quadrature()
                    .map(|(d, w)| w * sh_basis(d)[i] * sh_basis(d)[j])
                    .sum();
                assert!(
                    (product - f64::from(u8::from(i == j))).abs() < 1e-12,
                    "{i} {j}: {product}"
                );
            }
        }
    }

    #[test]
    fn half_turns_move_shape_and_colour_together_and_undo_themselves() {
        for signs in [Signs::HALF_TURN_X, Signs::HALF_TURN_Z] {
            let old = random_cloud(20, 4);
            let mut new = old.clone();
            signs.apply(&mut new);
            let linear = DMat3::from_diagonal(DVec3::from(signs.0.map(f64::from)));
            let map = Affine {
                linear,
                translation: DVec3::ZERO,
            };
            assert_is_moved(&old, &new, map, linear);
            signs.apply(&mut new);
            assert_eq!(new, old);
        }
    }

    #[test]
    fn transformed_scenes_look_alike_from_the_transformed_camera() {
        let turn = DMat3::from_quat(DQuat::from_xyzw(0.3, -0.2, 0.5, 0.7).normalize());
        let translation = DVec3::new(3.0, -1.0, 0.5);
        for (stretch, degree) in [(DVec3::ONE, 4), (DVec3::splat(2.5), 3), (DVec3::new(2.0, 0.5, 1.0), 2)] {
            let map = Affine {
                linear: turn * DMat3::from_diagonal(stretch),
                translation,
            };
            let old = random_cloud(20, degree);
            let mut new = old.clone();
            map.apply(&mut new).unwrap();
            assert_is_moved(&old, &new, map, turn);
        }
        let mirror = Affine {
            linear: DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)),
            translation,
        };
        assert!(mirror.apply(&mut random_cloud(1, 0)).is_none());
    }
}
