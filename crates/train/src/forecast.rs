//! Predicts the duration of the rest of a run, and the pace that fits it into a budget.
//!
//! A recipe's steps differ in cost: images grow, and splats grow in number and colour. The rest of the recipe is evaluated with a
//! model of the work of a step, one constant of which is measured as the run proceeds, and of how its strategy adds splats.

use crate::recipe::{DensityControl, Recipe, Represents};
use crate::schedule::{Clock, StepPlan, UpcomingStretch, upcoming};
use crate::trainer::Trainer;

/// Work of a step, microseconds on one core (AVX-512), by least squares of the relative error over the first 250 to 500 steps of
/// six runs: chair with `classic`, `fast` and `curriculum`, fox_colmap with `fast`, fern with `mcmc`, demo with `classic`. Measured
/// steps were 0.65 to 1.22 of the prediction. Per pixel,
const PIXEL_COST: f64 = 0.09;
/// per splat-pixel pair visited by blending,
const PAIR_COST: f64 = 0.00065;
/// per splat,
const SPLAT_COST: f64 = 0.26;
/// per parameter of a splat in use,
const PARAMETER_COST: f64 = 0.0016;
/// per pixel of the LPIPS crop,
const PERCEPTUAL_PIXEL_COST: f64 = 1.15;
/// and per sample of a field.
const SAMPLE_COST: f64 = 2.0;
/// Parameters of a splat other than its harmonics.
const GEOMETRY_PARAMETERS: f64 = 11.0;
/// Pairs per pixel grow with the number of splats and shrink with the images' sides, both to this power (31 to 780 were seen);
const PAIRS_EXPONENT: f64 = 0.5;
/// `mcmc` adds splats as large as those that it copies (0.7 to 0.9 on fox, lund_door, maryRose).
const MCMC_PAIRS_EXPONENT: f64 = 0.75;
/// Number of points in time at which the rest of the run is evaluated.
const FORECAST_PARTS: usize = 48;
/// Steps between two measurements of a run without a budget, since each walks all tile entries and the rest of the recipe: at
/// most this many,
const MAX_MEASURE_INTERVAL: usize = 16;
/// and at most this fraction (one over it) of the steps completed, since costs change fast at first.
const MEASURE_DIVISOR: usize = 16;
/// Steps over which costs are averaged, but at most the last quarter, since costs change fast at first.
const MAX_WINDOW: usize = 50;
/// A measurement counts as at most this many times the mean: a step that was interrupted says nothing about the next ones.
const MAX_OUTLIER: f64 = 3.0;
/// Overdraw is not predicted to fall below this fraction of its current value.
const MIN_OVERDRAW_FRACTION: f64 = 0.25;
/// Growth factor of the splats added per round of `classic` in its first rounds (1.5 on chair, 2.3 on fox_colmap, of 1000 and 2000 steps).
const EARLY_GROWTH: f64 = 1.5;
const EARLY_ROUNDS: u32 = 3;
/// Then it decays, to 1 / e in this many steps (1,300 on demo, 3,300 on fox_colmap, 5,000 on chair, 6,000 on fern).
const GROWTH_DECAY_STEPS: f64 = 3000.0;
/// The strategy `fast` converges to a number of splats that grows with the images: pixels to this power (2.3 times for images of
/// twice the side; 1.8 to 2.6 on five scenes),
const SPLATS_EXPONENT: f64 = 0.6;
/// within this fraction of the recipe.
const CONVERGENCE_FRACTION: f64 = 0.12;

/// How far off a prediction may be, as a factor either way: up to a tenth of the recipe, and from nine tenths on; in between it falls
/// evenly in the logarithm. Over 21 runs of two recipes on six scenes, on a busy machine, the remaining time was within this range in 92 %
/// of the steps after the first tenth, and in 74 % in the worst run.
const UNCERTAINTY: [f64; 2] = [2.5, 1.3];

/// Range of the remaining time in nine of ten runs, if `left` seconds were predicted.
pub fn range(left: f64, recipe: &Recipe, clock: &Clock) -> [f64; 2] {
    let passed = clock.time / recipe.total_steps() as f64;
    let t = ((passed - 0.1) / 0.8).clamp(0.0, 1.0);
    let factor = UNCERTAINTY[0].powf(1.0 - t) * UNCERTAINTY[1].powf(t);
    [left / factor, left * factor]
}

