use crate::{Lens, Pose, RollingShutter};
use glam::{DVec2, DVec3, Vec2, Vec3};

/// Maximum angle between a direction and that of its pixel, radians; it is larger only where a lens folds.
const SAME_DIRECTION: f64 = 1e-3;

/// Intrinsic parameters of a camera, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Principal point x, pixels; the image's left edge is 0.
    pub cx: f32,
    /// Principal point y, pixels; the image's top edge is 0.
    pub cy: f32,
    /// Distortion; [`Lens::Pinhole`] unless photographs are kept distorted, since readers undistort them by default.
    pub lens: Lens,
}

impl Intrinsics {
    /// A pinhole camera with square pixels, a centred principal point and a horizontal field of view in radians.
    pub fn from_fov_x(width: u32, height: u32, fov_x: f32) -> Self {
        let focal = 0.5 * width as f32 / (0.5 * fov_x).tan();
        Self {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: 0.5 * width as f32,
            cy: 0.5 * height as f32,
            lens: Lens::Pinhole,
        }
    }

    /// The same camera with the image size scaled by `factor` (rounded to whole pixels, at least 1).
    ///
    /// Focal lengths and the principal point scale by the ratio of the *rounded* sizes, which preserves the field of view.
    pub fn scaled(&self, factor: f32) -> Self {
        let width = ((self.width as f32 * factor).round() as u32).max(1);
        let height = ((self.height as f32 * factor).round() as u32).max(1);
        self.resized(width, height)
    }

    /// The same camera with an image of exactly `width` x `height` pixels.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (width as f32 / self.width as f32, height as f32 / self.height as f32);
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            lens: self.lens,
        }
    }

    /// The point on the lens's plane at a position in the image, pixels.
    pub fn plane_of(&self, pixel: DVec2) -> DVec2 {
        let [fx, fy, cx, cy] = [self.fx, self.fy, self.cx, self.cy].map(f64::from);
        DVec2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy)
    }

    /// The inverse of [`Self::plane_of`].
    pub fn pixel_of(&self, plane: DVec2) -> DVec2 {
        let [fx, fy, cx, cy] = [self.fx, self.fy, self.cx, self.cy].map(f64::from);
        DVec2::new(fx * plane.x + cx, fy * plane.y + cy)
    }

    /// Pixel coordinates and [depth](Self::depth) of a point in camera space; `None` where the lens shows nothing, such as behind a
    /// pinhole.
    pub fn project(&self, point: Vec3) -> Option<(Vec2, f32)> {
        let depth = self.depth(point);
        if self.lens == Lens::Pinhole {
            let at = Vec2::new(
                self.fx * point.x / point.z + self.cx,
                self.fy * point.y / point.z + self.cy,
            );
            return (point.z > 0.0).then_some((at, depth));
        }
        let direction = point.as_dvec3();
        let plane = self.lens.project(direction)?;
        // Beyond the fold of a polynomial, another direction has the same pixel.
        let back = self.lens.direction(plane)?;
        let is_same = back.angle_between(direction) < SAME_DIRECTION;
        is_same.then(|| (self.pixel_of(plane).as_vec2(), depth))
    }

    /// The depth of a point in camera space: along +Z, or, for lenses that also see behind the camera, the distance from the camera.
    pub fn depth(&self, point: Vec3) -> f32 {
        if self.lens.is_wide() { point.length() } else { point.z }
    }

    /// Whether the lens shows something at pixel coordinates `(x, y)`.
    pub fn shows(&self, pixel: Vec2) -> bool {
        self.lens.direction(self.plane_of(pixel.as_dvec2())).is_some()
    }

    /// The point in camera space that is seen at pixel coordinates `(x, y)` and a [depth](Self::depth) of 1; straight ahead where the
    /// lens shows nothing.
    pub fn ray(&self, pixel: Vec2) -> Vec3 {
        if self.lens == Lens::Pinhole {
            return Vec3::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1.0);
        }
        let direction = self.lens.direction(self.plane_of(pixel.as_dvec2()));
        let direction = direction.unwrap_or(DVec3::Z).as_vec3();
        direction / self.depth(direction)
    }

    /// Whether sizes are non-zero and every number is finite with positive focal lengths.
    pub fn is_valid(&self) -> bool {
        self.width > 0
            && self.height > 0
            && [self.fx, self.fy, self.cx, self.cy].iter().all(|v| v.is_finite())
            && self.fx > 0.0
            && self.fy > 0.0
    }
}

/// A posed camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Extrinsic parameters.
    pub pose: Pose,
    /// Intrinsic parameters.
    pub intrinsics: Intrinsics,
    /// Near plane: nothing at a smaller [depth](Intrinsics::depth) is drawn, world units.
    pub near: f32,
    /// Its motion during the readout of a photograph; `None` if it is at rest.
    pub shutter: Option<RollingShutter>,
}

impl Camera {
    /// Default near plane: gsplat's 0.01.
    pub const DEFAULT_NEAR: f32 = 0.01;

    /// A camera at rest with the default near plane.
    pub fn new(pose: Pose, intrinsics: Intrinsics) -> Self {
        Self {
            pose,
            intrinsics,
            near: Self::DEFAULT_NEAR,
            shutter: None,
        }
    }

    /// Whether it is a pinhole at rest: without distortion or rolling shutter.
    pub fn is_pinhole(&self) -> bool {
        self.intrinsics.lens == Lens::Pinhole && self.shutter.is_none()
    }

