//! Before projection: refinement of each camera's pose by the photometric loss.
//!
//! A correction maps from the camera space of the dataset's pose to that of the true pose:
//! `x_refined = exp(omega) (R x + t) + tau`. Steps are taken in the tangent space at the current correction (Lin et al. 2021,
//! "BARF", section 3.1), so that the derivative is exact for corrections of any size.

use super::Occupant;
use super::per_view::PerViewAdam;
use crate::tensor_file::{NamedTensor, TensorSource, to_bytes};
use glam::{Quat, Vec3};
use irradia_scene::{Camera, Dataset, Pose};
use irradia_splat::CameraGradient;

/// Refined camera space from the dataset's: quaternion w, x, y, z and translation, world units.
const POSE_LEN: usize = 7;
const IDENTITY: [f32; POSE_LEN] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];

/// A correction of each view's pose, initially the identity. The motion common to all training views is removed from them,
/// since it belongs to the scene: held-out cameras, which are not refined, keep their place in the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseRefinement {
    /// `[views][POSE_LEN]`.
    corrections: Vec<[f32; POSE_LEN]>,
    /// The training views, with their cameras in the dataset.
    train: Vec<(usize, Camera)>,
    /// Adam on the tangent: rotation in radians, translation in world units.
    adam: PerViewAdam<6>,
}

impl PoseRefinement {
    /// Name of the file beside the scene.
    pub const FILE: &str = "poses.safetensors";

    /// For the views of `dataset`.
    pub fn new(dataset: &Dataset) -> Self {
        let views = dataset.views.len();
        Self {
            corrections: vec![IDENTITY; views],
            train: dataset.train.iter().map(|i| (*i, dataset.views[*i].camera)).collect(),
            adam: PerViewAdam::new(views),
        }
    }

    /// The corrected camera of `view`.
    pub fn refined(&self, view: usize, camera: &Camera) -> Camera {
        let (rotation, translation) = rotation_and_translation(&self.corrections[view]);
        moved(camera, rotation, translation)
    }

    /// One step of Adam on `view`. `camera` is the corrected camera that was rendered, `gradient` its gradient; `rate` is in
    /// radians, and in units of `length_unit` for the translation.
    pub fn step(&mut self, view: usize, camera: &Camera, gradient: &CameraGradient, rate: f32, length_unit: f32) {
        let v = tangent_gradient(camera, gradient);
        let shift = rate * length_unit;
        let step = self.adam.step(view, v, [rate, rate, rate, shift, shift, shift]);
        let common = Twist::from(step)
            .to_world(&camera.pose)
            .scaled(-1.0 / self.train.len() as f32);
        for at in 0..self.train.len() {
            let (other, base) = self.train[at];
            let camera = self.refined(other, &base);
            self.move_by(other, common.to_camera(&camera.pose));
        }
        self.move_by(view, Twist::from(step));
    }

    /// Appends a small motion in camera space to the correction of `view`.
    fn move_by(&mut self, view: usize, motion: Twist) {
        let (rotation, translation) = rotation_and_translation(&self.corrections[view]);
        let turned = Quat::from_scaled_axis(motion.omega);
        let q = (turned * rotation).normalize();
        let t = turned * translation + motion.tau;
        self.corrections[view] = [q.w, q.x, q.y, q.z, t.x, t.y, t.z];
    }
}

/// A small rigid motion `x_new = x + omega x x + tau`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Twist {
    /// Radians.
    omega: Vec3,
    /// World units.
    tau: Vec3,
}

impl From<[f32; 6]> for Twist {
    fn from([x, y, z, tau @ ..]: [f32; 6]) -> Self {
        let (omega, tau) = (Vec3::new(x, y, z), Vec3::from_array(tau));
        Self { omega, tau }
    }
}

impl Twist {
    fn scaled(self, factor: f32) -> Self {
        Self {
            omega: factor * self.omega,
            tau: factor * self.tau,
        }
    }

    /// Converts a motion in the space of a camera at `pose` to the same motion of world points.
    fn to_world(self, pose: &Pose) -> Self {
        let omega = pose.rotation * self.omega;
        Self {
            omega,
            tau: pose.rotation * self.tau + pose.position.cross(omega),
        }
    }

