//! Small dense linear algebra: null spaces, symmetric eigenvectors, 3x3 singular values, linear systems, real roots.
//!
//! Sizes are at most 10, for which a crate such as `nalgebra` (20 s of build time) has no advantage.

use glam::{DMat3, DVec3};

/// The sum of the outer products of `vectors` with themselves.
pub fn scatter(vectors: impl Iterator<Item = DVec3>) -> [[f64; 3]; 3] {
    let mut sum = DMat3::ZERO;
    for v in vectors {
        sum += DMat3::from_cols(v * v.x, v * v.y, v * v.z);
    }
    sum.to_cols_array_2d()
}

/// Eigenvalues, ascending, and eigenvectors (as rows) of a symmetric matrix, by cyclic Jacobi rotations.
pub fn symmetric_eigen<const N: usize>(mut a: [[f64; N]; N]) -> ([f64; N], [[f64; N]; N]) {
    let mut vectors = [[0.0; N]; N];
    for i in 0..N {
        vectors[i][i] = 1.0;
    }
    for _ in 0..30 {
        let (mut off, mut diagonal) = (0.0, 0.0);
        for i in 0..N {
            diagonal += a[i][i] * a[i][i];
            off += a[i][..i].iter().map(|x| x * x).sum::<f64>();
        }
        if off <= 1e-32 * diagonal || !off.is_finite() {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                if a[p][q] == 0.0 {
                    continue;
                }
                let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                for k in 0..N {
                    let (x, y) = (a[k][p], a[k][q]);
                    a[k][p] = c * x - s * y;
                    a[k][q] = s * x + c * y;
                }
                for k in 0..N {
                    let (x, y) = (a[p][k], a[q][k]);
                    a[p][k] = c * x - s * y;
                    a[q][k] = s * x + c * y;
                }
                for k in 0..N {
                    let (x, y) = (vectors[p][k], vectors[q][k]);
                    vectors[p][k] = c * x - s * y;
                    vectors[q][k] = s * x + c * y;
                }
            }
        }
    }
    let mut order: [usize; N] = std::array::from_fn(|i| i);
    order.sort_by(|i, j| a[*i][*i].total_cmp(&a[*j][*j]));
    (order.map(|i| a[i][i]), order.map(|i| vectors[i]))
}

/// `m = u diag(s) v^T` with `s` descending, by one-sided Jacobi rotations; `u` and `v` are orthogonal, of either handedness.
pub fn svd3(m: DMat3) -> (DMat3, DVec3, DMat3) {
    let mut a = [m.x_axis, m.y_axis, m.z_axis];
    let mut v = [DVec3::X, DVec3::Y, DVec3::Z];
    for _ in 0..30 {
        let mut rotated = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let (alpha, beta, gamma) = (a[p].length_squared(), a[q].length_squared(), a[p].dot(a[q]));
            if gamma.abs() <= 1e-16 * (alpha * beta).sqrt() || gamma == 0.0 || !gamma.is_finite() {
                continue;
            }
            rotated = true;
            let zeta = (beta - alpha) / (2.0 * gamma);
            let t = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
            let c = 1.0 / (1.0 + t * t).sqrt();
            let s = c * t;
            (a[p], a[q]) = (c * a[p] - s * a[q], s * a[p] + c * a[q]);
            (v[p], v[q]) = (c * v[p] - s * v[q], s * v[p] + c * v[q]);
        }
        if !rotated {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|i, j| a[*j].length_squared().total_cmp(&a[*i].length_squared()));
    let [a, v] = [order.map(|i| a[i]), order.map(|i| v[i])];
    let s = DVec3::new(a[0].length(), a[1].length(), a[2].length());
    let u0 = a[0].try_normalize().unwrap_or(DVec3::X);
    let u1 = match (s.y > 1e-14 * s.x).then(|| a[1] / s.y) {
        Some(u1) => u1,
        None => u0.any_orthonormal_vector(),
    };
    let third = u0.cross(u1);
    let u2 = third * if third.dot(a[2]) < 0.0 { -1.0 } else { 1.0 };
    (DMat3::from_cols(u0, u1, u2), s, DMat3::from_cols(v[0], v[1], v[2]))
}

/// The rotation closest to `m` in the Frobenius norm.
pub fn closest_rotation(m: DMat3) -> DMat3 {
    let (u, _, v) = svd3(m);
    let sign = (u.determinant() * v.determinant()).signum();
    DMat3::from_cols(u.x_axis, u.y_axis, sign * u.z_axis) * v.transpose()
}

