//! Intrinsics in double precision, with the derivatives that bundle adjustment needs.

use glam::{DVec2, DVec3};
use irradia_scene::{Intrinsics, Lens};

/// Number of parameters: fx, fy, cx, cy, then k1, k2, p1, p2, or k1 to k4 of a fisheye.
pub const PARAMETERS: usize = 8;

/// Maximum angle from a fisheye's axis that is used, radians: beyond it, points on the plane z = 1, on which poses are estimated, are too
/// far out.
const MAX_FISHEYE_ANGLE_RADIANS: f64 = 1.35;

/// Intrinsics of a camera with OpenCV's first four lens coefficients (COLMAP's `OPENCV`), or of a fisheye (`OPENCV_FISHEYE`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DCamera {
    /// Width of the photographs, px.
    pub width: u32,
    /// Height of the photographs, px.
    pub height: u32,
    /// fx, fy, cx, cy in px, then k1, k2, p1, p2, or k1 to k4 of a fisheye; the first pixel's centre is at 0.5.
    pub parameters: [f64; PARAMETERS],
    /// Whether the distance from the centre is a function of the angle from the axis, not of its tangent.
    pub fisheye: bool,
}

/// A projection and its derivatives.
#[derive(Clone, Copy, Debug)]
pub struct Projection {
    /// Pixels.
    pub at: DVec2,
    /// d at / d (point in camera axes): rows of x and of y.
    pub point_jacobian: [DVec3; 2],
    /// d at / d parameters: rows of x and of y.
    pub camera_jacobian: [[f64; PARAMETERS]; 2],
}

impl DCamera {
    /// A camera without distortion whose principal point is the image's centre.
    pub fn centered(width: u32, height: u32, focal: f64) -> Self {
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        Self {
            width,
            height,
            parameters: [focal, focal, cx, cy, 0.0, 0.0, 0.0, 0.0],
            fisheye: false,
        }
    }

    /// The camera with the focal lengths and principal point of `k`, whose lens is ignored.
    pub fn pinhole(k: &Intrinsics) -> Self {
        Self {
            width: k.width,
            height: k.height,
            parameters: [k.fx, k.fy, k.cx, k.cy, 0.0, 0.0, 0.0, 0.0].map(f64::from),
            fisheye: false,
        }
    }

    /// The longer side of its photographs, px.
    pub fn long_side(&self) -> f64 {
        f64::from(self.width.max(self.height))
    }

    /// Distance of the principal point from the centre, px.
    pub fn principal_offset(&self) -> f64 {
        let [_, _, cx, cy, ..] = self.parameters;
        (cx - 0.5 * f64::from(self.width)).hypot(cy - 0.5 * f64::from(self.height))
    }

    /// The camera without tangential distortion, which a fisheye does not have.
    pub fn without_tangential(mut self) -> Self {
        if !self.fisheye {
            self.parameters[6..].fill(0.0);
        }
        self
    }

    /// The camera of photographs that are turned clockwise by `turns` quarter turns.
    pub fn turned(mut self, turns: u8) -> Self {
        for _ in 0..turns {
            let [fx, fy, cx, cy, k1, k2, k3, k4] = self.parameters;
            // Tangential coefficients turn like a vector; those of a fisheye are all radial.
            let last = if self.fisheye { [k3, k4] } else { [k4, -k3] };
            self.parameters = [fy, fx, f64::from(self.height) - cy, cx, k1, k2, last[0], last[1]];
            (self.width, self.height) = (self.height, self.width);
        }
        self
    }

    /// Pixels per unit of the plane z = 1, averaged over both axes.
    pub fn focal(&self) -> f64 {
        0.5 * (self.parameters[0] + self.parameters[1])
    }

    /// The lens.
    pub fn lens(&self) -> Lens {
        let [.., k1, k2, p1, p2] = self.parameters;
        if self.fisheye {
            return Lens::fisheye([k1, k2, p1, p2]);
        }
        if [k1, k2, p1, p2] == [0.0; 4] {
            return Lens::Pinhole;
        }
        Lens::Opencv {
            k: [k1, k2, 0.0, 0.0, 0.0, 0.0],
            p: [p1, p2],
        }
    }

