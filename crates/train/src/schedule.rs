//! Everything that depends on time. [`plan`] is pure: what one step does. [`Clock::tick`] moves on by one step.

use crate::recipe::{Density, Knob, Param, Recipe, Shape};
use irradia_scene::Rng;
use irradia_splat::Rates;

/// Where a run stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Clock {
    /// Steps made.
    pub step: u64,
    /// Recipe steps gone by; runs faster than `step` when a run is shorter than its recipe.
    pub time: f64,
    /// The stage.
    pub stage: usize,
    /// `time` when it was entered.
    pub stage_time: f64,
    /// `step` when it was entered.
    pub stage_step: u64,
    /// The values in force when it was entered, by [`Param::ALL`]: a ramp without `from` goes on from them.
    pub carried: [f64; Param::ALL.len()],
    /// Whether opacities were reset before.
    pub was_reset: bool,
}

/// What one step does.
#[derive(Clone, Debug, PartialEq)]
pub struct StepPlan {
    /// Size of the training image relative to the data's.
    pub image_scale: f32,
    /// SH bands in use.
    pub sh_degree: u32,
    /// w in (1 - w) L1 + w (1 - SSIM).
    pub ssim_weight: f32,
    /// Weight of the alpha term.
    pub alpha_weight: f32,
    /// Learning rates; that of the means in units of the scene's extent.
    pub rates: Rates,
    /// Whether density statistics are gathered.
    pub gathers: bool,
    /// A round of density control, after the step; the flag says whether oversized splats go too.
    pub densify: Option<(Density, bool)>,
    /// Opacities are lowered to this, after the step.
    pub reset_opacity: Option<f32>,
    /// Held-out views are evaluated, after the step.
    pub evaluate: bool,
    /// A checkpoint is written, after the step.
    pub checkpoint: bool,
}

impl Clock {
    /// At the start of `recipe`.
    pub fn new(recipe: &Recipe) -> Self {
        let mut clock = Self {
            step: 0,
            time: 0.0,
            stage: 0,
            stage_time: 0.0,
            stage_step: 0,
            carried: Param::ALL.map(Param::default_value),
            was_reset: false,
        };
        clock.carried = values(recipe, &clock);
        clock
    }

    /// Whether the recipe is over.
    pub fn finished(&self, recipe: &Recipe) -> bool {
        self.stage >= recipe.stage.len()
    }

    /// Moves on by one step that took `pace` recipe steps; true where a stage ended.
    pub fn tick(&mut self, recipe: &Recipe, pace: f64) -> bool {
        let before = values(recipe, self);
        self.was_reset |= plan(recipe, self).reset_opacity.is_some();
        self.step += 1;
        self.time += pace;
        // Half a thousandth of a step forgives the rounding of a sum of fractions.
        let mut ended = false;
        while self.stage < recipe.stage.len()
            && self.time - self.stage_time >= recipe.stage[self.stage].steps as f64 - 5e-4
        {
            self.stage_time += recipe.stage[self.stage].steps as f64;
            self.stage += 1;
            self.stage_step = self.step;
            self.carried = before;
            ended = true;
        }
        ended
    }
}

