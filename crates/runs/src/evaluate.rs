//! Scenes against photographs.

use crate::RunError;
use irradia_measure::Evaluation;
use irradia_scene::Dataset;
use irradia_train::eval::{EvalOptions, EvaluatedView, evaluate_views, mean};
use irradia_train::model::Model;

/// Renders `model` from the views `indices` of `dataset` and measures each as `options` say. Every view is handed to `see` when it is done; returned is the mean over all, NaN where there are none.
///
/// # Errors
/// When a photograph cannot be read; the first error of `see`.
pub fn evaluate<E: From<RunError>>(
    model: &Model,
    dataset: &Dataset,
    indices: &[usize],
    options: &EvalOptions,
    mut see: impl FnMut(&EvaluatedView) -> Result<(), E>,
) -> Result<Evaluation, E> {
    let mut metrics: Vec<Evaluation> = Vec::new();
    let mut outcome = Ok(());
    evaluate_views(model, dataset, indices, options, |view| {
        if outcome.is_ok() {
            outcome = see(&view);
        }
        metrics.push(view.metrics);
    })
    .map_err(RunError::from)?;
    outcome?;
    Ok(mean(&metrics))
}

/// A view's name as a file name without extension: folders become underscores.
pub fn file_stem(name: &str) -> String {
    let stem = name.rsplit_once('.').map_or(
        name,
        |(stem, extension)| if extension.contains('/') { name } else { stem },
    );
    stem.chars()
        .map(|c| {
            if c.is_alphanumeric() || "-_.".contains(c) {
                c
            } else {
                '_'
            }
        })
        .collect()
}
