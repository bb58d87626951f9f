//! Loads photographs on threads of its own, so that a step does not wait as long as the disk and the decoder keep up.

use super::Prepared;
use irradia_scene::{Dataset, LoadError, Photo};
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;

/// A photograph to load.
#[derive(Clone)]
pub(super) struct Job {
    pub view: usize,
    pub scale: f32,
    /// Its pixels at full size, if they are in memory.
    pub full: Option<Arc<Photo>>,
    /// Whether the pixels at full size are returned, too.
    pub keep_full: bool,
}

/// A loaded photograph.
pub(super) struct Loaded {
    pub view: usize,
    pub scale: f32,
    pub result: Result<(Arc<Prepared>, Option<Arc<Photo>>), LoadError>,
}

#[derive(Default)]
struct State {
    queue: VecDeque<Job>,
    /// Views and scales being loaded.
    running: Vec<(usize, f32)>,
    done: Vec<Loaded>,
    closed: bool,
}

struct Shared {
    state: Mutex<State>,
    /// A job was queued, or the loader was closed.
    queued: Condvar,
    /// A job was done.
    done: Condvar,
    dataset: Arc<Dataset>,
    background: [f32; 3],
}

impl Shared {
    /// Every statement leaves the state consistent, so that a panic elsewhere does not invalidate it.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        let mut state = self.lock();
        while !state.closed {
            let Some(job) = state.queue.pop_front() else {
                state = self.queued.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let key = (job.view, job.scale);
            state.running.push(key);
            drop(state);
            let name = &self.dataset.views[job.view].name;
            let result = caught(name, || load(&self.dataset, &job, self.background));
            state = self.lock();
            state.running.retain(|running| *running != key);
            state.done.push(Loaded {
                view: job.view,
                scale: job.scale,
                result,
            });
            self.done.notify_all();
        }
    }
}

/// The threads and their queue. Loading does not use the thread pool of the steps, which may wait for it.
pub(super) struct Loader(Arc<Shared>);

impl Loader {
    pub fn new(dataset: Arc<Dataset>, background: [f32; 3], threads: usize) -> Self {
        let shared = Arc::new(Shared {
            state: Mutex::default(),
            queued: Condvar::new(),
            done: Condvar::new(),
            dataset,
            background,
        });
        for _ in 0..threads.max(1) {
            let shared = shared.clone();
            thread::spawn(move || shared.work());
        }
        Self(shared)
    }

    /// Replaces the queue; photographs that are being loaded or wait to be taken are not queued again.
    pub fn queue(&self, jobs: Vec<Job>) {
        let mut state = self.0.lock();
        let State {
            queue, running, done, ..
        } = &mut *state;
        let taken = |job: &Job| {
            let key = (job.view, job.scale);
            running.contains(&key) || done.iter().any(|done| (done.view, done.scale) == key)
        };
        *queue = jobs.into_iter().filter(|job| !taken(job)).collect();
        self.0.queued.notify_all();
    }

    /// The photographs loaded since the last call; waits for at least one if `wait`.
    pub fn take(&self, wait: bool) -> Vec<Loaded> {
        let mut state = self.0.lock();
        while wait && state.done.is_empty() {
            state = self.0.done.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        std::mem::take(&mut state.done)
    }

    /// Whether nothing is queued, being loaded, or waiting to be taken.
    pub fn is_idle(&self) -> bool {
        let state = self.0.lock();
        state.queue.is_empty() && state.running.is_empty() && state.done.is_empty()
    }

    /// Views being loaded, and those waiting to be taken.
    pub fn in_flight(&self) -> Vec<usize> {
        let state = self.0.lock();
        let running = state.running.iter().map(|(view, _)| *view);
        running.chain(state.done.iter().map(|done| done.view)).collect()
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        let mut state = self.0.lock();
        state.closed = true;
        state.queue.clear();
        self.0.queued.notify_all();
    }
}

/// The result of `load` for the view `name`. A decoder's panic on a damaged file is an error: it must not leave the training waiting, and
/// not end it where the file can be done without.
pub(crate) fn caught<T>(name: &str, load: impl FnOnce() -> Result<T, LoadError>) -> Result<T, LoadError> {
    catch_unwind(AssertUnwindSafe(load)).unwrap_or_else(|_| {
        Err(LoadError(format!(
            "{name}: the image decoder failed; copy the file again or remove it"
        )))
    })
}

fn load(dataset: &Dataset, job: &Job, background: [f32; 3]) -> Result<(Arc<Prepared>, Option<Arc<Photo>>), LoadError> {
    let view = &dataset.views[job.view];
    let k = &view.camera.intrinsics;
    let to = k.scaled(job.scale);
    let source = &view.photo;
    let prepare = |photo: &Photo| Arc::new(Prepared::new(photo, to.width, to.height, background));
    if let Some(full) = &job.full {
        return Ok((prepare(full), job.keep_full.then(|| full.clone())));
    }
    if !source.is_shrunk_from_full(to.width, to.height) {
        return Ok((prepare(&source.load_at(to.width, to.height)?), None));
    }
    let photo = source.load()?;
    if (photo.width, photo.height) != (k.width, k.height) {
        return Err(LoadError(format!(
            "{}: the photograph has {}x{} pixels, but its camera has {}x{}: was the file replaced while training?",
            view.name, photo.width, photo.height, k.width, k.height
        )));
    }
    let prepared = prepare(&photo);
    Ok((prepared, job.keep_full.then(|| Arc::new(photo))))
}
