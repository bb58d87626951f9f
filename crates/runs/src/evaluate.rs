//! Evaluation of scenes against photographs.

use crate::RunError;
use irradia_measure::Evaluation;
use irradia_scene::{Dataset, View};
use irradia_train::eval::{EvalOptions, EvaluatedView, evaluate_views, mean};
use irradia_train::model::Model;
use rayon::prelude::*;
use std::collections::HashSet;
use std::ops::ControlFlow;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// In every warning about views without figures.
pub const NOT_MEASURED: &str = "not measured";

/// Maximum bytes of the photographs that are decoded at the same time.
const MAX_DECODED_BYTES: usize = 256 << 20;

/// Renders `model` from the views `indices` of `dataset` and evaluates each with `options`. Passes every view to `on_view` once it is
/// evaluated; returns the mean over the measured views, NaN if there are none.
///
/// # Errors
/// When a photograph cannot be read; the error of `on_view`, which ends the evaluation.
pub fn evaluate<E: From<RunError>>(
    model: &Model,
    dataset: &Dataset,
    indices: &[usize],
    options: &EvalOptions,
    mut on_view: impl FnMut(&EvaluatedView) -> Result<(), E>,
) -> Result<Evaluation, E> {
    let mut metrics: Vec<Evaluation> = Vec::new();
    let mut outcome = Ok(());
    evaluate_views(model, dataset, indices, options, |view| {
        outcome = on_view(&view);
        metrics.push(view.metrics);
        if outcome.is_err() {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    })
    .map_err(RunError::from)?;
    outcome?;
    Ok(mean(&metrics))
}

/// PSNR of the 8-bit pixels `render [H, W, 3]` against `truth [H, W, 3]` where `mask [H, W]` is not 0, dB; equal ones get that of a single
/// difference of one. `None` if no pixel is left.
pub fn psnr_8_bits(render: &[u8], truth: &[u8], mask: Option<&[u8]>) -> Option<f64> {
    let (mut sum, mut count) = (0u64, 0u64);
    for (i, (a, b)) in render.chunks_exact(3).zip(truth.chunks_exact(3)).enumerate() {
        if mask.is_none_or(|mask| mask[i] != 0) {
            let squares = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2));
            sum += squares.sum::<u64>();
            count += 3;
        }
    }
    (count > 0).then(|| -10.0 * (sum.max(1) as f64 / (count as f64 * 255.0 * 255.0)).log10())
}

/// Removes from `views` those whose photographs cannot be decoded, such as files that are damaged behind their headers; returns one line
/// that names them, or `None` if all can.
pub fn leave_out_unreadable(dataset: &Dataset, views: &mut Vec<usize>) -> Option<String> {
    let bytes = |view: &usize| {
        let View { camera, photo, .. } = &dataset.views[*view];
        4 * camera.intrinsics.width as usize * camera.intrinsics.height as usize + photo.working_bytes()
    };
    let largest = views.iter().map(bytes).max()?;
    let at_once = (MAX_DECODED_BYTES / largest.max(1)).clamp(1, rayon::current_num_threads());
    let mut unreadable: Vec<(usize, String)> = Vec::new();
    for batch in views.chunks(at_once) {
        let failed = |view: &usize| Some((*view, why_unreadable(&dataset.views[*view])?));
        unreadable.par_extend(batch.par_iter().filter_map(failed));
    }
    let (_, why) = unreadable.first()?;
    let names = unreadable.iter().map(|(view, _)| dataset.views[*view].name.as_str());
    let line = format!(
        "{} of {} views are {NOT_MEASURED}, since their photographs cannot be read: {} ({why})",
        unreadable.len(),
        views.len(),
        names.collect::<Vec<_>>().join(", ")
    );
    views.retain(|view| unreadable.iter().all(|(other, _)| other != view));
    Some(line)
}

/// [`leave_out_unreadable`] for the held-out views of `dataset`, with a warning; they are not trained on either.
pub(crate) fn hold_out_readable(dataset: &mut Dataset) {
    let mut test = std::mem::take(&mut dataset.test);
    let line = leave_out_unreadable(dataset, &mut test);
    dataset.test = test;
    dataset.warnings.extend(line);
}

/// Why the photograph of `view` cannot be decoded; `None` if it can.
fn why_unreadable(view: &View) -> Option<String> {
    // A decoder's panic on a damaged file counts as an error, as in training.
    match catch_unwind(AssertUnwindSafe(|| view.photo.load())) {
        Ok(loaded) => loaded.err().map(|error| error.to_string()),
        Err(_) => Some("the image decoder failed; copy the file again or remove it".to_owned()),
    }
}

/// One line about the views that are not measured, given the names of all views and whether each was measured; `None` if all were.
pub fn unmeasured<'a>(views: impl Iterator<Item = (&'a str, bool)>) -> Option<String> {
    let (mut all, mut unmeasured_names) = (0, Vec::new());
    for (name, measured) in views {
        all += 1;
        if !measured {
            unmeasured_names.push(name);
        }
    }
    (!unmeasured_names.is_empty()).then(|| {
        let names = unmeasured_names.join(", ");
        format!(
            "{} of {all} views are {NOT_MEASURED}, since their masks exclude all pixels: {names}",
            unmeasured_names.len()
        )
    })
}

/// [`file_stem`] of each name, with a number added to duplicates: no two are equal, ignoring case.
pub fn file_stems<'a>(names: impl Iterator<Item = &'a str>) -> Vec<String> {
    distinct(names.map(file_stem))
}

/// The names, with a number added to duplicates. Names that differ only in case are duplicates, since some file systems ignore case.
pub fn distinct(names: impl Iterator<Item = String>) -> Vec<String> {
    let mut taken: HashSet<String> = HashSet::new();
    let free = |name: String| {
        let numbered = (2..).map(|n| format!("{name}_{n}"));
        let mut candidates = std::iter::once(name.clone()).chain(numbered);
        candidates
            .find(|name| taken.insert(name.to_lowercase()))
            .expect("the range is infinite")
    };
    names.map(free).collect()
}

/// A view's name as a file name without extension: slashes become underscores.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_would_collide_get_numbers() {
        let names = ["a/b.png", "a_b.png", "1.jpg", "1.png", "1_2.png", "A_B.png"];
        let stems = file_stems(names.into_iter());
        assert_eq!(stems, ["a_b", "a_b_2", "1", "1_2", "1_2_2", "A_B_3"]);
    }
}
