//! A camera's pose from world points: from three points, from all points, and robustly.

use super::linear::{cubic_roots, solve_spd, symmetric_eigen};
use super::pose::DPose;
use super::ransac::{Estimate, Estimator, Limits, estimate};
use glam::{DMat3, DQuat, DVec2, DVec3};
use irradia_compute::simd::{Kernel, Lanes, Level, Mask, Simd};
use irradia_compute::unroll;

/// The poses, at most four, from which three points appear in the directions `bearings`, unit vectors
/// (Persson and Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver", 2018).
pub fn three_points(bearings: [DVec3; 3], points: [DVec3; 3], poses: &mut Vec<DPose>) {
    let [y1, y2, y3] = bearings;
    let [x1, x2, x3] = points;
    let (d12, d13, d23) = (x1 - x2, x1 - x3, x2 - x3);
    let normal = d12.cross(d13);
    let (a12, a13, a23) = (d12.length_squared(), d13.length_squared(), d23.length_squared());
    let (c12, c13, c23) = (y1.dot(y2), y1.dot(y3), y2.dot(y3));
    let (b12, b13, b23) = (-2.0 * c12, -2.0 * c13, -2.0 * c23);
    let blob = c12 * c23 * c13 - 1.0;
    let (s12, s13, s23) = (1.0 - c12 * c12, 1.0 - c13 * c13, 1.0 - c23 * c23);
    // The pencil of the two quadrics in the depths is degenerate at a root of this cubic.
    let p3 = a13 * (a23 * s13 - a13 * s23);
    let p2 = 2.0 * blob * a23 * a13 + a13 * (2.0 * a12 + a13) * s23 + a23 * (a23 - a12) * s13;
    let p1 = a23 * (a13 - a23) * s12 - a12 * a12 * s23 - 2.0 * a12 * (blob * a23 + a13 * s23);
    let p0 = a12 * (a12 * s23 - a23 * s12);
    let Some(g) = cubic_roots([p0, p1, p2, p3]).next() else {
        return;
    };
    let a01 = 0.5 * a23 * b12;
    let a02 = -0.5 * a23 * b13 * g;
    let a12_ = 0.5 * b23 * (a13 * g - a12);
    let (values, vectors) = symmetric_eigen([
        [a23 * (1.0 - g), a01, a02],
        [a01, a23 - a12 + a13 * g, a12_],
        [a02, a12_, g * (a13 - a23) - a12],
    ]);
    // One eigenvalue is zero, the others have opposite signs: the degenerate quadric is two planes.
    let ratio = -values[2] / values[0];
    if !ratio.is_finite() || normal.length_squared() == 0.0 {
        return;
    }
    let slope = ratio.max(0.0).sqrt();
    let (v, w) = (vectors[0], vectors[2]);
    let inverse = DMat3::from_cols(d12, d13, normal).inverse();
    for s in [slope, -slope] {
        let w2 = 1.0 / (s * w[0] - v[0]);
        let (w0, w1) = ((v[1] - s * w[1]) * w2, (v[2] - s * w[2]) * w2);
        let a = 1.0 / ((a13 - a12) * w1 * w1 - a12 * b13 * w1 - a12);
        let b = (a13 * b12 * w1 - a12 * b13 * w0 - 2.0 * w0 * w1 * (a12 - a13)) * a;
        let c = ((a13 - a12) * w0 * w0 + a13 * b12 * w0 + a13) * a;
        let discriminant = b * b - 4.0 * c;
        if discriminant.is_nan() || discriminant < 0.0 {
            continue;
        }
        let far = -0.5 * (b + b.signum() * discriminant.sqrt());
        for tau in [far, c / far] {
            if tau.is_nan() || tau <= 0.0 {
                continue;
            }
            let squared = a23 / (tau * (b23 + tau) + 1.0);
            let l2 = squared.sqrt();
            let l3 = tau * l2;
            let l1 = w0 * l2 + w1 * l3;
            if l1.is_nan() || l1 < 0.0 {
                continue;
            }
            let [l1, l2, l3] = polish_depths([l1, l2, l3], [a12, a13, a23], [b12, b13, b23]);
            let (r1, r2, r3) = (y1 * l1, y2 * l2, y3 * l3);
            let (e12, e13) = (r1 - r2, r1 - r3);
            let rotation = DMat3::from_cols(e12, e13, e12.cross(e13)) * inverse;
            let pose = DPose::from_camera_from_world(DQuat::from_mat3(&rotation).normalize(), r1 - rotation * x1);
            if pose.is_finite() {
                poses.push(pose);
            }
        }
    }
}

