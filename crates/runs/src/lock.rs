//! One process a run's folder: the lock that is held while a run is trained.

use crate::RunError;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;

/// The file that is locked. It stays when the run is over.
const NAME: &str = ".lock";

/// Held for as long as a run may write into its folder.
///
/// The lock is the system's own on an open file, not the file's existence: it goes when its process does, however that ends,
/// so that none is ever stale, and network file systems keep it across hosts. Where a file system has no locks, nothing is
/// held and nothing refused.
#[derive(Debug)]
pub(crate) struct FolderLock {
    _file: Option<File>,
}

impl FolderLock {
    /// Takes the lock of `folder`, which exists.
    ///
    /// # Errors
    /// When another process, or another run of this one, holds it; when the file cannot be made.
    pub fn take(folder: &Path) -> Result<Self, RunError> {
        let path = folder.join(NAME);
        let opened = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path);
        let mut file = opened.map_err(RunError::io("write", &path))?;
        match file.try_lock() {
            Ok(()) => {
                // Who holds it is only told, never asked: it does not matter if this fails.
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

    /// Whether a run was ever trained in `folder`, or prepared to be.
    pub fn was_taken(folder: &Path) -> bool {
        folder.join(NAME).is_file()
    }

    /// [`Self::take`] where a run has left its lock file: refuses early, and leaves no trace in other folders.
    pub fn take_existing(folder: &Path) -> Result<Option<Self>, RunError> {
        Self::was_taken(folder).then(|| Self::take(folder)).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_holder_at_a_time_and_what_a_dead_process_left_does_not_count() {
        let folder = tempfile::tempdir().unwrap();
        assert!(FolderLock::take_existing(folder.path()).unwrap().is_none());
        // As a process that was killed leaves it.
        std::fs::write(folder.path().join(NAME), "4194305").unwrap();
        let held = FolderLock::take(folder.path()).unwrap();
        let line = FolderLock::take_existing(folder.path()).unwrap_err().to_string();
        assert!(
            line.contains(&std::process::id().to_string()) && line.contains("--out"),
            "{line}"
        );
        drop(held);
        FolderLock::take(folder.path()).unwrap();
    }
}
