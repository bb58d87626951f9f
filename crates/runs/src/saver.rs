//! Writes checkpoints, large ones in the background: the training is held up while its splats are copied, and not while they are
//! written. Most of a first copy's time is the system's, for fresh pages, so that its memory is kept for the next one: with five million
//! splats 4.8 s, then 0.2 s each.

use crate::RunFolder;
use irradia_splat::SplatState;
use irradia_train::checkpoint::Checkpoint;
use irradia_train::memory;
use std::thread::JoinHandle;

/// Copying is worth its memory for checkpoints of at least this many bytes: smaller ones are written in half a second.
const BACKGROUND_FROM: u64 = 256 << 20;

/// Step and path of a checkpoint, or why there is none.
type Outcome = Result<(u64, String), String>;

/// The writer of a run's checkpoints, at most one at a time. Dropping it waits for the last one.
#[derive(Default)]
pub(crate) struct Saver {
    writing: Option<JoinHandle<(Outcome, SplatState)>>,
    outcome: Option<Outcome>,
    /// The memory of the last copy.
    spare: SplatState,
}

impl Saver {
    /// Writes `checkpoint`. Returns its path, or nothing if it is still being written, from a copy: where it is large and memory
    /// for the copy, for which [`memory::MemoryPlan`] leaves room, is free twice over.
    ///
    /// # Errors
    /// One line.
    pub fn save(&mut self, folder: &RunFolder, checkpoint: Checkpoint) -> Result<Option<String>, String> {
        self.wait();
        let bytes = checkpoint.bytes();
        let held = self.spare.bytes() as u64;
        if bytes < BACKGROUND_FROM || memory::free().is_none_or(|free| free as u64 + held < 2 * bytes) {
            self.spare = SplatState::default();
            return self.save_now(folder, &checkpoint).map(Some);
        }
        self.save_behind(folder, &checkpoint);
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

    fn save_behind(&mut self, folder: &RunFolder, checkpoint: &Checkpoint) {
        self.wait();
        let spare = std::mem::take(&mut self.spare);
        let (folder, copy) = (folder.clone(), checkpoint.copied_into(spare));
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
            let (outcome, spare) = writing.join().unwrap_or_else(failed);
            (self.outcome, self.spare) = (Some(outcome), spare);
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
        saver.save_behind(&run.folder, &checkpoint);
        saver.wait();
        let (step, path) = saver.take_saved().expect("written");
        assert!(step == 2 && run.folder.file(&path).is_file());
        assert_eq!((saver.take_saved(), saver.take_failure()), (None, None));

        std::fs::remove_dir_all(run.folder.file("checkpoints")).unwrap();
        saver.save_behind(&run.folder, &checkpoint);
        saver.wait();
        assert_eq!(saver.take_saved(), None);
        assert!(saver.take_failure().is_some_and(|why| why.starts_with("no checkpoint")));
    }
}
