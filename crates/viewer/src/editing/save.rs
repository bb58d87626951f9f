//! Writes the list of edits and the scene beside the file that was opened, which is never replaced.

use super::EditingError;
use super::session::Session;
use irradia_runs::formats::{FormatError, write_atomic, write_splats};
use std::fs;
use std::path::{Path, PathBuf};

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
fn entry_of(source: &Path) -> &Path {
    match source.file_name().is_some_and(|name| name == "meta.json") {
        true => source.parent().unwrap_or(source),
        false => source,
    }
}

/// The folder that contains a scene's file or its folder of images.
pub(super) fn folder_of(source: &Path) -> &Path {
    entry_of(source).parent().unwrap_or(Path::new(""))
}

/// The name of a scene's file, or of its folder of images, without the extension.
pub(crate) fn stem_of(source: &Path) -> String {
    let name = entry_of(source)
        .file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default();
    let stem = name.split('.').next().unwrap_or_default();
    if stem.is_empty() {
        "scene".to_owned()
    } else {
        stem.to_owned()
    }
}

/// Writes the list, the scene, the scenes that were split off and those that pages sent to be merged; to the same files as before if the
/// session has been saved.
pub(super) fn save(session: &Session, source: &Path, before: Option<&Saved>) -> Result<Saved, EditingError> {
    let stem = stem_of(source);
    let folder = folder_of(source);
    let names = |number: usize| {
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
        None => (1..)
            .map(names)
            .find(|(list, scene)| !list.exists() && !scene.exists())
            .expect("some number is free"),
    };
    let parts = session.parts()?;
    write_splats(&scene, &session.draft().shown())?;
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

/// Writes the list of a session that ends to a new file beside the scene's, if it has unsaved edits; returns the path of the file.
pub(super) fn save_rest(
    session: &Session,
    source: &Path,
    saved: Option<&Saved>,
) -> Result<Option<PathBuf>, EditingError> {
    let list = session.list();
    let text = list.to_toml();
    if list.edits.is_empty() || saved.is_some_and(|saved| saved.text == text) {
        return Ok(None);
    }
    let (folder, stem) = (folder_of(source), stem_of(source));
    let name = |number: usize| folder.join(format!("{stem}.unsaved-{number}.toml"));
    let path = (1..)
        .map(name)
        .find(|path| !path.exists())
        .expect("some number is free");
    session.save_merged()?;
    write_atomic(&path, |out| out.write_all(text.as_bytes()))?;
    Ok(Some(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::editing::uploads::Uploads;
    use irradia_edit::{Draft, Operation};
    use irradia_runs::scene::GaussianCloud;
    use std::sync::Arc;

    #[test]
    fn edits_that_were_not_saved_are_kept_once() {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("a.ply");
        let cloud = GaussianCloud {
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            log_scales: vec![[-2.0; 3]],
            opacity_logits: vec![1.0],
            sh: vec![0.3; 3],
            ..GaussianCloud::default()
        };
        let mut session = Session::new(Draft::new(cloud, Vec::new()), Arc::new(Uploads::new(folder.path())));
        assert_eq!(save_rest(&session, &source, None).unwrap(), None, "nothing was done");
        session.edit(1, true, Operation::Opacity { factor: 0.5 }).unwrap();
        let saved = save(&session, &source, None).unwrap();
        assert_eq!(save_rest(&session, &source, Some(&saved)).unwrap(), None);
        session.edit(2, true, Operation::Opacity { factor: 0.25 }).unwrap();
        let rest = save_rest(&session, &source, Some(&saved)).unwrap().expect("a file");
        assert_eq!(rest, folder.path().join("a.unsaved-1.toml"));
        assert_eq!(std::fs::read_to_string(rest).unwrap(), session.list().to_toml());
    }
}
