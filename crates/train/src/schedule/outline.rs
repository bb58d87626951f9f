//! A recipe's whole plan at a glance, to be printed and drawn.

use super::{Clock, values};
use crate::recipe::{Param, Recipe, Values};

/// A stretch of what is still to come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ahead {
    /// Index of the stage.
    pub stage: usize,
    /// Size of the training images relative to the data's.
    pub image_scale: f64,
    /// SH bands in use.
    pub sh_degree: f64,
    /// Whether pictures are compared by a perceptual loss.
    pub perceptual: bool,
    /// Splats there may be, as a share of the cap.
    pub count_share: f64,
    /// Recipe steps of the stage that will have gone by at its end, as a share.
    pub share: f64,
    /// Recipe steps that it lasts.
    pub duration: f64,
}

/// What is left of `recipe` after `clock` in about `parts` parts, as if no stage ended early.
pub fn ahead(recipe: &Recipe, clock: &Clock, parts: usize) -> Vec<Ahead> {
    let mut clock = clock.clone();
    let total = recipe.total_steps() as f64;
    let pace = ((total - clock.time) / parts as f64).max(1e-3);
    let mut stretches = Vec::new();
    while let Some(stage) = recipe.stage.get(clock.stage) {
        let values = values(recipe, &clock);
        let duration = pace.min(clock.stage_time + stage.steps as f64 - clock.time).max(1e-3);
        stretches.push(Ahead {
            stage: clock.stage,
            image_scale: values[Param::ImageScale],
            sh_degree: values[Param::ShDegree],
            perceptual: values[Param::PerceptualWeight] > 0.0,
            count_share: values[Param::CountShare],
            share: (clock.time + duration - clock.stage_time) / stage.steps as f64,
            duration,
        });
        clock.pass(recipe, duration);
    }
    stretches
}

/// The knobs at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Moment {
    /// Recipe steps gone by.
    pub time: f64,
    /// Index of the stage.
    pub stage: usize,
    /// Their values.
    pub values: Values,
}

/// `recipe` at `moments` times, evenly over its steps and at both ends of every stage, as if no stage ended early.
pub fn outline(recipe: &Recipe, moments: usize) -> Vec<Moment> {
    let pace = recipe.total_steps() as f64 / moments.max(1) as f64;
    let mut clock = Clock::new(recipe);
    let mut plan = Vec::new();
    while !clock.finished(recipe) {
        let moment = |clock: &Clock| Moment {
            time: clock.time,
            stage: clock.stage,
            values: values(recipe, clock),
        };
        plan.push(moment(&clock));
        let left = clock.stage_time + recipe.stage[clock.stage].steps as f64 - clock.time;
        if left > pace {
            clock.pass(recipe, pace);
        } else {
            let last = Clock {
                time: clock.time + left * (1.0 - 1e-9),
                progress: clock.progress + left * (1.0 - 1e-9),
                ..clock.clone()
            };
            plan.push(moment(&last));
            clock.pass(recipe, left);
        }
    }
    plan
}
