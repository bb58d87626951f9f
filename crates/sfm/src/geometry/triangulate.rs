//! Triangulation: a point from its projections.

use super::linear::solve_spd;
use super::pose::DPose;
use glam::{DMat3, DVec2, DVec3};

/// One camera's view of a point.
#[derive(Clone, Copy, Debug)]
pub struct ViewRay {
    /// From world to camera axes.
    pub rotation: DMat3,
    /// Camera centre, world.
    pub position: DVec3,
    /// The projection on the plane z = 1, undistorted.
    pub at: DVec2,
    /// Pixels per unit of that plane.
    pub focal: f64,
}

impl ViewRay {
    /// The ray of a camera at `pose`.
    pub fn new(pose: &DPose, at: DVec2, focal: f64) -> Self {
        Self {
            rotation: pose.camera_rotation(),
            position: pose.position,
            at,
            focal,
        }
    }

    /// Unit direction of the ray, world.
    pub fn direction(&self) -> DVec3 {
        self.rotation.transpose() * self.at.extend(1.0).normalize()
    }

    /// The squared reprojection error of `point`, px^2; infinite behind the camera.
    pub fn error_squared(&self, point: DVec3) -> f64 {
        let p = self.rotation * (point - self.position);
        if p.z <= 0.0 {
            return f64::INFINITY;
        }
        (p.truncate() / p.z - self.at).length_squared() * self.focal * self.focal
    }
}

/// The point with the smallest sum of squared distances to all rays; `None` if they are parallel.
pub fn midpoint(rays: impl Iterator<Item = ViewRay>) -> Option<DVec3> {
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    for ray in rays {
        let d = ray.direction();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * ray.position;
    }
    let point = solve_spd(normal.transpose().to_cols_array_2d(), right.to_array()).map(DVec3::from_array)?;
    point.is_finite().then_some(point)
}

/// Refines `start` by Gauss-Newton steps on the reprojection error in pixels.
pub fn refine_point(start: DVec3, rays: impl Iterator<Item = ViewRay> + Clone, steps: usize) -> Option<DVec3> {
    let mut point = start;
    for _ in 0..steps {
        let mut normal = [[0.0; 3]; 3];
        let mut gradient = [0.0; 3];
        for ray in rays.clone() {
            let p = ray.rotation * (point - ray.position);
            if p.z <= 0.0 {
                return None;
            }
            let inverse = ray.focal / p.z;
            let (x, y) = (p.x / p.z, p.y / p.z);
            let rows = ray.rotation.transpose();
            let (jx, jy) = (
                (rows.x_axis - rows.z_axis * x) * inverse,
                (rows.y_axis - rows.z_axis * y) * inverse,
            );
            let (rx, ry) = ((x - ray.at.x) * ray.focal, (y - ray.at.y) * ray.focal);
            for i in 0..3 {
                gradient[i] -= jx[i] * rx + jy[i] * ry;
                for j in 0..3 {
                    normal[i][j] += jx[i] * jx[j] + jy[i] * jy[j];
                }
            }
        }
        for i in 0..3 {
            normal[i][i] *= 1.0 + 1e-9;
        }
        let step = DVec3::from_array(solve_spd(normal, gradient)?);
        point += step;
        if step.length_squared() <= 1e-18 * point.length_squared() {
            break;
        }
    }
    point.is_finite().then_some(point)
}

/// The cosine of the angle at `point` between two camera centres.
pub fn cosine_at(point: DVec3, a: DVec3, b: DVec3) -> f64 {
    (a - point).normalize_or_zero().dot((b - point).normalize_or_zero())
}

#[cfg(test)]
mod tests {
    use super::super::testing::TwoViews;
    use super::*;

    #[test]
    fn points_are_recovered_and_noise_moves_them_little() {
        let exact = TwoViews::new(1, 50, 0.0);
        let noisy = TwoViews::new(1, 50, 1e-3);
        for (views, tolerance) in [(&exact, 1e-9), (&noisy, 0.3)] {
            let second = DPose::from_camera_from_world(views.motion.rotation, views.motion.translation);
            for (p, world) in views.points.iter().zip(&views.world) {
                let rays = [
                    ViewRay::new(&DPose::IDENTITY, p[0], 500.0),
                    ViewRay::new(&second, p[1], 500.0),
                ];
                let start = midpoint(rays.into_iter()).expect("rays meet");
                let point = refine_point(start, rays.into_iter(), 5).expect("in front");
                assert!(
                    (point - *world).length() < tolerance * world.length(),
                    "{point} {world}"
                );
                let error = |x| rays.iter().map(|s| s.error_squared(x)).sum::<f64>();
                assert!(error(point) <= error(start) + 1e-12);
            }
        }
    }

    #[test]
    fn parallel_rays_have_no_midpoint() {
        let beside = DPose {
            position: DVec3::X,
            ..DPose::IDENTITY
        };
        let rays = [DPose::IDENTITY, beside].map(|pose| ViewRay::new(&pose, DVec2::ZERO, 1.0));
        assert!(midpoint(rays.into_iter()).is_none_or(|p| p.length() > 1e6));
        let behind = DVec3::new(0.0, 0.0, -1.0);
        assert_eq!(rays[0].error_squared(behind), f64::INFINITY);
    }
}
