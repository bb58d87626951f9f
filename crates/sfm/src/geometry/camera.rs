//! Intrinsics in double precision, with the derivatives that bundle adjustment needs.

use glam::{DVec2, DVec3};
use irradia_scene::Lens;

/// Number of parameters: fx, fy, cx, cy, k1, k2, p1, p2.
pub const PARAMETERS: usize = 8;

/// Intrinsics of a camera with OpenCV's first four lens coefficients (COLMAP's `OPENCV`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DCamera {
    /// Photographs' width, px.
    pub width: u32,
    /// Photographs' height, px.
    pub height: u32,
    /// fx, fy, cx, cy in px, then k1, k2, p1, p2; the first pixel's centre is at 0.5.
    pub parameters: [f64; PARAMETERS],
}

/// A projection and its derivatives.
#[derive(Clone, Copy, Debug)]
pub struct Projection {
    /// Pixels.
    pub at: DVec2,
    /// d at / d (point in camera axes): rows of x and of y.
    pub by_point: [DVec3; 2],
    /// d at / d parameters: rows of x and of y.
    pub by_camera: [[f64; PARAMETERS]; 2],
}

impl DCamera {
    /// A camera without distortion whose principal point is the image's centre.
    pub fn centered(width: u32, height: u32, focal: f64) -> Self {
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        Self {
            width,
            height,
            parameters: [focal, focal, cx, cy, 0.0, 0.0, 0.0, 0.0],
        }
    }

    /// Pixels per unit of the plane z = 1, averaged over both axes.
    pub fn focal(&self) -> f64 {
        0.5 * (self.parameters[0] + self.parameters[1])
    }

    /// The lens.
    pub fn lens(&self) -> Lens {
        let [.., k1, k2, p1, p2] = self.parameters;
        if [k1, k2, p1, p2] == [0.0; 4] {
            return Lens::Pinhole;
        }
        Lens::Opencv {
            k: [k1, k2, 0.0, 0.0, 0.0, 0.0],
            p: [p1, p2],
        }
    }

    /// Pixels of a point in camera axes, in front of the camera.
    #[inline(always)]
    pub fn pixel(&self, p: DVec3) -> DVec2 {
        let [fx, fy, cx, cy, ..] = self.parameters;
        let (x, y) = (p.x / p.z, p.y / p.z);
        let d = self.distort(x, y);
        DVec2::new(fx * d.x + cx, fy * d.y + cy)
    }

    #[inline(always)]
    fn distort(&self, x: f64, y: f64) -> DVec2 {
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

    /// Pixels of a point in camera axes, in front of the camera, with derivatives.
    #[inline(always)]
    pub fn project(&self, p: DVec3) -> Projection {
        let [fx, fy, cx, cy, ..] = self.parameters;
        let inverse = 1.0 / p.z;
        let (x, y) = (p.x * inverse, p.y * inverse);
        let r2 = x * x + y * y;
        let DVec2 { x: dx, y: dy } = self.distort(x, y);
        let [xx, xy, yy] = self.distort_derivative(x, y);
        let row = |f: f64, a: f64, b: f64| DVec3::new(f * a, f * b, -f * (a * x + b * y)) * inverse;
        Projection {
            at: DVec2::new(fx * dx + cx, fy * dy + cy),
            by_point: [row(fx, xx, xy), row(fy, xy, yy)],
            by_camera: [
                [
                    dx,
                    0.0,
                    1.0,
                    0.0,
                    fx * x * r2,
                    fx * x * r2 * r2,
                    fx * 2.0 * x * y,
                    fx * (r2 + 2.0 * x * x),
                ],
                [
                    0.0,
                    dy,
                    0.0,
                    1.0,
                    fy * y * r2,
                    fy * y * r2 * r2,
                    fy * (r2 + 2.0 * y * y),
                    fy * 2.0 * x * y,
                ],
            ],
        }
    }

    /// The point of the plane z = 1 that projects to `pixel`, by Newton's method; `None` where the lens is not invertible.
    pub fn unproject(&self, pixel: DVec2) -> Option<DVec2> {
        let [fx, fy, cx, cy, ..] = self.parameters;
        let target = DVec2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
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
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> DCamera {
        DCamera {
            width: 640,
            height: 480,
            parameters: [500.0, 510.0, 322.0, 239.0, 0.06, -0.08, -0.001, 0.002],
        }
    }

    #[test]
    fn derivatives_match_finite_differences() {
        const H: f64 = 1e-6;
        let (camera, p) = (camera(), DVec3::new(0.7, -0.5, 2.0));
        let projection = camera.project(p);
        assert_eq!(projection.at, camera.pixel(p));
        for axis in 0..3 {
            let step = DVec3::AXES[axis] * H;
            let numeric = (camera.pixel(p + step) - camera.pixel(p - step)) / (2.0 * H);
            for row in 0..2 {
                assert!(
                    (projection.by_point[row][axis] - numeric[row]).abs() < 1e-5,
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
                    (projection.by_camera[row][parameter] - numeric[row]).abs() < 1e-5,
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
        let mut folded = camera;
        folded.parameters[4] = -2.0;
        assert_eq!(folded.unproject(DVec2::new(5000.0, 239.0)), None);
        assert_eq!(DCamera::centered(10, 10, 5.0).lens(), Lens::Pinhole);
    }
}
