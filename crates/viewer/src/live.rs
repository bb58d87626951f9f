//! A running training: its state for the pages, and their requests to it.

use crate::message::Action;
use irradia_runs::{Run, Snapshot, Snapshots};
use irradia_train::Trainer;
use irradia_train::event::{Event, Observer, Signal, StepReport};
use irradia_train::recipe::Param;
use irradia_train::report::CurvePoint;
use irradia_train::schedule::outline;
use serde::Serialize;
use serde_json::{Value, json};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// Maximum number of points of a curve: more would not be visible. When it is exceeded, every second one is dropped.
const MAX_CURVE_POINTS: usize = 1024;
/// Number of points of the plan.
const PLAN_POINTS: usize = 200;
/// Maximum number of warnings that are kept.
const MAX_WARNINGS: usize = 20;
/// Time over which the speed is averaged, seconds.
const SPEED_WINDOW_SECONDS: f64 = 3.0;

/// The phase of the training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Phase {
    Preparing,
    Training,
    Paused,
    Finished,
}

/// The requests of pages.
#[derive(Default)]
struct Control {
    paused: bool,
    one_step: bool,
    save: bool,
    stop: bool,
}

struct History {
    phase: Phase,
    newest: Option<StepReport>,
    total_steps: u64,
    curve: Vec<CurvePoint>,
    /// Steps between points of the curve.
    point_interval: u64,
    /// How many times points have been dropped.
    thinned: u64,
    stages: Vec<(u64, String)>,
    /// Moving average of the training views' squared error.
    mse: Option<f64>,
    steps_per_second: f64,
    last_step_at: Option<Instant>,
    saved: Option<u64>,
    /// The latest different ones.
    warnings: Vec<String>,
}

/// The part of the history that a page already has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ReportCursor {
    points: usize,
    thinned: u64,
}

