//! How long the rest of a run takes, and the pace at which it takes as long as it may.
//!
//! A recipe's steps do not cost the same: images grow, splats grow in number. What is left of the recipe is looked through
//! with a model of a step's cost whose one constant is measured as the run goes.

use crate::schedule::{Ahead, ahead};
use crate::trainer::Trainer;

/// A step's cost grows with pixels and splats to these powers: twice the pixels cost 1.65 times as much, twice the splats
/// 1.3 times (RESULTS.md, "How cost grows").
const PIXELS_POWER: f64 = 0.72;
const SPLATS_POWER: f64 = 0.38;
/// Moments of the future that are looked at.
const MOMENTS: usize = 32;
/// Steps over which the cost is averaged.
const WINDOW: u64 = 50;
/// Seconds of a step before any was measured: its order on two cores.
const FIRST_GUESS: f64 = 0.01;

/// What has been learnt of a run's cost and growth.
#[derive(Clone, Debug, Default)]
pub struct Forecast {
    /// Steps seen.
    steps: u64,
    /// The trainer's seconds when it was last looked at.
    seconds: f64,
    /// Work of the step that comes.
    work: f64,
    /// Seconds to a unit of work, a moving mean.
    unit: Option<f64>,
    /// Seconds that the rest of the run takes, were each recipe step a step.
    whole: f64,
    /// Stage, recipe time and number of splats when the stage was first seen.
    entered: Option<(usize, f64, f64)>,
}

impl Forecast {
    /// Takes in what the last step cost; to be called before each step, which trains on images of size `image_scale`.
    pub fn observe(&mut self, trainer: &Trainer, image_scale: f32) {
        if self.work > 0.0 {
            self.steps += 1;
            let unit = (trainer.seconds - self.seconds) / self.work;
            let share = 1.0 / self.steps.min(WINDOW) as f64;
            self.unit = Some(self.unit.map_or(unit, |mean| mean + share * (unit - mean)));
        }
        self.seconds = trainer.seconds;
        let (clock, count) = (&trainer.clock, trainer.state.len() as f64);
        if self.entered.is_none_or(|(stage, ..)| stage != clock.stage) {
            self.entered = Some((clock.stage, clock.time, count));
        }
        self.work = work(f64::from(image_scale), count);
        self.whole = self.look_ahead(trainer);
    }

    /// [`Self::whole`] for the recipe that is left.
    fn look_ahead(&self, trainer: &Trainer) -> f64 {
        let ahead = ahead(&trainer.recipe, &trainer.clock, MOMENTS);
        let count = trainer.state.len() as f64;
        let start = trainer.clock.time;
        let (stage, entered, before) = self.entered.unwrap_or((trainer.clock.stage, start, count));
        // Growth goes on as it has since the stage began. Without an example, and where the number has only fallen (random
        // points that nothing needed), the stage may double it.
        let seen = start - entered;
        let length: f64 = ahead.iter().filter(|a| a.grows).map(|a| a.duration).sum();
        let known =
            seen > 0.1 * length && count > before && ahead.first().is_some_and(|now| now.grows && now.stage == stage);
        let rate = if known {
            (count - before) / seen
        } else {
            count / length.max(1.0)
        };
        let (mut splats, mut sum) = (count, 0.0);
        for Ahead {
            stage,
            image_scale,
            count_share,
            grows,
            duration,
        } in ahead
        {
            if grows {
                let limit = (trainer.limit(stage, count_share) as f64).max(count);
                splats = (splats + rate * duration).clamp(1.0, limit);
            }
            sum += duration * work(image_scale, splats);
        }
        match self.unit {
            Some(unit) => unit * sum,
            None => FIRST_GUESS * (trainer.recipe.total_steps() as f64 - start),
        }
    }

    /// Seconds that the rest of the run takes at its present pace.
    pub fn seconds_left(&self, trainer: &Trainer) -> f64 {
        self.whole / trainer.pace
    }

    /// The pace at which the rest of the run takes `seconds`.
    pub fn pace(&self, trainer: &Trainer, seconds: f64) -> f64 {
        let left = trainer.recipe.total_steps() as f64 - trainer.clock.time;
        // At least one more step, whatever has become of the time.
        (self.whole / seconds.max(1e-6)).min(left)
    }
}

fn work(image_scale: f64, splats: f64) -> f64 {
    image_scale.powi(2).powf(PIXELS_POWER) * splats.max(1.0).powf(SPLATS_POWER)
}