/// Measured cost and growth of a run.
#[derive(Clone, Debug, Default)]
pub struct Forecast {
    /// Steps observed.
    steps: usize,
    /// The seconds of the trainer's steps at the last measurement.
    seconds: f64,
    /// Steps since then.
    since: usize,
    /// The next step and its number of splats.
    next: Option<(UpcomingStretch, f64)>,
    /// Pairs per pixel of each splat step, normalised to an image scale and a number of splats of 1.
    overdraws: Vec<f64>,
    /// Seconds per unit of work, a moving average.
    work_seconds: Option<f64>,
    /// Seconds that the rest of the run takes at a pace of 1.
    rest_seconds: f64,
    /// Mean pixels of a training image.
    pixels: f64,
    /// Recipe time and number of splats when that number last changed, or the stage began.
    last_round: Option<(usize, f64, f64)>,
    /// Splats added per recipe step by the last round of density control.
    rate: f64,
    /// Rounds observed in this stage.
    rounds: u32,
    /// Size of the training images.
    image_scale: f64,
    /// Target of `fast` since images have grown.
    target: Option<TargetCount>,
}

/// A target number of splats.
#[derive(Clone, Copy, Debug)]
struct TargetCount {
    count: f64,
    /// Splats added per recipe step.
    rate: f64,
    /// Recipe time at which the target is reached or abandoned.
    until: f64,
}

impl TargetCount {
    /// The target after the sides of images grow by `factor` at `time`, with `count` splats.
    fn new(trainer: &Trainer, factor: f64, time: f64, count: f64) -> Self {
        let follow = CONVERGENCE_FRACTION * trainer.recipe.total_steps() as f64;
        let target = count * factor.powi(2).powf(SPLATS_EXPONENT);
        Self {
            count: target,
            rate: (target - count) / follow,
            until: time + follow,
        }
    }
}

impl Forecast {
    /// Measures the cost of the last steps; called before each step with its `plan`. A run whose pace follows the forecast measures
    /// every step (`closely`), others ever less often, down to one in [`MAX_MEASURE_INTERVAL`].
    pub fn observe(&mut self, trainer: &Trainer, plan: &StepPlan, closely: bool) {
        if self.pixels == 0.0 {
            let cameras = trainer.train_cameras();
            let sizes = cameras.iter().map(|c| &c.intrinsics);
            let pixels: f64 = sizes.map(|k| f64::from(k.width) * f64::from(k.height)).sum();
            self.pixels = pixels / cameras.len().max(1) as f64;
        }
        self.since += usize::from(self.next.is_some());
        self.follow_growth(trainer, plan);
        // Another image size or stage changes the cost: earlier measurements must not be mixed in.
        let other = self.next.is_some_and(|(step, _)| {
            step.stage != trainer.clock.stage || (f64::from(plan.image_scale) / step.image_scale - 1.0).abs() > 0.05
        });
        if !closely && !other && self.since < (self.steps / MEASURE_DIVISOR).min(MAX_MEASURE_INTERVAL) {
            return;
        }
        if let Some((step, count)) = self.next.take() {
            let before = self.steps;
            self.steps += self.since;
            let share = (self.since as f64 / window(self.steps) as f64).min(1.0);
            let pairs = trainer.engine.pairs() as f64 / (self.pixels * step.image_scale.powi(2));
            // A field has no pairs, and does not predict those of later splats.
            if pairs > 0.0 {
                let power = pairs_exponent(trainer);
                let overdraw = pairs / (count.max(1.0) / step.image_scale).powf(power);
                self.overdraws
                    .resize(self.overdraws.len() + self.steps - before, overdraw);
            }
            let seconds = (step_seconds(trainer) - self.seconds) / self.since as f64;
            let work_seconds = seconds / self.work(trainer, &step, count, pairs);
            self.work_seconds = Some(self.work_seconds.map_or(work_seconds, |mean| {
                mean + share * (work_seconds.min(MAX_OUTLIER * mean) - mean)
            }));
        }
        (self.seconds, self.since) = (step_seconds(trainer), 0);
        let upcoming = upcoming(&trainer.recipe, &trainer.clock, FORECAST_PARTS);
        self.next = upcoming.first().map(|next| (*next, trainer.engine.len() as f64));
        self.rest_seconds = self.predict(trainer, &upcoming);
    }

