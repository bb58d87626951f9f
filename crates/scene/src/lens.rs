use glam::{DVec2, DVec3};
use std::f64::consts::PI;

/// The mapping of a lens from directions to its plane, in COLMAP's and OpenCV's parameters. A pixel is `(fx, fy)` times a point of the
/// plane plus the principal point.
///
/// Directions are those of the OpenCV camera: x right, y down, z forward.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub enum Lens {
    /// No distortion: the plane is that of `(X / Z, Y / Z)`.
    #[default]
    Pinhole,
    /// OpenCV's rational model (COLMAP `FULL_OPENCV`; `OPENCV`, `RADIAL` and `SIMPLE_RADIAL` by setting the rest to zero).
    Opencv {
        /// Radial coefficients k1..k6; k4..k6 form the denominator.
        k: [f64; 6],
        /// Tangential coefficients p1, p2.
        p: [f64; 2],
    },
    /// OpenCV's fisheye model (Kannala and Brandt 2006; COLMAP `OPENCV_FISHEYE`), `theta_d = theta (1 + k1 theta^2 + ..)`, with the terms
    /// that COLMAP's `THIN_PRISM_FISHEYE` adds.
    Fisheye {
        /// Radial coefficients k1..k4.
        k: [f64; 4],
        /// Tangential coefficients p1, p2.
        p: [f64; 2],
        /// Coefficients of a thin prism, sx1 and sy1.
        s: [f64; 2],
    },
    /// The field-of-view model (Devernay and Faugeras 2001; COLMAP `FOV`).
    Fov {
        /// The model's angle, radians.
        omega: f64,
    },
    /// A panorama of all directions: longitude to the right of straight ahead, and latitude below the horizon, in radians.
    Equirectangular,
}

impl Lens {
    /// Radial coefficients k1..k3 and tangential ones p1, p2 (Brown and Conrady).
    pub const fn brown([k1, k2, k3]: [f64; 3], p: [f64; 2]) -> Self {
        Lens::Opencv {
            k: [k1, k2, k3, 0.0, 0.0, 0.0],
            p,
        }
    }

    /// A fisheye without tangential distortion or prism.
    pub const fn fisheye(k: [f64; 4]) -> Self {
        Lens::Fisheye {
            k,
            p: [0.0; 2],
            s: [0.0; 2],
        }
    }

    /// Whether the lens can also see behind the camera.
    pub fn is_wide(&self) -> bool {
        matches!(self, Lens::Fisheye { .. } | Lens::Equirectangular)
    }

    /// The same lens without its tangential part and prism.
    fn radial(&self) -> Self {
        match *self {
            Lens::Opencv { k, .. } => Lens::Opencv { k, p: [0.0; 2] },
            Lens::Fisheye { k, .. } => Lens::fisheye(k),
            other => other,
        }
    }

    /// The radius on the undistorted plane, at most `largest`, up to which the lens is monotonic; infinite if it is monotonic all the way.
    /// Beyond it a polynomial folds back and would show the image twice.
    pub fn reach_on_plane(&self, largest: f64) -> f64 {
        if *self == Lens::Pinhole {
            return f64::INFINITY;
        }
        let radial = self.radial();
        monotonic(largest, |radius| radial.distort(DVec2::new(radius, 0.0)).x).unwrap_or(f64::INFINITY)
    }

    /// The angle from the axis, radians, up to which a wide lens is monotonic.
    pub fn reach_in_angle(&self) -> f64 {
        match *self {
            Lens::Fisheye { .. } => monotonic(PI - 1e-6, |theta| self.radius_of_angle(theta)).unwrap_or(PI),
            _ => PI,
        }
    }

    /// The distance from the centre, on the lens's plane, of a direction `theta` radians from the axis; NaN where the lens shows nothing.
    /// Its tangential part is ignored.
    pub fn radius_of_angle(&self, theta: f64) -> f64 {
        let point = self.radial().project(DVec3::new(theta.sin(), 0.0, theta.cos()));
        point.map_or(f64::NAN, |point| point.x)
    }

    /// Whether every coefficient is finite.
    pub fn is_finite(&self) -> bool {
        let all = |values: &[f64]| values.iter().all(|v| v.is_finite());
        match self {
            Lens::Pinhole | Lens::Equirectangular => true,
            Lens::Opencv { k, p } => all(k) && all(p),
            Lens::Fisheye { k, p, s } => all(k) && all(p) && all(s),
            Lens::Fov { omega } => omega.is_finite(),
        }
    }

