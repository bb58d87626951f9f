//! The essential matrix `e = [t]x r`: `b^T e a = 0` for corresponding points of calibrated photographs on the planes z = 1.

use super::correspondences::{Correspondences, sampson_squared};
use super::fundamental::epipolar_row;
use super::linear::{null_space, real_roots, solve_spd, svd3};
use super::ransac::Estimator;
use glam::{DMat3, DQuat, DVec2, DVec3};

/// A rigid motion between two cameras: `x_b = rotation x_a + translation`, with a translation of length 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// From the first camera's axes to the second's.
    pub rotation: DQuat,
    /// The first camera's centre in the second's axes.
    pub translation: DVec3,
}

impl Motion {
    /// The essential matrix `[t]x r`.
    pub fn essential(&self) -> DMat3 {
        cross_matrix(self.translation) * DMat3::from_quat(self.rotation)
    }

    /// The depths of a correspondence in both cameras, where its rays are closest to each other.
    pub fn depths(&self, [a, b]: [DVec2; 2]) -> [f64; 2] {
        let (a, b) = (self.rotation * a.extend(1.0), b.extend(1.0));
        // Least squares of z_b b = z_a a + t.
        let (aa, ab, bb) = (a.dot(a), a.dot(b), b.dot(b));
        let (at, bt) = (a.dot(self.translation), b.dot(self.translation));
        let det = aa * bb - ab * ab;
        [(ab * bt - bb * at) / det, (aa * bt - ab * at) / det]
    }

    /// The fraction of `points` that agree with the motion: their Sampson distances are below `threshold`, and both rays point the same
    /// way. Their depths are not tested: distant points may be triangulated just behind the cameras.
    pub fn agreeing_fraction(&self, points: &[[DVec2; 2]], threshold: f64) -> f64 {
        let essential = self.essential();
        let agrees = |p: &&[DVec2; 2]| {
            sampson_squared(&essential, **p) < threshold * threshold
                && (self.rotation * p[0].extend(1.0)).dot(p[1].extend(1.0)) > 0.0
        };
        points.iter().filter(agrees).count() as f64 / points.len().max(1) as f64
    }
}

/// `cross_matrix(t) x = t cross x`.
pub fn cross_matrix(t: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, t.z, -t.y),
        DVec3::new(-t.z, 0.0, t.x),
        DVec3::new(t.y, -t.x, 0.0),
    )
}

/// The essential matrix closest to `m`: singular values 1, 1, 0.
pub fn closest_essential(m: DMat3) -> DMat3 {
    let (u, _, v) = svd3(m);
    u * DMat3::from_diagonal(DVec3::new(1.0, 1.0, 0.0)) * v.transpose()
}

/// The four motions of an essential matrix (Hartley and Zisserman 2004, 9.6.2).
pub fn motions(essential: DMat3) -> [Motion; 4] {
    let (mut u, _, mut v) = svd3(essential);
    u.z_axis *= u.determinant().signum();
    v.z_axis *= v.determinant().signum();
    let w = DMat3::from_cols(DVec3::Y, -DVec3::X, DVec3::Z);
    let translation = u.z_axis;
    let rotations = [w, w.transpose()].map(|w| DQuat::from_mat3(&(u * w * v.transpose())).normalize());
    std::array::from_fn(|i| Motion {
        rotation: rotations[i / 2],
        translation: if i % 2 == 0 { translation } else { -translation },
    })
}

/// The motion of an essential matrix with the most points in front of both cameras, and their number.
pub fn motion_in_front<'a>(essential: DMat3, points: impl Iterator<Item = &'a [DVec2; 2]> + Clone) -> (Motion, usize) {
    motions(essential)
        .map(|motion| {
            let count = points
                .clone()
                .filter(|p| motion.depths(**p).iter().all(|z| *z > 0.0))
                .count();
            (motion, count)
        })
        .into_iter()
        // The first of equals, for a result that does not depend on rounding.
        .reduce(|best, next| if next.1 > best.1 { next } else { best })
        .expect("four motions")
}

