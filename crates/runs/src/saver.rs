//! Writes checkpoints, large ones in the background: training waits while its splats are copied, but not while they are written.
//! The system would spend most of a copy's time on fresh pages (with five million splats 4.8 of 5 s), so the memory is obtained
//! beforehand, also in the background, and kept for the next copy.

use crate::RunFolder;
use irradia_splat::SplatState;
use irradia_train::checkpoint::Checkpoint;
use irradia_train::memory;
use std::thread::JoinHandle;

/// Copying is worth its memory for checkpoints of at least this many bytes: smaller ones are written in half a second.
const MIN_BACKGROUND_BYTES: u64 = 256 << 20;
/// Number of splats for which memory is obtained, relative to the current number: density control adds some before the checkpoint.
const RESERVE_FACTOR: f64 = 1.25;

/// Step and path of a checkpoint, or why it was not written.
type Outcome = Result<(u64, String), String>;

/// The writer of a run's checkpoints, at most one at a time. Dropping it waits for the last one.
#[derive(Default)]
pub(crate) struct Saver {
    writing: Option<JoinHandle<(Outcome, SplatState)>>,
    outcome: Option<Outcome>,
    /// The memory for the next copy, unless it is still being obtained.
    buffer: SplatState,
    allocating: Option<JoinHandle<SplatState>>,
}

impl Saver {
    /// Obtains memory for a copy of `state`, which will have at most `max_splats` splats, if checkpoints are to be written in the background
    /// and there is none yet. Returns immediately.
    pub fn prepare(&mut self, state: &SplatState, max_splats: usize) {
        let busy = self.writing.is_some() || self.allocating.is_some();
        if busy || self.buffer.has_room_for(state) || !should_copy(state.bytes() as u64, self.buffer.bytes()) {
            return;
        }
        self.buffer = SplatState::default();
        let len = ((state.len() as f64 * RESERVE_FACTOR) as usize)
            .min(max_splats)
            .max(state.len());
        let degree = state.splats.sh_degree();
        self.allocating = Some(std::thread::spawn(move || SplatState::resident(len, degree)));
    }

    /// Writes `checkpoint`. Returns its path, or `None` if it is still being written from a copy: this is the case if it is large and
    /// twice the memory of the copy, for which [`memory::MemoryPlan`] leaves room, is free.
    ///
    /// # Errors
    /// One line.
    pub fn save(&mut self, folder: &RunFolder, checkpoint: Checkpoint) -> Result<Option<String>, String> {
        self.wait();
        if let Some(allocating) = self.allocating.take() {
            self.buffer = allocating.join().unwrap_or_default();
        }
        if !should_copy(checkpoint.bytes(), self.buffer.bytes()) {
            self.buffer = SplatState::default();
            return self.save_now(folder, &checkpoint).map(Some);
        }
        self.save_in_background(folder, &checkpoint);
        Ok(None)
    }

    /// Writes `checkpoint` and returns its path.
    ///
    /// # Errors
    /// One line.
    pub fn save_now(&mut self, folder: &RunFolder, checkpoint: &Checkpoint) -> Result<String, String> {
        self.wait();
        write(folder, checkpoint).map(|(_, path)| path)
    }

    fn save_in_background(&mut self, folder: &RunFolder, checkpoint: &Checkpoint) {
        self.wait();
        let buffer = std::mem::take(&mut self.buffer);
        let (folder, copy) = (folder.clone(), checkpoint.copied_into(buffer));
        self.writing = Some(std::thread::spawn(move || (write(&folder, &copy), copy.into_state())));
    }

    /// Waits for the checkpoint that is being written.
    pub fn wait(&mut self) {
        if let Some(writing) = self.writing.take() {
            let failed = |_| {
                (
                    Err("no checkpoint: its writer failed".to_owned()),
                    SplatState::default(),
                )
            };
            let (outcome, buffer) = writing.join().unwrap_or_else(failed);
            (self.outcome, self.buffer) = (Some(outcome), buffer);
        }
    }

    /// The checkpoint that was completed since the last call.
    pub fn take_saved(&mut self) -> Option<(u64, String)> {
        self.poll();
        match self.outcome.take() {
            Some(Ok(saved)) => Some(saved),
            other => {
                self.outcome = other;
                None
            }
        }
    }

    /// Why a checkpoint could not be written since the last call.
    pub fn take_failure(&mut self) -> Option<String> {
        self.poll();
        match self.outcome.take() {
            Some(Err(why)) => Some(why),
            other => {
                self.outcome = other;
                None
            }
        }
    }

    fn poll(&mut self) {
        if self.writing.as_ref().is_some_and(JoinHandle::is_finished) {
            self.wait();
        }
    }
}

impl Drop for Saver {
    fn drop(&mut self) {
        self.wait();
    }
}

/// Whether a state of `bytes` is copied, if `held` bytes have already been obtained for the copy.
fn should_copy(bytes: u64, held: usize) -> bool {
    let enough = |free: usize| (free + held) as u64 >= 2 * bytes;
    bytes >= MIN_BACKGROUND_BYTES && memory::free().is_some_and(enough)
}

fn write(folder: &RunFolder, checkpoint: &Checkpoint) -> Outcome {
    let path = folder.write_checkpoint(checkpoint);
    path.map(|path| (checkpoint.step, path))
        .map_err(|error| format!("no checkpoint: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prelude::SynthOptions;
    use crate::{Run, TrainInput, write_synth_dataset};

    #[test]
    fn memory_is_obtained_for_large_states_alone_and_once() {
        let mut saver = Saver::default();
        saver.prepare(&SplatState::resident(1000, 3), 2000);
        assert!(saver.allocating.is_none(), "a small state is written at once");
        // 752 bytes a splat.
        let large = SplatState::resident(400_000, 3);
        if should_copy(large.bytes() as u64, 0) {
            saver.prepare(&large, 450_000);
            saver.buffer = saver.allocating.take().expect("begun").join().unwrap();
            assert_eq!(saver.buffer.len(), 450_000);
            saver.prepare(&large, 450_000);
            assert!(saver.allocating.is_none(), "there is enough");
        }
    }

    #[test]
    fn a_checkpoint_written_behind_is_reported_when_it_is_complete_and_a_failure_too() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        let options = SynthOptions {
            views: 3,
            width: 16,
            height: 12,
            seed: 0,
            ..SynthOptions::default()
        };
        write_synth_dataset(&photos, &options).unwrap();
        let input = TrainInput {
            steps: Some(2),
            ..TrainInput::new(photos, folder.path().join("run"))
        };
        let mut run = Run::begin(input.check().unwrap()).unwrap();
        run.train(&mut []).unwrap();
        let mut saver = Saver::default();
        let checkpoint = Checkpoint::of(&run.trainer);
        saver.save_in_background(&run.folder, &checkpoint);
        saver.wait();
        let (step, path) = saver.take_saved().expect("written");
        assert!(step == 2 && run.folder.file(&path).is_file());
        assert_eq!((saver.take_saved(), saver.take_failure()), (None, None));

        std::fs::remove_dir_all(run.folder.file("checkpoints")).unwrap();
        std::fs::write(run.folder.file("checkpoints"), "").unwrap();
        saver.save_in_background(&run.folder, &checkpoint);
        saver.wait();
        assert_eq!(saver.take_saved(), None);
        assert!(saver.take_failure().is_some_and(|why| why.starts_with("no checkpoint")));
    }
}
