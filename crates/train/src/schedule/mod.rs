//! Everything that depends on time. [`plan`] is pure: the plan of one step. [`Clock::tick`] advances by one step.

mod convergence;
mod outline;
#[cfg(test)]
mod published;

pub use convergence::ConvergenceMonitor;
pub use outline::{OutlinePoint, UpcomingStretch, outline, upcoming};

use crate::recipe::{DensityControl, Exit, Knob, MergeSettings, Param, Recipe, Shape, Values};
use crate::stream::Stream;
use convergence::MEASURE_EVERY;
use irradia_splat::regularize::Regularizers;
use irradia_splat::{Rates, Statistics};

/// Position of a run in its schedule.
#[derive(Clone, Debug, PartialEq)]
pub struct Clock {
    /// Steps completed.
    pub step: u64,
    /// Recipe steps completed; advances faster than `step` when a run is shorter than its recipe, and skips the rest of a stage
    /// that ends early.
    pub time: f64,
    /// Position of run-wide parameters, in recipe steps: like `time`, but skipped time is spread over the rest of the run, so that
    /// no parameter jumps.
    pub progress: f64,
    /// Recipe steps of `progress` per recipe step of `time`.
    pub stretch: f64,
    /// Index of the current stage.
    pub stage: usize,
    /// `time` at the start of the stage.
    pub stage_time: f64,
    /// `step` at the start of the stage.
    pub stage_step: u64,
    /// The values in effect at the start of the stage: a ramp without `from` continues from them.
    pub carried: Values,
    /// Whether opacities have been reset.
    pub was_reset: bool,
    /// Monitors the training error in this stage.
    pub monitor: ConvergenceMonitor,
}

/// The metrics of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepMetrics {
    /// L1 error of the step's view.
    pub error: f64,
    /// Mean L1 error over (a subset of) the training views, if the plan requested it.
    pub measured: Option<f64>,
    /// Number of training views.
    pub views: u64,
}

/// The plan of one step.
#[derive(Clone, Debug, PartialEq)]
pub struct StepPlan {
    /// Size of the training image relative to the data's.
    pub image_scale: f32,
    /// SH bands in use.
    pub sh_degree: u32,
    /// Values of all parameters; [`StepPlan::value`] gives those in effect.
    pub values: Values,
    /// Density statistics to gather.
    pub gathers: Option<Statistics>,
    /// Weight of the photograph's edges in the gathered error.
    pub edge_share: f32,
    /// A round of density control after the step.
    pub densify: Option<Round>,
    /// Merge adjacent splats after the step.
    pub merge: Option<MergeSettings>,
    /// Reset opacities to this after the step.
    pub reset_opacity: Option<f32>,
    /// Recompute the smoothing filter before the step.
    pub refilter: bool,
    /// Update a field's occupancy grid after the step.
    pub update_occupancy: bool,
    /// Measure the error over training views after the step.
    pub measure: bool,
    /// Evaluate held-out views after the step.
    pub evaluate: bool,
    /// Write a checkpoint after the step.
    pub checkpoint: bool,
}

/// A round of density control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Round {
    /// The strategy.
    pub density: DensityControl,
    /// Whether oversized splats are removed too.
    pub prune_large: bool,
    /// Which round of the stage it is, from 1.
    pub number: u64,
    /// Maximum number of splats, as a fraction of the cap.
    pub count_share: f64,
    /// Fraction of the stage completed, now and at the previous round.
    pub completed: [f64; 2],
}

impl StepPlan {
    /// A parameter's value in effect ([`Values::in_effect`]).
    pub fn value(&self, param: Param) -> f32 {
        self.values.in_effect(param) as f32
    }

    /// Whether a switch is on.
    pub fn is_on(&self, switch: Param) -> bool {
        self.values[switch] >= 0.5
    }

    /// Weights of the regularisers.
    pub fn regularizers(&self) -> Regularizers {
        Regularizers {
            opacity: self.value(Param::OpacityReg),
            opacity_square: self.value(Param::OpacitySquareReg),
            scale: self.value(Param::ScaleReg),
            covariance: self.value(Param::CovarianceReg),
        }
    }

    /// Learning rates; that of the means in units of the scene's extent.
    pub fn rates(&self) -> Rates {
        Rates {
            means: self.value(Param::RateMeans),
            means_from: None,
            quats: self.value(Param::RateQuats),
            log_scales: self.value(Param::RateScales),
            opacities: self.value(Param::RateOpacities),
            sh_dc: self.value(Param::RateShDc),
            sh_rest: self.value(Param::RateShRest),
        }
    }
}

