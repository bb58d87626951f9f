use crate::FormatError;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Writes a file atomically: under a temporary name in the same folder, synced to the disk, then renamed to `path`. If
/// anything fails, or the process is killed, the previous content of `path` is unchanged. A symbolic link is kept, and the file that
/// it leads to is replaced; anything that is not a regular file, such as a pipe or `/dev/stdout`, is written to directly. Missing folders
/// are created.
///
/// # Errors
/// [`FormatError::Write`] with the system's reason, such as a full disk; the temporary file is removed.
pub fn write_atomic(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), FormatError> {
    write_beside(path, write).map_err(|source| FormatError::Write {
        path: path.to_owned(),
        source,
    })
}

fn write_beside(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let path = &destination(path);
    if fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        let mut writer = BufWriter::with_capacity(1 << 18, OpenOptions::new().write(true).open(path)?);
        write(&mut writer)?;
        return writer.flush();
    }
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        fs::create_dir_all(folder)?;
    }
    let (temporary, file) = Temporary::beside(path)?;
    let mut writer = BufWriter::with_capacity(1 << 18, file);
    write(&mut writer)?;
    let file = writer.into_inner().map_err(|error| error.into_error())?;
    file.sync_all()?;
    drop(file);
    temporary.become_file(path)
}

/// Where links from `path` lead, also if there is no file yet, which has no canonical path. Links may lead in a circle: as many are followed
/// as by Linux.
fn destination(path: &Path) -> PathBuf {
    const LINKS: usize = 40;
    let mut path = path.to_owned();
    for _ in 0..LINKS {
        match (fs::canonicalize(&path), fs::read_link(&path), path.parent()) {
            (Ok(found), ..) => return found,
            (_, Ok(target), Some(folder)) => path = folder.join(target),
            _ => break,
        }
    }
    path
}

/// A file that is removed unless it gets its final name, even if the writing code panics.
struct Temporary {
    path: Option<PathBuf>,
}

impl Temporary {
    fn beside(target: &Path) -> io::Result<(Self, File)> {
        // Two threads, or a killed process with the same id, must not use the same name.
        static COUNTER: AtomicU64 = AtomicU64::new(0);
        let name = target
            .file_name()
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path has no file name"))?
            .to_string_lossy()
            .into_owned();
        loop {
            let number = COUNTER.fetch_add(1, Ordering::Relaxed);
            let path = target.with_file_name(format!(".{name}.{}-{number}.tmp", std::process::id()));
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => return Ok((Self { path: Some(path) }, file)),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        }
    }

    fn become_file(mut self, target: &Path) -> io::Result<()> {
        let path = self.path.as_ref().expect("set until it is renamed");
        fs::rename(path, target)?;
        self.path = None;
        Ok(())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if let Some(path) = &self.path {
            // The first error is the one to report; this one would hide it.
            let _ = fs::remove_file(path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn links_keep_leading_to_the_file_and_devices_stay() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link, device] = ["a.bin", "link", "device"].map(|name| folder.path().join(name));
        fs::write(&file, b"old").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        std::os::unix::fs::symlink("/dev/null", &device).unwrap();
        for path in [&link, &device] {
            write_atomic(path, |w| w.write_all(b"new")).unwrap();
            assert!(fs::symlink_metadata(path).unwrap().is_symlink());
        }
        assert_eq!(fs::read(&file).unwrap(), b"new");
        fs::remove_file(&file).unwrap();
        write_atomic(&link, |w| w.write_all(b"again")).unwrap();
        assert_eq!(
            fs::read(&file).unwrap(),
            b"again",
            "a link to a file that is not there yet"
        );
        assert!(!fs::metadata(&device).unwrap().is_file());
        let circle = folder.path().join("circle");
        std::os::unix::fs::symlink("circle", &circle).unwrap();
        write_atomic(&circle, |w| w.write_all(b"file")).unwrap();
        assert_eq!(
            fs::read(&circle).unwrap(),
            b"file",
            "a link that leads to itself is replaced"
        );
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_temporary() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_atomic(&path, |w| w.write_all(b"first")).unwrap();
        let error = write_atomic(&path, |w| {
            w.write_all(b"sec")?;
            Err(io::Error::other("no space left"))
        })
        .unwrap_err();
        assert!(error.to_string().contains("a.bin") && error.to_string().contains("no space left"));
        assert_eq!(fs::read(&path).unwrap(), b"first");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        write_atomic(&path, |w| w.write_all(b"second")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        // Missing folders are created, but not below a file.
        write_atomic(&folder.path().join("new/a.bin"), |_| Ok(())).unwrap();
        assert!(write_atomic(&path.join("a.bin"), |_| Ok(())).is_err());
    }
}
