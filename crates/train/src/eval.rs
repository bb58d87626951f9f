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
        let mut metrics = match options.metrics {
            Metrics::All(lpips) => evaluate(&render, &truth, mask, lpips),
            Metrics::Psnr => Evaluation {
                psnr: psnr_masked(&render.rounded_to_8_bits(), &truth, mask),
                ssim: f64::NAN,
                lpips: None,
                half_fit_psnr: None,
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
        metrics.half_fit_psnr = fit.any().then(|| half_fit_psnr(model, &mut renderer, &held_out, fit));
        see(EvaluatedView {
            name: view.name.clone(),
            metrics,
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

/// The mean of the metrics over views; LPIPS, and what was measured after a fit, where every view has it. NaN when there are none.
pub fn mean(metrics: &[Evaluation]) -> Evaluation {
    let n = metrics.len() as f64;
    let over_all = |of: fn(&Evaluation) -> Option<f64>| {
        let values: Option<Vec<f64>> = metrics.iter().map(of).collect();
        values.filter(|v| !v.is_empty()).map(|v| v.iter().sum::<f64>() / n)
    };
    Evaluation {
        psnr: metrics.iter().map(|m| m.psnr).sum::<f64>() / n,
        ssim: metrics.iter().map(|m| m.ssim).sum::<f64>() / n,
        lpips: over_all(|m| m.lpips),
        half_fit_psnr: over_all(|m| m.half_fit_psnr),
    }
}
