//! What is read off the course of a run.

use super::super::report::Report;
use serde::Serialize;

/// A look at the held-out views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Look {
    /// Steps made.
    pub step: u64,
    /// Seconds of training so far; looking is not training.
    pub seconds: f64,
    /// Mean over the held-out views, dB.
    pub psnr: f64,
}

/// Logged losses in a block, at most: about as many views as a small scene has, so that a block's mean says more about
/// the model than about which views came up.
const BLOCK: usize = 25;

/// The looks of a run, in order; the last is the final scene.
pub(super) fn looks(report: &Report) -> Vec<Look> {
    let measured = report.curve.iter().filter_map(|point| {
        Some(Look {
            step: point.step,
            seconds: point.seconds,
            psnr: point.psnr?,
        })
    });
    let mut looks: Vec<Look> = measured.filter(|look| look.psnr.is_finite()).collect();
    if report.psnr.is_finite() && report.training_seconds.is_finite() {
        // The same scene with all bands of harmonics: it stands for a look at the last step.
        looks.retain(|look| look.step < report.steps);
        looks.push(Look {
            step: report.steps,
            seconds: report.training_seconds,
            psnr: report.psnr,
        });
    }
    looks
}

/// Every half dB that some run reached, at most 24 of them: what lies further below the best is left out.
pub(super) fn levels(runs: &[Vec<Look>]) -> Vec<f64> {
    let psnr = || runs.iter().flatten().map(|look| look.psnr);
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

/// Where along `axis` (seconds or steps) a run first reached `psnr`, on the straight line between two looks; at its first
/// look where it was above already, which is then an upper bound. `None` where it never was.
pub fn reached(looks: &[Look], psnr: f64, axis: fn(&Look) -> f64) -> Option<f64> {
    let at = looks.iter().position(|look| look.psnr >= psnr)?;
    let here = &looks[at];
    let Some(before) = at.checked_sub(1).map(|at| &looks[at]) else {
        return Some(axis(here));
    };
    let part = (psnr - before.psnr) / (here.psnr - before.psnr);
    Some(axis(before) + part * (axis(here) - axis(before)))
}

/// The share of blocks of steps in which the training loss rises: the logged losses in order, cut into blocks of 25 (of
/// fewer where there are under 250, but at least 5), whose means are compared, each with the one before. Single steps see
/// different views and rise half of the time whatever happens. `None` with fewer than two blocks.
pub fn rises(losses: &[f64]) -> Option<f64> {
    let losses: Vec<f64> = losses.iter().copied().filter(|loss| loss.is_finite()).collect();
    let block = (losses.len() / 10).clamp(5, BLOCK);
    let means: Vec<f64> = losses
        .chunks_exact(block)
        .map(|block| block.iter().sum::<f64>() / block.len() as f64)
        .collect();
    share(&means, |before, after| after > before)
}

/// The share of looks at the held-out views that saw a lower PSNR than the look before. `None` with fewer than two.
pub fn falls(looks: &[Look]) -> Option<f64> {
    let psnr: Vec<f64> = looks.iter().map(|look| look.psnr).collect();
    share(&psnr, |before, after| after < before)
}

fn share(values: &[f64], worse: impl Fn(f64, f64) -> bool) -> Option<f64> {
    let pairs = values.windows(2);
    let count = pairs.len();
    (count > 0).then(|| pairs.filter(|pair| worse(pair[0], pair[1])).count() as f64 / count as f64)
}
