//! The newest state of a training, for other threads.

use crate::Scene;
use irradia_scene::{Camera, Dataset};
use irradia_train::event::{Event, Observer, Signal};
use irradia_train::schedule::plan;
use irradia_train::{Recipe, Trainer};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// The state of a training between two steps.
#[derive(Clone)]
pub struct Snapshot {
    /// Steps made.
    pub step: u64,
    /// Steps the run will make, as far as is known.
    pub total_steps: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// Name of the stage.
    pub stage: String,
    /// What is trained, as held-out views show it.
    pub scene: Scene,
    /// The resolved recipe, shared by all snapshots of a run.
    pub recipe: Arc<Recipe>,
    /// The data, shared with the training.
    pub dataset: Arc<Dataset>,
}

#[derive(Default)]
struct State {
    newest: Option<Arc<Snapshot>>,
    /// Whether the training loop runs, and answers.
    running: bool,
    /// Requests answered.
    answers: u64,
}

#[derive(Default)]
struct Shared {
    /// Whether somebody waits; read between steps without a lock.
    wanted: AtomicBool,
    state: Mutex<State>,
    answered: Condvar,
}

impl Shared {
    /// The state is whole between any two statements, so that a panic elsewhere does not spoil it.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Asks a running training for its newest state, from any thread. Handles are cheap to clone.
///
/// The training answers between two steps and goes on; splats are copied only when they are asked for and a step was made
/// since. Dataset, recipe and cameras are shared.
#[derive(Clone)]
pub struct Snapshots(Arc<Shared>);

impl Snapshots {
    /// The newest state: waits for the end of the present step while the training runs. Before the training runs there is
    /// none; afterwards it is the last one.
    pub fn newest(&self) -> Option<Arc<Snapshot>> {
        let mut state = self.0.lock();
        let before = state.answers;
        if state.running {
            self.0.wanted.store(true, Ordering::Relaxed);
        }
        while state.running && state.answers == before {
            state = self.0.answered.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.newest.clone()
    }

    /// Asks for the newest state without waiting for it: [`Snapshots::last`] has it after the present step.
    pub fn request(&self) {
        self.0.wanted.store(true, Ordering::Relaxed);
    }

    /// The state that was asked for last, by any handle.
    pub fn last(&self) -> Option<Arc<Snapshot>> {
        self.0.lock().newest.clone()
    }
}

/// The training's side of [`Snapshots`].
pub(crate) struct SnapshotServer {
    shared: Arc<Shared>,
    /// What all snapshots share, made at the first request.
    common: Option<(Arc<Recipe>, Arc<[Camera]>)>,
}

impl SnapshotServer {
    pub fn new() -> Self {
        Self {
            shared: Arc::default(),
            common: None,
        }
    }

    pub fn handle(&self) -> Snapshots {
        Snapshots(self.shared.clone())
    }

    /// From now on requests are answered.
    pub fn open(&self) {
        self.shared.lock().running = true;
    }

    /// From now on the last state is the newest: it is kept where somebody may still ask.
    pub fn close(&mut self, trainer: &Trainer) {
        if Arc::strong_count(&self.shared) > 1 {
            self.publish(trainer);
        }
        self.stop();
    }

    fn stop(&self) {
        self.shared.lock().running = false;
        self.shared.answered.notify_all();
    }

    fn answer(&mut self, trainer: &Trainer) {
        if self.shared.wanted.load(Ordering::Relaxed) {
            self.publish(trainer);
        }
    }

    fn publish(&mut self, trainer: &Trainer) {
        let (recipe, cameras) = self.common.get_or_insert_with(|| {
            let dataset = &trainer.dataset;
            let cameras = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
            (Arc::new(trainer.recipe.clone()), cameras)
        });
        let mut state = self.shared.lock();
        self.shared.wanted.store(false, Ordering::Relaxed);
        let step = trainer.clock.step;
        if state.newest.as_ref().is_none_or(|newest| newest.step != step) {
            state.newest = Some(Arc::new(Snapshot {
                step,
                total_steps: trainer.total_steps(),
                seconds: trainer.seconds,
                stage: trainer.stage_name().to_owned(),
                scene: Scene {
                    model: trainer.scene().into_owned(),
                    options: trainer.render_options(plan(&trainer.recipe, &trainer.clock).sh_degree),
                    cameras: Some(cameras.clone()),
                },
                recipe: recipe.clone(),
                dataset: trainer.dataset.clone(),
            }));
        }
        state.answers += 1;
        self.shared.answered.notify_all();
    }
}

impl Observer for SnapshotServer {
    fn on_event(&mut self, event: &Event, trainer: &Trainer) -> Signal {
        if matches!(event, Event::Started { .. } | Event::Step(_)) {
            self.answer(trainer);
        }
        Signal::Continue
    }

    fn while_paused(&mut self, trainer: &Trainer) -> Signal {
        self.answer(trainer);
        Signal::Continue
    }
}

impl Drop for SnapshotServer {
    /// Nobody waits for a training that is gone, by a panic perhaps.
    fn drop(&mut self) {
        self.stop();
    }
}