    /// The inverse of [`Self::to_world`].
    fn to_camera(self, pose: &Pose) -> Self {
        let back = pose.rotation.inverse();
        Self {
            omega: back * self.omega,
            tau: back * (self.tau + self.omega.cross(pose.position)),
        }
    }
}

/// `camera` after `x_new = rotation x + translation` in its own space.
fn moved(camera: &Camera, rotation: Quat, translation: Vec3) -> Camera {
    let back = rotation.inverse();
    Camera {
        pose: Pose {
            rotation: (camera.pose.rotation * back).normalize(),
            position: camera.pose.world_from_camera(-(back * translation)),
        },
        ..*camera
    }
}

/// `camera` after `x_new = exp(omega) x + tau`; `tangent` is omega in radians, then tau in world units.
pub(crate) fn corrected(camera: &Camera, tangent: [f32; 6]) -> Camera {
    let Twist { omega, tau } = tangent.into();
    moved(camera, Quat::from_scaled_axis(omega), tau)
}

fn rotation_and_translation(correction: &[f32; POSE_LEN]) -> (Quat, Vec3) {
    let [w, x, y, z, tx, ty, tz] = *correction;
    (Quat::from_xyzw(x, y, z, w), Vec3::new(tx, ty, tz))
}

/// The gradient with respect to `(omega, tau)` of `exp(omega) (R x + t) + tau` at zero, from that of R and t: with
/// `dR = [omega]x R` and `dt = [omega]x t + tau`, it is the axial vector of `v_R R^T + v_t t^T`, and `v_t`.
pub(crate) fn tangent_gradient(camera: &Camera, gradient: &CameraGradient) -> [f32; 6] {
    let (r, t) = camera.pose.camera_from_world_parts();
    let r = r.to_cols_array_2d();
    let m = |i: usize, j: usize| -> f64 {
        let turned: f64 = (0..3).map(|k| gradient.rotation[i][k] * f64::from(r[k][j])).sum();
        turned + gradient.translation[i] * f64::from(t[j])
    };
    let [x, y, z] = gradient.translation;
    [m(2, 1) - m(1, 2), m(0, 2) - m(2, 0), m(1, 0) - m(0, 1), x, y, z].map(|v| v as f32)
}