/// The value of every knob, by [`Param::ALL`].
fn values(recipe: &Recipe, clock: &Clock) -> [f64; Param::ALL.len()] {
    let Some(stage) = recipe.stage.get(clock.stage) else {
        return clock.carried;
    };
    let total = recipe.total_steps() as f64;
    std::array::from_fn(|i| {
        let param = Param::ALL[i];
        if let Some(knob) = stage.params.get(&param) {
            value(
                knob,
                clock.time - clock.stage_time,
                stage.steps as f64,
                clock.carried[i],
            )
        } else if let Some(knob) = recipe.params.get(&param) {
            value(knob, clock.time, total, param.default_value())
        } else {
            clock.carried[i]
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

/// Whether the step that `clock` stands before is one of every `every`.
pub fn is_due(clock: &Clock, every: u64) -> bool {
    (clock.step + 1).is_multiple_of(every)
}

/// What the step that `clock` stands before does. After the recipe's end it is what the last step did, at rest.
pub fn plan(recipe: &Recipe, clock: &Clock) -> StepPlan {
    let v = values(recipe, clock);
    let of = |param: Param| v[param as usize];
    let stage = &recipe.stage[clock.stage.min(recipe.stage.len() - 1)];
    // Counted as people do: after the step that makes it the n-th.
    let in_stage = clock.step + 1 - clock.stage_step;
    let density = stage.density.as_ref();
    let (densify, reset_opacity) = match density {
        Some(density @ Density::Classic(knobs)) => (
            in_stage
                .is_multiple_of(knobs.every)
                .then(|| (density.clone(), clock.was_reset)),
            (knobs.reset_every > 0 && is_due(clock, knobs.reset_every)).then_some(knobs.reset_to),
        ),
        None => (None, None),
    };
    StepPlan {
        image_scale: of(Param::ImageScale) as f32,
        sh_degree: of(Param::ShDegree) as u32,
        ssim_weight: of(Param::SsimWeight) as f32,
        alpha_weight: of(Param::AlphaWeight) as f32,
        rates: Rates {
            means: of(Param::RateMeans) as f32,
            quats: of(Param::RateQuats) as f32,
            log_scales: of(Param::RateScales) as f32,
            opacities: of(Param::RateOpacities) as f32,
            sh_dc: of(Param::RateShDc) as f32,
            sh_rest: of(Param::RateShRest) as f32,
        },
        gathers: density.is_some(),
        densify,
        reset_opacity,
        evaluate: is_due(clock, recipe.eval_every),
        checkpoint: is_due(clock, recipe.checkpoint_every),
    }
}

/// The stream of the run's seed that orders the views.
const STREAM_VIEWS: u64 = 3;

/// The training views from this step on, each once: shuffled anew in each pass over them. A function of the seed and the
/// step alone, so that a resumed run sees what the first would have.
pub fn coming_views(train: &[usize], seed: u64, clock: &Clock) -> Vec<usize> {
    let n = train.len() as u64;
    let pass = |number: u64| {
        let mut order = train.to_vec();
        Rng::new(seed ^ number.wrapping_mul(0x9e37_79b9_7f4a_7c15), STREAM_VIEWS).shuffle(&mut order);
        order
    };
    let (number, at) = (clock.step / n, (clock.step % n) as usize);
    let mut coming = pass(number)[at..].to_vec();
    // What was seen in this pass comes again in the next.
    let mut seen: Vec<usize> = coming.clone();
    seen.sort_unstable();
    coming.extend(
        pass(number + 1)
            .into_iter()
            .filter(|view| seen.binary_search(view).is_err()),
    );
    coming
}

#[cfg(test)]
mod tests {
    use super::*;

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
            max_extent = 20
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
            clock.tick(recipe, pace);
        }
        plans
    }

    #[test]
    fn knobs_follow_their_curves_and_go_on_over_stages() {
        let p = plans(&recipe(), 1.0);
        assert_eq!(p.len(), 20);
        assert!((p[10].rates.means - 0.1).abs() < 1e-6, "half way in the logarithm");
        assert_eq!(
            [p[3].sh_degree, p[4].sh_degree, p[11].sh_degree, p[12].sh_degree],
            [0, 1, 1, 3]
        );
        assert!((p[5].rates.quats - 0.5).abs() < 1e-6);
        // The second stage's ramp has no `from`: it goes on from the last value in force, without a jump.
        assert!((p[10].rates.quats - p[9].rates.quats).abs() < 1e-6);
        assert!((p[15].rates.quats - 0.5 * p[9].rates.quats).abs() < 1e-6);
        assert_eq!(
            (p[3].ssim_weight, p[15].ssim_weight),
            (0.2, 0.2),
            "a knob that a stage does not name is carried"
        );
        assert!((p[15].rates.opacities - 1.5).abs() < 1e-6);
    }

    #[test]
    fn density_control_counts_steps_of_its_stage_and_pruning_waits_for_a_reset() {
        let p = plans(&recipe(), 1.0);
        let densify: Vec<(usize, bool)> = (0..20)
            .filter_map(|i| p[i].densify.as_ref().map(|(_, large)| (i + 1, *large)))
            .collect();
        assert_eq!(densify, [(14, true), (18, true)], "step 12 reset the opacities");
        let resets: Vec<usize> = (0..20)
            .filter(|i| p[*i].reset_opacity.is_some())
            .map(|i| i + 1)
            .collect();
        assert_eq!(resets, [12, 18]);
        assert!(!p[9].gathers && p[10].gathers);
        assert_eq!(
            (0..20).filter(|i| p[*i].evaluate).map(|i| i + 1).collect::<Vec<_>>(),
            [7, 14]
        );
    }

    #[test]
    fn a_shorter_run_passes_through_the_whole_recipe() {
        let recipe = recipe();
        for steps in [7u64, 13, 40] {
            let p = plans(&recipe, 20.0 / steps as f64);
            assert_eq!(p.len() as u64, steps);
            assert!((p[0].rates.means - 1.0).abs() < 1e-6);
            let expected = 0.01f64.powf((steps - 1) as f64 / steps as f64) as f32;
            assert!((p.last().unwrap().rates.means / expected - 1.0).abs() < 1e-4);
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
            let coming = coming_views(&train, 7, &clock);
            let mut all = coming.clone();
            all.sort_unstable();
            assert_eq!(all, train, "what comes names each view once");
            seen.push(coming[0]);
        }
        for pass in seen.chunks(5) {
            let mut sorted = pass.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, train);
        }
        assert!(seen[..5] != seen[5..10] || seen[5..10] != seen[10..]);
    }

    #[test]
    fn a_stage_shorter_than_a_step_is_passed_over() {
        let mut recipe = recipe();
        recipe.stage[0].steps = 1;
        let mut clock = Clock::new(&recipe);
        assert!(clock.tick(&recipe, 5.0));
        assert_eq!((clock.stage, clock.stage_time), (1, 1.0));
        assert!(clock.tick(&recipe, 100.0) && clock.finished(&recipe));
    }
}