/// An orthonormal basis of the null space of `rows` (`R < N`), by elimination with full pivoting; `None` if the rank is below R.
///
/// `K` is `N - R`.
pub fn null_space<const R: usize, const N: usize, const K: usize>(mut rows: [[f64; N]; R]) -> Option<[[f64; N]; K]> {
    const { assert!(R + K == N) };
    let mut columns: [usize; N] = std::array::from_fn(|i| i);
    let largest = rows.iter().flatten().fold(0.0f64, |m, x| m.max(x.abs()));
    for i in 0..R {
        let (mut pivot, mut at) = (0.0f64, (i, i));
        for r in i..R {
            for c in i..N {
                if rows[r][columns[c]].abs() > pivot {
                    (pivot, at) = (rows[r][columns[c]].abs(), (r, c));
                }
            }
        }
        if pivot <= 1e-12 * largest {
            return None;
        }
        rows.swap(i, at.0);
        columns.swap(i, at.1);
        let inverse = 1.0 / rows[i][columns[i]];
        for x in &mut rows[i] {
            *x *= inverse;
        }
        let row = rows[i];
        for r in 0..R {
            let factor = rows[r][columns[i]];
            if r != i && factor != 0.0 {
                for c in 0..N {
                    rows[r][c] -= factor * row[c];
                }
            }
        }
    }
    let mut basis = [[0.0; N]; K];
    for k in 0..K {
        let mut vector = [0.0; N];
        vector[columns[R + k]] = 1.0;
        for r in 0..R {
            vector[columns[r]] = -rows[r][columns[R + k]];
        }
        for before in &basis[..k] {
            let dot: f64 = before.iter().zip(&vector).map(|(a, b)| a * b).sum();
            for c in 0..N {
                vector[c] -= dot * before[c];
            }
        }
        let length = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
        basis[k] = vector.map(|x| x / length);
    }
    Some(basis)
}

/// Solves the symmetric positive definite system `a x = b` by Cholesky factorisation; `None` if `a` is not positive definite.
pub fn solve_spd<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    for i in 0..N {
        for j in 0..=i {
            let mut sum = a[i][j];
            for k in 0..j {
                sum -= a[i][k] * a[j][k];
            }
            if i == j {
                if sum.is_nan() || sum <= 0.0 {
                    return None;
                }
                a[i][i] = sum.sqrt();
            } else {
                a[i][j] = sum / a[j][j];
            }
        }
    }
    for i in 0..N {
        for k in 0..i {
            b[i] -= a[i][k] * b[k];
        }
        b[i] /= a[i][i];
    }
    for i in (0..N).rev() {
        for k in i + 1..N {
            b[i] -= a[k][i] * b[k];
        }
        b[i] /= a[i][i];
    }
    Some(b)
}

/// The real roots of `c[0] + c[1] x + c[2] x^2 + c[3] x^3`, polished by Newton's method.
pub fn cubic_roots(c: [f64; 4]) -> impl Iterator<Item = f64> {
    let scale = c.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    let mut roots = [f64::NAN; 3];
    if c[3].abs() > 1e-14 * scale {
        // The monic cubic, depressed by x = y - a / 3.
        let (a, b, d) = (c[2] / c[3], c[1] / c[3], c[0] / c[3]);
        let q = (a * a - 3.0 * b) / 9.0;
        let r = (2.0 * a * a * a - 9.0 * a * b + 27.0 * d) / 54.0;
        if r * r < q * q * q {
            let theta = (r / (q * q * q).sqrt()).clamp(-1.0, 1.0).acos();
            for (k, root) in roots.iter_mut().enumerate() {
                *root = -2.0 * q.sqrt() * ((theta + std::f64::consts::TAU * k as f64) / 3.0).cos() - a / 3.0;
            }
        } else {
            let e = -r.signum() * (r.abs() + (r * r - q * q * q).sqrt()).cbrt();
            roots[0] = e + if e == 0.0 { 0.0 } else { q / e } - a / 3.0;
        }
    } else if c[2].abs() > 1e-14 * scale {
        let discriminant = c[1] * c[1] - 4.0 * c[2] * c[0];
        if discriminant >= 0.0 {
            let h = -0.5 * (c[1] + c[1].signum() * discriminant.sqrt());
            roots[0] = h / c[2];
            roots[1] = c[0] / h;
        }
    } else {
        roots[0] = -c[0] / c[1];
    }
    roots.into_iter().filter(|x| x.is_finite()).map(move |mut x| {
        for _ in 0..2 {
            let value = c[0] + x * (c[1] + x * (c[2] + x * c[3]));
            let slope = c[1] + x * (2.0 * c[2] + x * 3.0 * c[3]);
            if slope != 0.0 {
                x -= value / slope;
            }
        }
        x
    })
}