impl Occupant for PoseRefinement {
    fn name(&self) -> &'static str {
        "poses"
    }

    fn tensors(&self) -> Vec<NamedTensor> {
        let corrections = self.corrections.as_flattened();
        let corrections = NamedTensor::f32s("corrections", vec![self.corrections.len(), POSE_LEN], corrections);
        std::iter::once(corrections).chain(self.adam.tensors()).collect()
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        self.corrections = tensors.rows::<POSE_LEN>("corrections", self.corrections.len())?;
        self.adam.restore(tensors, "")
    }

    fn export(&self) -> Option<Vec<u8>> {
        let corrections = self.corrections.as_flattened();
        let corrections = NamedTensor::f32s("corrections", vec![self.corrections.len(), POSE_LEN], corrections);
        Some(to_bytes(&[corrections], ("irradia_poses", "1".into())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Intrinsics, Photo, Rng, View};
    use irradia_splat::{Engine, OutputGradient, RenderOptions, SplatState, Splats};
    use std::sync::Arc;

    fn camera() -> Camera {
        Camera::new(
            Pose::look_at(Vec3::new(0.3, -0.4, -3.0), Vec3::new(0.1, 0.0, 0.2), Vec3::NEG_Y),
            Intrinsics::from_fov_x(48, 40, 0.8),
        )
    }

    #[test]
    fn a_correction_is_applied_in_camera_space() {
        let (camera, x) = (camera(), Vec3::new(0.2, 0.5, 0.7));
        let tangent = [0.1, -0.2, 0.05, 0.3, 0.1, -0.4];
        let before = camera.pose.camera_from_world(x);
        let want = Quat::from_scaled_axis(Vec3::new(0.1, -0.2, 0.05)) * before + Vec3::new(0.3, 0.1, -0.4);
        let got = corrected(&camera, tangent).pose.camera_from_world(x);
        assert!((got - want).length() < 1e-5, "{got} and {want}");
        assert!((corrected(&camera, [0.0; 6]).pose.position - camera.pose.position).length() < 1e-6);
    }

    #[test]
    fn a_motion_common_to_all_views_is_removed() {
        let view = |x: f32| {
            View::new(
                String::new(),
                Camera::new(
                    Pose::look_at(Vec3::new(x, 0.3, -3.0), Vec3::ZERO, Vec3::NEG_Y),
                    Intrinsics::from_fov_x(48, 40, 0.8),
                ),
                Arc::new(Photo {
                    width: 0,
                    height: 0,
                    channels: 3,
                    data: vec![],
                    mask: None,
                }),
            )
        };
        let dataset = Dataset {
            views: [-1.0, 0.0, 1.0].map(view).into(),
            train: vec![0, 2],
            ..Dataset::default()
        };
        let mut poses = PoseRefinement::new(&dataset);
        for (i, view) in [0, 2, 0].into_iter().cycle().take(20).enumerate() {
            let gradient = CameraGradient {
                translation: [1.0, -2.0 * i as f64, 0.5],
                rotation: [[0.1; 3], [0.2 * i as f64; 3], [-0.3; 3]],
            };
            let camera = poses.refined(view, &dataset.views[view].camera);
            poses.step(view, &camera, &gradient, 1e-3, 1.0);
        }
        // Each correction as a motion of the world, to first order.
        let motion = |view: usize| {
            let [_, x, y, z, tau @ ..] = poses.corrections[view];
            let (omega, tau) = (2.0 * Vec3::new(x, y, z), Vec3::from_array(tau));
            Twist { omega, tau }.to_world(&dataset.views[view].camera.pose)
        };
        let [a, b] = [motion(0), motion(2)];
        assert!(a.omega.length() > 1e-3 && a.tau.length() > 1e-3, "{a:?}");
        assert!((a.omega + b.omega).length() < 0.05 * a.omega.length(), "{a:?} {b:?}");
        assert!((a.tau + b.tau).length() < 0.05 * a.tau.length(), "{a:?} {b:?}");
        assert_eq!(poses.corrections[1], IDENTITY, "held-out cameras stay");
    }

    #[test]
    fn the_tangents_gradient_agrees_with_finite_differences() {
        let mut rng = Rng::new(2, 2);
        let mut splats = Splats::zeros(40, 1);
        for i in 0..40 {
            splats.quats.set(0, i, 1.0);
            for c in 0..3 {
                splats.means.set(c, i, rng.range(-0.7, 0.7));
                splats.log_scales.set(c, i, rng.range(-1.6, -0.8));
                splats.sh.set(c, i, rng.range(-0.5, 1.5));
            }
            splats.opacity_logits.set(0, i, rng.range(-2.0, 0.0));
            for k in 3..12 {
                splats.sh.set(k, i, rng.range(-0.2, 0.2));
            }
        }
        let mut engine = Engine::new(SplatState::new(splats));
        let (camera, options) = (camera(), RenderOptions::default());
        let pixels = 3 * 48 * 40;
        // Smooth over the image, like the losses of small motions.
        let weights: Vec<f32> = (0..pixels)
            .map(|i| (0.1 * (i % 48) as f32).sin() * (0.08 * (i / 48) as f32).cos())
            .collect();
        let mut loss = |camera: Camera| -> f64 {
            engine.render(camera.into(), &options);
            let color = engine.frame().color;
            color.iter().zip(&weights).map(|(c, w)| f64::from(c * w)).sum()
        };
        let h = 2e-3f32;
        let want: Vec<f64> = (0..6)
            .map(|i| {
                let mut at = |sign: f32| {
                    let mut tangent = [0.0; 6];
                    tangent[i] = sign * h;
                    loss(corrected(&camera, tangent))
                };
                (at(1.0) - at(-1.0)) / f64::from(2.0 * h)
            })
            .collect();
        engine.render(camera.into(), &options);
        engine.backward(&OutputGradient {
            camera: true,
            ..OutputGradient::of_color(&weights)
        });
        let got = tangent_gradient(&camera, &engine.camera_gradient().expect("requested"));
        let size = want.iter().map(|v| v.abs()).fold(0.0, f64::max);
        for (i, (got, want)) in got.iter().zip(&want).enumerate() {
            // Splats that enter and leave at alpha 1/255 make finite differences noisy.
            assert!((f64::from(*got) - want).abs() < 0.03 * size, "{i}: {got} and {want}");
        }
    }
}