    /// Pixels per unit of the plane z = 1 at the point `p` of it: of a fisheye in the radial direction, in which it has the fewest; of a
    /// perspective lens at its centre, since its distortion is neglected.
    pub fn focal_at(&self, p: DVec2) -> f64 {
        if self.fisheye {
            self.focal() * self.fisheye_radius_slope(p.length().atan()) / (1.0 + p.length_squared())
        } else {
            self.focal()
        }
    }

    /// The pixel of a point in camera axes, in front of the camera.
    #[inline(always)]
    pub fn pixel(&self, p: DVec3) -> DVec2 {
        let [fx, fy, cx, cy, ..] = self.parameters;
        let (x, y) = (p.x / p.z, p.y / p.z);
        let d = self.distort(x, y);
        DVec2::new(fx * d.x + cx, fy * d.y + cy)
    }

    /// Whether the lens shows the point `p` of the plane z = 1: up to the angle at which distances from the centre stop growing. Beyond it,
    /// [`Self::pixel`] returns to the photograph.
    pub fn is_shown(&self, p: DVec2) -> bool {
        if self.fisheye {
            let theta = p.length().atan();
            return theta < MAX_FISHEYE_ANGLE_RADIANS && self.fisheye_radius_slope(theta) > 0.0;
        }
        // The slope of r (1 + k1 r^2 + k2 r^4) is 1 + 3 k1 r^2 + 5 k2 r^4. The smallest positive root r^2 is 2 / turn.
        let [.., k1, k2, _, _] = self.parameters;
        let turn = -3.0 * k1 + (9.0 * k1 * k1 - 20.0 * k2).sqrt();
        // Without a root, `turn` is not a number.
        turn.is_nan() || turn * p.length_squared() < 2.0
    }

    /// The distance from the centre, in focal lengths, at which a fisheye shows the angle `theta` from its axis.
    fn fisheye_radius(&self, theta: f64) -> f64 {
        let [.., k1, k2, k3, k4] = self.parameters;
        let t2 = theta * theta;
        theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    }

    /// d [`Self::fisheye_radius`] / d theta.
    fn fisheye_radius_slope(&self, theta: f64) -> f64 {
        let [.., k1, k2, k3, k4] = self.parameters;
        let t2 = theta * theta;
        1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    }

    /// A fisheye's distance from the centre divided by the distance r on the plane z = 1, and the derivative of this ratio by r, divided
    /// by r.
    fn fisheye_scale(&self, x: f64, y: f64) -> [f64; 2] {
        let r2 = x * x + y * y;
        // The first terms of both series, where the differences below would cancel.
        if r2 < 1e-8 {
            let slope = self.parameters[4] - 1.0 / 3.0;
            return [1.0 + slope * r2, 2.0 * slope];
        }
        let r = r2.sqrt();
        let theta = r.atan();
        let scale = self.fisheye_radius(theta) / r;
        [scale, (self.fisheye_radius_slope(theta) / (1.0 + r2) - scale) / r2]
    }