    /// Updates growth with the number of splats and the image size of the next step.
    fn follow_growth(&mut self, trainer: &Trainer, plan: &StepPlan) {
        let (stage, time, count) = (trainer.clock.stage, trainer.clock.time, trainer.engine.len() as f64);
        match self.last_round {
            Some((then, at, before)) if then == stage => {
                if count != before {
                    self.rate = (count - before) / (time - at);
                    self.rounds += 1;
                    self.last_round = Some((stage, time, count));
                }
            }
            _ => (self.last_round, self.rate, self.rounds) = (Some((stage, time, count)), 0.0, 0),
        }
        let image_scale = f64::from(plan.image_scale);
        if self.image_scale > 0.0 && image_scale > self.image_scale {
            self.target = Some(TargetCount::new(trainer, image_scale / self.image_scale, time, count));
        }
        self.image_scale = image_scale;
    }

    /// Predicts [`Self::rest_seconds`] for the rest of the recipe.
    fn predict(&self, trainer: &Trainer, upcoming: &[UpcomingStretch]) -> f64 {
        let work_seconds = self.work_seconds.unwrap_or(1e-6 / rayon::current_num_threads() as f64);
        let mut growth = Growth {
            rate: self.growth_rate(trainer),
            target: self.target,
            image_scale: self.image_scale,
            time: trainer.clock.time,
            count: trainer.engine.len() as f64,
        };
        let (now, settled) = self.overdraw();
        let (seen, power) = (self.overdraws.len() as f64, pairs_exponent(trainer));
        let (mut sum, mut steps) = (0.0, seen);
        for stretch in upcoming {
            growth.advance(trainer, stretch);
            steps += stretch.duration / trainer.pace;
            let overdraw = settled + (now - settled) * seen / steps.max(1.0);
            let pairs = overdraw * (growth.count / stretch.image_scale).powf(power);
            sum += stretch.duration * self.work(trainer, stretch, growth.count, pairs);
        }
        work_seconds * sum
    }

    /// Recent mean of [`Self::overdraws`], and its predicted limit: random initial splats overlap, with five to twelve times the pairs
    /// of the trained ones. Overdraw falls approximately as `a + b / step`, so that the recent mean and that at half-way determine `a`.
    fn overdraw(&self) -> (f64, f64) {
        let mean = |end: usize| {
            let last = &self.overdraws[end - window(end).min(end)..end];
            last.iter().sum::<f64>() / last.len().max(1) as f64
        };
        let seen = self.overdraws.len();
        let (now, halfway) = (mean(seen), mean(seen.div_ceil(2)));
        (now, (2.0 * now - halfway).clamp(MIN_OVERDRAW_FRACTION * now, now))
    }

    /// Splats added per recipe step from now on: as in the last round, and more if `classic` has just begun. Before the first round
    /// the stage may double their number; if the number falls (random points that were not needed) it is predicted constant.
    fn growth_rate(&self, trainer: &Trainer) -> f64 {
        let Some(stage) = trainer.recipe.stage.get(trainer.clock.stage) else {
            return 0.0;
        };
        if self.rate < 0.0 {
            return 0.0;
        }
        if self.rate == 0.0 {
            return trainer.engine.len() as f64 / stage.steps as f64;
        }
        let begins = matches!(stage.density, Some(DensityControl::Classic(_))) && self.rounds < EARLY_ROUNDS;
        self.rate * if begins { EARLY_GROWTH } else { 1.0 }
    }