/// Refines the depths `l` along the bearings by Newton steps on the three distances between the points.
fn polish_depths(mut l: [f64; 3], [a12, a13, a23]: [f64; 3], [b12, b13, b23]: [f64; 3]) -> [f64; 3] {
    for _ in 0..3 {
        let [l1, l2, l3] = l;
        let residual = DVec3::new(
            l1 * l1 + l2 * l2 + b12 * l1 * l2 - a12,
            l1 * l1 + l3 * l3 + b13 * l1 * l3 - a13,
            l2 * l2 + l3 * l3 + b23 * l2 * l3 - a23,
        );
        let jacobian = DMat3::from_cols(
            DVec3::new(2.0 * l1 + b12 * l2, 2.0 * l1 + b13 * l3, 0.0),
            DVec3::new(2.0 * l2 + b12 * l1, 0.0, 2.0 * l2 + b23 * l3),
            DVec3::new(0.0, 2.0 * l3 + b13 * l1, 2.0 * l3 + b23 * l2),
        );
        let step = jacobian.inverse() * residual;
        if !step.is_finite() {
            break;
        }
        l = [l1 - step.x, l2 - step.y, l3 - step.z];
    }
    l
}

/// World points and their projections in one photograph.
pub struct Resection {
    /// `[N]` undistorted projections on the plane z = 1, and world points.
    points: Vec<(DVec2, DVec3)>,
    /// x, y, z in the world and both coordinates of the projection, padded with NaN.
    planes: [Vec<f32>; 5],
    /// The origin of the planes: the mean of the points, so that `f32` is precise enough.
    origin: DVec3,
    /// Maximum error of an inlier on the plane z = 1.
    threshold: f64,
}

impl Resection {
    /// From projections and points.
    pub fn new(points: Vec<(DVec2, DVec3)>, threshold: f64) -> Self {
        let origin = points.iter().map(|p| p.1).sum::<DVec3>() / points.len().max(1) as f64;
        let padded = points.len().next_multiple_of(16);
        let plane = |value: &dyn Fn(&(DVec2, DVec3)) -> f64| {
            let mut plane: Vec<f32> = points.iter().map(|p| value(p) as f32).collect();
            plane.resize(padded, f32::NAN);
            plane
        };
        let planes = [
            plane(&|p| p.1.x - origin.x),
            plane(&|p| p.1.y - origin.y),
            plane(&|p| p.1.z - origin.z),
            plane(&|p| p.0.x),
            plane(&|p| p.0.y),
        ];
        Self {
            points,
            planes,
            origin,
            threshold,
        }
    }

    /// The best pose of the candidates `first` and of random samples.
    pub fn solve(&self, first: Vec<DPose>, limits: Limits) -> Option<Estimate<DPose>> {
        estimate(self, first, limits)
    }

    /// `[N]` whether each point is within the threshold.
    pub fn inliers(&self, pose: &DPose) -> Vec<bool> {
        self.points
            .iter()
            .map(|(at, point)| self.squared_error(pose, *at, *point) < self.threshold.powi(2))
            .collect()
    }

    fn squared_error(&self, pose: &DPose, at: DVec2, point: DVec3) -> f64 {
        let p = pose.camera_from_world(point);
        if p.z > 0.0 {
            (p.truncate() / p.z - at).length_squared()
        } else {
            f64::INFINITY
        }
    }
}

struct Cost<'a> {
    problem: &'a Resection,
    /// `x_camera = rotation x + translation`, column by column, with x relative to the origin.
    rotation: [f64; 9],
    translation: [f64; 3],
}

impl Kernel for Cost<'_> {
    type Output = (f64, usize);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> (f64, usize)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let [x, y, z, u, v] = &self.problem.planes;
        let m = unroll!(i in 9 => simd.splat(self.rotation[i]));
        let t = unroll!(i in 3 => simd.splat(self.translation[i]));
        let inverse = simd.splat(self.problem.threshold.powi(-2));
        let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
        let mut sum = zero;
        let mut inliers = 0;
        for i in (0..x.len()).step_by(S::LANES) {
            let (x, y, z) = (simd.load(&x[i..]), simd.load(&y[i..]), simd.load(&z[i..]));
            let p = unroll!(r in 3 => m[r].mul_add(x, m[3 + r].mul_add(y, m[6 + r].mul_add(z, t[r]))));
            let (dx, dy) = (p[0] / p[2] - simd.load(&u[i..]), p[1] / p[2] - simd.load(&v[i..]));
            let squared = dx.mul_add(dx, dy * dy) * inverse;
            let inside = squared.lt(one).and(zero.lt(p[2]));
            sum += squared.select(inside, one);
            inliers += inside.bits().count_ones();
        }
        let padding = (x.len() - self.problem.points.len()) as f64;
        (f64::from(sum.sum()) - padding, inliers as usize)
    }
}

impl Estimator for Resection {
    type Model = DPose;
    const SAMPLE: usize = 3;

    fn observations(&self) -> usize {
        self.points.len()
    }