    /// Pixel coordinates of a world point and its [depth](Intrinsics::depth); `None` closer than the near plane and where the lens
    /// shows nothing.
    pub fn project(&self, world: Vec3) -> Option<(Vec2, f32)> {
        let (point, k) = (self.pose.camera_from_world(world), &self.intrinsics);
        let projected = match &self.shutter {
            None => k.project(point),
            Some(shutter) => {
                let project = |time| Some(k.project(shutter.at(point, time))?.0);
                let seen = shutter.seen([k.width, k.height], project);
                seen.map(|at| (at, k.depth(point)))
            }
        };
        projected.filter(|(_, depth)| *depth > self.near)
    }

    /// Like [`Self::project`], but `None` outside the image as well; occlusion is ignored.
    pub fn sees(&self, world: Vec3) -> Option<(Vec2, f32)> {
        let k = &self.intrinsics;
        self.project(world)
            .filter(|(at, _)| (0.0..k.width as f32).contains(&at.x) && (0.0..k.height as f32).contains(&at.y))
    }

    /// The ray through pixel coordinates `(x, y)`: a point on it and its unit direction, in the world. It goes straight ahead where the
    /// lens shows nothing.
    pub fn ray(&self, pixel: Vec2) -> (Vec3, Vec3) {
        let (k, ray) = (&self.intrinsics, self.intrinsics.ray(pixel));
        let (from, along) = match &self.shutter {
            None => (self.pose.position, ray),
            Some(shutter) => {
                let (from, along) = shutter.line(ray, shutter.time(pixel, [k.width, k.height]));
                (self.pose.world_from_camera(from), along)
            }
        };
        (from, (self.pose.rotation * along).normalize())
    }

    /// [Depth](Intrinsics::depth) per world unit along a unit direction in the world.
    pub fn depth_along(&self, direction: Vec3) -> f32 {
        self.intrinsics.depth(self.pose.rotation.inverse() * direction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FirstSide;
    use glam::Quat;

    #[test]
    fn scaling_odd_sizes_preserves_the_field_of_view() {
        let k = Intrinsics::from_fov_x(541, 333, 1.0);
        let half = k.scaled(0.5);
        assert_eq!((half.width, half.height), (271, 167));
        assert!((half.fx / half.width as f32 - k.fx / k.width as f32).abs() < 1e-5);
        assert!((half.cy / half.height as f32 - 0.5).abs() < 1e-6);
    }

    #[test]
    fn a_lens_shows_points_of_its_rays_and_none_beyond_its_fold() {
        let lenses = [
            Lens::Opencv {
                k: [-0.3, 0.0, 0.0, 0.0, 0.0, 0.0],
                p: [0.001, -0.002],
            },
            Lens::fisheye([0.02, 0.0, 0.0, 0.0]),
            Lens::Equirectangular,
        ];
        for lens in lenses {
            let k = Intrinsics {
                lens,
                ..Intrinsics::from_fov_x(640, 480, 1.0)
            };
            for pixel in [Vec2::new(10.0, 20.0), Vec2::new(320.0, 240.0), Vec2::new(500.0, 300.0)] {
                let (at, depth) = k.project(3.0 * k.ray(pixel)).expect("it shows what it sees");
                assert!(
                    (at - pixel).length() < 0.01 && (depth - 3.0).abs() < 1e-5,
                    "{lens:?} {pixel} {at}"
                );
            }
            // r - 0.3 r^3 grows up to a radius of 1.05, and is 0 again at 1.83.
            assert_eq!(k.project(Vec3::new(1.8, 0.0, 1.0)).is_some(), lens.is_wide());
            assert_eq!(k.project(Vec3::new(0.3, 0.2, -1.0)).is_some(), lens.is_wide());
        }
    }

    #[test]
    fn a_projected_point_lies_on_the_ray_of_its_pixel() {
        let camera = Camera::new(
            Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::ZERO, Vec3::Z),
            Intrinsics::from_fov_x(64, 48, 0.9),
        );
        let point = Vec3::new(0.2, -0.1, 0.3);
        let (pixel, depth) = camera.project(point).expect("in front");
        let (_, direction) = camera.ray(pixel);
        let expected = (point - camera.pose.position).normalize();
        assert!((direction - expected).length() < 1e-5 && depth > 3.0);
        assert!(camera.project(Vec3::new(2.0, 4.0, 6.0)).is_none(), "behind");
    }

    #[test]
    fn a_rolling_shutter_shows_points_where_their_rows_see_them() {
        let still = Camera::new(
            Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::ZERO, Vec3::Z),
            Intrinsics::from_fov_x(640, 480, 0.9),
        );
        let shutter = RollingShutter {
            first: FirstSide::Top,
            translation: Vec3::new(0.02, -0.01, 0.03),
            rotation: Vec3::new(0.01, 0.06, -0.02),
        };
        let camera = Camera {
            shutter: Some(shutter),
            ..still
        };
        assert!(still.is_pinhole() && !camera.is_pinhole());
        for world in [Vec3::new(0.2, -0.1, 0.9), Vec3::new(-0.4, 0.3, -0.8), Vec3::ZERO] {
            let (pixel, depth) = camera.project(world).expect("in front");
            let (at_rest, same_depth) = still.project(world).expect("in front");
            assert_eq!(depth, same_depth);
            // The camera as it is when the row is exposed.
            let time = pixel.y / 480.0 - 0.5;
            let mut moved = still;
            moved.pose.position = still.pose.world_from_camera(time * shutter.translation);
            moved.pose.rotation = still.pose.rotation * Quat::from_scaled_axis(time * shutter.rotation);
            let (expected, _) = moved.project(world).expect("in front");
            let apart = pixel.distance(expected);
            assert!(apart < 0.1, "{world} {pixel} {expected} at rest {at_rest}");
            let (from, along) = camera.ray(pixel);
            let nearest = from + along * (world - from).dot(along);
            assert!(nearest.distance(world) < 1e-4, "{world} {nearest}");
        }
    }
}