impl Clock {
    /// At the start of `recipe`.
    pub fn new(recipe: &Recipe) -> Self {
        let mut clock = Self {
            step: 0,
            time: 0.0,
            progress: 0.0,
            stretch: 1.0,
            stage: 0,
            stage_time: 0.0,
            stage_step: 0,
            carried: Values::default_values(),
            was_reset: false,
            monitor: ConvergenceMonitor::default(),
        };
        clock.carried = values(recipe, &clock);
        clock
    }

    /// Whether the recipe is complete.
    pub fn finished(&self, recipe: &Recipe) -> bool {
        self.stage >= recipe.stage.len()
    }

    /// Advances by one step that took `pace` recipe steps; true if a stage ended.
    pub fn tick(&mut self, recipe: &Recipe, pace: f64, metrics: StepMetrics) -> bool {
        let plan = plan(recipe, self);
        self.was_reset |= plan.reset_opacity.is_some();
        self.step += 1;
        self.time += pace;
        self.progress += pace * self.stretch;
        let in_stage = self.time - self.stage_time;
        self.monitor
            .observe(metrics.error, metrics.measured, metrics.views, in_stage);
        let growth = values(recipe, self)[Param::ImageScale] / plan.values[Param::ImageScale];
        if growth.max(1.0 / growth) > MAX_GROWTH {
            // Errors of images of different sizes cannot be compared: larger ones have more detail, and a larger error.
            self.monitor = ConvergenceMonitor::default();
        }
        let exit = recipe.stage.get(self.stage).and_then(|stage| stage.exit.as_ref());
        if exit.is_some_and(|exit| self.monitor.should_end(exit, metrics.views, in_stage)) {
            self.leave_early(recipe);
        }
        self.enter_stages(recipe, plan.values)
    }

    /// Advances `time` without a step.
    pub(crate) fn advance(&mut self, recipe: &Recipe, time: f64) {
        let before = values(recipe, self);
        self.time += time;
        self.progress += time * self.stretch;
        self.enter_stages(recipe, before);
    }

    /// Enters the stage at `time`; true if it differs from the current one. `before` are the values in effect until then.
    fn enter_stages(&mut self, recipe: &Recipe, before: Values) -> bool {
        // Half a thousandth of a step tolerates the rounding of a sum of fractions.
        let mut ended = false;
        while self.stage < recipe.stage.len()
            && self.time - self.stage_time >= recipe.stage[self.stage].steps as f64 - 5e-4
        {
            self.stage_time += recipe.stage[self.stage].steps as f64;
            self.stage += 1;
            self.stage_step = self.step;
            self.carried = before;
            self.monitor = ConvergenceMonitor::default();
            ended = true;
        }
        ended
    }

    fn leave_early(&mut self, recipe: &Recipe) {
        self.time = self.time.max(self.stage_time + recipe.stage[self.stage].steps as f64);
        let total = recipe.total_steps() as f64;
        if total > self.time {
            self.stretch = (total - self.progress) / (total - self.time);
        }
    }
}

/// The values of all parameters.
fn values(recipe: &Recipe, clock: &Clock) -> Values {
    let Some(stage) = recipe.stage.get(clock.stage) else {
        return clock.carried;
    };
    let total = recipe.total_steps() as f64;
    Values::from_fn(|param| {
        if let Some(knob) = stage.params.get(&param) {
            value(
                knob,
                clock.time - clock.stage_time,
                stage.steps as f64,
                clock.carried[param],
            )
        } else if let Some(knob) = recipe.params.get(&param) {
            value(knob, clock.progress, total, param.row().default)
        } else {
            clock.carried[param]
        }
    })
}

fn value(knob: &Knob, time: f64, length: f64, carried: f64) -> f64 {
    match knob {
        Knob::Const(v) => *v,
        Knob::Ramp { from, to, shape } => {
            let from = from.unwrap_or(carried);
            let t = (time / length).clamp(0.0, 1.0);
            match shape {
                Shape::Linear => from + (to - from) * t,
                Shape::Log => (from.max(1e-30).ln() * (1.0 - t) + to.ln() * t).exp(),
                Shape::Cosine => to + (from - to) * 0.5 * (1.0 + (std::f64::consts::PI * t).cos()),
            }
        }
        Knob::Steps { steps } => steps
            .iter()
            .rev()
            .find(|(at, _)| *at as f64 <= time)
            .map_or(steps[0].1, |(_, v)| *v),
    }
}

/// Whether the step at `clock` completes a multiple of `every` steps.
pub fn is_due(clock: &Clock, every: u64) -> bool {
    (clock.step + 1).is_multiple_of(every)
}

