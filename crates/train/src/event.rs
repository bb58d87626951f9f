//! The events of a run and its observers.

use irradia_splat::densify::DensityChange;
use serde::Serialize;

/// An event of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// Training begins or resumes.
    Started {
        /// Recipe's name.
        recipe: String,
        /// Steps made so far.
        step: u64,
        /// Total number of steps, as far as known.
        total_steps: u64,
        /// Current number of splats.
        splats: usize,
        /// Number of parameters of the field, if one is trained.
        #[serde(skip_serializing_if = "Option::is_none")]
        parameters: Option<usize>,
        /// Training views.
        views: usize,
    },
    /// A stage begins.
    StageEntered {
        /// Its name.
        stage: String,
        /// Steps made so far.
        step: u64,
        /// Seconds of training so far.
        seconds: f64,
    },
    /// A step was completed.
    Step(StepReport),
    /// Density control acted.
    Densified {
        /// Steps made so far.
        step: u64,
        /// Splats copied.
        cloned: usize,
        /// Splats replaced by two.
        split: usize,
        /// Splats removed.
        pruned: usize,
        /// Current number of splats.
        splats: usize,
    },
    /// The held-out views were evaluated, or 32 of them if there are more.
    Evaluated {
        /// Steps made so far.
        step: u64,
        /// Seconds of training so far.
        seconds: f64,
        /// Their mean, dB.
        psnr: f64,
        /// Current number of splats.
        splats: usize,
        /// Number of parameters of the field, if one is trained.
        #[serde(skip_serializing_if = "Option::is_none")]
        parameters: Option<usize>,
    },
    /// A checkpoint was written.
    Saved {
        /// Steps made so far.
        step: u64,
        /// Its path, relative to the run's folder.
        path: String,
    },
    /// The run is paused at an observer's request.
    Paused {
        /// Steps made so far.
        step: u64,
    },
    /// The run resumes after a pause.
    Resumed {
        /// Steps made so far.
        step: u64,
    },
    /// What was decided from the data, before the first step or later.
    Decided {
        /// One line.
        message: String,
    },
    /// A warning: the run continues.
    Warned {
        /// One line.
        message: String,
    },
    /// Training ended.
    Finished {
        /// Steps made.
        step: u64,
        /// Seconds of training.
        seconds: f64,
        /// Why.
        reason: String,
    },
}

/// One step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StepReport {
    /// Steps made, this one included.
    pub step: u64,
    /// Seconds of training so far.
    pub seconds: f64,
    /// Predicted remaining seconds of training.
    pub seconds_left: f64,
    /// Range that contains the remaining seconds in nine of ten runs.
    pub seconds_left_range: [f64; 2],
    /// Recipe steps per step.
    pub pace: f64,
    /// Index of the view in the dataset.
    pub view: usize,
    /// The weighted loss.
    pub loss: f64,
    /// Mean squared error of the training view; `-10 log10` of it is its PSNR.
    pub mse: f64,
    /// Current number of splats.
    pub splats: usize,
    /// Number of parameters of the field, if one is trained.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parameters: Option<usize>,
    /// Splats visible in the view.
    pub visible: usize,
    /// Splats skipped because their gradient was not finite.
    pub non_finite: usize,
}

impl Event {
    /// The event of a round of density control.
    pub fn densified(step: u64, change: DensityChange, splats: usize) -> Self {
        let DensityChange { cloned, split, pruned } = change;
        Event::Densified {
            step,
            cloned,
            split,
            pruned,
            splats,
        }
    }
}

/// The request of an observer. Requests of several observers are combined; [`Signal::Stop`] also ends a pause.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Signal {
    /// No request.
    #[default]
    Continue,
    /// Write a checkpoint now.
    Save,
    /// Pause until no observer returns this from [`Observer::while_paused`].
    Pause,
    /// Stop, with everything saved.
    Stop,
}

/// An observer of a run, which can end it only with [`Signal::Stop`].
pub trait Observer {
    /// Receives `event`; `trainer` is in its state after the event.
    fn on_event(&mut self, event: &Event, trainer: &crate::Trainer) -> Signal;

    /// Whether to stop; polled between views while held-out views are evaluated, when there are no events.
    fn wants_stop(&self) -> bool {
        false
    }

    /// Polled several times per second while the run is paused, whichever observer paused it.
    fn while_paused(&mut self, _trainer: &crate::Trainer) -> Signal {
        Signal::Continue
    }

    /// A problem of the observer, reported once; polled after every event and forwarded as [`Event::Warned`].
    fn warning(&mut self) -> Option<String> {
        None
    }

    /// A checkpoint that was completed in the background since the last call: its step, and its path relative to the run's folder;
    /// polled after every event and forwarded as [`Event::Saved`].
    fn saved(&mut self) -> Option<(u64, String)> {
        None
    }

    /// Writes a checkpoint, if this observer is responsible for it; returns its path, relative to the run's folder, or nothing if
    /// it is still being written.
    ///
    /// # Errors
    /// One line, which is forwarded as [`Event::Warned`]; training continues.
    fn save(&mut self, _trainer: &crate::Trainer) -> Result<Option<String>, String> {
        Ok(None)
    }
}
