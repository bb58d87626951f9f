//! Parameter curves over a run's steps, for plotting.
//!
//! A run's schedule follows from its recipe and from the start of its stages: the schedule is replayed.

use super::StageReport;
use crate::recipe::{Exit, Param, Recipe};
use crate::schedule::{Clock, StepMetrics, plan};
use serde::{Deserialize, Serialize};

/// Parameter curves over the steps of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Schedule {
    /// Whether this is what the run did. Otherwise it is the plan, aligned with the steps of each stage: for a run with a time budget whose
    /// stages may end early, the skipped time is unknown. Within a stage recipe time is assumed to be proportional to steps, which is exact
    /// up to the drift of a budget's pace.
    pub done: bool,
    /// Steps completed.
    pub steps: Vec<f32>,
    /// The parameters at those steps; those that are always 0 are omitted.
    pub knobs: Vec<KnobCurve>,
}

/// A parameter's values.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KnobCurve {
    /// Its name, such as `loss.ssim`; curves with the same part before the dot share a chart.
    pub name: String,
    /// At [`Schedule::steps`].
    pub values: Vec<f32>,
}

/// Approximate number of samples of a run.
const TARGET_SAMPLES: f64 = 160.0;

/// A run, as far as its schedule depends on it.
#[derive(Clone, Copy)]
pub struct Course<'a> {
    /// Its recipe.
    pub recipe: &'a Recipe,
    /// The stages that it has entered.
    pub stages: &'a [StageReport],
    /// Its clock at the end.
    pub clock: &'a Clock,
    /// Recipe steps before its first step.
    pub skipped: f64,
    /// The number of steps into which the others were fitted.
    pub steps: Option<u64>,
    /// Whether they were fitted into a time budget instead.
    pub timed: bool,
}

/// The schedule of a run.
pub fn schedule(course: &Course) -> Schedule {
    let Course { recipe, skipped, .. } = *course;
    let spans = spans(course);
    let mut run = Clock::new(recipe);
    run.advance(recipe, skipped);
    let mut quiet = recipe.clone();
    quiet.stage.iter_mut().for_each(|stage| stage.exit = None);
    let total: f64 = spans.iter().map(|span| span.lasted).sum();
    let mut schedule = Schedule {
        done: spans.iter().all(|span| span.known),
        ..Schedule::default()
    };
    let metrics = StepMetrics {
        error: 0.0,
        measured: None,
        views: 1,
    };
    for span in &spans {
        let (i, full) = (span.stage, recipe.stage[span.stage].steps as f64 - span.skipped);
        let parts = (TARGET_SAMPLES * span.lasted / total.max(1.0))
            .ceil()
            .clamp(1.0, TARGET_SAMPLES) as usize;
        // Just before its end the stage is still current.
        let last = (span.lasted - 1e-3).max(0.0);
        let mut before = 0.0;
        for part in 0..=parts {
            let time = last * part as f64 / parts as f64;
            if part > 0 {
                run.tick(&quiet, time - before, metrics);
            }
            before = time;
            if run.stage == i {
                let step = span.entered as f64 + span.steps as f64 * part as f64 / parts as f64;
                schedule.push(step, &quiet, &run);
            }
        }
        if span.lasted < full {
            // An error of 0 is below this limit, so that the stage ends as in the run.
            let mut leaving = quiet.clone();
            leaving.stage[i].exit = Some(Exit::Threshold { tau: f64::INFINITY });
            run.tick(&leaving, span.lasted - last, metrics);
        } else if run.stage == i {
            run.tick(&quiet, full - last, metrics);
        }
    }
    schedule
        .knobs
        .retain(|knob| knob.values.iter().any(|value| *value != 0.0));
    schedule
}

/// The extent of a stage in a run.
struct Span {
    /// The stage.
    stage: usize,
    /// Recipe steps skipped at its start.
    skipped: f64,
    /// Steps completed at its start.
    entered: u64,
    /// Steps made in it.
    steps: u64,
    /// Recipe steps completed in it.
    lasted: f64,
    /// Whether that is certain.
    known: bool,
}

