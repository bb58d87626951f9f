//! The latest state of a training run, for other threads.

use crate::Scene;
use irradia_scene::{Camera, Dataset};
use irradia_train::event::{Event, Observer, Signal};
use irradia_train::lights::Lights;
use irradia_train::schedule::plan;
use irradia_train::{Recipe, Trainer};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// The state of a training run between two steps.
#[derive(Clone)]
pub struct Snapshot {
    /// Steps completed.
    pub step: u64,
    /// Total number of steps, as far as known.
    pub total_steps: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// Name of the stage.
    pub stage: String,
    /// The trained scene, as used for evaluation.
    pub scene: Scene,
    /// The light of each photograph, as learned so far.
    pub lights: Option<Arc<Lights>>,
    /// The resolved recipe, shared by all snapshots of a run.
    pub recipe: Arc<Recipe>,
    /// The dataset, shared with the training.
    pub dataset: Arc<Dataset>,
}

#[derive(Default)]
struct State {
    newest: Option<Arc<Snapshot>>,
    /// Whether the training loop is running and answers requests.
    running: bool,
    /// Number of answers published.
    answers: u64,
}

#[derive(Default)]
struct Shared {
    /// Whether a request is pending; read between steps without a lock.
    requested: AtomicBool,
    state: Mutex<State>,
    answered: Condvar,
}

impl Shared {
    /// The state is consistent between any two statements, so that a panic elsewhere does not invalidate it.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Requests the latest state of a running training, from any thread. Handles are cheap to clone.
///
/// The training answers between two steps and continues; splats are copied only on request and if a step has been made since
/// the last copy. Dataset, recipe and cameras are shared.
#[derive(Clone)]
pub struct Snapshots(Arc<Shared>);

impl Snapshots {
    /// The latest state; while the training runs, waits for the end of the current step. `None` before the training runs; the final
    /// state afterwards.
    pub fn newest(&self) -> Option<Arc<Snapshot>> {
        let mut state = self.0.lock();
        let before = state.answers;
        if state.running {
            self.0.requested.store(true, Ordering::Relaxed);
        }
        while state.running && state.answers == before {
            state = self.0.answered.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.newest.clone()
    }

    /// Requests the latest state without waiting: [`Snapshots::last`] returns it after the current step.
    pub fn request(&self) {
        self.0.requested.store(true, Ordering::Relaxed);
    }

    /// The state most recently requested by any handle.
    pub fn last(&self) -> Option<Arc<Snapshot>> {
        self.0.lock().newest.clone()
    }
}

/// The training's side of [`Snapshots`].
pub(crate) struct SnapshotServer {
    shared: Arc<Shared>,
    /// Shared by all snapshots, created at the first request.
    shared_parts: Option<(Arc<Recipe>, Arc<[Camera]>)>,
}

impl SnapshotServer {
    pub fn new() -> Self {
        Self {
            shared: Arc::default(),
            shared_parts: None,
        }
    }

    pub fn handle(&self) -> Snapshots {
        Snapshots(self.shared.clone())
    }

    /// Starts answering requests.
    pub fn open(&self) {
        self.shared.lock().running = true;
    }

    /// Stops answering; the final state remains available if a handle exists.
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
        if self.shared.requested.load(Ordering::Relaxed) {
            self.publish(trainer);
        }
    }

    fn publish(&mut self, trainer: &Trainer) {
        let (recipe, cameras) = self.shared_parts.get_or_insert_with(|| {
            let dataset = &trainer.dataset;
            let cameras = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
            (Arc::new(trainer.recipe.clone()), cameras)
        });
        let mut state = self.shared.lock();
        self.shared.requested.store(false, Ordering::Relaxed);
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
                    world_from_dataset: trainer.dataset.world_from_dataset,
                    notes: Vec::new(),
                },
                lights: trainer.lights().map(Arc::new),
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
    /// Releases threads that wait for a training that has ended, possibly by a panic.
    fn drop(&mut self) {
        self.stop();
    }
}