/// Polynomials of degree 1, 2 and 3 in x, y, z; monomials in the orders of [`LINEAR`], [`QUADRATIC`] and [`MONOMIALS`].
type Linear = [f64; 4];
type Quadratic = [f64; 10];
type Cubic = [f64; 20];

/// Exponents of x, y, z in the order of Nister (2004), in which elimination leaves polynomials in z.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];
const LINEAR: [[u8; 3]; 4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]];
const QUADRATIC: [[u8; 3]; 10] = [
    [2, 0, 0],
    [1, 1, 0],
    [1, 0, 1],
    [1, 0, 0],
    [0, 2, 0],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// The index in `of` of the product of two monomials.
const fn product_table<const A: usize, const B: usize, const C: usize>(
    a: &[[u8; 3]; A],
    b: &[[u8; 3]; B],
    of: &[[u8; 3]; C],
) -> [[usize; B]; A] {
    let mut table = [[0; B]; A];
    let mut i = 0;
    while i < A {
        let mut j = 0;
        while j < B {
            let mut k = 0;
            while of[k][0] != a[i][0] + b[j][0] || of[k][1] != a[i][1] + b[j][1] || of[k][2] != a[i][2] + b[j][2] {
                k += 1;
            }
            table[i][j] = k;
            j += 1;
        }
        i += 1;
    }
    table
}

const LINEAR_LINEAR: [[usize; 4]; 4] = product_table(&LINEAR, &LINEAR, &QUADRATIC);
const QUADRATIC_LINEAR: [[usize; 4]; 10] = product_table(&QUADRATIC, &LINEAR, &MONOMIALS);

fn add_product(a: &Linear, b: &Linear, scale: f64, to: &mut Quadratic) {
    for i in 0..4 {
        for j in 0..4 {
            to[LINEAR_LINEAR[i][j]] += scale * a[i] * b[j];
        }
    }
}

fn add_cubic(a: &Quadratic, b: &Linear, to: &mut Cubic) {
    for i in 0..10 {
        for j in 0..4 {
            to[QUADRATIC_LINEAR[i][j]] += a[i] * b[j];
        }
    }
}

/// The essential matrices, at most ten, through five points (Nister, "An Efficient Solution to the Five-Point Relative Pose Problem",
/// 2004).
pub fn five_points(points: &[[DVec2; 2]; 5], models: &mut Vec<DMat3>) {
    let Some(basis) = null_space::<5, 9, 4>(points.map(epipolar_row)) else {
        return;
    };
    // e[row][column] = x basis[0] + y basis[1] + z basis[2] + basis[3]; the basis is column by column.
    let e: [[Linear; 3]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| basis.map(|b| b[3 * c + r])));
    let mut rows = [[0.0; 20]; 10];
    // det(e) = 0.
    for (c, sign_of) in [(0, [1, 2]), (1, [2, 0]), (2, [0, 1])] {
        let [i, j] = sign_of;
        let mut minor = [0.0; 10];
        add_product(&e[1][i], &e[2][j], 1.0, &mut minor);
        add_product(&e[1][j], &e[2][i], -1.0, &mut minor);
        add_cubic(&minor, &e[0][c], &mut rows[9]);
    }
    // (e e^T - trace(e e^T) / 2) e = 0.
    let mut square = [[[0.0; 10]; 3]; 3];
    for i in 0..3 {
        for j in 0..=i {
            for k in 0..3 {
                add_product(&e[i][k], &e[j][k], 1.0, &mut square[i][j]);
            }
            square[j][i] = square[i][j];
        }
    }
    for k in 0..10 {
        let half = 0.5 * (square[0][0][k] + square[1][1][k] + square[2][2][k]);
        for i in 0..3 {
            square[i][i][k] -= half;
        }
    }
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                add_cubic(&square[i][k], &e[k][j], &mut rows[3 * i + j]);
            }
        }
    }
    if !eliminate(&mut rows) {
        return;
    }
    // Rows 4 to 9 begin with x^2 z, x^2, y^2 z, y^2, x y z, x y: the first of each pair minus z times the second is linear in x and y.
    let mut b = [[[0.0; 5]; 3]; 3];
    for (row, b) in b.iter_mut().enumerate() {
        let (upper, lower) = (&rows[4 + 2 * row][10..], &rows[5 + 2 * row][10..]);
        for (k, (from, degree)) in [(0, 2), (3, 2), (6, 3)].into_iter().enumerate() {
            for power in 0..=degree {
                b[k][power] += upper[from + degree - power];
                b[k][power + 1] -= lower[from + degree - power];
            }
        }
    }
    let mut determinant = [0.0; 11];
    for (c, [i, j]) in [(0, [1, 2]), (1, [2, 0]), (2, [0, 1])] {
        for p in 0..5 {
            for q in 0..5 {
                let minor = b[1][i][p] * b[2][j][q] - b[1][j][p] * b[2][i][q];
                for r in 0..5 {
                    // The columns of x and y have degree 3, the column of 1 has degree 4: higher products are zero.
                    if p + q + r <= 10 {
                        determinant[p + q + r] += minor * b[0][c][r];
                    }
                }
            }
        }
    }
    for z in real_roots(determinant) {
        let at = b.map(|row| DVec3::from_array(row.map(|c| c.iter().rev().fold(0.0, |value, c| value * z + c))));
        let normal = [at[0].cross(at[1]), at[0].cross(at[2]), at[1].cross(at[2])]
            .into_iter()
            .reduce(|best, next| {
                if next.length_squared() > best.length_squared() {
                    next
                } else {
                    best
                }
            })
            .expect("three products");
        let (x, y) = (normal.x / normal.z, normal.y / normal.z);
        let m: [f64; 9] = std::array::from_fn(|i| x * basis[0][i] + y * basis[1][i] + z * basis[2][i] + basis[3][i]);
        let length = m.iter().map(|x| x * x).sum::<f64>().sqrt();
        if length.is_finite() {
            models.push(DMat3::from_cols_array(&m.map(|x| x / length)));
        }
    }
}

