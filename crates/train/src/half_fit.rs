//! Fits per-image parameters on the left half of a held-out photograph and measures the right half.
//!
//! Training cannot determine the exposure or the exact pose of a photograph that it never saw. If a recipe learns these for its
//! training views, those of held-out views are therefore fitted to pixels that are then not scored (Martin-Brualla et al. 2021,
//! "NeRF in the Wild", section 5, do so for appearance codes).

use crate::eval::vignetted;
use crate::model::{Model, RenderOptions};
use crate::socket::{PerViewAdam, Vignette, corrected, tangent_gradient};
use irradia_measure::{Affine, psnr_masked};
use irradia_scene::{Camera, Image, Photo};
use irradia_splat::{OutputGradient, Renderer, SplatGradients};

/// The parameters to fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HalfFit {
    /// An affine map of colours.
    pub exposure: bool,
    /// The camera's pose; not for fields.
    pub pose: bool,
}

/// Gradient steps of the pose: the first half at half resolution.
const POSE_STEPS: usize = 100;
/// Initial and final learning rate, in radians and in units of the scene's extent.
const POSE_RATES: [f32; 2] = [1e-3, 1e-5];

impl HalfFit {
    /// Whether anything is fitted.
    pub fn any(self) -> bool {
        self.exposure || self.pose
    }
}

/// A held-out photograph.
#[derive(Clone, Copy)]
pub struct HeldOut<'a> {
    /// Its camera, as the dataset has it.
    pub camera: &'a Camera,
    /// The photograph over the background, `[H, W, 3]`.
    pub truth: &'a Image,
    /// `[H, W]`, 0 for pixels to ignore.
    pub mask: Option<&'a [u8]>,
    /// How the scene is rendered.
    pub options: &'a RenderOptions,
    /// The vignettes of the lenses, which are applied to every frame.
    pub vignette: Option<&'a Vignette>,
    /// Extent of the scene, world units.
    pub extent: f32,
}

/// PSNR in dB over the right half of a held-out view, after fitting the parameters of `fit` on its left half; `None` if the mask
/// excludes all pixels of a half.
pub fn half_fit_psnr(model: &Model, renderer: &mut Renderer, view: &HeldOut, fit: HalfFit) -> Option<f64> {
    let HeldOut {
        truth,
        mask,
        options,
        vignette,
        ..
    } = *view;
    let width = truth.width as usize;
    let counts = |i: usize| mask.is_none_or(|mask| mask[i] != 0);
    let pixels = 0..width * truth.height as usize;
    if [true, false].map(|left| pixels.clone().any(|i| counts(i) && is_left(i, width) == left)) != [true; 2] {
        return None;
    }
    let camera = if fit.pose {
        fitted_pose(model, renderer, view, fit)
    } else {
        *view.camera
    };
    let render = vignetted(vignette, &camera, model.render(renderer, &camera, options).color);
    let render = if fit.exposure {
        Affine::fit_unclipped(&render, truth, |i| counts(i) && is_left(i, width)).apply_to(&render)
    } else {
        render
    };
    let right: Vec<u8> = pixels
        .map(|i| u8::from(counts(i) && !is_left(i, width)) * 255)
        .collect();
    Some(psnr_masked(&render.rounded_to_8_bits(), truth, Some(&right)))
}

fn is_left(pixel: usize, width: usize) -> bool {
    pixel % width < width / 2
}

/// The pose that fits the left half best, by gradient descent from `camera`.
fn fitted_pose(model: &Model, renderer: &mut Renderer, view: &HeldOut, fit: HalfFit) -> Camera {
    let HeldOut {
        truth,
        mask,
        options,
        vignette,
        extent,
        ..
    } = *view;
    let Some(splats) = model.splats() else {
        return *view.camera;
    };
    let (mut camera, size) = (*view.camera, view.camera.intrinsics);
    let mut adam = PerViewAdam::<6>::new(1);
    let mut gradients = SplatGradients::default();
    let photo = Photo {
        width: truth.width,
        height: truth.height,
        channels: 3,
        data: truth.to_u8(),
        mask: mask.map(<[u8]>::to_vec),
    };
    // Half size first: large errors of the pose are corrected there.
    let targets = [0.5, 1.0].map(|scale| {
        let intrinsics = size.scaled(scale);
        let target = photo.resized(intrinsics.width, intrinsics.height);
        let data = target.data.iter().map(|v| f32::from(*v) / 255.0).collect();
        let truth = Image::new(target.width, target.height, 3, data);
        (intrinsics, truth, target.mask)
    });
    for step in 0..POSE_STEPS {
        let (intrinsics, truth, mask) = &targets[usize::from(2 * step >= POSE_STEPS)];
        camera.intrinsics = *intrinsics;
        let width = intrinsics.width;
        let counts = |i: usize| is_left(i, width as usize) && mask.as_ref().is_none_or(|mask| mask[i] != 0);
        let render = vignetted(vignette, &camera, model.render(renderer, &camera, options).color);
        let map = if fit.exposure {
            Affine::fit_unclipped(&render, truth, counts)
        } else {
            Affine::IDENTITY
        };
        let mut v_color = squared_error_gradient(&render, truth, &map, counts);
        if let Some(vignette) = vignette {
            vignette.backward(&camera.intrinsics, renderer.color(), &mut v_color);
        }
        let v_out = OutputGradient {
            camera: true,
            ..OutputGradient::of_color(&v_color)
        };
        renderer.backward(splats, &v_out, &mut gradients);
        let gradient = gradients.camera.unwrap_or_default();
        let passed = step as f32 / POSE_STEPS as f32;
        let rate = POSE_RATES[0] * (POSE_RATES[1] / POSE_RATES[0]).powf(passed);
        let shift = rate * extent;
        let v = tangent_gradient(&camera, &gradient);
        let change = adam.step(0, v, [rate, rate, rate, shift, shift, shift]);
        camera = corrected(&camera, change);
    }
    camera.intrinsics = size;
    camera
}

