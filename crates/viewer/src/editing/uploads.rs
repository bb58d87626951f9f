//! Scenes that pages have sent to be merged. Edits can name these and scenes beside the edited one, and no other files.

use super::EditingError;
use irradia_edit::EditError;
use irradia_runs::formats::{FormatError, SplatFile, SplatFormat, read_splat_file, write_atomic};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Maximum bytes of all files that are kept.
const MAX_TOTAL_BYTES: usize = 1 << 30;

struct Upload {
    bytes: Vec<u8>,
    scene: SplatFile,
}

/// The scenes that were sent, by name.
pub(crate) struct Uploads {
    /// The folder of the edited scene, where saving writes them.
    folder: PathBuf,
    files: Mutex<BTreeMap<String, Upload>>,
}

impl Uploads {
    /// No scenes yet; saving writes them to `folder`.
    pub fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
            files: Mutex::default(),
        }
    }

    /// Keeps a file that a page calls `name`. Returns the name by which edits find it, and its number of splats.
    ///
    /// # Errors
    /// When it is not a splat file, or there is no room.
    pub fn add(&self, name: &str, bytes: Vec<u8>) -> Result<(String, usize), EditingError> {
        let name: String = name.chars().map(sanitized).collect();
        let path = PathBuf::from(name.trim_start_matches('.'));
        let format = SplatFormat::of(&path)?;
        if !format.is_readable() || format == SplatFormat::SogFolder {
            return Err(refused(format!(
                "{name}: this format cannot be merged: choose .ply or .sog"
            )));
        }
        let scene = SplatFile::parse(format, &bytes).map_err(|source| FormatError::Malformed {
            path: path.clone(),
            source,
        })?;
        let mut files = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        let kept: usize = files.values().map(|upload| upload.bytes.len()).sum();
        let shown = path.display().to_string();
        let stem = shown.get(..shown.len() - format.suffix().len()).unwrap_or_default();
        let numbered = |number: usize| match number {
            1 => shown.clone(),
            _ => format!("{stem}-{number}{}", format.suffix()),
        };
        let is_free = |name: &String| match files.get(name) {
            Some(other) => other.bytes == bytes,
            None => self.is_free(name, &bytes),
        };
        let name = (1..).map(numbered).find(is_free).expect("some number is free");
        if kept + bytes.len() > MAX_TOTAL_BYTES && !files.contains_key(&name) {
            return Err(refused(
                "there is no room for more scenes: merge them with irradia edit".to_owned(),
            ));
        }
        let splats = scene.cloud.len();
        files.insert(name.clone(), Upload { bytes, scene });
        Ok((name, splats))
    }

    /// Whether the folder has no other file of this name.
    fn is_free(&self, name: &str, bytes: &[u8]) -> bool {
        let path = self.folder.join(name);
        match fs::metadata(&path) {
            Ok(file) => file.len() == bytes.len() as u64 && fs::read(&path).is_ok_and(|other| other == bytes),
            Err(_) => true,
        }
    }

    /// The scene that edits call `name`: one that was sent, otherwise a file beside the edited scene, as lists that were saved name it.
    ///
    /// # Errors
    /// When there is none, or the file cannot be read.
    pub fn open(&self, name: &str) -> Result<SplatFile, String> {
        let files = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(upload) = files.get(name) {
            return Ok(upload.scene.clone());
        }
        drop(files);
        read_splat_file(&self.sibling(name)?).map_err(|error| error.to_string())
    }

    /// Whether [`Self::open`] finds a scene.
    ///
    /// # Errors
    /// When there is none.
    pub fn check(&self, name: &str) -> Result<(), String> {
        let files = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        if files.contains_key(name) {
            return Ok(());
        }
        self.sibling(name).map(drop)
    }

    /// The file `name` beside the edited scene.
    fn sibling(&self, name: &str) -> Result<PathBuf, String> {
        let path = self.folder.join(name);
        if name.contains(['/', '\\', ':']) || !path.is_file() {
            return Err(format!("no scene {name} has been sent: choose it with Merge first"));
        }
        Ok(path)
    }

    /// Writes the file `name` to the folder, where `irradia edit` finds it.
    ///
    /// # Errors
    /// When it cannot be written, or another file has taken its name meanwhile.
    pub fn save(&self, name: &str) -> Result<(), EditingError> {
        let files = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(upload) = files.get(name) else { return Ok(()) };
        if !self.is_free(name, &upload.bytes) {
            return Err(refused(format!(
                "there is another {name} beside the scene now: move it away"
            )));
        }
        let path = self.folder.join(name);
        if !path.exists() {
            write_atomic(&path, |out| out.write_all(&upload.bytes))?;
        }
        Ok(())
    }
}

fn refused(message: String) -> EditingError {
    EditError::Scene(message).into()
}

/// `c`, or an underscore for a character that some systems refuse in file names or that could form a path.
fn sanitized(c: char) -> char {
    if c.is_alphanumeric() || "-_.".contains(c) {
        c
    } else {
        '_'
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_runs::formats::encode_splats;
    use irradia_scene::GaussianCloud;

    fn scene(opacity: f32) -> Vec<u8> {
        let cloud = GaussianCloud {
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            log_scales: vec![[-1.0; 3]],
            opacity_logits: vec![opacity],
            sh: vec![0.5; 3],
            ..GaussianCloud::default()
        };
        encode_splats(SplatFormat::Ply, &cloud, &Default::default()).unwrap()
    }

    #[test]
    fn names_are_no_paths_and_differ_where_contents_do() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("taken.ply"), "other").unwrap();
        let uploads = Uploads::new(folder.path());
        let add = |name: &str, opacity: f32| uploads.add(name, scene(opacity)).map(|(name, _)| name).unwrap();
        assert_eq!(add("../a b/c.ply", 1.0), "_a_b_c.ply");
        assert_eq!(add("room.ply", 1.0), "room.ply");
        assert_eq!(add("room.ply", 1.0), "room.ply");
        assert_eq!(add("room.ply", 2.0), "room-2.ply");
        assert_eq!(add("taken.ply", 1.0), "taken-2.ply");
        assert_eq!(uploads.open("room-2.ply").unwrap().cloud.opacity_logits, [2.0]);
        fs::write(folder.path().join("beside.ply"), scene(3.0)).unwrap();
        assert_eq!(uploads.open("beside.ply").unwrap().cloud.opacity_logits, [3.0]);
        let within = format!("../{}/beside.ply", folder.path().file_name().unwrap().display());
        for name in ["/etc/passwd", "..", "", "absent.ply", within.as_str()] {
            assert!(uploads.open(name).unwrap_err().contains("has been sent"), "{name}");
        }
        uploads.save("room.ply").unwrap();
        uploads.save("room.ply").unwrap();
        assert_eq!(fs::read(folder.path().join("room.ply")).unwrap(), scene(1.0));
        fs::write(folder.path().join("room-2.ply"), "other").unwrap();
        assert!(
            uploads
                .save("room-2.ply")
                .unwrap_err()
                .to_string()
                .contains("move it away")
        );
        for (name, bytes, says) in [
            ("a.ply", b"ply".to_vec(), "a.ply"),
            ("a.png", scene(1.0), "a.png"),
            ("a.npz", scene(1.0), "choose .ply"),
            ("meta.json", scene(1.0), "choose .ply"),
        ] {
            let error = uploads.add(name, bytes).unwrap_err().to_string();
            assert!(error.contains(says) && !error.contains('\n'), "{error}");
        }
    }
}
