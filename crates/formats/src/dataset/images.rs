//! Photographs in a folder that the user names, instead of where the layout expects them.

use super::declared::DeclaredDataset;
use super::files::{find_image, is_image_name};
use super::sibling_folder::files_below;
use crate::FormatError;
use std::cell::LazyCell;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// How the names of folders begin whose images are no photographs.
const OTHER_FOLDERS: [&str; 3] = ["mask", "depth", "normal"];

/// Takes the photographs of `declared` from `folder`: by path, by path without its first folder (`a/b.jpg` for `images/a/b.jpg`), or by
/// file name alone, also in a subfolder if only one has such a file. `downscale` is relative to these photographs.
///
/// # Errors
/// When none of them is found.
pub(super) fn relocate(declared: &mut DeclaredDataset, folder: &Path, downscale: f32) -> Result<(), FormatError> {
    let below = LazyCell::new(|| PhotographsBelow::find(folder));
    for view in &mut declared.views {
        let name = Path::new(&view.name);
        let shorter = Path::new(view.name_without_folder());
        let candidates = [Some(name), Some(shorter), name.file_name().map(Path::new)];
        let found = candidates
            .into_iter()
            .flatten()
            .find_map(|name| find_image(&folder.join(name)));
        view.image = found.or_else(|| below.only(&view.name));
    }
    if declared.views.iter().all(|view| view.image.is_none()) {
        let first = declared.views.first().map_or("", |view| view.name.as_str());
        let message = format!("has none of the dataset's photographs, such as {first}");
        return Err(FormatError::malformed(folder, message));
    }
    declared.downscale = downscale;
    Ok(())
}

/// The photographs of a folder and its subfolders, by file name without extension in lower case; `None` if several have that name.
pub(super) struct PhotographsBelow(HashMap<String, Option<PathBuf>>);

impl PhotographsBelow {
    pub fn find(folder: &Path) -> Self {
        let by_path = files_below(folder, is_image_name);
        let mut by_name: HashMap<String, Option<PathBuf>> = HashMap::new();
        let is_photograph = |path: &str| !OTHER_FOLDERS.iter().any(|start| path.starts_with(start));
        for (_, file) in by_path.into_iter().filter(|(path, _)| is_photograph(path)) {
            let Some(stem) = file.file_stem() else { continue };
            let name = stem.to_string_lossy().to_lowercase();
            by_name
                .entry(name)
                .and_modify(|only| *only = None)
                .or_insert(Some(file));
        }
        Self(by_name)
    }

    /// The only photograph with the file name of `path`, which may lack its extension or have another.
    pub fn only(&self, path: &str) -> Option<PathBuf> {
        let path = Path::new(path);
        let mut names = [path.file_name(), path.file_stem()].into_iter().flatten();
        names.find_map(|name| self.0.get(&name.to_string_lossy().to_lowercase())?.clone())
    }
}
