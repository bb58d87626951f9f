//! Evaluation of scenes against photographs.

use crate::RunError;
use irradia_measure::Evaluation;
use irradia_scene::Dataset;
use irradia_train::eval::{EvalOptions, EvaluatedView, evaluate_views, mean};
use irradia_train::model::Model;
use std::collections::HashSet;
use std::ops::ControlFlow;

/// Renders `model` from the views `indices` of `dataset` and evaluates each with `options`. Passes every view to `see` once it is
/// evaluated; returns the mean over the measured views, NaN if there are none.
///
/// # Errors
/// When a photograph cannot be read; the error of `see`, which ends the evaluation.
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
        outcome = see(&view);
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

/// One line about the views that are not measured, given the names of all views and whether each was measured; `None` if all were.
pub fn unmeasured<'a>(views: impl Iterator<Item = (&'a str, bool)>) -> Option<String> {
    let (mut all, mut blank) = (0, Vec::new());
    for (name, measured) in views {
        all += 1;
        if !measured {
            blank.push(name);
        }
    }
    (!blank.is_empty()).then(|| {
        let names = blank.join(", ");
        format!(
            "{} of {all} views are not measured, since their masks exclude all pixels: {names}",
            blank.len()
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
