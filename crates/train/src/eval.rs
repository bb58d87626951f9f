//! Evaluation of held-out views.

use crate::half_fit::{HalfFit, HeldOut, half_fit_psnr};
use crate::model::{Model, RenderOptions};
use crate::painter::Painter;
use crate::photos::Prepared;
use crate::socket::Vignette;
use crate::trainer::TrainError;
use irradia_compute::Device;
use irradia_measure::{Evaluation, Networks, evaluate, psnr_masked};
use irradia_scene::{Camera, Dataset, Image, LoadError, Photo, View};
use irradia_splat::Renderer;
use irradia_splat::init::camera_extent;
use rayon::prelude::*;
use std::ops::ControlFlow;

/// Upper limit of PSNR, dB: that of equal images is infinite. A frame of 8 bits in which one value in 2,000 is off by one has
/// 81 dB.
pub const MAX_PSNR: f64 = 100.0;

/// Maximum bytes of the views that are evaluated at the same time.
const MAX_BATCH_BYTES: usize = 256 << 20;
/// Bytes per pixel of such a view: the photograph, and both images as floats.
const BYTES_PER_PIXEL: usize = 3 + 2 * 12;

/// The result of one view with its images, `[H, W, 3]`.
pub struct EvaluatedView {
    /// The view's name.
    pub name: String,
    /// Its metrics, PSNR at most [`MAX_PSNR`]; NaN and `None` if its mask excludes all pixels.
    pub metrics: Evaluation,
    /// The photograph over the background.
    pub truth: Image,
    /// The rendered view.
    pub render: Image,
    /// `[H, W]`, 0 for pixels to ignore.
    pub mask: Option<Vec<u8>>,
}

impl EvaluatedView {
    /// Whether there was a pixel to compare.
    pub fn is_measured(&self) -> bool {
        !self.metrics.psnr.is_nan()
    }
}

/// Which metrics to compute.
#[derive(Clone, Copy)]
pub enum Metrics<'a> {
    /// PSNR only (the others are NaN and `None`): for evaluation during training.
    Psnr,
    /// All, including LPIPS by the networks given.
    All(Networks<'a>),
}

/// How views are evaluated.
#[derive(Clone, Copy)]
pub struct EvalOptions<'a> {
    /// How views are rendered.
    pub render: RenderOptions,
    /// The metrics of each view.
    pub metrics: Metrics<'a>,
    /// The parameters to fit on the left half of each view for its `half_fit_psnr`.
    pub half_fit: HalfFit,
    /// The vignettes of the lenses, which are applied to every frame.
    pub vignette: Option<&'a Vignette>,
    /// Where views are rendered, except those that fit parameters.
    pub device: &'a Device,
}

impl<'a> EvalOptions<'a> {
    /// Measures PSNR only, and fits nothing.
    pub fn psnr(render: RenderOptions, vignette: Option<&'a Vignette>, device: &'a Device) -> Self {
        Self {
            render,
            metrics: Metrics::Psnr,
            half_fit: HalfFit::default(),
            vignette,
            device,
        }
    }
}

