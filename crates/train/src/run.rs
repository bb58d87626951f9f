//! The loop around [`Trainer::step`]: when to stop and to evaluate, and events to observers.

use crate::eval::{EvalOptions, evaluate_views, mean};
use crate::event::{Event, Observer, Signal, StepReport};
use crate::forecast::{self, Forecast};
use crate::paces::Paces;
use crate::schedule::{is_due, plan};
use crate::trainer::{TrainError, Trainer};
use std::fmt::{self, Display, Formatter};
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// When a run ends before its recipe is complete, and what sets its pace.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunLimits {
    /// Held-out PSNR in dB at which to stop.
    pub until_psnr: Option<f64>,
    /// Seconds of training into which the whole recipe is fitted.
    pub budget: Option<f64>,
    /// Paces to repeat; they take precedence over a budget.
    pub paces: Option<Paces>,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndReason {
    /// The recipe was followed to its end.
    RecipeComplete,
    /// [`RunLimits::until_psnr`] was reached.
    PsnrReached,
    /// An observer requested it.
    Stopped,
}

impl Display for EndReason {
    fn fmt(&self, f: &mut Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::RecipeComplete => "recipe complete",
            Self::PsnrReached => "held-out PSNR reached",
            Self::Stopped => "stopped",
        })
    }
}

/// Fraction of its budget below which a run has ended early.
const EARLY_END_FRACTION: f64 = 0.9;

/// Steps between evaluations of the held-out views for `until_psnr`.
const UNTIL_PSNR_INTERVAL: u64 = 50;

/// Maximum number of held-out views of an evaluation during training: all 200 of a Blender scene took longer than the steps between
/// evaluations.
const MAX_EVALUATED: usize = 32;

/// Interval at which observers of a paused run are polled: imperceptible to a person, and a negligible load.
const PAUSE_INTERVAL: Duration = Duration::from_millis(20);

/// Pace of a run that continues a scene and skips the beginning of its recipe, relative to a run of full length: higher paces than 1 also
/// repeat some of the growth.
const CONTINUED_PACE: f64 = 2.0;

/// The combined requests of the observers.
#[derive(Clone, Copy, Default)]
struct Requests {
    save: bool,
    pause: bool,
    stop: bool,
}

impl Requests {
    fn add(&mut self, signal: Signal) {
        match signal {
            Signal::Continue => {}
            Signal::Save => self.save = true,
            Signal::Pause => self.pause = true,
            Signal::Stop => self.stop = true,
        }
    }
}

