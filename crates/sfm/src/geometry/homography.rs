//! The homography `h`: `b ~ h a` for points on a plane, or of any scene seen from one place.

use super::correspondences::{Correspondences, transfer_squared};
use super::fundamental::{apply, normalization};
use super::linear::{closest_rotation, null_space, symmetric_eigen};
use super::ransac::Estimator;
use glam::{DMat3, DVec2, DVec3};

/// Two rows of `b cross h a = 0` in the entries of `h`, column by column.
fn transfer_rows([a, b]: [DVec2; 2]) -> [[f64; 9]; 2] {
    [
        [0.0, -a.x, b.y * a.x, 0.0, -a.y, b.y * a.y, 0.0, -1.0, b.y],
        [a.x, 0.0, -b.x * a.x, a.y, 0.0, -b.x * a.y, 1.0, 0.0, -b.x],
    ]
}

/// The homography through four points; `None` if three are on a line.
pub fn four_points(points: &[[DVec2; 2]; 4]) -> Option<DMat3> {
    let mut rows = [[0.0; 9]; 8];
    for (i, p) in points.iter().enumerate() {
        [rows[2 * i], rows[2 * i + 1]] = transfer_rows(*p);
    }
    let [h] = null_space::<8, 9, 1>(rows)?;
    let h = DMat3::from_cols_array(&h);
    (h.determinant().abs() > 1e-12).then_some(h)
}

/// The homography that minimises the algebraic error over all points.
pub fn linear_homography(points: impl Iterator<Item = [DVec2; 2]> + Clone) -> Option<DMat3> {
    let weighted = points.clone().map(|p| (p, 1.0));
    let (from_a, from_b) = (normalization(weighted.clone(), 0)?, normalization(weighted, 1)?);
    let mut normal = [[0.0; 9]; 9];
    for [a, b] in points {
        for row in transfer_rows([apply(&from_a, a), apply(&from_b, b)]) {
            for i in 0..9 {
                for j in 0..9 {
                    normal[i][j] += row[i] * row[j];
                }
            }
        }
    }
    let (_, vectors) = symmetric_eigen(normal);
    Some(from_b.inverse() * DMat3::from_cols_array(&vectors[0]) * from_a)
}

/// The rotation that best maps the first bearings onto the second (Kabsch 1976).
pub fn rotation_between(points: impl Iterator<Item = [DVec2; 2]>) -> DMat3 {
    let mut sum = DMat3::ZERO;
    for [a, b] in points {
        let (a, b): (DVec3, DVec3) = (a.extend(1.0).normalize(), b.extend(1.0).normalize());
        sum += DMat3::from_cols(b * a.x, b * a.y, b * a.z);
    }
    closest_rotation(sum)
}

/// Whether `rotation` maps the first of two points to the second with an error below `threshold` in the second photograph.
pub fn rotates(rotation: &DMat3, [a, b]: [DVec2; 2], threshold: f64) -> bool {
    let rotated = *rotation * a.extend(1.0);
    rotated.z > 0.0 && (rotated.truncate() / rotated.z - b).length() < threshold
}

/// How many of `points` a rotation explains with errors below `threshold` in the second photograph. The rotation is fitted to all points,
/// then again to those within each of the distances `coarse_thresholds`. Points that are not numbers are left out.
pub fn count_rotation_inliers(points: &[[DVec2; 2]], coarse_thresholds: &[f64], threshold: f64) -> usize {
    let finite = points.iter().copied().filter(|p| p.iter().all(|at| at.is_finite()));
    let mut rotation = rotation_between(finite);
    for within in coarse_thresholds {
        rotation = rotation_between(points.iter().copied().filter(|p| rotates(&rotation, *p, *within)));
    }
    points.iter().filter(|p| rotates(&rotation, **p, threshold)).count()
}

/// Estimation of the homography from correspondences.
pub struct Homography<'a> {
    /// The correspondences.
    pub points: &'a Correspondences,
    /// Maximum distance of an inlier in the second photograph.
    pub threshold: f64,
}

impl Estimator for Homography<'_> {
    type Model = DMat3;
    const SAMPLE: usize = 4;

    fn observations(&self) -> usize {
        self.points.points.len()
    }

    fn fit(&self, sample: &[usize], models: &mut Vec<DMat3>) {
        models.extend(four_points(&std::array::from_fn(|i| self.points.points[sample[i]])));
    }

    fn cost(&self, model: &DMat3) -> (f64, usize) {
        self.points.transfer_cost(model, self.threshold)
    }

    fn refine(&self, model: &DMat3) -> Option<DMat3> {
        let limit = self.threshold * self.threshold;
        let inliers = self
            .points
            .points
            .iter()
            .copied()
            .filter(|p| transfer_squared(model, *p) < limit);
        linear_homography(inliers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn plane() -> Vec<[DVec2; 2]> {
        let h = DMat3::from_cols_array(&[1.1, 0.1, 0.2, -0.05, 0.9, -0.1, 0.3, -0.2, 1.0]);
        (0..25)
            .map(|i| {
                let a = DVec2::new(f64::from(i % 5) * 0.2 - 0.4, f64::from(i / 5) * 0.17 - 0.3);
                let b = h * a.extend(1.0);
                [a, b.truncate() / b.z]
            })
            .collect()
    }

    #[test]
    fn four_points_and_all_points_give_the_plane() {
        let points = plane();
        let exact = four_points(&[points[0], points[4], points[20], points[23]]).expect("no three on a line");
        let linear = linear_homography(points.iter().copied()).expect("in general position");
        for p in &points {
            assert!(transfer_squared(&exact, *p) < 1e-20);
            assert!(transfer_squared(&linear, *p) < 1e-20);
        }
        assert!(four_points(&[points[0], points[1], points[2], points[23]]).is_none());
    }

    #[test]
    fn a_turn_is_recovered() {
        let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.1, -0.3, 0.2);
        let points = plane().into_iter().map(|[a, _]| {
            let b = turn * a.extend(1.0);
            [a, b.truncate() / b.z]
        });
        assert!(rotation_between(points.clone()).abs_diff_eq(DMat3::from_quat(turn), 1e-12));
        let with_nan: Vec<[DVec2; 2]> = points.chain([[DVec2::NAN, DVec2::ZERO]]).collect();
        assert_eq!(count_rotation_inliers(&with_nan, &[0.1], 1e-6), 25);
    }
}