    #[inline(always)]
    fn distort(&self, x: f64, y: f64) -> DVec2 {
        if self.fisheye {
            return DVec2::new(x, y) * self.fisheye_scale(x, y)[0];
        }
        let [.., k1, k2, p1, p2] = self.parameters;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        DVec2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// d distorted / d (x, y): `[[xx, xy], [yx, yy]]`; symmetric.
    #[inline(always)]
    fn distort_derivative(&self, x: f64, y: f64) -> [f64; 3] {
        if self.fisheye {
            let [scale, slope] = self.fisheye_scale(x, y);
            return [scale + x * x * slope, x * y * slope, scale + y * y * slope];
        }
        let [.., k1, k2, p1, p2] = self.parameters;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        let slope = 2.0 * (k1 + 2.0 * k2 * r2);
        [
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        ]
    }

    /// The pixel of a point in camera axes, in front of the camera, with derivatives.
    #[inline(always)]
    pub fn project(&self, p: DVec3) -> Projection {
        let [fx, fy, cx, cy, ..] = self.parameters;
        let inverse = 1.0 / p.z;
        let (x, y) = (p.x * inverse, p.y * inverse);
        let r2 = x * x + y * y;
        let DVec2 { x: dx, y: dy } = self.distort(x, y);
        let [xx, xy, yy] = self.distort_derivative(x, y);
        let row = |f: f64, a: f64, b: f64| DVec3::new(f * a, f * b, -f * (a * x + b * y)) * inverse;
        let lens_jacobian = self.lens_jacobian(x, y, r2);
        let [of_x, of_y] = [0, 1].map(|axis| lens_jacobian.map(|d| [fx, fy][axis] * d[axis]));
        Projection {
            at: DVec2::new(fx * dx + cx, fy * dy + cy),
            point_jacobian: [row(fx, xx, xy), row(fy, xy, yy)],
            camera_jacobian: [
                [dx, 0.0, 1.0, 0.0, of_x[0], of_x[1], of_x[2], of_x[3]],
                [0.0, dy, 0.0, 1.0, of_y[0], of_y[1], of_y[2], of_y[3]],
            ],
        }
    }

    /// d distorted / d lens coefficients, of x and of y for each.
    #[inline(always)]
    fn lens_jacobian(&self, x: f64, y: f64, r2: f64) -> [[f64; 2]; 4] {
        if self.fisheye {
            let r = r2.sqrt();
            let theta = r.atan();
            let t2 = theta * theta;
            let first = if r > 1e-4 { theta * t2 / r } else { t2 };
            return [1.0, t2, t2 * t2, t2 * t2 * t2].map(|power| [x * first * power, y * first * power]);
        }
        [
            [x * r2, y * r2],
            [x * r2 * r2, y * r2 * r2],
            [2.0 * x * y, r2 + 2.0 * y * y],
            [r2 + 2.0 * x * x, 2.0 * x * y],
        ]
    }

    /// The point of the plane z = 1 that projects to `pixel`, by Newton's method; `None` where the lens is not invertible.
    pub fn unproject(&self, pixel: DVec2) -> Option<DVec2> {
        let [fx, fy, cx, cy, ..] = self.parameters;
        let target = DVec2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
        if self.fisheye {
            return self.unproject_fisheye(target);
        }
        let mut p = target;
        for _ in 0..20 {
            let error = self.distort(p.x, p.y) - target;
            let [xx, xy, yy] = self.distort_derivative(p.x, p.y);
            let det = xx * yy - xy * xy;
            if det.is_nan() || det <= 1e-6 || xx <= 0.0 {
                return None;
            }
            let step = DVec2::new(yy * error.x - xy * error.y, xx * error.y - xy * error.x) / det;
            p -= step;
            if step.length_squared() < 1e-22 {
                return Some(p);
            }
        }
        None
    }

    /// Like [`Self::unproject`], for a position in focal lengths from the centre.
    fn unproject_fisheye(&self, target: DVec2) -> Option<DVec2> {
        let distance = target.length();
        let mut theta = distance.min(MAX_FISHEYE_ANGLE_RADIANS);
        for _ in 0..20 {
            let slope = self.fisheye_radius_slope(theta);
            if slope.is_nan() || slope <= 1e-6 {
                return None;
            }
            let step = (self.fisheye_radius(theta) - distance) / slope;
            theta -= step;
            if step.abs() < 1e-12 {
                let scale = if distance > 1e-12 { theta.tan() / distance } else { 1.0 };
                return (0.0..MAX_FISHEYE_ANGLE_RADIANS)
                    .contains(&theta)
                    .then(|| target * scale);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> DCamera {
        DCamera {
            width: 640,
            height: 480,
            parameters: [500.0, 510.0, 322.0, 239.0, 0.06, -0.08, -0.001, 0.002],
            fisheye: false,
        }
    }

    fn fisheye() -> DCamera {
        DCamera {
            parameters: [300.0, 305.0, 322.0, 239.0, 0.03, -0.01, 0.002, -0.0005],
            fisheye: true,
            ..camera()
        }
    }

    #[test]
    fn a_turned_camera_sees_turned_photographs() {
        let p = DVec3::new(0.7, -0.5, 2.0);
        for camera in [camera(), fisheye()] {
            let [at, turned] = [camera.pixel(p), camera.turned(1).pixel(DVec3::new(-p.y, p.x, p.z))];
            assert!(turned.distance(DVec2::new(480.0 - at.y, at.x)) < 1e-9, "{turned}");
            assert_eq!([camera.turned(1).width, camera.turned(1).height], [480, 640]);
            assert_eq!(camera.turned(3).turned(1), camera);
        }
    }

    #[test]
    fn derivatives_match_finite_differences() {
        for p in [DVec3::new(0.7, -0.5, 2.0), DVec3::new(1e-5, 2e-5, 1.0)] {
            check_derivatives(camera(), p);
            check_derivatives(fisheye(), p);
        }
        check_derivatives(fisheye(), DVec3::new(3.0, -2.0, 1.0));
    }

    fn check_derivatives(camera: DCamera, p: DVec3) {
        const H: f64 = 1e-6;
        let projection = camera.project(p);
        assert_eq!(projection.at, camera.pixel(p));
        for axis in 0..3 {
            let step = DVec3::AXES[axis] * H;
            let numeric = (camera.pixel(p + step) - camera.pixel(p - step)) / (2.0 * H);
            for row in 0..2 {
                assert!(
                    (projection.point_jacobian[row][axis] - numeric[row]).abs() < 1e-5,
                    "{row} {axis}"
                );
            }
        }
        for parameter in 0..PARAMETERS {
            let moved = |by: f64| {
                let mut moved = camera;
                moved.parameters[parameter] += by;
                moved.pixel(p)
            };
            let numeric = (moved(H) - moved(-H)) / (2.0 * H);
            for row in 0..2 {
                assert!(
                    (projection.camera_jacobian[row][parameter] - numeric[row]).abs() < 1e-5,
                    "{row} {parameter}"
                );
            }
        }
    }

    #[test]
    fn unproject_inverts_pixel_and_agrees_with_the_scene_s_lens() {
        let camera = camera();
        for p in [DVec2::ZERO, DVec2::new(0.5, -0.4), DVec2::new(-0.6, 0.2)] {
            let pixel = camera.pixel(p.extend(1.0));
            assert!((camera.unproject(pixel).expect("invertible") - p).length() < 1e-11);
            let distorted = camera.lens().distort(p);
            assert!((pixel - DVec2::new(500.0 * distorted.x + 322.0, 510.0 * distorted.y + 239.0)).length() < 1e-10);
        }
        let fisheye = fisheye();
        for p in [DVec2::ZERO, DVec2::new(0.5, -0.4), DVec2::new(-3.6, 2.2)] {
            let pixel = fisheye.pixel(p.extend(1.0));
            assert!((fisheye.unproject(pixel).expect("invertible") - p).length() < 1e-9);
            let distorted = fisheye.lens().distort(p);
            assert!((pixel - DVec2::new(300.0 * distorted.x + 322.0, 305.0 * distorted.y + 239.0)).length() < 1e-9);
            let moved = fisheye.pixel((p * 1.000_001).extend(1.0)) - pixel;
            let slope = moved.length() / (1e-6 * p.length().max(1e-12));
            assert!(p == DVec2::ZERO || (slope / fisheye.focal_at(p) - 1.0).abs() < 0.02);
        }
        assert_eq!(
            fisheye.unproject(DVec2::new(322.0 + 300.0 * 1.5, 239.0)),
            None,
            "too wide"
        );
        let mut folded = camera;
        // Its distances from the centre, r (1 - r^2 / 4), grow up to r^2 = 4 / 3.
        folded.parameters[4..].copy_from_slice(&[-0.25, 0.0, 0.0, 0.0]);
        for (r, is_shown) in [(0.0, true), (1.15, true), (1.16, false), (2.0, false), (9.0, false)] {
            assert_eq!(folded.is_shown(DVec2::new(r, 0.0)), is_shown, "{r}");
            assert!(fisheye.is_shown(DVec2::new(0.0, r)) == (r < 4.0) && camera.is_shown(0.1 * DVec2::Y * r));
        }
        assert!(DCamera::centered(10, 10, 5.0).is_shown(DVec2::new(1e9, 0.0)));
        folded.parameters[4] = -2.0;
        assert_eq!(folded.unproject(DVec2::new(5000.0, 239.0)), None);
        assert_eq!(DCamera::centered(10, 10, 5.0).lens(), Lens::Pinhole);
    }
}