/// The real roots of the polynomial with coefficients `c` from degree 0 up, by a Sturm chain and bisection.
///
/// Roots beyond 1 in magnitude are those of the reversed polynomial, so that both searches are over \[-1, 1\].
pub fn real_roots<const N: usize>(c: [f64; N]) -> Vec<f64> {
    let mut roots = Vec::with_capacity(N);
    roots_within_one(&c, &mut roots);
    let mut reversed = c;
    reversed.reverse();
    let inner = roots.len();
    roots_within_one(&reversed, &mut roots);
    for root in &mut roots[inner..] {
        *root = 1.0 / *root;
    }
    roots.retain(|x| x.is_finite());
    roots
}

fn evaluate(c: &[f64], x: f64) -> f64 {
    c.iter().rev().fold(0.0, |value, c| value * x + c)
}

fn roots_within_one<const N: usize>(c: &[f64; N], roots: &mut Vec<f64>) {
    // chain[i] has degree lengths[i] - 1.
    let mut chain = [[0.0; N]; N];
    let mut lengths = [0; N];
    chain[0] = *c;
    lengths[0] = N;
    for i in 1..N {
        chain[1][i - 1] = c[i] * i as f64;
    }
    lengths[1] = N - 1;
    let mut links = 2;
    while links < N && lengths[links - 1] > 1 {
        // The negated remainder, scaled to avoid overflow.
        let mut rest = chain[links - 2];
        let divisor = &chain[links - 1][..lengths[links - 1]];
        let lead = divisor[divisor.len() - 1];
        if lead == 0.0 {
            break;
        }
        for i in (divisor.len() - 1..lengths[links - 2]).rev() {
            let factor = rest[i] / lead;
            for (k, d) in divisor.iter().enumerate() {
                rest[i + 1 - divisor.len() + k] -= factor * d;
            }
        }
        let length = divisor.len() - 1;
        let largest = rest[..length].iter().fold(0.0f64, |m, x| m.max(x.abs()));
        if largest == 0.0 || !largest.is_finite() {
            break;
        }
        for k in 0..length {
            chain[links][k] = -rest[k] / largest;
        }
        lengths[links] = length;
        links += 1;
    }
    let changes = |x: f64| {
        let (mut count, mut before) = (0, 0.0);
        for i in 0..links {
            let value = evaluate(&chain[i][..lengths[i]], x);
            if value * before < 0.0 {
                count += 1;
            }
            if value != 0.0 {
                before = value.signum();
            }
        }
        count
    };
    // Intervals with the sign changes at both ends and the depth of bisection.
    let mut intervals = vec![(-1.0, 1.0, changes(-1.0), changes(1.0), 0)];
    while let Some((low, high, at_low, at_high, depth)) = intervals.pop() {
        if at_low <= at_high {
            continue;
        }
        if at_low - at_high > 1 && depth < 40 {
            // Slightly off centre, because roots at round numbers would otherwise be on the boundary.
            let middle = low + 0.4987 * (high - low);
            let at_middle = changes(middle);
            intervals.push((low, middle, at_low, at_middle, depth + 1));
            intervals.push((middle, high, at_middle, at_high, depth + 1));
            continue;
        }
        roots.push(bracketed_root(c, low, high));
    }
}