/// Gauss-Jordan elimination of the first ten columns.
fn eliminate(rows: &mut [[f64; 20]; 10]) -> bool {
    for i in 0..10 {
        let pivot = (i..10).fold(i, |best, r| {
            if rows[r][i].abs() > rows[best][i].abs() {
                r
            } else {
                best
            }
        });
        if rows[pivot][i].abs() < 1e-14 {
            return false;
        }
        rows.swap(i, pivot);
        let inverse = 1.0 / rows[i][i];
        for c in i..20 {
            rows[i][c] *= inverse;
        }
        let row = rows[i];
        for r in 0..10 {
            let factor = rows[r][i];
            if r != i && factor != 0.0 {
                for c in i..20 {
                    rows[r][c] -= factor * row[c];
                }
            }
        }
    }
    true
}

/// Gauss-Newton steps on the Sampson distance over rotation and direction of translation, for points within `threshold`.
pub fn refine_motion(start: Motion, points: &[[DVec2; 2]], threshold: f64, steps: usize) -> Option<Motion> {
    let mut motion = start;
    let limit = threshold * threshold;
    for _ in 0..steps {
        let essential = motion.essential();
        let side = motion.translation.any_orthonormal_vector();
        let other = motion.translation.cross(side);
        let mut normal = [[0.0; 5]; 5];
        let mut gradient = [0.0; 5];
        for p in points {
            let a = p[0].extend(1.0);
            let b = p[1].extend(1.0);
            let (line_b, line_a) = (essential * a, essential.transpose() * b);
            let squared_length = line_b.truncate().length_squared() + line_a.truncate().length_squared();
            let algebraic = b.dot(line_b);
            // Not the reverse comparison: a point that is not a number, where a lens is not invertible, is left out too.
            let is_inlier = algebraic * algebraic < limit * squared_length;
            if !is_inlier {
                continue;
            }
            // The Sampson denominator is held fixed, as in iteratively reweighted least squares.
            let weight = 1.0 / squared_length;
            let y = motion.rotation * a;
            let turn = y.cross(b.cross(motion.translation));
            let shift = y.cross(b);
            let j = [turn.x, turn.y, turn.z, shift.dot(side), shift.dot(other)];
            for i in 0..5 {
                gradient[i] -= weight * j[i] * algebraic;
                for k in 0..5 {
                    normal[i][k] += weight * j[i] * j[k];
                }
            }
        }
        for (i, row) in normal.iter_mut().enumerate() {
            row[i] *= 1.0 + 1e-9;
        }
        let step = solve_spd(normal, gradient)?;
        motion.rotation =
            (DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2])) * motion.rotation).normalize();
        motion.translation = (motion.translation + step[3] * side + step[4] * other).normalize();
    }
    (motion.rotation.is_finite() && motion.translation.is_finite()).then_some(motion)
}