/// Trains until the recipe is complete, a limit is reached or an observer requests a stop; returns the reason.
///
/// # Errors
/// When a photograph cannot be read.
pub fn run(
    trainer: &mut Trainer,
    limits: &RunLimits,
    observers: &mut [&mut dyn Observer],
) -> Result<EndReason, TrainError> {
    if trainer.clock.step == 0 {
        skip_beginning(trainer, limits)?;
    }
    if let Some(pace) = limits.paces.as_ref().and_then(|paces| paces.at(trainer.clock.step + 1)) {
        trainer.pace = pace;
    }
    let mut events = begin_events(trainer);
    let mut forecast = Forecast::default();
    let mut requests = notify(trainer, &mut events, observers);
    wait_while_paused(trainer, &mut requests, &mut events, observers)?;
    let mut reason = None;
    // Loading for the first splats is not part of the steps.
    trainer.photos.take_seconds();
    let (began, before) = (Instant::now(), trainer.times.wall);
    while reason.is_none() && !requests.stop && !trainer.finished() {
        let due = plan(&trainer.recipe, &trainer.clock);
        forecast.observe(trainer, &due, limits.budget.is_some());
        if let Some(budget) = limits.budget {
            trainer.pace = forecast.pace(trainer, budget - trainer.seconds).max(trainer.min_pace());
        }
        if let Some(pace) = limits.paces.as_ref().and_then(|paces| paces.at(trainer.clock.step + 1)) {
            trainer.pace = pace;
        }
        let evaluates = due.evaluate || (limits.until_psnr.is_some() && is_due(&trainer.clock, UNTIL_PSNR_INTERVAL));
        let left = forecast.seconds_left(trainer);
        let range = match limits.budget {
            // The pace follows the budget.
            Some(_) => [left; 2],
            None => forecast::range(left, &trainer.recipe, &trainer.clock),
        };
        let report = StepReport {
            seconds_left: left,
            seconds_left_range: range,
            ..trainer.step(&mut events)?
        };
        trainer.times.loading += trainer.photos.take_seconds();
        events.insert(0, Event::Step(report));
        if evaluates && !trainer.dataset.test.is_empty() {
            let is_reached = evaluate_held_out(trainer, limits.until_psnr, &mut events, observers)?;
            reason = is_reached.then_some(EndReason::PsnrReached);
        }
        requests = notify(trainer, &mut events, observers);
        trainer.times.wall = before + began.elapsed().as_secs_f64();
        if due.checkpoint || requests.save || requests.stop {
            let started = Instant::now();
            trainer.read_back()?;
            save(trainer, &mut events, observers);
            trainer.times.saving += started.elapsed().as_secs_f64();
        }
        if reason.is_none() && !trainer.finished() {
            let started = Instant::now();
            wait_while_paused(trainer, &mut requests, &mut events, observers)?;
            trainer.times.paused += started.elapsed().as_secs_f64();
        }
        trainer.times.wall = before + began.elapsed().as_secs_f64();
    }
    trainer.read_back()?;
    events.extend(lost_splats_event(trainer));
    events.extend(cpu_loss_warning(trainer));
    events.extend(limits.budget.and_then(|budget| ended_early(trainer, budget)));
    let reason = reason.unwrap_or(if requests.stop {
        EndReason::Stopped
    } else {
        EndReason::RecipeComplete
    });
    events.push(Event::Finished {
        step: trainer.clock.step,
        seconds: trainer.seconds,
        reason: reason.to_string(),
    });
    while !events.is_empty() {
        notify(trainer, &mut events, observers);
    }
    Ok(reason)
}

/// Skips the beginning of the recipe if the run continues a scene and is shorter than the recipe, whose first rates would undo more than a
/// short run can repair.
fn skip_beginning(trainer: &mut Trainer, limits: &RunLimits) -> Result<(), TrainError> {
    let total = trainer.recipe.total_steps() as f64;
    let pace = CONTINUED_PACE * trainer.min_pace().max(1.0);
    let skipped = match (&limits.paces, trainer.options.steps, limits.budget) {
        (Some(paces), ..) => paces.skipped(),
        _ if !trainer.continues_scene => 0.0,
        (_, Some(steps), _) => total - pace * steps as f64,
        (.., Some(budget)) => total - pace * trainer.steps_within(budget)?.max(1.0),
        _ => 0.0,
    };
    if skipped >= 1.0 {
        trainer.skip(skipped);
        trainer.decisions.push(format!(
            "the run continues a scene and is shorter than the recipe: it skips the first {skipped:.0} of {total:.0} steps"
        ));
    }
    Ok(())
}

/// The events before the first step of this process. The trainer's decisions are reported once.
fn begin_events(trainer: &mut Trainer) -> Vec<Event> {
    let mut events = vec![Event::Started {
        recipe: trainer.recipe.name.clone(),
        step: trainer.clock.step,
        total_steps: trainer.total_steps(),
        splats: trainer.engine.len(),
        parameters: trainer.parameters(),
        views: trainer.dataset.train.len(),
    }];
    let decisions = std::mem::take(&mut trainer.decisions);
    events.extend(decisions.into_iter().map(|message| Event::Decided { message }));
    if trainer.clock.step == 0 {
        events.extend(trainer.warnings().into_iter().map(|message| Event::Warned { message }));
        events.push(Event::StageEntered {
            stage: trainer.stage_name().to_owned(),
            step: 0,
            seconds: 0.0,
        });
    } else {
        // Resumed with less memory than that with which the recipe got its limit.
        let warning = trainer.memory.warning(&trainer.recipe.name);
        events.extend(warning.map(|message| Event::Warned { message }));
    }
    events
}