/// Renders `model` from the views `indices` of `dataset` and compares the frames with their photographs; passes each result to `visit`,
/// which may end the evaluation.
///
/// # Errors
/// When a photograph cannot be read, or the device fails.
pub fn evaluate_views(
    model: &Model,
    dataset: &Dataset,
    indices: &[usize],
    options: &EvalOptions,
    mut visit: impl FnMut(EvaluatedView) -> ControlFlow<()>,
) -> Result<(), TrainError> {
    let (mut painter, mut renderer) = (Painter::new(model, options.device)?, Renderer::new());
    let cameras: Vec<Camera> = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
    let extent = camera_extent(&cameras);
    let views = indices.iter().map(|index| &dataset.views[*index]);
    let background = options.render.background;
    for batch in indices.chunks(batch_size(views)) {
        // Photographs are decoded by one thread each; a frame is rendered by all threads, or the device.
        let load = |index: &usize| {
            let view = &dataset.views[*index];
            let photo = view.photo.load()?;
            Ok((truth_image(&photo, view, background), photo.mask))
        };
        let truths: Vec<Result<_, LoadError>> = batch.par_iter().map(load).collect();
        let mut pairs = Vec::with_capacity(batch.len());
        for (index, truth) in batch.iter().zip(truths) {
            let (camera, (truth, mask)) = (&dataset.views[*index].camera, truth?);
            let render = painter.render(camera, &options.render)?.color;
            pairs.push((vignetted(options.vignette, camera, render), truth, mask));
        }
        let measure = |(render, truth, mask): &(Image, Image, Option<Vec<u8>>)| {
            measure(render, truth, mask.as_deref(), options.metrics)
        };
        let measured: Vec<Evaluation> = match options.metrics {
            // LPIPS takes much memory, and all threads for one view.
            Metrics::All(networks) if networks.any() => pairs.iter().map(measure).collect(),
            _ => pairs.par_iter().map(measure).collect(),
        };
        for ((index, (render, truth, mask)), mut metrics) in batch.iter().zip(pairs).zip(measured) {
            let view = &dataset.views[*index];
            let held_out = HeldOut {
                camera: &view.camera,
                truth: &truth,
                mask: mask.as_deref(),
                options: &options.render,
                vignette: options.vignette,
                extent,
            };
            let fit = options.half_fit;
            if fit.any() && !metrics.psnr.is_nan() {
                metrics.half_fit_psnr = half_fit_psnr(model, &mut renderer, &held_out, fit);
            }
            // Not `f64::min`, which returns the other operand for NaN.
            metrics.psnr = metrics.psnr.clamp(f64::NEG_INFINITY, MAX_PSNR);
            metrics.psnr_corrected = metrics.psnr_corrected.clamp(f64::NEG_INFINITY, MAX_PSNR);
            metrics.half_fit_psnr = metrics.half_fit_psnr.map(|psnr| psnr.min(MAX_PSNR));
            let flow = visit(EvaluatedView {
                name: view.name.clone(),
                metrics,
                truth,
                render,
                mask,
            });
            if flow.is_break() {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// The metrics of a frame; those of a view whose mask excludes all pixels are not measured.
fn measure(render: &Image, truth: &Image, mask: Option<&[u8]>, metrics: Metrics) -> Evaluation {
    match metrics {
        _ if mask.is_some_and(|mask| mask.iter().all(|m| *m == 0)) => NOT_MEASURED,
        Metrics::All(networks) => evaluate(render, truth, mask, networks),
        Metrics::Psnr => Evaluation {
            psnr: psnr_masked(&render.rounded_to_8_bits(), truth, mask),
            ..NOT_MEASURED
        },
    }
}

/// Number of views that are evaluated at the same time: one per thread, if they are small.
fn batch_size<'a>(views: impl Iterator<Item = &'a View>) -> usize {
    let pixels = views.map(|view| view.camera.intrinsics.width as usize * view.camera.intrinsics.height as usize);
    let largest = pixels.max().unwrap_or(0).max(1);
    (MAX_BATCH_BYTES / (BYTES_PER_PIXEL * largest)).clamp(1, rayon::current_num_threads())
}

/// `render` `[H, W, 3]` as the lens of `camera` shows it.
pub fn vignetted(vignette: Option<&Vignette>, camera: &Camera, render: Image) -> Image {
    match vignette {
        Some(vignette) => vignette.apply_to(&camera.intrinsics, render),
        None => render,
    }
}

fn truth_image(photo: &Photo, view: &View, background: [f32; 3]) -> Image {
    let k = &view.camera.intrinsics;
    let prepared = Prepared::new(photo, k.width, k.height, background);
    Image::new(
        k.width,
        k.height,
        3,
        prepared.rgb.iter().map(|v| f32::from(*v) / 255.0).collect(),
    )
}

const NOT_MEASURED: Evaluation = Evaluation {
    psnr: f64::NAN,
    psnr_corrected: f64::NAN,
    ssim: f64::NAN,
    lpips: None,
    unseen_lpips: None,
    half_fit_psnr: None,
};

/// The mean of the metrics over the measured views: LPIPS if all of them have it, half-fit PSNR over those that have it. NaN and
/// `None` if there are none.
pub fn mean(metrics: &[Evaluation]) -> Evaluation {
    let measured: Vec<&Evaluation> = metrics.iter().filter(|m| !m.psnr.is_nan()).collect();
    let mean = |values: Vec<f64>| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
    let all = |of: fn(&Evaluation) -> f64| mean(measured.iter().map(|m| of(m)).collect()).unwrap_or(f64::NAN);
    let distance = |of: fn(&Evaluation) -> Option<f64>| {
        let distances: Option<Vec<f64>> = measured.iter().map(|m| of(m)).collect();
        distances.and_then(mean)
    };
    Evaluation {
        psnr: all(|m| m.psnr),
        psnr_corrected: all(|m| m.psnr_corrected),
        ssim: all(|m| m.ssim),
        lpips: distance(|m| m.lpips),
        unseen_lpips: distance(|m| m.unseen_lpips),
        half_fit_psnr: mean(measured.iter().filter_map(|m| m.half_fit_psnr).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_scene::{Intrinsics, Pose};
    use irradia_splat::Splats;
    use std::sync::Arc;

    /// Three photographs of a scene that renders black: exact, fully masked, and off by a fifth everywhere.
    fn dataset() -> Dataset {
        let pose = Pose {
            rotation: Quat::IDENTITY,
            position: Vec3::ZERO,
        };
        let view = |name: &str, data: Vec<u8>, mask: Option<Vec<u8>>| {
            View::new(
                name,
                Camera::new(pose, Intrinsics::from_fov_x(16, 16, 1.0)),
                Arc::new(Photo {
                    width: 16,
                    height: 16,
                    channels: 3,
                    data,
                    mask,
                }),
            )
        };
        Dataset {
            views: vec![
                view("exact", vec![0; 768], None),
                view("blank", vec![200; 768], Some(vec![0; 256])),
                view("off", vec![51; 768], None),
            ],
            train: vec![0],
            test: vec![0, 1, 2],
            ..Dataset::default()
        }
    }

    #[test]
    fn an_exact_frame_and_a_blank_mask_leave_the_mean_finite() {
        let model = Model::of_splats(Splats::zeros(0, 0));
        let mut views = Vec::new();
        for half_fit in [
            HalfFit::default(),
            HalfFit {
                exposure: true,
                pose: false,
            },
        ] {
            let options = EvalOptions {
                render: RenderOptions::default(),
                metrics: Metrics::All(Networks::default()),
                half_fit,
                vignette: None,
                device: &Device::Cpu,
            };
            let data = dataset();
            views.clear();
            let visit = |view| {
                views.push(view);
                ControlFlow::Continue(())
            };
            evaluate_views(&model, &data, &data.test, &options, visit).unwrap();
            let measured: Vec<bool> = views.iter().map(EvaluatedView::is_measured).collect();
            assert_eq!(measured, [true, false, true]);
            let metrics: Vec<Evaluation> = views.iter().map(|view| view.metrics).collect();
            // A fifth off everywhere: 20 log10(5) = 13.98 dB.
            let off = 20.0 * 5f64.log10();
            let mean = mean(&metrics);
            assert!((mean.psnr - 0.5 * (MAX_PSNR + off)).abs() < 1e-6, "{mean:?}");
            assert!(mean.ssim.is_finite() && mean.half_fit_psnr.is_none_or(f64::is_finite));
            assert_eq!(mean.half_fit_psnr.is_some(), half_fit.any());
        }
        assert!(mean(&[NOT_MEASURED]).psnr.is_nan() && mean(&[]).psnr.is_nan());
    }
}
