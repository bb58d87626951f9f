use glam::DVec2;

/// Lens distortion, in COLMAP's and OpenCV's parameters.
///
/// Both directions map the normalised image plane: `(x, y) = (X / Z, Y / Z)` of the OpenCV camera.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub enum Lens {
    /// No distortion.
    #[default]
    Pinhole,
    /// OpenCV's rational model (COLMAP `FULL_OPENCV`; `OPENCV`, `RADIAL` and `SIMPLE_RADIAL` by setting the rest to zero).
    Opencv {
        /// Radial coefficients k1..k6; k4..k6 form the denominator.
        k: [f64; 6],
        /// Tangential coefficients p1, p2.
        p: [f64; 2],
    },
    /// OpenCV's fisheye model (Kannala and Brandt 2006; COLMAP `OPENCV_FISHEYE`), `theta_d = theta (1 + k1 theta^2 + ..)`.
    Fisheye {
        /// Coefficients k1..k4.
        k: [f64; 4],
    },
}

impl Lens {
    /// Maps the undistorted plane point `p` to the distorted plane.
    pub fn distort(&self, p: DVec2) -> DVec2 {
        match self {
            Lens::Pinhole => p,
            Lens::Opencv { k, p: [p1, p2] } => {
                let (x, y) = (p.x, p.y);
                let r2 = x * x + y * y;
                let radial =
                    (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])));
                DVec2::new(
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                )
            }
            Lens::Fisheye { k } => {
                let r = p.length();
                if r < 1e-12 {
                    return p;
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let theta_d = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
                p * (theta_d / r)
            }
        }
    }

    /// The inverse of [`Lens::distort`] by Newton's method with a numeric Jacobian; `None` where it does not converge
    /// (outside the region in which the model is invertible).
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        if *self == Lens::Pinhole {
            return Some(distorted);
        }
        let mut p = match self {
            // A fisheye radius is an angle: its tangent is a far better initial guess than the angle itself.
            Lens::Fisheye { .. } => {
                let theta = distorted.length().min(1.5);
                distorted * (theta.tan() / theta.max(1e-12))
            }
            _ => distorted,
        };
        const H: f64 = 1e-6;
        for _ in 0..50 {
            let error = self.distort(p) - distorted;
            if error.length() < 1e-10 {
                return Some(p);
            }
            let dx = (self.distort(p + DVec2::X * H) - self.distort(p - DVec2::X * H)) / (2.0 * H);
            let dy = (self.distort(p + DVec2::Y * H) - self.distort(p - DVec2::Y * H)) / (2.0 * H);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistort_inverts_distort() {
        let lenses = [
            Lens::Pinhole,
            Lens::Opencv {
                k: [0.0578, -0.0805, 0.01, 0.02, 0.0, 0.0],
                p: [-0.00098, 0.00016],
            },
            Lens::Fisheye {
                k: [0.02, -0.01, 0.003, -0.0005],
            },
        ];
        for lens in lenses {
            for p in [DVec2::ZERO, DVec2::new(0.3, -0.2), DVec2::new(-0.5, 0.7)] {
                let back = lens.undistort(lens.distort(p)).expect("converges");
                assert!((back - p).length() < 1e-8, "{lens:?} {p} {back}");
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