/// Evaluates held-out views, and appends the event of it to `events`; returns whether their PSNR has reached `until_psnr`.
fn evaluate_held_out(
    trainer: &mut Trainer,
    until_psnr: Option<f64>,
    events: &mut Vec<Event>,
    observers: &[&mut dyn Observer],
) -> Result<bool, TrainError> {
    let (step, seconds, splats) = (trainer.clock.step, trainer.seconds, trainer.engine.len());
    let started = Instant::now();
    let views = match until_psnr {
        None => evenly_spaced(&trainer.dataset.test),
        // The limit is on the PSNR of all views.
        Some(_) => trainer.dataset.test.clone(),
    };
    let psnr = held_out_psnr(trainer, &views, observers)?;
    trainer.times.evaluating += started.elapsed().as_secs_f64();
    if !psnr.is_nan() {
        events.push(Event::Evaluated {
            step,
            seconds,
            psnr,
            splats,
            parameters: trainer.parameters(),
        });
    }
    Ok(until_psnr.is_some_and(|limit| psnr >= limit))
}

/// What became of the first splats, if a run ends with fewer; a warning if hardly any are left.
fn lost_splats_event(trainer: &Trainer) -> Option<Event> {
    let (first, last) = (trainer.initial_splats, trainer.engine.len());
    if trainer.field.is_some() || !trainer.finished() || last >= first {
        return None;
    }
    let left = format!("{last} of initially {first} splats are left: the others faded or appeared in no photograph");
    Some(if 10 * last < first {
        Event::Warned {
            message: format!("{left}; if the scene is blurred, photographs disagree (light, poses, moving objects)"),
        }
    } else {
        Event::Decided { message: left }
    })
}

/// Why a run ended before its `budget`, in seconds, was used up.
fn ended_early(trainer: &Trainer, budget: f64) -> Option<Event> {
    let (steps, seconds) = (trainer.clock.step, trainer.seconds);
    let is_limited = trainer.finished() && trainer.pace == trainer.min_pace();
    (is_limited && seconds < EARLY_END_FRACTION * budget).then(|| Event::Decided {
        message: format!(
            "{seconds:.0} s of {budget:.0} were needed: photographs are so far apart that more than {steps} steps would only \
             fit single ones (--steps sets another number)"
        ),
    })
}

/// How many steps had losses that only the CPU computes, although the splats are on a GPU.
fn cpu_loss_warning(trainer: &Trainer) -> Option<Event> {
    let (steps, device) = (trainer.cpu_loss_steps, &trainer.options.device);
    (steps > 0).then(|| Event::Warned {
        message: format!(
            "the losses of {steps} steps were computed on the CPU, from frames read back from {device}: recipe {} uses some that the GPU \
             lacks (docs/gpu.md)",
            trainer.recipe.name
        ),
    })
}

fn save(trainer: &Trainer, events: &mut Vec<Event>, observers: &mut [&mut dyn Observer]) {
    for observer in observers.iter_mut() {
        match observer.save(trainer) {
            Ok(Some(path)) => events.push(Event::Saved {
                step: trainer.clock.step,
                path,
            }),
            Ok(None) => {}
            Err(message) => events.push(Event::Warned { message }),
        }
    }
}

fn notify(trainer: &Trainer, events: &mut Vec<Event>, observers: &mut [&mut dyn Observer]) -> Requests {
    let mut requests = Requests::default();
    for event in events.drain(..) {
        for observer in observers.iter_mut() {
            requests.add(observer.on_event(&event, trainer));
        }
    }
    for observer in observers.iter_mut() {
        events.extend(observer.saved().map(|(step, path)| Event::Saved { step, path }));
        events.extend(observer.warning().map(|message| Event::Warned { message }));
    }
    requests
}

/// Waits while an observer requests a pause and none requests a stop.
///
/// # Errors
/// When the device has failed and an observer requests a checkpoint.
fn wait_while_paused(
    trainer: &Trainer,
    requests: &mut Requests,
    events: &mut Vec<Event>,
    observers: &mut [&mut dyn Observer],
) -> Result<(), TrainError> {
    if !requests.pause || requests.stop {
        return Ok(());
    }
    let step = trainer.clock.step;
    events.push(Event::Paused { step });
    requests.stop |= notify(trainer, events, observers).stop;
    while requests.pause && !requests.stop {
        std::thread::sleep(PAUSE_INTERVAL);
        *requests = Requests::default();
        for observer in observers.iter_mut() {
            requests.add(observer.while_paused(trainer));
        }
        if requests.save || requests.stop {
            trainer.read_back()?;
            save(trainer, events, observers);
            requests.stop |= notify(trainer, events, observers).stop;
        }
    }
    events.push(Event::Resumed { step });
    requests.stop |= notify(trainer, events, observers).stop;
    Ok(())
}