/// The plan of the step at `clock`. After the recipe's end, that of the last step, with nothing due.
pub fn plan(recipe: &Recipe, clock: &Clock) -> StepPlan {
    let values = values(recipe, clock);
    let stage = &recipe.stage[clock.stage.min(recipe.stage.len() - 1)];
    // Counted from 1: the number of steps of the stage once this one is complete.
    let in_stage = clock.step + 1 - clock.stage_step;
    let density = stage.density;
    let next = recipe.stage.get(clock.stage + 1).and_then(|stage| stage.density);
    let gathers = density.or(next.filter(DensityControl::gathers_early));
    let measured = matches!(stage.exit, Some(Exit::Threshold { .. } | Exit::Relative { .. }));
    StepPlan {
        image_scale: values[Param::ImageScale] as f32,
        sh_degree: values[Param::ShDegree] as u32,
        values,
        gathers: gathers.map(|density| density.statistics()),
        edge_share: gathers.map_or(0.0, |density| density.edge_share()),
        densify: density
            .filter(|density| in_stage.is_multiple_of(density.every()))
            .map(|density| {
                let completed = ((clock.time - clock.stage_time) / stage.steps as f64).clamp(0.0, 1.0);
                // Steps and time are nearly proportional within a stage: a budget's pace drifts.
                let before = completed * (in_stage - density.every()) as f64 / in_stage as f64;
                Round {
                    density,
                    prune_large: clock.was_reset,
                    number: in_stage / density.every(),
                    count_share: values[Param::CountShare],
                    completed: [completed, before],
                }
            }),
        merge: stage.merge.filter(|merge| in_stage.is_multiple_of(merge.every)),
        reset_opacity: density
            .and_then(|density| density.reset())
            .and_then(|(every, to)| is_due(clock, every).then_some(to)),
        refilter: recipe.render.smoothing_filter && clock.step.is_multiple_of(REFILTER_EVERY),
        update_occupancy: is_due(clock, OCCUPANCY_EVERY),
        measure: measured && in_stage.is_multiple_of(MEASURE_EVERY),
        evaluate: is_due(clock, recipe.eval_every),
        checkpoint: is_due(clock, recipe.checkpoint_every),
    }
}

/// Growth of the images at a step up to which the error before and after it can be compared, so that gradual growth does not prevent the end
/// of a stage.
const MAX_GROWTH: f64 = 1.1;

/// Steps between updates of the 3D smoothing filter (Mip-Splatting's code: 100).
const REFILTER_EVERY: u64 = 100;

/// Steps between updates of a field's occupancy grid (Instant-NGP).
const OCCUPANCY_EVERY: u64 = 16;

/// The training views from this step on, each once: shuffled anew in each pass over them. A pure function of seed and step, so
/// that a resumed run sees the same views.
pub fn upcoming_views(train: &[usize], seed: u64, clock: &Clock) -> Vec<usize> {
    let n = train.len() as u64;
    let pass = |number: u64| {
        let mut order = train.to_vec();
        let seed = seed ^ number.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        Stream::ViewOrder.rng(seed).shuffle(&mut order);
        order
    };
    let (number, at) = (clock.step / n, (clock.step % n) as usize);
    let mut upcoming = pass(number)[at..].to_vec();
    // Views already seen in this pass come in the next.
    let mut seen: Vec<usize> = upcoming.clone();
    seen.sort_unstable();
    upcoming.extend(
        pass(number + 1)
            .into_iter()
            .filter(|view| seen.binary_search(view).is_err()),
    );
    upcoming
}

#[cfg(test)]
mod tests {
    use super::*;

    const METRICS: StepMetrics = StepMetrics {
        error: 0.1,
        measured: None,
        views: 4,
    };

    fn recipe() -> Recipe {
        let text = r#"
            name = "test"
            about = ""
            max_splats = 10
            eval_every = 7
            checkpoint_every = 1000
            render = { background = [0, 0, 0], antialias = false }
            init = { opacity = 0.1, scale = 1.0, random_points = 10 }
            adam = { beta1 = 0.9, beta2 = 0.999, epsilon = 1e-15 }
            [params]
            rate_means = { from = 1.0, to = 0.01, shape = "log" }
            sh_degree = { steps = [[0, 0], [4, 1], [12, 3]] }
            [[stage]]
            name = "one"
            steps = 10
            params = { rate_quats = { from = 0.0, to = 1.0 }, ssim_weight = 0.2 }
            [[stage]]
            name = "two"
            steps = 10
            params = { rate_quats = { to = 0.0 }, rate_opacities = { from = 2.0, to = 1.0, shape = "cosine" } }
            [stage.density]
            strategy = "classic"
            every = 4
            gradient_threshold = 1.0
            small = 0.01
            min_opacity = 0.005
            max_scale = 0.1
            reset_every = 6
            reset_to = 0.01
        "#;
        Recipe::parse("test", text, &[]).unwrap()
    }