    /// Work of a step on `count` splats with `pairs` pairs per pixel, microseconds.
    fn work(&self, trainer: &Trainer, step: &UpcomingStretch, count: f64, pairs: f64) -> f64 {
        if let (Represents::Field, Some(settings)) =
            (trainer.recipe.stage[step.stage].represents, &trainer.recipe.field)
        {
            return SAMPLE_COST * settings.samples as f64;
        }
        let pixels = self.pixels * step.image_scale.powi(2);
        let parameters = GEOMETRY_PARAMETERS + 3.0 * (step.sh_degree + 1.0).powi(2);
        let perceptual = if step.perceptual && trainer.options.lpips.is_some() {
            PERCEPTUAL_PIXEL_COST * pixels.min(crate::objective::CROP_SIDE.pow(2) as f64)
        } else {
            0.0
        };
        pixels * (PIXEL_COST + PAIR_COST * pairs)
            + count.max(1.0) * (SPLAT_COST + PARAMETER_COST * parameters)
            + perceptual
    }

    /// Seconds that the rest of the run takes at its current pace.
    pub fn seconds_left(&self, trainer: &Trainer) -> f64 {
        (self.rest_seconds / trainer.pace - (step_seconds(trainer) - self.seconds)).max(0.0)
    }

    /// The pace at which the rest of the run takes `seconds`.
    pub fn pace(&self, trainer: &Trainer, seconds: f64) -> f64 {
        let left = trainer.recipe.total_steps() as f64 - trainer.clock.time;
        let audits = trainer.audit_steps() * self.rest_seconds / left;
        // At least one more step, even without time left.
        (self.rest_seconds / (seconds - audits).max(1e-6)).min(left)
    }
}

/// Seconds of the trainer's steps, without the renders between them: those of all views for an audit would make the next steps look as
/// expensive.
fn step_seconds(trainer: &Trainer) -> f64 {
    trainer.seconds - trainer.seconds_between
}

/// Number of recent steps to average over.
fn window(steps: usize) -> usize {
    (steps / 4).clamp(1, MAX_WINDOW)
}

fn pairs_exponent(trainer: &Trainer) -> f64 {
    let copies = |density: &Option<DensityControl>| matches!(density, Some(DensityControl::Mcmc(_)));
    if trainer.recipe.stage.iter().any(|stage| copies(&stage.density)) {
        MCMC_PAIRS_EXPONENT
    } else {
        PAIRS_EXPONENT
    }
}

/// Predicts the number of splats over the rest of a run.
struct Growth {
    /// [`Forecast::growth_rate`].
    rate: f64,
    target: Option<TargetCount>,
    image_scale: f64,
    time: f64,
    count: f64,
}

impl Growth {
    /// Advances by `stretch`.
    fn advance(&mut self, trainer: &Trainer, stretch: &UpcomingStretch) {
        let stage = &trainer.recipe.stage[stretch.stage];
        let limit = (trainer.limit(stretch.stage, stretch.count_share) as f64).max(self.count);
        let grown = match &stage.density {
            None => self.count,
            Some(DensityControl::Mcmc(settings)) => {
                self.count * f64::from(settings.growth).powf(stretch.duration / settings.every as f64)
            }
            Some(DensityControl::Taming(_)) => {
                let before = stretch.completed - stretch.duration / stage.steps as f64;
                let left = (1.0 - stretch.completed).max(0.0) / (1.0 - before).max(1e-9);
                limit - (limit - self.count) * left.powi(2)
            }
            Some(DensityControl::Fast(_)) => {
                let factor = stretch.image_scale / self.image_scale;
                if factor > 1.0 {
                    self.target = Some(TargetCount::new(trainer, factor, self.time, self.count));
                }
                match self.target {
                    None => self.count + self.rate * stretch.duration,
                    Some(target) if self.time < target.until && self.count < target.count => {
                        (self.count + target.rate * stretch.duration).min(target.count)
                    }
                    Some(_) => self.count,
                }
            }
            Some(DensityControl::Classic(_)) => {
                let fades = GROWTH_DECAY_STEPS * trainer.pace;
                let left = (-stretch.duration / fades).exp();
                let added = self.rate * fades * (1.0 - left);
                self.rate *= left;
                self.count + added
            }
        };
        self.count = grown.clamp(1.0, limit);
        self.image_scale = stretch.image_scale;
        self.time += stretch.duration;
    }
}
