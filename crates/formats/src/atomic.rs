use crate::FormatError;
use std::fs::{self, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// Writes a file atomically: under a temporary name in the same folder, synced to the disk, then renamed to `path`. If
/// anything fails, or the process is killed, the previous content of `path` is unchanged. A symbolic link is kept, and the file that
/// it leads to is replaced; anything that is not a regular file, such as a pipe or `/dev/stdout`, is written to directly. Missing folders
/// are created.
///
/// # Errors
/// [`FormatError::Write`] with the system's reason, such as a full disk; the temporary file is removed.
pub fn write_atomic(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), FormatError> {
    StagedFile::write(path, write)?.put_in_place()
}

/// A file that is complete under a temporary name. If several files belong together, all of them are staged before the first is put in
/// place. Otherwise [`write_atomic`] does both.
#[derive(Debug)]
pub struct StagedFile {
    path: PathBuf,
    /// `None` if the file was written to directly.
    temporary: Option<NamedTempFile>,
}

impl StagedFile {
    /// Writes the file under a temporary name, which is removed unless it is put in place.
    ///
    /// # Errors
    /// Those of [`write_atomic`].
    pub fn write(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<Self, FormatError> {
        let path = resolve_links(path);
        match write_temporary(&path, write) {
            Ok(temporary) => Ok(Self { path, temporary }),
            Err(source) => Err(FormatError::Write { path, source }),
        }
    }

    /// Renames the file to its final name.
    ///
    /// # Errors
    /// [`FormatError::Write`] with the system's reason.
    pub fn put_in_place(self) -> Result<(), FormatError> {
        let Self { path, temporary } = self;
        match temporary.map(|temporary| temporary.persist(&path)) {
            Some(Err(error)) => Err(FormatError::Write {
                path,
                source: error.error,
            }),
            _ => Ok(()),
        }
    }
}

fn write_temporary(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<Option<NamedTempFile>> {
    if fs::metadata(path).is_ok_and(|metadata| !metadata.is_file() && !metadata.is_dir()) {
        let mut writer = BufWriter::with_capacity(1 << 18, OpenOptions::new().write(true).open(path)?);
        write(&mut writer)?;
        writer.flush()?;
        return Ok(None);
    }
    if let Some(folder) = folder_of(path) {
        fs::create_dir_all(folder)?;
    }
    let mut writer = BufWriter::with_capacity(1 << 18, create_beside(path)?);
    write(&mut writer)?;
    let temporary = writer.into_inner().map_err(|error| error.into_error())?;
    temporary.as_file().sync_all()?;
    Ok(Some(temporary))
}

/// Where links from `path` lead, also if there is no file yet, which has no canonical path. Links may lead in a circle: as many are followed
/// as by Linux.
fn resolve_links(path: &Path) -> PathBuf {
    const MAX_LINKS: usize = 40;
    let mut path = path.to_owned();
    for _ in 0..MAX_LINKS {
        match (fs::canonicalize(&path), fs::read_link(&path), path.parent()) {
            (Ok(canonical), ..) => return canonical,
            (_, Ok(target), Some(folder)) => path = folder.join(target),
            _ => break,
        }
    }
    path
}

/// A file beside `path` that is removed unless it is renamed, even if the writing code panics. It has the permissions of any new file, which
/// may be read by others.
fn create_beside(path: &Path) -> io::Result<NamedTempFile> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path has no file name"))?
        .to_string_lossy();
    let prefix = format!(".{name}.");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(".tmp");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder_of(path).unwrap_or(Path::new(".")))
}

/// The folder of a file; `None` for a mere file name, which is in the current one.
pub fn folder_of(path: &Path) -> Option<&Path> {
    path.parent().filter(|folder| !folder.as_os_str().is_empty())
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
        let plain = folder.path().join("plain");
        fs::write(&plain, b"").unwrap();
        let [written, usual] = [&path, &plain].map(|path| fs::metadata(path).unwrap().permissions());
        assert_eq!(written, usual);
        fs::remove_file(&plain).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        write_atomic(&path, |w| w.write_all(b"second")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        // Missing folders are created, but not below a file.
        write_atomic(&folder.path().join("new/a.bin"), |_| Ok(())).unwrap();
        assert!(write_atomic(&path.join("a.bin"), |_| Ok(())).is_err());
    }
}