    /// The point on the plane of a direction of any length; `None` where the lens has none: behind the camera, or, for wide lenses, at most
    /// straight behind it.
    pub fn project(&self, direction: DVec3) -> Option<DVec2> {
        let DVec3 { x, y, z } = direction;
        match self {
            Lens::Equirectangular => Some(DVec2::new(x.atan2(z), y.atan2(x.hypot(z)))),
            Lens::Fisheye { .. } => {
                let sine = x.hypot(y);
                if sine > 1e-12 * z.abs() {
                    Some(self.bend(DVec2::new(x, y) * (sine.atan2(z) / sine)))
                } else {
                    (z > 0.0).then(|| DVec2::new(x, y) / z)
                }
            }
            _ => (z > 0.0).then(|| self.bend(DVec2::new(x, y) / z)),
        }
    }

    /// The inverse of [`Lens::project`], of any length; `None` outside the region in which the lens is invertible.
    pub fn direction(&self, point: DVec2) -> Option<DVec3> {
        match self {
            Lens::Equirectangular => {
                let is_there = point.x.abs() <= PI && point.y.abs() <= 0.5 * PI;
                let (sin, cos) = point.x.sin_cos();
                let (down, level) = point.y.sin_cos();
                is_there.then(|| DVec3::new(level * sin, down, level * cos))
            }
            Lens::Fisheye { .. } => {
                let bent = self.unbend(point)?;
                let theta = bent.length();
                let sine = if theta > 1e-12 { theta.sin() / theta } else { 1.0 };
                (theta <= PI).then(|| (bent * sine).extend(theta.cos()))
            }
            _ => Some(self.unbend(point)?.extend(1.0)),
        }
    }

    /// Maps a point of the undistorted plane `(X / Z, Y / Z)` to the lens's plane.
    pub fn distort(&self, p: DVec2) -> DVec2 {
        self.project(p.extend(1.0)).expect("it is in front of the camera")
    }

    /// The inverse of [`Lens::distort`]; `None` where [`Lens::direction`] has none, or one that is not in front of the camera.
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        let direction = self.direction(distorted)?;
        (direction.z > 0.0).then(|| direction.truncate() / direction.z)
    }

    /// The distortion on the plane on which the model defines it: that of equal angles for fisheyes, otherwise the undistorted plane.
    fn bend(&self, p: DVec2) -> DVec2 {
        let (x, y) = (p.x, p.y);
        let r2 = p.length_squared();
        // OpenCV's tangential part.
        let tangential = |[p1, p2]: [f64; 2]| {
            DVec2::new(
                2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            )
        };
        match *self {
            Lens::Pinhole | Lens::Equirectangular => p,
            Lens::Opencv { k, p: tangent } => {
                let radial =
                    (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])));
                p * radial + tangential(tangent)
            }
            Lens::Fisheye { k, p: tangent, s } => {
                let radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * k[3])));
                p * radial + tangential(tangent) + DVec2::from(s) * r2
            }
            Lens::Fov { omega } => {
                let r = r2.sqrt();
                if r * omega.abs() < 1e-9 {
                    return p;
                }
                p * ((2.0 * r * (0.5 * omega).tan()).atan() / (r * omega))
            }
        }
    }

    /// The inverse of [`Lens::bend`] by Newton's method with a numeric Jacobian; `None` where it does not converge.
    fn unbend(&self, bent: DVec2) -> Option<DVec2> {
        if matches!(self, Lens::Pinhole | Lens::Equirectangular) {
            return Some(bent);
        }
        let mut p = bent;
        const H: f64 = 1e-6;
        for _ in 0..50 {
            let error = self.bend(p) - bent;
            if error.length() < 1e-10 {
                return Some(p);
            }
            let dx = (self.bend(p + DVec2::X * H) - self.bend(p - DVec2::X * H)) / (2.0 * H);
            let dy = (self.bend(p + DVec2::Y * H) - self.bend(p - DVec2::Y * H)) / (2.0 * H);
            let det = dx.x * dy.y - dx.y * dy.x;
            if det.is_nan() || det <= 1e-9 {
                return None;
            }
            p -= DVec2::new(
                (dy.y * error.x - dy.x * error.y) / det,
                (dx.x * error.y - dx.y * error.x) / det,
            );
        }
        None
    }
}