/// The spans of the stages that a run has entered.
fn spans(course: &Course) -> Vec<Span> {
    let Course {
        recipe,
        stages,
        clock,
        skipped,
        steps,
        timed,
    } = *course;
    let total = recipe.total_steps() as f64;
    let (mut spans, mut entered, mut start) = (Vec::new(), 0, 0.0);
    for (i, stage) in recipe.stage.iter().enumerate().take(clock.stage + 1) {
        // What the run skipped before its first step is no part of the span.
        let time = skipped.clamp(start, start + stage.steps as f64);
        let full = start + stage.steps as f64 - time;
        if full <= 0.0 {
            start = time;
            continue;
        }
        // A stage shorter than a step was never entered.
        let report = stages.iter().find(|report| report.name == stage.name);
        let end = report.map_or(entered, |report| report.last_step.max(entered));
        let made = end - entered;
        let pace = steps.map_or(1.0, |steps| {
            (total - time) / steps.saturating_sub(entered).max(1) as f64
        });
        let (lasted, known) = if i == clock.stage {
            (clock.time - clock.stage_time - (time - start), true)
        } else if stage.exit.is_none() {
            (full, true)
        } else if timed {
            (full, false)
        } else {
            let lasted = made as f64 * pace;
            // If the stage would have ended by itself in that step, it was complete.
            let whole = report.is_none() || lasted > full - 1.01 * pace;
            (if whole { full } else { lasted }, true)
        };
        spans.push(Span {
            stage: i,
            skipped: time - start,
            entered,
            steps: made,
            lasted: lasted.clamp(0.0, full),
            known,
        });
        (entered, start) = (end, time + full);
    }
    if spans.last().is_some_and(|span| span.lasted <= 0.0) {
        spans.pop();
    }
    spans
}

impl Schedule {
    fn push(&mut self, step: f64, recipe: &Recipe, clock: &Clock) {
        if self.knobs.is_empty() {
            let curves = plotted_params().map(|(name, _)| KnobCurve {
                name: name.to_owned(),
                values: Vec::new(),
            });
            self.knobs = curves.collect();
        }
        self.steps.push(step as f32);
        let plan = plan(recipe, clock);
        for (knob, (_, param)) in self.knobs.iter_mut().zip(plotted_params()) {
            knob.values.push(plan.value(param));
        }
    }
}

