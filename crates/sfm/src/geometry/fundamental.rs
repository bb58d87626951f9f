//! The fundamental matrix `f`: `b^T f a = 0` for corresponding points `a` and `b`.

use super::correspondences::{Correspondences, sampson_squared};
use super::linear::{cubic_roots, null_space, svd3, symmetric_eigen};
use super::ransac::Estimator;
use glam::{DMat3, DVec2};

/// One row of `b^T f a = 0` in the entries of `f`, column by column.
pub(super) fn epipolar_row([a, b]: [DVec2; 2]) -> [f64; 9] {
    [a.x * b.x, a.x * b.y, a.x, a.y * b.x, a.y * b.y, a.y, b.x, b.y, 1.0]
}

/// The one or three fundamental matrices through seven points (Hartley and Zisserman 2004, 11.1.2).
pub fn seven_points(points: &[[DVec2; 2]; 7], models: &mut Vec<DMat3>) {
    let Some([f, g]) = null_space::<7, 9, 2>(points.map(epipolar_row)) else {
        return;
    };
    let (f, g) = (DMat3::from_cols_array(&f), DMat3::from_cols_array(&g));
    // The values of det(x f + g) at four points give its coefficients.
    let at = |x: f64| (f * x + g).determinant();
    let (c0, c3) = (at(0.0), f.determinant());
    let (plus, minus) = (at(1.0), at(-1.0));
    let c2 = 0.5 * (plus + minus) - c0;
    let c1 = 0.5 * (plus - minus) - c3;
    models.extend(cubic_roots([c0, c1, c2, c3]).map(|x| f * x + g));
}

/// The least-squares fundamental matrix over weighted points (the normalised eight-point algorithm), made singular.
pub fn eight_points(points: impl Iterator<Item = ([DVec2; 2], f64)> + Clone) -> Option<DMat3> {
    let (from_a, from_b) = (normalization(points.clone(), 0)?, normalization(points.clone(), 1)?);
    let mut normal = [[0.0; 9]; 9];
    for ([a, b], weight) in points {
        let row = epipolar_row([apply(&from_a, a), apply(&from_b, b)]);
        for i in 0..9 {
            let weighted = weight * row[i];
            for j in 0..=i {
                normal[i][j] += weighted * row[j];
            }
        }
    }
    for i in 0..9 {
        for j in i + 1..9 {
            normal[i][j] = normal[j][i];
        }
    }
    let (_, vectors) = symmetric_eigen(normal);
    let (u, s, v) = svd3(DMat3::from_cols_array(&vectors[0]));
    let singular = u * DMat3::from_diagonal(s.with_z(0.0)) * v.transpose();
    Some(from_b.transpose() * singular * from_a)
}

/// The similarity that moves the points' mean to the origin and scales their mean distance from it to sqrt(2) (Hartley 1997).
pub(super) fn normalization(points: impl Iterator<Item = ([DVec2; 2], f64)> + Clone, side: usize) -> Option<DMat3> {
    let mut sum = DVec2::ZERO;
    let mut total = 0.0;
    for (p, weight) in points.clone() {
        sum += weight * p[side];
        total += weight;
    }
    let mean = sum / total;
    let distance: f64 = points
        .map(|(p, weight)| weight * (p[side] - mean).length())
        .sum::<f64>()
        / total;
    let scale = std::f64::consts::SQRT_2 / distance;
    scale
        .is_finite()
        .then(|| DMat3::from_cols_array(&[scale, 0.0, 0.0, 0.0, scale, 0.0, -scale * mean.x, -scale * mean.y, 1.0]))
}

pub(super) fn apply(similarity: &DMat3, p: DVec2) -> DVec2 {
    similarity.x_axis.x * p + similarity.z_axis.truncate()
}

/// Estimation of the fundamental matrix from correspondences.
pub struct Fundamental<'a> {
    /// The correspondences.
    pub points: &'a Correspondences,
    /// Maximum Sampson distance of an inlier.
    pub threshold: f64,
}

impl Estimator for Fundamental<'_> {
    type Model = DMat3;
    const SAMPLE: usize = 7;

    fn observations(&self) -> usize {
        self.points.points.len()
    }

    fn fit(&self, sample: &[usize], models: &mut Vec<DMat3>) {
        seven_points(&std::array::from_fn(|i| self.points.points[sample[i]]), models);
    }

    fn cost(&self, model: &DMat3) -> (f64, usize) {
        self.points.epipolar_cost(model, self.threshold)
    }

    fn refine(&self, model: &DMat3) -> Option<DMat3> {
        let limit = self.threshold * self.threshold;
        let weighted = self.points.points.iter().filter_map(|p| {
            let squared = sampson_squared(model, *p);
            // The Sampson denominator turns the algebraic error into a distance.
            (squared < limit).then(|| {
                let (b, a) = (*model * p[0].extend(1.0), model.transpose() * p[1].extend(1.0));
                (
                    *p,
                    1.0 / (a.truncate().length_squared() + b.truncate().length_squared()),
                )
            })
        });
        if weighted.clone().count() < 8 {
            return None;
        }
        eight_points(weighted)
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::TwoViews;
    use super::*;

    #[test]
    fn seven_points_contain_the_true_matrix() {
        for seed in 0..20 {
            let views = TwoViews::new(seed, 30, 0.0);
            let mut models = Vec::new();
            seven_points(&std::array::from_fn(|i| views.points[i]), &mut models);
            let best = models
                .iter()
                .map(|f| views.points.iter().map(|p| sampson_squared(f, *p)).fold(0.0, f64::max))
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-14, "{seed}: {best}");
        }
    }

    #[test]
    fn eight_points_average_noise() {
        let views = TwoViews::new(3, 200, 1e-3);
        let f = eight_points(views.points.iter().map(|p| (*p, 1.0))).expect("points in general position");
        let mean = views.points.iter().map(|p| sampson_squared(&f, *p)).sum::<f64>() / 200.0;
        // With noise s on all four coordinates, the root mean square of the Sampson distance is s.
        assert!(mean.sqrt() < 1.1e-3, "{}", mean.sqrt());
        assert!(f.determinant().abs() < 1e-9 * f.x_axis.length_squared().max(1.0));
    }
}