pub(crate) struct Live {
    snapshots: Snapshots,
    control: Mutex<Control>,
    history: Mutex<History>,
    /// When the next copy of the scene may be taken; `None` while no page is open.
    due: Mutex<Option<Instant>>,
    /// Called when the scene may have changed.
    pub on_change: OnceLock<Box<dyn Fn() + Send + Sync>>,
    plan: Value,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Live {
    pub fn new(run: &Run) -> Self {
        let trainer = run.trainer();
        let recipe = &trainer.recipe;
        let points = outline(recipe, PLAN_POINTS);
        let total = recipe.total_steps().max(1) as f64;
        let series = |param: Param| -> Value {
            let point = |at: &irradia_train::schedule::OutlinePoint| json!([at.time / total, at.values[param]]);
            points.iter().map(point).collect()
        };
        let mut from = 0;
        let stages: Vec<Value> = recipe
            .stage
            .iter()
            .map(|stage| {
                let start = from;
                from += stage.steps;
                json!({ "name": stage.name, "from": start as f64 / total, "to": from as f64 / total })
            })
            .collect();
        let snapshots = run.snapshots();
        // The first state is taken when training begins.
        snapshots.request();
        Self {
            snapshots,
            control: Mutex::default(),
            history: Mutex::new(History::new(trainer.total_steps())),
            due: Mutex::new(None),
            on_change: OnceLock::new(),
            plan: json!({
                "recipe": recipe.name,
                "stages": stages,
                "image_scale": series(Param::ImageScale),
                "sh_degree": series(Param::ShDegree),
            }),
        }
    }

    /// The latest copy of the scene.
    pub fn newest(&self) -> Option<Arc<Snapshot>> {
        self.snapshots.last()
    }

    /// Whether drawing takes time from the training.
    pub fn is_training(&self) -> bool {
        lock(&self.history).phase == Phase::Training
    }

    /// The next copy of the scene is taken after this time; never if `None`.
    pub fn set_due(&self, due: Option<Instant>) {
        *lock(&self.due) = due;
    }

    /// A page was opened: a copy is taken now unless one is scheduled.
    pub fn page_opened(&self) {
        lock(&self.due).get_or_insert_with(Instant::now);
    }

    pub fn apply(&self, action: Action) {
        let mut control = lock(&self.control);
        match action {
            Action::Pause => control.paused = true,
            Action::Resume => control.paused = false,
            Action::Step => (control.paused, control.one_step) = (true, true),
            Action::Save => control.save = true,
            Action::Stop => control.stop = true,
        }
    }

    /// The schedule's plan.
    pub fn plan(&self) -> &Value {
        &self.plan
    }

    /// The state of the training, with the points of the curves after `cursor`, which is updated.
    pub fn report(&self, cursor: &mut ReportCursor) -> Value {
        let history = lock(&self.history);
        if cursor.thinned != history.thinned {
            *cursor = ReportCursor {
                points: 0,
                thinned: history.thinned,
            };
        }
        let from = cursor.points.min(history.curve.len());
        // The last point may still change.
        cursor.points = history.curve.len().saturating_sub(1);
        let newest = history.newest.as_ref();
        json!({
            "tell": "train",
            "phase": history.phase,
            "step": newest.map_or(0, |report| report.step),
            "total": history.total_steps,
            "seconds": newest.map_or(0.0, |report| report.seconds),
            "left": newest.map(|report| report.seconds_left_range),
            "loss": newest.map(|report| report.loss),
            "splats": newest.map_or(0, |report| report.splats),
            "parameters": newest.and_then(|report| report.parameters),
            "psnr": history.mse.map(|mse| -10.0 * mse.log10()),
            "rate": history.steps_per_second,
            "memory": memory(),
            "stages": history.stages,
            "saved": history.saved,
            "warnings": history.warnings,
            "from": from,
            "curve": history.curve[from..],
        })
    }

    fn step(&self, report: &StepReport, trainer: &Trainer) {
        let mut history = lock(&self.history);
        let history = &mut *history;
        let now = Instant::now();
        if let Some(last) = history.last_step_at {
            let seconds = now.duration_since(last).as_secs_f64().max(1e-6);
            let share = 1.0 - (-seconds / SPEED_WINDOW_SECONDS).exp();
            let fresh = if history.steps_per_second == 0.0 { 1.0 } else { share };
            history.steps_per_second += fresh * (1.0 / seconds - history.steps_per_second);
        }
        history.last_step_at = Some(now);
        history.phase = Phase::Training;
        history.total_steps = trainer.total_steps();
        history.mse = Some(history.mse.map_or(report.mse, |mean| 0.95 * mean + 0.05 * report.mse));
        history.newest = Some(*report);
        let after = history
            .curve
            .last()
            .map_or(0, |last| last.step + history.point_interval);
        if report.step >= after {
            history.push(CurvePoint {
                step: report.step,
                seconds: report.seconds,
                loss: report.loss,
                psnr: None,
                splats: report.splats as u64,
            });
        }
    }

    fn record_event(&self, event: &Event, trainer: &Trainer) {
        match event {
            Event::Step(report) => self.step(report, trainer),
            Event::Evaluated {
                step,
                seconds,
                psnr,
                splats,
                ..
            } => lock(&self.history).push(CurvePoint {
                step: *step,
                seconds: *seconds,
                loss: f64::NAN,
                psnr: Some(*psnr),
                splats: *splats as u64,
            }),
            Event::StageEntered { stage, step, .. } => lock(&self.history).stages.push((*step, stage.clone())),
            Event::Saved { step, .. } => lock(&self.history).saved = Some(*step),
            Event::Warned { message } => lock(&self.history).warn(message),
            Event::Paused { .. } => lock(&self.history).phase = Phase::Paused,
            Event::Resumed { .. } => {
                let mut history = lock(&self.history);
                (history.phase, history.last_step_at) = (Phase::Training, None);
            }
            Event::Finished { .. } => lock(&self.history).phase = Phase::Finished,
            Event::Started { total_steps, .. } => lock(&self.history).total_steps = *total_steps,
            Event::Densified { .. } | Event::Decided { .. } => {}
        }
        self.request_due_copy();
        if matches!(event, Event::Finished { .. } | Event::Paused { .. }) {
            self.notify_change();
        }
    }

    /// Requests a copy of the scene if one is due, and announces that the scene may have changed.
    fn request_due_copy(&self) {
        let mut due = lock(&self.due);
        if due.is_some_and(|due| due <= Instant::now()) {
            // The next time is set when this copy has been drawn; until then there is one copy a minute.
            *due = Some(Instant::now() + Duration::from_secs(60));
            self.snapshots.request();
        }
        drop(due);
        self.notify_change();
    }

    fn notify_change(&self) {
        if let Some(on_change) = self.on_change.get() {
            on_change();
        }
    }

    fn signal(&self, role: Role) -> Signal {
        let mut control = lock(&self.control);
        match role {
            Role::Saves if std::mem::take(&mut control.save) => Signal::Save,
            Role::Saves => Signal::Continue,
            Role::Controls if control.stop => Signal::Stop,
            Role::Controls if control.paused => Signal::Pause,
            Role::Controls => Signal::Continue,
        }
    }
}

impl History {
    fn new(total_steps: u64) -> Self {
        Self {
            phase: Phase::Preparing,
            newest: None,
            total_steps,
            curve: Vec::new(),
            point_interval: 1,
            thinned: 0,
            stages: Vec::new(),
            mse: None,
            steps_per_second: 0.0,
            last_step_at: None,
            saved: None,
            warnings: Vec::new(),
        }
    }

