//! What the outside sees of a run.

use irradia_splat::densify::DensityChange;
use serde::Serialize;

/// Something that happened.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// Training begins or goes on.
    Started {
        /// Recipe's name.
        recipe: String,
        /// Steps made so far.
        step: u64,
        /// Steps there will be, as far as is known.
        total_steps: u64,
        /// Splats now.
        splats: usize,
        /// Numbers of the field, where one is trained.
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
    /// A step was made.
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
        /// Splats now.
        splats: usize,
    },
    /// Held-out views were looked at.
    Evaluated {
        /// Steps made so far.
        step: u64,
        /// Seconds of training so far.
        seconds: f64,
        /// Mean over the held-out views, dB.
        psnr: f64,
        /// Splats now.
        splats: usize,
        /// Numbers of the field, where one is trained.
        #[serde(skip_serializing_if = "Option::is_none")]
        parameters: Option<usize>,
    },
    /// A checkpoint was written.
    Saved {
        /// Steps made so far.
        step: u64,
        /// Where, relative to the run.
        path: String,
    },
    /// The run waits, because an observer asked for it.
    Paused {
        /// Steps made so far.
        step: u64,
    },
    /// The run goes on after a pause.
    Resumed {
        /// Steps made so far.
        step: u64,
    },
    /// Something that should be known and does not end the run.
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
    /// Seconds of training still to come, as far as is known.
    pub seconds_left: f64,
    /// Between which that lies in nine of ten runs.
    pub seconds_left_range: [f64; 2],
    /// Recipe steps that went by in it.
    pub pace: f64,
    /// Index of the view in the dataset.
    pub view: usize,
    /// The loss, weighted.
    pub loss: f64,
    /// Mean squared error of the training view; `-10 log10` of it is its PSNR.
    pub mse: f64,
    /// Splats now.
    pub splats: usize,
    /// Numbers of the field, where one is trained.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parameters: Option<usize>,
    /// Splats that the view saw.
    pub visible: usize,
    /// Splats whose gradient was not finite and that therefore rested.
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

/// What an observer wants. Of several observers' answers all are followed; [`Signal::Stop`] ends a pause too.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Signal {
    /// Nothing.
    #[default]
    Continue,
    /// A checkpoint, now.
    Save,
    /// The run to wait until [`Observer::while_paused`] of no observer answers this any more.
    Pause,
    /// The run to end, with everything saved.
    Stop,
}

/// Someone who watches a run. Watching can never end it but by [`Signal::Stop`].
pub trait Observer {
    /// Sees `event`; `trainer` is as it stands after it.
    fn on_event(&mut self, event: &Event, trainer: &crate::Trainer) -> Signal;

    /// Whether the run is to end; asked between views while held-out views are evaluated, where no event comes.
    fn wants_stop(&self) -> bool {
        false
    }

    /// Asked several times a second while the run is paused, whoever paused it.
    fn while_paused(&mut self, _trainer: &crate::Trainer) -> Signal {
        Signal::Continue
    }

    /// Something that went wrong with watching, once; asked after every event and told as [`Event::Warned`].
    fn warning(&mut self) -> Option<String> {
        None
    }

    /// Writes a checkpoint, if that is this observer's business; its place, relative to the run.
    ///
    /// # Errors
    /// One line; it is told as [`Event::Warned`] and training goes on.
    fn save(&mut self, _trainer: &crate::Trainer) -> Result<Option<String>, String> {
        Ok(None)
    }
}
