use crate::{Lens, Pose};
use glam::{Vec2, Vec3};

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
    /// Distortion; renderers accept only [`Lens::Pinhole`], readers undistort photographs.
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
    /// Near plane: nothing closer than this along +Z is drawn, world units.
    pub near: f32,
}

impl Camera {
    /// Default near plane: gsplat's 0.01.
    pub const DEFAULT_NEAR: f32 = 0.01;

    /// A camera with the default near plane.
    pub fn new(pose: Pose, intrinsics: Intrinsics) -> Self {
        Self {
            pose,
            intrinsics,
            near: Self::DEFAULT_NEAR,
        }
    }

    /// Pixel coordinates of a world point and its depth along +Z, ignoring the lens; `None` in front of the near plane.
    pub fn project(&self, world: Vec3) -> Option<(Vec2, f32)> {
        let p = self.pose.camera_from_world(world);
        let k = &self.intrinsics;
        (p.z > self.near).then(|| (Vec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy), p.z))
    }

    /// As [`Self::project`], but `None` outside the image as well; what may hide the point is ignored.
    pub fn sees(&self, world: Vec3) -> Option<(Vec2, f32)> {
        let k = &self.intrinsics;
        self.project(world)
            .filter(|(at, _)| (0.0..k.width as f32).contains(&at.x) && (0.0..k.height as f32).contains(&at.y))
    }

    /// Unit direction in the world of the ray through pixel coordinates `(x, y)`, ignoring the lens.
    pub fn ray_direction(&self, pixel: Vec2) -> Vec3 {
        let k = &self.intrinsics;
        let camera = Vec3::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy, 1.0);
        (self.pose.rotation * camera).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scaling_odd_sizes_preserves_the_field_of_view() {
        let k = Intrinsics::from_fov_x(541, 333, 1.0);
        let half = k.scaled(0.5);
        assert_eq!((half.width, half.height), (271, 167));
        assert!((half.fx / half.width as f32 - k.fx / k.width as f32).abs() < 1e-5);
        assert!((half.cy / half.height as f32 - 0.5).abs() < 1e-6);
    }

    #[test]
    fn a_projected_point_lies_on_the_ray_of_its_pixel() {
        let camera = Camera::new(
            Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::ZERO, Vec3::Z),
            Intrinsics::from_fov_x(64, 48, 0.9),
        );
        let point = Vec3::new(0.2, -0.1, 0.3);
        let (pixel, depth) = camera.project(point).expect("in front");
        let direction = camera.ray_direction(pixel);
        let expected = (point - camera.pose.position).normalize();
        assert!((direction - expected).length() < 1e-5 && depth > 3.0);
        assert!(camera.project(Vec3::new(2.0, 4.0, 6.0)).is_none(), "behind");
    }
}
