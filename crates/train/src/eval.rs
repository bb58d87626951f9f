//! Looking at held-out views.

use crate::half_fit::{HalfFit, HeldOut, half_fit_psnr};
use crate::model::{Model, RenderOptions};
use crate::photos::Prepared;
use crate::trainer::TrainError;
use irradia_measure::{Evaluation, Lpips, evaluate, psnr_masked};
use irradia_scene::{Camera, Dataset, Image, Photo, View};
use irradia_splat::Renderer;
use irradia_splat::init::camera_extent;

/// One view's outcome with its pictures, `[H, W, 3]`.
pub struct EvaluatedView {
    /// The view's name.
    pub name: String,
    /// Its metrics.
    pub metrics: Evaluation,
    /// PSNR in dB over its right half, after exposure or pose were fitted on the left half; `None` where not asked for.
    pub half_fit_psnr: Option<f64>,
    /// The photograph over the background.
    pub truth: Image,
    /// What the scene shows there.
    pub render: Image,
    /// `[H, W]`, 0 where the photograph does not count.
    pub mask: Option<Vec<u8>>,
}

/// Which metrics to compute.
#[derive(Clone, Copy)]
pub enum Metrics<'a> {
    /// PSNR alone (the others are NaN and `None`): a look while training.
    Psnr,
    /// All, LPIPS where there are weights.
    All(Option<&'a Lpips>),
}

/// How views are evaluated.
#[derive(Clone, Copy)]
pub struct EvalOptions<'a> {
    /// How they are rendered.
    pub render: RenderOptions,
    /// What is computed of each.
    pub metrics: Metrics<'a>,
    /// What is fitted on the left half of each for its `half_fit_psnr`.
    pub half_fit: HalfFit,
}

/// Looks at `model` from the views `indices` of `dataset` and compares; each is given to `see` when it is done.
///
/// # Errors
/// When a photograph cannot be read.
pub fn evaluate_views(
    model: &Model,
    dataset: &Dataset,
    indices: &[usize],
    options: &EvalOptions,
    mut see: impl FnMut(EvaluatedView),
) -> Result<(), TrainError> {
    let mut renderer = Renderer::new();
    let cameras: Vec<Camera> = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
    let extent = camera_extent(&cameras);
    for index in indices {
        let view = &dataset.views[*index];
        let photo = view.photo.load()?;
        let truth = truth_image(&photo, view, options.render.background);
        let render = model.render(&mut renderer, &view.camera, &options.render).color;
        let mask = photo.mask.as_deref();
        let metrics = match options.metrics {
            Metrics::All(lpips) => evaluate(&render, &truth, mask, lpips),
            Metrics::Psnr => Evaluation {
                psnr: psnr_masked(&render.rounded_to_8_bits(), &truth, mask),
                ssim: f64::NAN,
                lpips: None,
            },
        };
        let held_out = HeldOut {
            camera: &view.camera,
            truth: &truth,
            mask,
            options: &options.render,
            extent,
        };
        let fit = options.half_fit;
        let half_fit_psnr = fit.any().then(|| half_fit_psnr(model, &mut renderer, &held_out, fit));
        see(EvaluatedView {
            name: view.name.clone(),
            metrics,
            half_fit_psnr,
            truth,
            render,
            mask: photo.mask,
        });
    }
    Ok(())
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

/// The mean over views of what was measured after a fit; `None` where nothing was fitted.
pub fn mean_half_fit(psnr: &[f64]) -> Option<f64> {
    (!psnr.is_empty()).then(|| psnr.iter().sum::<f64>() / psnr.len() as f64)
}

/// The mean of the metrics over views; LPIPS where every view has one. NaN when there are none.
pub fn mean(metrics: &[Evaluation]) -> Evaluation {
    let n = metrics.len() as f64;
    let lpips: Option<Vec<f64>> = metrics.iter().map(|m| m.lpips).collect();
    Evaluation {
        psnr: metrics.iter().map(|m| m.psnr).sum::<f64>() / n,
        ssim: metrics.iter().map(|m| m.ssim).sum::<f64>() / n,
        lpips: lpips.filter(|l| !l.is_empty()).map(|l| l.iter().sum::<f64>() / n),
    }
}