/// The gradient `[3, H, W]` of the sum of squared differences between `map` of `render` and `truth` over the pixels of `counts`.
fn squared_error_gradient(render: &Image, truth: &Image, map: &Affine, counts: impl Fn(usize) -> bool) -> Vec<f32> {
    let pixels = (render.width * render.height) as usize;
    let mut v_color = vec![0.0; 3 * pixels];
    let both = render.data.as_chunks::<3>().0.iter().zip(truth.data.as_chunks::<3>().0);
    for (i, (x, y)) in both.enumerate().filter(|(i, _)| counts(*i)) {
        let mapped = map.apply(*x);
        for k in 0..3 {
            let v = (0..3)
                .map(|c| map.matrix[c][k] as f32 * (mapped[c] - y[c]))
                .sum::<f32>();
            v_color[k * pixels + i] = 2.0 * v;
        }
    }
    v_color
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor_file::{NamedTensor, to_bytes};
    use glam::Vec3;
    use irradia_scene::{Intrinsics, Pose, Rng};
    use irradia_splat::Splats;

    /// Opaque blobs of many colours in front of a camera.
    fn scene() -> (Model<'static>, Camera) {
        let mut rng = Rng::new(5, 5);
        let mut splats = Splats::zeros(400, 0);
        for i in 0..400 {
            splats.quats.set(0, i, 1.0);
            splats.opacity_logits.set(0, i, 3.0);
            for c in 0..3 {
                splats.means.set(c, i, rng.range(-1.0, 1.0));
                splats.log_scales.set(c, i, rng.range(-2.5, -1.5));
                splats.sh.set(c, i, rng.range(-1.2, 1.2));
            }
        }
        let camera = Camera::new(
            Pose::look_at(Vec3::new(0.0, 0.0, -3.0), Vec3::ZERO, Vec3::NEG_Y),
            Intrinsics::from_fov_x(96, 64, 0.7),
        );
        (Model::of_splats(splats), camera)
    }

    #[test]
    fn a_rotated_camera_and_a_darker_photograph_are_recovered_from_the_left_half() {
        let (model, camera) = scene();
        let (mut renderer, options) = (Renderer::new(), RenderOptions::default());
        let mut truth = model.render(&mut renderer, &camera, &options).color;
        truth.data.iter_mut().for_each(|v| *v *= 0.7);
        let truth = truth.rounded_to_8_bits();
        let off = corrected(&camera, [0.006, -0.008, 0.004, 0.01, 0.0, -0.01]);
        let mut psnr = |exposure, pose| {
            let fit = HalfFit { exposure, pose };
            let view = HeldOut {
                camera: &off,
                truth: &truth,
                mask: None,
                options: &options,
                vignette: None,
                extent: 1.0,
            };
            half_fit_psnr(&model, &mut renderer, &view, fit).expect("no mask")
        };
        let [neither, exposure, pose, both] = [
            psnr(false, false),
            psnr(true, false),
            psnr(false, true),
            psnr(true, true),
        ];
        eprintln!("neither {neither:.1}, exposure {exposure:.1}, pose {pose:.1}, both {both:.1} dB");
        assert!(exposure > neither + 2.0 && both > exposure + 8.0 && both > pose + 8.0);
        assert!(both > 38.0, "8 bits allow about 50 dB, the final learning rate less");
    }

    #[test]
    fn a_pose_is_fitted_to_frames_as_the_lens_shows_them() {
        let (model, camera) = scene();
        let (mut renderer, options) = (Renderer::new(), RenderOptions::default());
        let k = &camera.intrinsics;
        let lens = [64.0 / 96.0, k.fx / 96.0];
        let tensors = [
            NamedTensor::f32s("lenses", vec![1, 2], &lens),
            NamedTensor::f32s("curves", vec![1, 3], &[-0.5, 0.0, -0.2]),
        ];
        let vignette = Vignette::from_file(&to_bytes(&tensors, ("irradia_vignette", "1".into()))).unwrap();
        let truth = vignette.apply_to(k, model.render(&mut renderer, &camera, &options).color);
        let truth = truth.rounded_to_8_bits();
        let off = corrected(&camera, [0.006, -0.008, 0.004, 0.01, 0.0, -0.01]);
        let view = HeldOut {
            camera: &off,
            truth: &truth,
            mask: None,
            options: &options,
            vignette: Some(&vignette),
            extent: 1.0,
        };
        let fit = HalfFit {
            exposure: false,
            pose: true,
        };
        let psnr = half_fit_psnr(&model, &mut renderer, &view, fit).expect("no mask");
        assert!(psnr > 38.0, "{psnr:.1} dB: as without a vignette");
    }
}