/// The value, at most `largest`, up to which `of` increases; `None` if it increases all the way.
fn monotonic(largest: f64, of: impl Fn(f64) -> f64) -> Option<f64> {
    const STEPS: u32 = 2000;
    let mut before = 0.0;
    for i in 1..=STEPS {
        let value = of(largest * f64::from(i) / f64::from(STEPS));
        if value.is_nan() || value <= before {
            return Some(largest * f64::from(i - 1) / f64::from(STEPS));
        }
        before = value;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [Lens; 6] = [
        Lens::Pinhole,
        Lens::Opencv {
            k: [0.0578, -0.0805, 0.01, 0.02, 0.0, 0.0],
            p: [-0.00098, 0.00016],
        },
        Lens::fisheye([0.02, -0.01, 0.003, -0.0005]),
        THIN_PRISM,
        Lens::Fov { omega: 0.9 },
        Lens::Equirectangular,
    ];
    const THIN_PRISM: Lens = Lens::Fisheye {
        k: [0.02, -0.01, 0.003, -0.0005],
        p: [0.001, -0.002],
        s: [0.004, -0.003],
    };

    #[test]
    fn undistort_inverts_distort() {
        for lens in LENSES {
            for p in [DVec2::ZERO, DVec2::new(0.3, -0.2), DVec2::new(-0.5, 0.7)] {
                let back = lens.undistort(lens.distort(p)).expect("converges");
                assert!((back - p).length() < 1e-8, "{lens:?} {p} {back}");
            }
        }
    }

    #[test]
    fn wide_lenses_see_behind_the_camera_and_others_do_not() {
        let behind = DVec3::new(1.2, 0.4, -0.3);
        for lens in LENSES {
            assert_eq!(lens.project(behind).is_some(), lens.is_wide(), "{lens:?}");
            if let Some(point) = lens.project(behind) {
                let back = lens.direction(point).expect("converges");
                assert!(back.normalize().distance(behind.normalize()) < 1e-8, "{lens:?} {back}");
            }
        }
        assert_eq!(LENSES[2].project(DVec3::NEG_Z), None);
    }

    /// Pixels by COLMAP 4.2.1 (`pycolmap`, `Camera.img_from_cam`), for focal lengths (100, 110) and principal point (200, 150), and for a
    /// panorama of 400 x 300 pixels.
    #[test]
    fn points_are_where_colmap_has_them() {
        let directions = [DVec3::new(0.3, -0.2, 1.0), DVec3::new(-0.9, 0.7, 0.6)];
        let expected: [(Lens, [f64; 2], [[f64; 2]; 2]); 5] = [
            (
                Lens::fisheye([0.02, -0.01, 0.003, -0.0005]),
                [100.0, 110.0],
                [[228.85781962, 128.83759895], [113.07678809, 224.36763685]],
            ),
            (
                THIN_PRISM,
                [100.0, 110.0],
                [[228.83755449, 128.84367849], [112.9042936, 224.45751556]],
            ),
            (
                Lens::fisheye([0.0; 4]),
                [100.0, 110.0],
                [[228.79284507, 128.88524695], [114.24621077, 223.36713078]],
            ),
            (
                Lens::Fov { omega: 0.9 },
                [100.0, 110.0],
                [[230.98847543, 127.27511802], [105.9762571, 230.44253559]],
            ),
            (
                Lens::Equirectangular,
                [200.0 / PI, 300.0 / PI],
                [[218.55471582, 131.92583322], [137.43340836, 204.84822386]],
            ),
        ];
        for (lens, focal, pixels) in expected {
            for (direction, pixel) in directions.into_iter().zip(pixels) {
                let at =
                    lens.project(direction).expect("before the camera") * DVec2::from(focal) + DVec2::new(200.0, 150.0);
                assert!(at.distance(pixel.into()) < 1e-7, "{lens:?} {at}");
            }
        }
    }

    #[test]
    fn a_folded_model_returns_none() {
        let folded = Lens::Opencv {
            k: [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        };
        assert_eq!(folded.undistort(DVec2::new(2.0, 0.0)), None);
    }
}