/// The parameters with curves.
fn plotted_params() -> impl Iterator<Item = (&'static str, Param)> {
    let curve = |param: Param| param.row().curve.map(|name| (name, param));
    Param::ALL.into_iter().filter_map(curve)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three stages: a rate over the run, a scale over the first, a weight in the second.
    fn recipe(exit: &str) -> Recipe {
        let overrides = [
            "stage.warmup.steps=100",
            "stage.grow.steps=100",
            "stage.refine.steps=200",
            "params.rate_means={ from = 4.0, to = 0.0 }",
            "stage.warmup.params.image_scale={ from = 0.5, to = 1.0 }",
            "stage.grow.params.depth_weight=0.25",
            exit,
        ];
        let overrides: Vec<String> = overrides
            .iter()
            .filter(|o| !o.is_empty())
            .map(|o| (*o).to_owned())
            .collect();
        Recipe::parse("classic", Recipe::built_in("classic").unwrap(), &overrides).unwrap()
    }

    fn stage(name: &str, first_step: u64, last_step: u64) -> StageReport {
        StageReport {
            name: name.into(),
            first_step,
            last_step,
            seconds: 1.0,
        }
    }

    fn at(schedule: &Schedule, name: &str, step: f32) -> f32 {
        let knob = schedule.knobs.iter().find(|knob| knob.name == name).unwrap();
        let near = schedule.steps.iter().position(|s| *s >= step - 1e-3).unwrap();
        knob.values[near]
    }

    fn ended(recipe: &Recipe) -> Clock {
        Clock {
            stage: recipe.stage.len(),
            ..Clock::new(recipe)
        }
    }

    /// A run from its first recipe step, fitted neither into a number of steps nor into a time.
    fn whole<'a>(recipe: &'a Recipe, stages: &'a [StageReport], clock: &'a Clock) -> Course<'a> {
        Course {
            recipe,
            stages,
            clock,
            skipped: 0.0,
            steps: None,
            timed: false,
        }
    }

    #[test]
    fn a_run_without_early_ends_shows_the_plan() {
        let recipe = recipe("");
        let stages = [
            stage("warmup", 1, 50),
            stage("grow", 51, 100),
            stage("refine", 101, 200),
        ];
        let schedule = schedule(&Course {
            steps: Some(200),
            ..whole(&recipe, &stages, &ended(&recipe))
        });
        assert!(schedule.done && schedule.steps.windows(2).all(|w| w[0] <= w[1]));
        assert_eq!(schedule.steps.last(), Some(&200.0));
        assert!((at(&schedule, "rate.means", 100.0) - 2.0).abs() < 1e-3);
        assert!((at(&schedule, "scale.image", 25.0) - 0.75).abs() < 0.01);
        assert_eq!(
            (at(&schedule, "loss.depth", 25.0), at(&schedule, "loss.depth", 75.0)),
            (0.0, 0.25)
        );
        assert!(schedule.knobs.iter().all(|knob| knob.name != "loss.coarse"));
        assert!(
            schedule
                .knobs
                .iter()
                .all(|knob| knob.values.len() == schedule.steps.len())
        );
    }

    #[test]
    fn a_stage_ended_early_shows_what_was_done() {
        // The clock of a run whose first stage ends after 40 steps.
        let recipe = recipe("stage.warmup.exit={ when = 'threshold', tau = 0.1 }");
        let mut clock = Clock::new(&recipe);
        let mut truth = Vec::new();
        let mut entered = Vec::new();
        while !clock.finished(&recipe) {
            truth.push(plan(&recipe, &clock));
            let error = if clock.step + 1 < 40 { 1.0 } else { 0.0 };
            let metrics = StepMetrics {
                error,
                measured: Some(error),
                views: 1,
            };
            if clock.tick(&recipe, 1.0, metrics) {
                entered.push(clock.step);
            }
        }
        assert_eq!(entered, [40, 140, 340]);
        let stages = [
            stage("warmup", 1, 40),
            stage("grow", 41, 140),
            stage("refine", 141, 340),
        ];
        let schedule = schedule(&whole(&recipe, &stages, &clock));
        assert!(schedule.done);
        for (step, name, of) in [
            (20.0, "scale.image", truth[20].image_scale),
            (41.0, "scale.image", truth[41].image_scale),
            (100.0, "loss.depth", 0.25),
        ] {
            assert!((at(&schedule, name, step) - of).abs() < 0.02, "{name} at {step}");
        }
        let rates = schedule.knobs.iter().find(|knob| knob.name == "rate.means").unwrap();
        for (step, value) in schedule.steps.iter().zip(&rates.values) {
            let want = truth[(*step as usize).min(339)].value(Param::RateMeans);
            assert!((value - want).abs() < 0.03, "{value}, not {want}, at {step}");
        }
    }

    #[test]
    fn a_stopped_run_ends_at_its_last_step_and_a_timed_one_is_marked_as_plan() {
        let recipe = recipe("stage.warmup.exit={ when = 'threshold', tau = 0.1 }");
        let clock = Clock {
            stage: 1,
            step: 150,
            stage_step: 100,
            time: 150.0,
            stage_time: 100.0,
            ..Clock::new(&recipe)
        };
        let stages = [stage("warmup", 1, 100), stage("grow", 101, 150)];
        let course = whole(&recipe, &stages, &clock);
        let half = schedule(&course);
        assert!(half.done && half.steps.last() == Some(&150.0));
        let timed = Course { timed: true, ..course };
        assert!(!schedule(&timed).done);
        assert_eq!(
            schedule(&whole(&recipe, &[], &Clock::new(&recipe))),
            Schedule {
                done: true,
                ..Schedule::default()
            }
        );
    }

    #[test]
    fn a_run_that_skips_the_beginning_shows_what_it_did() {
        // 75 steps for the last 150 of 400: the first stage and a half are skipped.
        let recipe = recipe("");
        for (skipped, first_rate, stages) in [
            (250.0, 1.5, vec![stage("refine", 1, 75)]),
            (150.0, 2.5, vec![stage("grow", 1, 15), stage("refine", 16, 75)]),
        ] {
            let schedule = schedule(&Course {
                skipped,
                steps: Some(75),
                ..whole(&recipe, &stages, &ended(&recipe))
            });
            let rates = schedule.knobs.iter().find(|knob| knob.name == "rate.means").unwrap();
            assert!(schedule.done && schedule.steps.windows(2).all(|w| w[0] <= w[1]));
            for (step, value) in schedule.steps.iter().zip(&rates.values) {
                // Proportional to the steps that are left.
                let expected = first_rate * (1.0 - step / 75.0);
                assert!((value - expected).abs() < 0.02, "{value}, not {expected}, at {step}");
            }
            assert_eq!([schedule.steps[0], *schedule.steps.last().unwrap()], [0.0, 75.0]);
        }
    }
}