/// Estimation of the essential matrix from correspondences on the planes z = 1.
pub struct Essential<'a> {
    /// The correspondences.
    pub points: &'a Correspondences,
    /// Maximum Sampson distance of an inlier.
    pub threshold: f64,
}

impl Estimator for Essential<'_> {
    type Model = DMat3;
    const SAMPLE: usize = 5;

    fn observations(&self) -> usize {
        self.points.points.len()
    }

    fn fit(&self, sample: &[usize], models: &mut Vec<DMat3>) {
        five_points(&std::array::from_fn(|i| self.points.points[sample[i]]), models);
    }

    fn cost(&self, model: &DMat3) -> (f64, usize) {
        self.points.epipolar_cost(model, self.threshold)
    }

    fn refine(&self, model: &DMat3) -> Option<DMat3> {
        // All four motions have the same Sampson distances.
        let start = motions(*model)[0];
        Some(refine_motion(start, &self.points.points, self.threshold, 2)?.essential())
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::TwoViews;
    use super::*;

    #[test]
    fn five_points_contain_the_true_motion() {
        let mut errors = Vec::new();
        for seed in 0..101 {
            let views = TwoViews::new(seed, 20, 0.0);
            let mut models = Vec::new();
            five_points(&std::array::from_fn(|i| views.points[i]), &mut models);
            let truth = views.motion.essential() / std::f64::consts::SQRT_2;
            let best = models
                .iter()
                .map(|e| {
                    let sign = e
                        .to_cols_array()
                        .iter()
                        .zip(truth.to_cols_array())
                        .map(|(a, b)| a * b)
                        .sum::<f64>();
                    (*e * sign.signum() - truth)
                        .to_cols_array()
                        .iter()
                        .fold(0.0f64, |m, x| m.max(x.abs()))
                })
                .fold(f64::INFINITY, f64::min);
            errors.push(best);
        }
        errors.sort_by(f64::total_cmp);
        // Some samples are close to a double root, where half the digits are lost.
        assert!(
            errors[50] < 1e-11 && errors[95] < 1e-6 && errors[100] < 1e-4,
            "{errors:?}"
        );
    }

    #[test]
    fn decomposition_by_depths_is_the_true_motion() {
        for seed in 0..20 {
            let views = TwoViews::new(seed, 20, 0.0);
            let (motion, count) = motion_in_front(views.motion.essential() * -3.0, views.points.iter());
            assert_eq!(count, 20);
            assert!(motion.rotation.angle_between(views.motion.rotation) < 1e-6);
            assert!(motion.translation.angle_between(views.motion.translation) < 1e-6);
        }
    }

    #[test]
    fn refinement_reaches_the_truth_from_two_degrees_away() {
        let views = TwoViews::new(4, 100, 0.0);
        let start = Motion {
            rotation: DQuat::from_rotation_x(0.03) * views.motion.rotation,
            translation: (views.motion.translation + DVec3::new(0.02, 0.03, -0.01)).normalize(),
        };
        let motion = refine_motion(start, &views.points, 1.0, 6).expect("converges");
        assert!(motion.rotation.angle_between(views.motion.rotation) < 1e-7);
        assert!(motion.translation.angle_between(views.motion.translation) < 1e-7);
        // A point where a lens is not invertible changes nothing.
        let with_nan = [&views.points[..], &[[DVec2::NAN, DVec2::ZERO]]].concat();
        assert_eq!(refine_motion(start, &with_nan, 1.0, 6), Some(motion));
    }
}