    fn fit(&self, sample: &[usize], models: &mut Vec<DPose>) {
        let picked: [(DVec2, DVec3); 3] = std::array::from_fn(|i| self.points[sample[i]]);
        three_points(picked.map(|p| p.0.extend(1.0).normalize()), picked.map(|p| p.1), models);
    }

    fn cost(&self, pose: &DPose) -> (f64, usize) {
        let rotation = pose.camera_rotation();
        Level::detect().run(Cost {
            problem: self,
            rotation: rotation.to_cols_array(),
            translation: (rotation * (self.origin - pose.position)).to_array(),
        })
    }

    fn refine(&self, pose: &DPose) -> Option<DPose> {
        refine_pose(*pose, &self.points, self.threshold, 3)
    }
}

/// Gauss-Newton steps on the squared errors of the points within `threshold` on the plane z = 1.
pub fn refine_pose(start: DPose, points: &[(DVec2, DVec3)], threshold: f64, steps: usize) -> Option<DPose> {
    let mut pose = start;
    for _ in 0..steps {
        let rotation = pose.camera_rotation();
        let mut normal = [[0.0; 6]; 6];
        let mut gradient = [0.0; 6];
        for (at, point) in points {
            let p = rotation * (*point - pose.position);
            let error = p.truncate() / p.z - *at;
            if p.z <= 0.0 || error.length_squared() >= threshold * threshold {
                continue;
            }
            let (x, y, inverse) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
            let rows = rotation.transpose();
            let (sx, sy) = (
                (rows.z_axis * x - rows.x_axis) * inverse,
                (rows.z_axis * y - rows.y_axis) * inverse,
            );
            let j = [
                [-x * y, 1.0 + x * x, -y, sx.x, sx.y, sx.z],
                [-1.0 - y * y, x * y, x, sy.x, sy.y, sy.z],
            ];
            for i in 0..6 {
                gradient[i] -= j[0][i] * error.x + j[1][i] * error.y;
                for k in 0..=i {
                    normal[i][k] += j[0][i] * j[0][k] + j[1][i] * j[1][k];
                }
            }
        }
        for i in 0..6 {
            normal[i][i] *= 1.0 + 1e-9;
        }
        let step = solve_spd(normal, gradient)?;
        pose = pose.moved(
            DVec3::new(step[0], step[1], step[2]),
            DVec3::new(step[3], step[4], step[5]),
        );
    }
    pose.is_finite().then_some(pose)
}

#[cfg(test)]
mod tests {
    use super::super::testing::TwoViews;
    use super::*;

    fn view(seed: u64, noise: f64) -> (DPose, Vec<(DVec2, DVec3)>) {
        let views = TwoViews::new(seed, 100, noise);
        let pose = DPose::from_camera_from_world(views.motion.rotation, views.motion.translation);
        (pose, views.points.iter().map(|p| p[1]).zip(views.world).collect())
    }

    #[test]
    fn three_points_contain_the_true_pose() {
        for seed in 0..100 {
            let (truth, points) = view(seed, 0.0);
            let mut poses = Vec::new();
            let picked: [(DVec2, DVec3); 3] = std::array::from_fn(|i| points[i]);
            three_points(
                picked.map(|p| p.0.extend(1.0).normalize()),
                picked.map(|p| p.1),
                &mut poses,
            );
            assert!(poses.len() <= 4);
            let best = poses
                .iter()
                .map(|p| (p.position - truth.position).length() + p.rotation.angle_between(truth.rotation))
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-6, "{seed}: {best} of {poses:?}");
        }
    }

    #[test]
    fn a_pose_is_found_among_outliers() {
        let (truth, mut points) = view(5, 1e-3);
        let mut rng = irradia_scene::Rng::new(9, 9);
        for point in points.iter_mut().step_by(2) {
            point.0 = DVec2::new(f64::from(rng.range(-0.5, 0.5)), f64::from(rng.range(-0.5, 0.5)));
        }
        let problem = Resection::new(points, 4e-3);
        let limits = Limits {
            samples: 500,
            confidence: 0.9999,
            seed: 1,
        };
        let found = problem.solve(Vec::new(), limits).expect("a pose");
        assert!((48..=56).contains(&found.inliers), "{}", found.inliers);
        assert_eq!(
            problem.inliers(&found.model).iter().filter(|i| **i).count(),
            found.inliers
        );
        assert!((found.model.position - truth.position).length() < 0.01);
        assert!(found.model.rotation.angle_between(truth.rotation) < 0.003);
    }

    #[test]
    fn refinement_converges_quadratically() {
        let (truth, points) = view(6, 0.0);
        let start = truth.moved(DVec3::new(0.02, -0.01, 0.03), DVec3::new(0.05, 0.02, -0.04));
        let pose = refine_pose(start, &points, 1.0, 5).expect("converges");
        assert!((pose.position - truth.position).length() < 1e-9);
    }
}
