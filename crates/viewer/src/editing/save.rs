//! Writes the list of edits and the scene beside the file that was opened, which is never replaced.

use super::EditingError;
use super::session::Session;
use irradia_runs::formats::{FormatError, SplatFormat, write_atomic, write_splats};
use irradia_runs::write_own_cameras;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{fs, io};

/// Where a session has been saved.
#[derive(Clone, Debug)]
pub(super) struct Saved {
    list: PathBuf,
    scene: PathBuf,
    parts: Vec<PathBuf>,
    /// The list as it was written.
    text: String,
}

impl Saved {
    /// A line that names the files.
    pub fn line(&self) -> String {
        let name = |path: &Path| {
            path.file_name()
                .map(|name| name.to_string_lossy().into_owned())
                .unwrap_or_default()
        };
        let parts = match self.parts.len() {
            0 => String::new(),
            1 => " and a part".to_owned(),
            count => format!(" and {count} parts"),
        };
        format!("saved {} and {}{parts}", name(&self.list), name(&self.scene))
    }
}

/// A scene's file, or its folder of images.
fn scene_entry(source: &Path) -> &Path {
    if source.file_name().is_some_and(|name| name == "meta.json") {
        source.parent().unwrap_or(source)
    } else {
        source
    }
}

/// The folder that contains a scene's file or its folder of images.
pub(super) fn folder_of(source: &Path) -> &Path {
    scene_entry(source).parent().unwrap_or(Path::new(""))
}

/// The name of a scene's file without the end that tells its format, or the name of its folder of images.
pub(crate) fn stem_of(source: &Path) -> String {
    let name = scene_entry(source)
        .file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default();
    let stem = match SplatFormat::of(source) {
        Ok(SplatFormat::SogFolder) => Some(name.as_str()),
        Ok(format) => name.get(..name.len() - format.suffix().len()),
        Err(_) => Path::new(&name).file_stem().and_then(|stem| stem.to_str()),
    };
    stem.filter(|stem| !stem.is_empty()).unwrap_or("scene").to_owned()
}

/// Names of the files in a folder; none if it cannot be read.
fn names_in(folder: &Path) -> Vec<String> {
    let folder = if folder.as_os_str().is_empty() {
        Path::new(".")
    } else {
        folder
    };
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect()
}

/// Writes the list, the scene, the scenes that were split off and those that pages sent to be merged; to the same files as before if the
/// session has been saved.
pub(super) fn save(session: &Session, source: &Path, before: Option<&Saved>) -> Result<Saved, EditingError> {
    let stem = stem_of(source);
    let folder = folder_of(source);
    let paths = |number: usize| {
        let end = if number == 1 {
            String::new()
        } else {
            format!("-{number}")
        };
        // Not `edits.toml`: in a run, that is the list of edits made to its scene in place.
        let list = format!("{stem}.edits{end}.toml");
        (folder.join(list), folder.join(format!("{stem}.edited{end}.ply")))
    };
    let (list, scene) = match before {
        Some(before) => (before.list.clone(), before.scene.clone()),
        None => {
            let names = names_in(folder);
            // Parts and cameras are beside the scene, with its name, and may be left where the scene was renamed.
            let is_free = |(list, scene): &(PathBuf, PathBuf)| {
                let beside = format!("{}.", stem_of(scene));
                !list.exists() && !scene.exists() && !names.iter().any(|name| name.starts_with(&beside))
            };
            (1..).map(paths).find(is_free).expect("some number is free")
        }
    };
    let parts = session.parts()?;
    write_splats(&scene, &session.draft().visible_cloud())?;
    write_own_cameras(source, &scene, &session.moved())?;
    let path_of = |name: &str| scene.with_extension(format!("{name}.ply"));
    for (name, part) in &parts {
        write_splats(&path_of(name), part)?;
    }
    let parts: Vec<PathBuf> = parts.iter().map(|(name, _)| path_of(name)).collect();
    // Parts of splits that have been undone since are removed.
    for old in before.iter().flat_map(|before| &before.parts) {
        if !parts.contains(old) && old.exists() {
            fs::remove_file(old).map_err(|source| FormatError::Write {
                path: old.clone(),
                source,
            })?;
        }
    }
    session.save_merged()?;
    let text = session.list().to_toml();
    write_atomic(&list, |out| out.write_all(text.as_bytes()))?;
    Ok(Saved {
        list,
        scene,
        parts,
        text,
    })
}

/// The file of a session's unsaved edits beside the scene: it is kept up to date, so that a crash loses nothing.
#[derive(Default)]
pub(super) struct UnsavedEdits {
    /// The file and the list as it was written; `None` if nothing is unsaved.
    written: Option<(PathBuf, Arc<str>)>,
    /// The scenes that the list merged when they were last written.
    merged: Vec<String>,
}

impl UnsavedEdits {
    /// The file, if there are unsaved edits.
    pub fn path(&self) -> Option<&Path> {
        self.written.as_ref().map(|(path, _)| path.as_path())
    }