/// The root in a bracket by Newton's method, with bisection where a step leaves the bracket.
fn bracketed_root(c: &[f64], mut low: f64, mut high: f64) -> f64 {
    let rising = evaluate(c, high) >= 0.0;
    let mut x = 0.5 * (low + high);
    for _ in 0..60 {
        let (mut value, mut slope) = (0.0, 0.0);
        for c in c.iter().rev() {
            slope = slope * x + value;
            value = value * x + c;
        }
        if (value >= 0.0) == rising {
            high = x;
        } else {
            low = x;
        }
        let newton = x - value / slope;
        let next = if newton > low && newton < high {
            newton
        } else {
            0.5 * (low + high)
        };
        if (next - x).abs() <= 1e-15 * x.abs().max(1e-3) {
            return next;
        }
        x = next;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    fn random<const N: usize>(rng: &mut Rng) -> [f64; N] {
        std::array::from_fn(|_| f64::from(rng.normal()))
    }

    #[test]
    fn eigenvectors_diagonalise() {
        let mut rng = Rng::new(1, 0);
        let b: [[f64; 9]; 9] = std::array::from_fn(|_| random(&mut rng));
        let mut a = [[0.0; 9]; 9];
        for i in 0..9 {
            for j in 0..9 {
                a[i][j] = (0..9).map(|k| b[i][k] * b[j][k]).sum();
            }
        }
        let (values, vectors) = symmetric_eigen(a);
        assert!(values.is_sorted());
        for (value, v) in values.iter().zip(&vectors) {
            for i in 0..9 {
                let av: f64 = (0..9).map(|k| a[i][k] * v[k]).sum();
                assert!((av - value * v[i]).abs() < 1e-10);
            }
        }
    }

    #[test]
    fn singular_values_recompose_even_when_some_are_zero() {
        let mut rng = Rng::new(2, 0);
        for rank in 1..=3 {
            for _ in 0..20 {
                let mut m = DMat3::ZERO;
                for _ in 0..rank {
                    let (a, b) = (DVec3::from_array(random(&mut rng)), DVec3::from_array(random(&mut rng)));
                    m += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
                }
                let (u, s, v) = svd3(m);
                let back = u * DMat3::from_diagonal(s) * v.transpose();
                assert!(s.x >= s.y && s.y >= s.z && s.z >= 0.0);
                assert!(back.abs_diff_eq(m, 1e-9), "{rank}: {back} {m}");
                assert!((u * u.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-9));
                assert!((v * v.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-9));
            }
        }
    }

    #[test]
    fn null_space_is_orthonormal_and_annihilated() {
        let mut rng = Rng::new(3, 0);
        let rows: [[f64; 9]; 5] = std::array::from_fn(|_| random(&mut rng));
        let basis = null_space::<5, 9, 4>(rows).expect("full rank");
        let dot = |a: &[f64; 9], b: &[f64; 9]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        for (i, v) in basis.iter().enumerate() {
            assert!(rows.iter().all(|row| dot(row, v).abs() < 1e-12));
            for (j, w) in basis.iter().enumerate() {
                assert!((dot(v, w) - f64::from(i == j)).abs() < 1e-12);
            }
        }
        assert!(null_space::<2, 3, 1>([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]).is_none());
    }

    #[test]
    fn a_positive_definite_system_is_solved_and_another_refused() {
        let a = [[4.0, 1.0], [1.0, 3.0]];
        let x = solve_spd(a, [1.0, 2.0]).expect("positive definite");
        assert!((x[0] - 1.0 / 11.0).abs() < 1e-15 && (x[1] - 7.0 / 11.0).abs() < 1e-15);
        assert!(solve_spd([[1.0, 2.0], [2.0, 1.0]], [0.0; 2]).is_none());
    }

    #[test]
    fn roots_are_found_on_both_sides_of_one() {
        // (x + 7)(x - 0.25)(x - 0.5)(x - 3)(x^2 + 1)
        let mut c = vec![1.0];
        for factor in [
            vec![7.0, 1.0],
            vec![-0.25, 1.0],
            vec![-0.5, 1.0],
            vec![-3.0, 1.0],
            vec![1.0, 0.0, 1.0],
        ] {
            let mut product = vec![0.0; c.len() + factor.len() - 1];
            for (i, a) in c.iter().enumerate() {
                for (j, b) in factor.iter().enumerate() {
                    product[i + j] += a * b;
                }
            }
            c = product;
        }
        let mut roots = real_roots::<7>(c.try_into().expect("degree 6"));
        roots.sort_by(f64::total_cmp);
        for (root, want) in roots.iter().zip([-7.0, 0.25, 0.5, 3.0]) {
            assert!((root - want).abs() < 1e-9, "{roots:?}");
        }
        assert_eq!(roots.len(), 4);
    }

    #[test]
    fn cubics_of_every_kind() {
        let sorted = |c| {
            let mut roots: Vec<f64> = cubic_roots(c).collect();
            roots.sort_by(f64::total_cmp);
            roots
        };
        let near = |got: Vec<f64>, want: &[f64]| {
            assert!(
                got.len() == want.len() && got.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-12),
                "{got:?} {want:?}"
            );
        };
        near(sorted([-6.0, 11.0, -6.0, 1.0]), &[1.0, 2.0, 3.0]);
        near(sorted([-8.0, 4.0, -2.0, 1.0]), &[2.0]);
        near(sorted([6.0, -5.0, 1.0, 0.0]), &[2.0, 3.0]);
        near(sorted([-6.0, 3.0, 0.0, 0.0]), &[2.0]);
    }
}
