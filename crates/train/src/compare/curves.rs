//! Figures derived from the curves of a run.

use super::super::report::Report;
use serde::Serialize;

/// An evaluation of the held-out views during a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct EvaluationPoint {
    /// Steps completed.
    pub step: u64,
    /// Seconds of training so far, excluding evaluation.
    pub seconds: f64,
    /// Mean over the held-out views, dB.
    pub psnr: f64,
}

/// Maximum number of logged losses per block: about the number of views of a small scene, so that a block's mean depends more
/// on the model than on the views.
const MAX_BLOCK_LEN: usize = 25;

/// The evaluations of a run, in order; the last is that of the final scene.
pub(super) fn evaluations(report: &Report) -> Vec<EvaluationPoint> {
    let measured = report.curve.iter().filter_map(|point| {
        Some(EvaluationPoint {
            step: point.step,
            seconds: point.seconds,
            psnr: point.psnr?,
        })
    });
    let mut evaluations: Vec<EvaluationPoint> = measured.filter(|point| point.psnr.is_finite()).collect();
    if report.psnr.is_finite() && report.training_seconds.is_finite() {
        // The same scene with all bands of harmonics: it replaces an evaluation at the last step.
        evaluations.retain(|point| point.step < report.steps);
        evaluations.push(EvaluationPoint {
            step: report.steps,
            seconds: report.training_seconds,
            psnr: report.psnr,
        });
    }
    evaluations
}

/// Every half dB that some run reached, at most the 24 highest.
pub(super) fn levels(runs: &[Vec<EvaluationPoint>]) -> Vec<f64> {
    let psnr = || runs.iter().flatten().map(|point| point.psnr);
    let (lowest, highest) = (
        psnr().fold(f64::INFINITY, f64::min),
        psnr().fold(f64::NEG_INFINITY, f64::max),
    );
    if lowest > highest {
        return Vec::new();
    }
    let last = (2.0 * highest).floor() as i64;
    let first = ((2.0 * lowest).floor() as i64).max(last - 23);
    (first..=last).map(|half| half as f64 / 2.0).collect()
}

/// Position along `axis` (seconds or steps) at which a run first reached `psnr`, linearly interpolated between two evaluations; if
/// the first evaluation is above it, that evaluation's position, an upper bound. `None` if it was never reached.
pub fn position_at_psnr(evaluations: &[EvaluationPoint], psnr: f64, axis: fn(&EvaluationPoint) -> f64) -> Option<f64> {
    let at = evaluations.iter().position(|point| point.psnr >= psnr)?;
    let here = &evaluations[at];
    let Some(before) = at.checked_sub(1).map(|at| &evaluations[at]) else {
        return Some(axis(here));
    };
    let part = (psnr - before.psnr) / (here.psnr - before.psnr);
    Some(axis(before) + part * (axis(here) - axis(before)))
}

/// The fraction of blocks of steps in which the training loss rises: the logged losses in order, in blocks of 25 (of fewer if
/// there are under 250, but at least 5), the mean of each compared with the previous one. Single steps show different views, and their
/// losses rise half of the time in any case. `None` with fewer than two blocks.
pub fn rise_fraction(losses: &[f64]) -> Option<f64> {
    let losses: Vec<f64> = losses.iter().copied().filter(|loss| loss.is_finite()).collect();
    let block = (losses.len() / 10).clamp(5, MAX_BLOCK_LEN);
    let means: Vec<f64> = losses
        .chunks_exact(block)
        .map(|block| block.iter().sum::<f64>() / block.len() as f64)
        .collect();
    fraction(&means, |before, after| after > before)
}

/// The fraction of evaluations of the held-out views with a lower PSNR than the previous one. `None` with fewer than two.
pub fn fall_fraction(evaluations: &[EvaluationPoint]) -> Option<f64> {
    let psnr: Vec<f64> = evaluations.iter().map(|point| point.psnr).collect();
    fraction(&psnr, |before, after| after < before)
}

fn fraction(values: &[f64], worse: impl Fn(f64, f64) -> bool) -> Option<f64> {
    let pairs = values.windows(2);
    let count = pairs.len();
    (count > 0).then(|| pairs.filter(|pair| worse(pair[0], pair[1])).count() as f64 / count as f64)
}
