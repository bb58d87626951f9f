//! Convergence of the training error, by which stages end: S, the mean L1 over the training views (CurriculumGS).

use crate::recipe::Exit;

/// A running estimate of S since the start of the stage, or since its images last grew (`MAX_GROWTH`).
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ConvergenceMonitor {
    /// The estimate.
    pub mean: f64,
    /// Steps observed.
    pub steps: u64,
    /// The estimate when every view had been seen once.
    pub start: f64,
    /// Reference of the plateau rule: the estimate at its last sufficient drop.
    pub best: f64,
    /// Recipe steps into the stage at that drop.
    pub best_time: f64,
}

/// Window of the estimate for many views: the maximum number of steps to average over.
const MAX_WINDOW: u64 = 100;
/// Steps between measurements of S if a stage may end by its value.
pub const MEASURE_EVERY: u64 = 100;

impl ConvergenceMonitor {
    /// Records a step's error, and S if it was measured; `time` is in recipe steps since the start of the stage.
    pub fn observe(&mut self, error: f64, measured: Option<f64>, views: u64, time: f64) {
        self.steps += 1;
        let window = views.clamp(1, MAX_WINDOW);
        // A plain mean until the window is full, then an exponential one.
        self.mean += (error - self.mean) / self.steps.min(window) as f64;
        if let Some(measured) = measured {
            self.mean = measured;
        }
        if self.steps == window {
            (self.start, self.best, self.best_time) = (self.mean, self.mean, time);
        }
    }

    /// Whether the stage may end by `exit`. Never before every view (or a hundred) has been seen.
    pub fn should_end(&mut self, exit: &Exit, views: u64, time: f64) -> bool {
        if self.steps < views.clamp(1, MAX_WINDOW) {
            return false;
        }
        match *exit {
            Exit::Threshold { tau } => self.mean < tau,
            Exit::Relative { ratio } => self.mean < ratio * self.start,
            Exit::Plateau { drop, window } => {
                if self.mean < self.best * (1.0 - drop) {
                    (self.best, self.best_time) = (self.mean, time);
                }
                time - self.best_time >= window as f64
            }
        }
    }
}
