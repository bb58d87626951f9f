//! Before projection: each camera's pose, which the photographs themselves put right.
//!
//! A correction lies between the camera that the dataset gives and the one that took the photograph:
//! `x_refined = exp(omega) (R x + t) + tau`. Steps are taken in the tangent space at the correction as it stands (Lin et al.
//! 2021, "BARF", section 3.1), so that its derivative is exact however large it has become.

use super::Occupant;
use super::per_view::PerViewAdam;
use crate::tensor_file::{NamedTensor, TensorSource, to_bytes};
use glam::{Quat, Vec3};
use irradia_scene::{Camera, Pose};
use irradia_splat::CameraGradient;

/// Refined camera space from the dataset's: quaternion w, x, y, z and translation, world units.
const NUMBERS: usize = 7;
const IDENTITY: [f32; NUMBERS] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];

/// A correction of each view's pose, none at first.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseRefinement {
    /// `[views][NUMBERS]`.
    corrections: Vec<[f32; NUMBERS]>,
    /// Of the tangent: rotation in radians, translation in world units.
    adam: PerViewAdam<6>,
}

impl PoseRefinement {
    /// For `views` views.
    pub fn new(views: usize) -> Self {
        Self {
            corrections: vec![IDENTITY; views],
            adam: PerViewAdam::new(views),
        }
    }

    /// The camera of `view` with its correction.
    pub fn refined(&self, view: usize, camera: &Camera) -> Camera {
        let (rotation, translation) = parts(&self.corrections[view]);
        moved(camera, rotation, translation)
    }

    /// One step of Adam on `view`. `camera` is the refined camera that was rendered, `gradient` its gradient; `rate` is in
    /// radians, and in units of `extent` for the translation.
    pub fn step(&mut self, view: usize, camera: &Camera, gradient: &CameraGradient, rate: f32, extent: f32) {
        let v = tangent_gradient(camera, gradient);
        let shift = rate * extent;
        let step = self.adam.step(view, v, [rate, rate, rate, shift, shift, shift]);
        let (rotation, translation) = parts(&self.corrections[view]);
        let turned = exp([step[0], step[1], step[2]]);
        let q = (turned * rotation).normalize();
        let t = turned * translation + Vec3::new(step[3], step[4], step[5]);
        self.corrections[view] = [q.w, q.x, q.y, q.z, t.x, t.y, t.z];
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
pub(crate) fn turned(camera: &Camera, tangent: [f32; 6]) -> Camera {
    let [x, y, z, tau @ ..] = tangent;
    moved(camera, exp([x, y, z]), Vec3::from_array(tau))
}

fn parts(correction: &[f32; NUMBERS]) -> (Quat, Vec3) {
    let [w, x, y, z, tx, ty, tz] = *correction;
    (Quat::from_xyzw(x, y, z, w), Vec3::new(tx, ty, tz))
}

/// The rotation of the vector's length in radians about its direction.
fn exp(omega: [f32; 3]) -> Quat {
    Quat::from_scaled_axis(Vec3::from_array(omega))
}

/// The gradient with regard to `(omega, tau)` of `exp(omega) (R x + t) + tau` at zero, from that of R and t: with
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
        let corrections = NamedTensor::real("corrections", vec![self.corrections.len(), NUMBERS], corrections);
        std::iter::once(corrections).chain(self.adam.tensors()).collect()
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        self.corrections = tensors.rows::<NUMBERS>("corrections", self.corrections.len())?;
        self.adam.restore(tensors)
    }

    fn export(&self) -> Option<Vec<u8>> {
        let corrections = self.corrections.as_flattened();
        let corrections = NamedTensor::real("corrections", vec![self.corrections.len(), NUMBERS], corrections);
        Some(to_bytes(&[corrections], ("irradia_poses", "1".into())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Intrinsics, Rng};
    use irradia_splat::{Engine, OutputGradient, RenderOptions, SplatState, Splats};

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
        let want = exp([0.1, -0.2, 0.05]) * before + Vec3::new(0.3, 0.1, -0.4);
        let got = turned(&camera, tangent).pose.camera_from_world(x);
        assert!((got - want).length() < 1e-5, "{got} and {want}");
        assert!((turned(&camera, [0.0; 6]).pose.position - camera.pose.position).length() < 1e-6);
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
        // Smooth over the image, as losses are over what moves little.
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
                    loss(turned(&camera, tangent))
                };
                (at(1.0) - at(-1.0)) / f64::from(2.0 * h)
            })
            .collect();
        engine.render(camera.into(), &options);
        engine.backward(&OutputGradient {
            camera: true,
            ..OutputGradient::of_color(&weights)
        });
        let got = tangent_gradient(&camera, &engine.camera_gradient().expect("asked for"));
        let size = want.iter().map(|v| v.abs()).fold(0.0, f64::max);
        for (i, (got, want)) in got.iter().zip(&want).enumerate() {
            // Splats that enter and leave at alpha 1/255 make differences rough.
            assert!((f64::from(*got) - want).abs() < 0.03 * size, "{i}: {got} and {want}");
        }
    }
}
