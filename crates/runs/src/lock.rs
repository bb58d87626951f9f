//! One process per run folder: the lock that is held during training.

use crate::RunError;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;

/// The locked file. It remains after the run.
const LOCK_FILE: &str = ".lock";

/// Held while a run may write into its folder.
///
/// This is a system lock on an open file, not the existence of a file: the system releases it whenever the process ends, so no lock
/// is ever stale, and network file systems honour it across hosts. On a file system without locks, nothing is locked or rejected.
#[derive(Debug)]
pub(crate) struct FolderLock {
    _file: Option<File>,
}

impl FolderLock {
    /// Locks `folder`, which exists.
    ///
    /// # Errors
    /// When another process, or another run in this process, holds the lock; when the file cannot be created.
    pub fn acquire(folder: &Path) -> Result<Self, RunError> {
        let path = folder.join(LOCK_FILE);
        let opened = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path);
        let mut file = opened.map_err(RunError::io("write", &path))?;
        match file.try_lock() {
            Ok(()) => {
                // The holder's id is only for messages: a failure does not matter.
                let _ = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
                Ok(Self { _file: Some(file) })
            }
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let _ = file.rewind().and_then(|()| file.read_to_string(&mut holder));
                let holder = holder.parse::<u32>().map_or(String::new(), |id| format!(" {id}"));
                Err(RunError::InUse {
                    folder: folder.to_owned(),
                    holder,
                })
            }
            Err(TryLockError::Error(_)) => Ok(Self { _file: None }),
        }
    }

    /// Whether `folder` was ever locked for a run.
    pub fn has_lock_file(folder: &Path) -> bool {
        folder.join(LOCK_FILE).is_file()
    }

    /// [`Self::acquire`] if a run has left its lock file. It fails early and creates no file in other folders.
    pub fn acquire_existing(folder: &Path) -> Result<Option<Self>, RunError> {
        Self::has_lock_file(folder).then(|| Self::acquire(folder)).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_one_holder_at_a_time_and_files_of_dead_processes_are_ignored() {
        let folder = tempfile::tempdir().unwrap();
        assert!(FolderLock::acquire_existing(folder.path()).unwrap().is_none());
        // As left by a killed process.
        std::fs::write(folder.path().join(LOCK_FILE), "4194305").unwrap();
        let held = FolderLock::acquire(folder.path()).unwrap();
        let line = FolderLock::acquire_existing(folder.path()).unwrap_err().to_string();
        assert!(
            line.contains(&std::process::id().to_string()) && line.contains("--out"),
            "{line}"
        );
        drop(held);
        FolderLock::acquire(folder.path()).unwrap();
    }
}