    /// Writes the session's `list` to the file if it differs from what is written and saved; removes the file if nothing is unsaved.
    ///
    /// # Errors
    /// When a file cannot be written or removed.
    pub fn update(
        &mut self,
        session: &Session,
        list: Arc<str>,
        source: &Path,
        saved: Option<&Saved>,
    ) -> Result<(), EditingError> {
        if session.edits().next().is_none() || saved.is_some_and(|saved| *saved.text == *list) {
            return self.remove();
        }
        if self.written.as_ref().is_none_or(|(_, written)| *written != list) {
            let path = self.path().map_or_else(|| new_unsaved_path(source), Path::to_owned);
            write_atomic(&path, |out| out.write_all(list.as_bytes()))?;
            self.written = Some((path, list));
        }
        // After the list: a merged scene that cannot be written must not lose it.
        let merged: Vec<String> = session.merged().map(str::to_owned).collect();
        if merged != self.merged {
            session.save_merged()?;
            self.merged = merged;
        }
        Ok(())
    }

    fn remove(&mut self) -> Result<(), EditingError> {
        let Some((path, _)) = self.written.take() else {
            return Ok(());
        };
        match fs::remove_file(&path) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => Err(FormatError::Write { path, source }.into()),
            _ => Ok(()),
        }
    }
}

/// A new file for unsaved edits of the scene `source`.
fn new_unsaved_path(source: &Path) -> PathBuf {
    let (folder, stem) = (folder_of(source), stem_of(source));
    (1..)
        .map(|number: usize| folder.join(format!("{stem}.unsaved-{number}.toml")))
        .find(|path| !path.exists())
        .expect("some number is free")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::editing::uploads::Uploads;
    use irradia_edit::{Draft, Operation, SelectStep, Shape};
    use irradia_runs::scene::GaussianCloud;

    #[test]
    fn a_scene_is_named_without_its_format() {
        for (source, stem) in [
            ("a/scene.ply", "scene"),
            ("a/scene.edited.ply", "scene.edited"),
            ("garden.v1.compressed.ply", "garden.v1"),
            ("Garden.SPZ", "Garden"),
            ("garden.spz.glb", "garden"),
            ("a/garden.v1/meta.json", "garden.v1"),
            ("garden.v1.unknown", "garden.v1"),
            ("a/.ply", "scene"),
            ("meta.json", "scene"),
        ] {
            assert_eq!(stem_of(source.as_ref()), stem, "{source}");
        }
    }

    /// A session on a scene of `n` splats that is read from `folder`.
    fn session(n: usize, folder: &Path) -> Session {
        let cloud = GaussianCloud {
            means: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            log_scales: vec![[-2.0; 3]; n],
            opacity_logits: vec![1.0; n],
            sh: vec![0.3; 3 * n],
            ..GaussianCloud::default()
        };
        Session::new(Draft::new(cloud, Vec::new()), Arc::new(Uploads::new(folder)))
    }

    #[test]
    fn a_part_of_an_earlier_session_is_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("a.ply");
        let save_part = |radius| {
            let mut session = session(4, folder.path());
            let ball = SelectStep::add(Shape::Sphere {
                center: [0.0; 3],
                radius,
            });
            session.select(1, true, vec![ball]).unwrap();
            session
                .edit(2, false, Operation::Split { name: "part".into() })
                .unwrap();
            save(&session, &source, None).unwrap()
        };
        let first = save_part(0.5);
        let part = fs::read(folder.path().join("a.edited.part-1.ply")).unwrap();
        for path in [&first.list, &first.scene] {
            let other = path.file_name().unwrap().to_string_lossy().replace("a.", "mine.");
            fs::rename(path, folder.path().join(other)).unwrap();
        }
        let second = save_part(2.5);
        assert_eq!(second.line(), "saved a.edits-2.toml and a.edited-2.ply and a part");
        assert_eq!(fs::read(&first.parts[0]).unwrap(), part);
    }

    #[test]
    fn edits_that_are_not_saved_are_in_one_file() {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("a.ply");
        let file = folder.path().join("a.unsaved-1.toml");
        let mut session = session(1, folder.path());
        let mut unsaved = UnsavedEdits::default();
        let mut keep = |session: &Session, saved: Option<&Saved>| {
            let list = session.list().to_toml().into();
            unsaved.update(session, list, &source, saved).unwrap();
            assert_eq!(unsaved.path(), file.exists().then_some(file.as_path()));
            fs::read_to_string(&file).ok()
        };
        assert_eq!(keep(&session, None), None, "nothing was done");
        for (gesture, factor) in [(1, 0.5), (2, 0.25)] {
            let op = Operation::Opacity { factor };
            session.edit(gesture, true, op).unwrap();
            assert_eq!(keep(&session, None), Some(session.list().to_toml()));
        }
        let saved = save(&session, &source, None).unwrap();
        assert_eq!(keep(&session, Some(&saved)), None, "saved");
        session.go_to(1).unwrap();
        assert_eq!(keep(&session, Some(&saved)), Some(session.list().to_toml()));
        session.go_to(0).unwrap();
        assert_eq!(keep(&session, Some(&saved)), None, "all is undone");
    }
}