    fn plans(recipe: &Recipe, pace: f64) -> Vec<StepPlan> {
        let mut clock = Clock::new(recipe);
        let mut plans = Vec::new();
        while !clock.finished(recipe) {
            plans.push(plan(recipe, &clock));
            clock.tick(recipe, pace, METRICS);
        }
        plans
    }

    #[test]
    fn parameters_follow_their_curves_and_continue_over_stages() {
        let p = plans(&recipe(), 1.0);
        assert_eq!(p.len(), 20);
        assert!(
            (p[10].value(Param::RateMeans) - 0.1).abs() < 1e-6,
            "half-way in the logarithm"
        );
        assert_eq!(
            [p[3].sh_degree, p[4].sh_degree, p[11].sh_degree, p[12].sh_degree],
            [0, 1, 1, 3]
        );
        assert!((p[5].value(Param::RateQuats) - 0.5).abs() < 1e-6);
        // The second stage's ramp has no `from`: it continues from the last value in effect, without a jump.
        assert!((p[10].value(Param::RateQuats) - p[9].value(Param::RateQuats)).abs() < 1e-6);
        assert!((p[15].value(Param::RateQuats) - 0.5 * p[9].value(Param::RateQuats)).abs() < 1e-6);
        assert_eq!(
            (p[3].value(Param::SsimWeight), p[15].value(Param::SsimWeight)),
            (0.2, 0.2),
            "a parameter that a stage does not set is carried over"
        );
        assert!((p[15].value(Param::RateOpacities) - 1.5).abs() < 1e-6);
    }

    #[test]
    fn density_control_counts_steps_of_its_stage_and_pruning_waits_for_a_reset() {
        let p = plans(&recipe(), 1.0);
        let densify: Vec<(usize, bool)> = (0..20)
            .filter_map(|i| p[i].densify.map(|round| (i + 1, round.prune_large)))
            .collect();
        assert_eq!(densify, [(14, true), (18, true)], "step 12 reset the opacities");
        let resets: Vec<usize> = (0..20)
            .filter(|i| p[*i].reset_opacity.is_some())
            .map(|i| i + 1)
            .collect();
        assert_eq!(resets, [12, 18]);
        assert!(
            p.iter().all(|plan| plan.gathers.is_some()),
            "statistics begin in the stage before"
        );
        assert_eq!(
            (0..20).filter(|i| p[*i].evaluate).map(|i| i + 1).collect::<Vec<_>>(),
            [7, 14]
        );
    }

    #[test]
    fn a_shorter_run_covers_the_whole_recipe() {
        let recipe = recipe();
        for steps in [7u64, 13, 40] {
            let p = plans(&recipe, 20.0 / steps as f64);
            assert_eq!(p.len() as u64, steps);
            assert!((p[0].value(Param::RateMeans) - 1.0).abs() < 1e-6);
            let expected = 0.01f64.powf((steps - 1) as f64 / steps as f64) as f32;
            assert!((p.last().unwrap().value(Param::RateMeans) / expected - 1.0).abs() < 1e-4);
            assert_eq!(p.last().unwrap().sh_degree, 3);
        }
    }