    /// Keeps a warning as the latest one.
    fn warn(&mut self, message: &str) {
        self.warnings.retain(|known| known != message);
        self.warnings.push(message.to_owned());
        let dropped = self.warnings.len().saturating_sub(MAX_WARNINGS);
        self.warnings.drain(..dropped);
    }

    fn push(&mut self, point: CurvePoint) {
        match self.curve.last_mut() {
            Some(last) if last.step == point.step => last.psnr = point.psnr.or(last.psnr),
            _ => self.curve.push(point),
        }
        if self.curve.len() > MAX_CURVE_POINTS {
            let mut index = 0;
            self.curve.retain(|point| {
                index += 1;
                point.psnr.is_some() || index % 2 == 1
            });
            self.point_interval *= 2;
            self.thinned += 1;
        }
    }
}

/// Memory in use, bytes, in steps of 8 MiB; 0 if the system does not report it.
fn memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_ascii_whitespace().next()?.parse::<u64>().ok());
    (kib.unwrap_or(0) >> 13) << 23
}

/// What an observer of a [`Watcher`] answers. Saving is separate, since a request to save must not end a pause.
#[derive(Clone, Copy)]
enum Role {
    Controls,
    Saves,
}

/// The observers that connect a training with its viewer, to be given to [`Run::train`].
pub struct Watcher {
    controls: RoleObserver,
    saves: RoleObserver,
}

struct RoleObserver(Arc<Live>, Role);

impl Watcher {
    pub(crate) fn new(live: Arc<Live>) -> Self {
        Self {
            controls: RoleObserver(live.clone(), Role::Controls),
            saves: RoleObserver(live, Role::Saves),
        }
    }

    /// Both observers.
    pub fn observers(&mut self) -> [&mut dyn Observer; 2] {
        [&mut self.controls, &mut self.saves]
    }
}

impl Observer for RoleObserver {
    fn on_event(&mut self, event: &Event, trainer: &Trainer) -> Signal {
        if matches!(self.1, Role::Controls) {
            self.0.record_event(event, trainer);
        }
        self.0.signal(self.1)
    }

    fn wants_stop(&self) -> bool {
        lock(&self.0.control).stop
    }

    fn while_paused(&mut self, _trainer: &Trainer) -> Signal {
        if matches!(self.1, Role::Controls) {
            self.0.request_due_copy();
            if std::mem::take(&mut lock(&self.0.control).one_step) {
                return Signal::Continue;
            }
        }
        self.0.signal(self.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_warnings_are_kept_each_once() {
        let mut history = History::new(1);
        for message in ["a", "b", "a"] {
            history.warn(message);
        }
        assert_eq!(history.warnings, ["b", "a"]);
        for number in 0..MAX_WARNINGS {
            history.warn(&number.to_string());
        }
        assert_eq!((history.warnings.len(), &*history.warnings[0]), (MAX_WARNINGS, "0"));
    }
}