/// At most [`MAX_EVALUATED`] of `views`, evenly spaced.
fn evenly_spaced(views: &[usize]) -> Vec<usize> {
    let count = views.len().min(MAX_EVALUATED);
    (0..count).map(|i| views[i * views.len() / count]).collect()
}

/// Mean PSNR over the held-out `views`, with the SH bands currently in use; NaN if none could be measured or an observer
/// requests a stop meanwhile.
fn held_out_psnr(trainer: &Trainer, views: &[usize], observers: &[&mut dyn Observer]) -> Result<f64, TrainError> {
    let render = trainer.render_options(plan(&trainer.recipe, &trainer.clock).sh_degree);
    let options = EvalOptions::psnr(render, trainer.sockets.vignette.as_ref(), &trainer.options.device);
    let (mut metrics, mut stopped) = (Vec::new(), false);
    evaluate_views(&trainer.scene(), &trainer.dataset, views, &options, |view| {
        metrics.push(view.metrics);
        stopped = observers.iter().any(|observer| observer.wants_stop());
        if stopped {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    })?;
    Ok(if stopped { f64::NAN } else { mean(&metrics).psnr })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::{from_bytes, to_bytes};
    use crate::conditions::tests::dataset;
    use crate::{Recipe, TrainOptions};
    use irradia_splat::Splats;

    /// What was decided.
    #[derive(Default)]
    struct DecisionLog(Vec<String>);

    impl Observer for DecisionLog {
        fn on_event(&mut self, event: &Event, _: &Trainer) -> Signal {
            if let Event::Decided { message } = event {
                self.0.push(message.clone());
            }
            Signal::Continue
        }
    }

    #[test]
    fn a_budget_for_more_steps_than_photographs_determine_is_not_used_up() {
        let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
        let mut trainer = Trainer::new(dataset(3, true), recipe, TrainOptions::default()).unwrap();
        let limits = RunLimits {
            budget: Some(3600.0),
            ..RunLimits::default()
        };
        let mut log = DecisionLog::default();
        let reason = run(&mut trainer, &limits, &mut [&mut log]).unwrap();
        assert_eq!((trainer.clock.step, reason), (600, EndReason::RecipeComplete));
        assert!(
            log.0.iter().any(|line| line.contains("of 3600 were needed")),
            "{:?}",
            log.0
        );
    }

    #[test]
    fn a_limit_by_memory_stays_and_a_lower_one_is_reported_when_a_run_resumes() {
        let set = ["max_splats=1000000".to_owned()];
        let recipe = Recipe::parse("classic", Recipe::built_in("classic").unwrap(), &set).unwrap();
        let options = |mebibytes: usize| TrainOptions {
            memory: Some(mebibytes << 20),
            ..TrainOptions::default()
        };
        let splats = Splats::zeros(4, 0);
        let mut trainer = Trainer::from_splats(dataset(3, true), recipe, options(80), splats).unwrap();
        let limit = trainer.recipe.max_splats;
        assert!(limit == trainer.memory.splats && limit < 1_000_000, "{limit}");
        trainer.clock.step = 7;
        let bytes = to_bytes(&trainer);
        for (mebibytes, is_reported) in [(70, true), (80, false), (100, false)] {
            let mut resumed = from_bytes(&bytes, dataset(3, true), options(mebibytes)).unwrap();
            let events = begin_events(&mut resumed);
            let is_warned = events.iter().any(|event| matches!(event, Event::Warned { .. }));
            assert_eq!(is_warned, is_reported, "{mebibytes} MiB");
            assert_eq!(resumed.cap < limit, is_reported);
        }
    }

    #[test]
    fn an_evaluation_during_training_has_few_views_from_all_over() {
        assert_eq!(evenly_spaced(&[7, 8, 9]), [7, 8, 9]);
        let views = evenly_spaced(&(100..300).collect::<Vec<_>>());
        assert_eq!(views.len(), MAX_EVALUATED);
        assert!(views[0] == 100 && views[31] > 290 && views.is_sorted_by(|a, b| (6..=7).contains(&(b - a))));
    }
}
