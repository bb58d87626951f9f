//! Looking at held-out views.

use crate::model::{LookOptions, Model};
use crate::photos::Prepared;
use crate::trainer::TrainError;
use irradia_measure::{Evaluation, Lpips, evaluate, psnr_masked};
use irradia_scene::{Dataset, Image, Photo, View};
use irradia_splat::Renderer;

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

/// Looks at `model` from the views `indices` of `dataset` and compares; each is given to `see` when it is done.
///
/// # Errors
/// When a photograph cannot be read.
pub fn evaluate_views(
    model: &Model,
    dataset: &Dataset,
    indices: &[usize],
    options: &LookOptions,
    metrics: Metrics,
    mut see: impl FnMut(EvaluatedView),
) -> Result<(), TrainError> {
    let mut renderer = Renderer::new();
    for index in indices {
        let view = &dataset.views[*index];
        let photo = view.photo.load()?;
        let truth = truth_image(&photo, view, options.background);
        let render = model.look(&mut renderer, &view.camera, options).color;
        let mask = photo.mask.as_deref();
        let metrics = match metrics {
            Metrics::All(lpips) => evaluate(&render, &truth, mask, lpips),
            Metrics::Psnr => Evaluation {
                psnr: psnr_masked(&render.rounded_to_8_bits(), &truth, mask),
                ssim: f64::NAN,
                lpips: None,
            },
        };
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