    #[test]
    fn every_pass_shows_each_view_once_in_a_new_order() {
        let recipe = recipe();
        let mut clock = Clock::new(&recipe);
        let train = [3, 5, 8, 9, 11];
        let mut seen = Vec::new();
        for step in 0..15 {
            clock.step = step;
            let upcoming = upcoming_views(&train, 7, &clock);
            let mut all = upcoming.clone();
            all.sort_unstable();
            assert_eq!(all, train, "the upcoming views contain each view once");
            seen.push(upcoming[0]);
        }
        for pass in seen.chunks(5) {
            let mut sorted = pass.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, train);
        }
        assert!(seen[..5] != seen[5..10] || seen[5..10] != seen[10..]);
    }

    #[test]
    fn a_stage_shorter_than_a_step_is_skipped() {
        let mut recipe = recipe();
        recipe.stage[0].steps = 1;
        let mut clock = Clock::new(&recipe);
        assert!(clock.tick(&recipe, 5.0, METRICS));
        assert_eq!((clock.stage, clock.stage_time), (1, 1.0));
        assert!(clock.tick(&recipe, 100.0, METRICS) && clock.finished(&recipe));
    }

    /// Ticks until the recipe is complete with the errors of `error(step)`; returns the steps after which a stage ended, and plans.
    fn ends(recipe: &Recipe, error: impl Fn(u64) -> StepMetrics) -> (Vec<u64>, Vec<StepPlan>) {
        let mut clock = Clock::new(recipe);
        let (mut ends, mut plans) = (Vec::new(), Vec::new());
        while !clock.finished(recipe) {
            plans.push(plan(recipe, &clock));
            if clock.tick(recipe, 1.0, error(clock.step)) {
                ends.push(clock.step);
            }
        }
        (ends, plans)
    }

    fn with_exit(exit: Exit) -> Recipe {
        let mut recipe = recipe();
        recipe.stage[0].steps = 300;
        recipe.stage[0].exit = Some(exit);
        recipe
    }

    fn error(value: f64) -> StepMetrics {
        StepMetrics {
            error: value,
            ..METRICS
        }
    }

    #[test]
    fn a_stage_ends_when_its_error_is_below_the_threshold_but_not_before_every_view_was_seen() {
        let recipe = with_exit(Exit::Threshold { tau: 0.05 });
        assert_eq!(ends(&recipe, |_| error(0.01)).0[0], 4, "four views");
        assert_eq!(ends(&recipe, |_| error(0.1)).0[0], 300, "its steps limit it");
        // An exponential mean over four views of a step from 0.1 to 0.01 passes 0.05 at the third step after it.
        assert_eq!(ends(&recipe, |s| error(if s < 50 { 0.1 } else { 0.01 })).0[0], 53);
        // A measurement takes precedence over the estimate.
        let measured = |step| StepMetrics {
            measured: (step == 99).then_some(0.02),
            ..METRICS
        };
        assert_eq!(ends(&recipe, measured).0[0], 100);
        assert!(
            plan(
                &recipe,
                &Clock {
                    step: 99,
                    ..Clock::new(&recipe)
                }
            )
            .measure
        );
    }

    #[test]
    fn a_relative_threshold_tunes_itself() {
        let recipe = with_exit(Exit::Relative { ratio: 0.5 });
        for scale in [0.3, 0.01] {
            let (at, _) = ends(&recipe, |s| error(scale * (-(s as f64) / 40.0).exp()));
            // The first mean is that of steps 0 to 3, at 1.5; half of it is ln 2 * 40 = 28 steps later, and the mean lags.
            assert!((28..36).contains(&at[0]), "{at:?}");
        }
    }

    #[test]
    fn a_plateau_ends_a_stage_and_a_slope_does_not() {
        let recipe = with_exit(Exit::Plateau { drop: 0.02, window: 60 });
        assert_eq!(ends(&recipe, |s| error((-(s as f64) / 100.0).exp())).0[0], 300);
        let (at, _) = ends(&recipe, |s| error((-(s.min(100) as f64) / 100.0).exp()));
        assert!((160..180).contains(&at[0]), "{at:?}");
    }

    #[test]
    fn a_plateau_is_judged_anew_when_images_become_larger() {
        let mut recipe = with_exit(Exit::Plateau { drop: 0.02, window: 60 });
        let sizes = Knob::Steps {
            steps: vec![(0, 0.5), (100, 1.0)],
        };
        recipe.stage[0].params.insert(Param::ImageScale, sizes);
        let falling = |s: u64| (-(s as f64) / 100.0).exp();
        // The error doubles with the size and keeps falling.
        let (at, _) = ends(&recipe, |s| error(if s < 100 { falling(s) } else { 2.0 * falling(s) }));
        assert_eq!(at[0], 300);
    }

    #[test]
    fn no_rate_jumps_when_a_stage_is_left_early_and_the_run_still_ends_at_the_end_of_every_ramp() {
        let recipe = with_exit(Exit::Threshold { tau: 0.05 });
        let (at, p) = ends(&recipe, |s| error(if s < 50 { 0.1 } else { 0.01 }));
        assert_eq!(at, [53, 63]);
        // Over the whole run: it continues from where it was, and the rest of the curve spans the rest of the run.
        let slope: Vec<f32> = p
            .windows(2)
            .map(|w| w[1].value(Param::RateMeans) / w[0].value(Param::RateMeans))
            .collect();
        assert!(
            (slope[52] / slope[51] - 1.0).abs() < 0.02,
            "the step across the stage boundary has the old slope"
        );
        let last = f64::from(p[62].value(Param::RateMeans)) * f64::from(slope[61]);
        assert!((last / 0.01 - 1.0).abs() < 0.01, "{last}");
        // Over the stage: the next stage's ramp continues from the value in effect.
        assert!((p[53].value(Param::RateQuats) - p[52].value(Param::RateQuats)).abs() < 1e-6);
    }
}
