use super::CameraGradient;
use super::lens::{LensLanes, LensParams};
use irradia_compute::simd::Simd;
use irradia_compute::unroll;
use irradia_scene::Camera;

/// Splats centred farther outside the image than this many of its longer sides are not drawn. The affine approximation of their footprint
/// is wrong by then: that of a large splat beside the camera covers the image, although the splat does not enter the view. No splat that
/// the golden images show is farther outside than 1.3 sides; other viewers draw the line at 0.1 to 0.2 (antimatter15's splat, Spark).
const MAX_SIDES_OUTSIDE: f64 = 2.0;

/// A camera as the renderer uses it, in double precision for the tests.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewParams {
    /// Rotation of `x_cam = R x + t`, row-major.
    pub rotation: [[f64; 3]; 3],
    /// Translation of `x_cam = R x + t`.
    pub translation: [f64; 3],
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels.
    pub principal: [f64; 2],
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Near plane, world units.
    pub near: f64,
    /// Lens, and motion during the exposure; `None` for a pinhole at rest.
    pub lens: Option<LensParams>,
}

impl ViewParams {
    /// From a scene camera.
    pub fn new(camera: &Camera) -> Self {
        let (r, t) = camera.pose.camera_from_world_parts();
        let r = r.to_cols_array_2d();
        let k = &camera.intrinsics;
        Self {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| f64::from(r[j][i]))),
            translation: t.to_array().map(f64::from),
            focal: [k.fx, k.fy].map(f64::from),
            principal: [k.cx, k.cy].map(f64::from),
            width: k.width,
            height: k.height,
            near: f64::from(camera.near),
            lens: LensParams::new(camera),
        }
    }

    /// The camera's centre in the world: `-R^T t`.
    pub fn center(&self) -> [f64; 3] {
        std::array::from_fn(|j| -(0..3).map(|i| self.rotation[i][j] * self.translation[i]).sum::<f64>())
    }

    /// The camera's total gradient from its direct part and that of the centre, on which viewing directions depend:
    /// `center = -R^-1 t`, so `d center = -R^-1 (dR center + dt)`.
    pub(crate) fn gradient(
        &self,
        mut rotation: [[f64; 3]; 3],
        mut translation: [f64; 3],
        v_center: [f64; 3],
    ) -> CameraGradient {
        let center = self.center();
        for i in 0..3 {
            let along: f64 = (0..3).map(|j| self.rotation[i][j] * v_center[j]).sum();
            translation[i] -= along;
            for j in 0..3 {
                rotation[i][j] -= along * center[j];
            }
        }
        CameraGradient { rotation, translation }
    }

    /// Minimum and maximum of `X / Z` and `Y / Z`; beyond them J is evaluated at the limit. They lie 0.3 tan(fov / 2)
    /// outside the image's borders for any principal point (gsplat); Inria's are symmetric about the axis, which is the same for a
    /// centred principal point.
    pub fn tangent_limits(&self) -> [[f64; 2]; 2] {
        let size = [self.width, self.height].map(f64::from);
        std::array::from_fn(|i| {
            let (focal, principal) = (self.focal[i], self.principal[i]);
            let margin = 0.3 * 0.5 * size[i] / focal;
            [-(principal / focal + margin), (size[i] - principal) / focal + margin]
        })
    }

    #[inline(always)]
    pub(super) fn lanes<S: Simd>(&self, simd: S) -> ViewLanes<S::F> {
        let (limits, center) = (self.tangent_limits(), self.center());
        ViewLanes {
            r: unroll!(i in 3 => unroll!(j in 3 => simd.splat(self.rotation[i][j]))),
            t: unroll!(i in 3 => simd.splat(self.translation[i])),
            f: unroll!(i in 2 => simd.splat(self.focal[i])),
            c: unroll!(i in 2 => simd.splat(self.principal[i])),
            limits: unroll!(i in 2 => unroll!(j in 2 => simd.splat(limits[i][j]))),
            size: [simd.splat(f64::from(self.width)), simd.splat(f64::from(self.height))],
            center: unroll!(i in 3 => simd.splat(center[i])),
            margin: simd.splat(MAX_SIDES_OUTSIDE * f64::from(self.width.max(self.height))),
            near: simd.splat(self.near),
            lens: self.lens.as_ref().map(|lens| lens.lanes(simd)),
        }
    }
}

/// [`ViewParams`] broadcast to all lanes.
pub(super) struct ViewLanes<F> {
    pub r: [[F; 3]; 3],
    pub t: [F; 3],
    pub f: [F; 2],
    pub c: [F; 2],
    pub limits: [[F; 2]; 2],
    pub size: [F; 2],
    pub center: [F; 3],
    /// How far outside the image a centre may be, pixels.
    pub margin: F,
    pub near: F,
    pub lens: Option<LensLanes<F>>,
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::{RenderOptions, Renderer, Splats, logit};
    use glam::{Quat, Vec3};
    use irradia_scene::{Intrinsics, Pose};

    /// A splat 3 units beside a camera with 50 pixels and a focal length of 50, at the depth at which its centre is `sides` sides outside
    /// the image, with a standard deviation of 2.
    pub fn splat_beside_camera(sides: f32) -> (Splats, Camera) {
        let pose = Pose {
            rotation: Quat::IDENTITY,
            position: Vec3::ZERO,
        };
        let k = Intrinsics {
            fx: 50.0,
            fy: 50.0,
            ..Intrinsics::from_fov_x(50, 50, 1.0)
        };
        let mut splats = Splats::zeros(1, 0);
        splats.means.set(0, 0, -3.0);
        splats.means.set(2, 0, 3.0 / (sides + 0.5));
        splats.quats.set(0, 0, 1.0);
        splats.opacity_logits.set(0, 0, logit(0.98));
        (0..3).for_each(|c| splats.log_scales.set(c, 0, 2f32.ln()));
        (splats, Camera::new(pose, k))
    }

    #[test]
    fn splats_far_beside_the_image_do_not_veil_it() {
        let mut renderer = Renderer::new();
        for (sides, is_drawn) in [(0.5, true), (1.95, true), (2.05, false), (30.0, false)] {
            let (splats, camera) = splat_beside_camera(sides);
            renderer.render(&splats, &ViewParams::new(&camera), &RenderOptions::default());
            let most = renderer.alpha().iter().fold(0.0f32, |most, alpha| most.max(*alpha));
            assert_eq!(most > 0.1, is_drawn, "{sides}: {most}");
        }
    }
}
