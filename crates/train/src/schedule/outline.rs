//! A recipe's whole plan as a list, for printing and plotting.

use super::{Clock, values};
use crate::recipe::{Param, Recipe, Values};

/// An upcoming stretch of the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpcomingStretch {
    /// Index of the stage.
    pub stage: usize,
    /// Size of the training images relative to the data's.
    pub image_scale: f64,
    /// SH bands in use.
    pub sh_degree: f64,
    /// Whether images are compared by a perceptual loss.
    pub perceptual: bool,
    /// Maximum number of splats, as a fraction of the cap.
    pub count_share: f64,
    /// Fraction of the stage completed at the end of the stretch.
    pub completed: f64,
    /// Its length in recipe steps.
    pub duration: f64,
}

/// The rest of `recipe` after `clock` in about `parts` parts, assuming that no stage ends early.
pub fn upcoming(recipe: &Recipe, clock: &Clock, parts: usize) -> Vec<UpcomingStretch> {
    let mut clock = clock.clone();
    let total = recipe.total_steps() as f64;
    let pace = ((total - clock.time) / parts as f64).max(1e-3);
    let mut stretches = Vec::new();
    while let Some(stage) = recipe.stage.get(clock.stage) {
        let values = values(recipe, &clock);
        let duration = pace.min(clock.stage_time + stage.steps as f64 - clock.time).max(1e-3);
        stretches.push(UpcomingStretch {
            stage: clock.stage,
            image_scale: values[Param::ImageScale],
            sh_degree: values[Param::ShDegree],
            perceptual: values[Param::PerceptualWeight] > 0.0,
            count_share: values[Param::CountShare],
            completed: (clock.time + duration - clock.stage_time) / stage.steps as f64,
            duration,
        });
        clock.advance(recipe, duration);
    }
    stretches
}

/// The parameters at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct OutlinePoint {
    /// Recipe steps completed.
    pub time: f64,
    /// Index of the stage.
    pub stage: usize,
    /// The values of all parameters.
    pub values: Values,
}

/// `recipe` at `points` times, evenly over its steps and at both ends of every stage, assuming that no stage ends early.
pub fn outline(recipe: &Recipe, points: usize) -> Vec<OutlinePoint> {
    let pace = recipe.total_steps() as f64 / points.max(1) as f64;
    let mut clock = Clock::new(recipe);
    let mut plan = Vec::new();
    while !clock.finished(recipe) {
        let point = |clock: &Clock| OutlinePoint {
            time: clock.time,
            stage: clock.stage,
            values: values(recipe, clock),
        };
        plan.push(point(&clock));
        let left = clock.stage_time + recipe.stage[clock.stage].steps as f64 - clock.time;
        if left > pace {
            clock.advance(recipe, pace);
        } else {
            let last = Clock {
                time: clock.time + left * (1.0 - 1e-9),
                progress: clock.progress + left * (1.0 - 1e-9),
                ..clock.clone()
            };
            plan.push(point(&last));
            clock.advance(recipe, left);
        }
    }
    plan
}
