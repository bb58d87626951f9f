//! Photographs in a folder that the user names, instead of where the layout expects them.

use super::declared::DeclaredDataset;
use super::files::find_image;
use crate::FormatError;
use std::path::Path;

/// Takes the photographs of `declared` from `folder`: by path, by path without its first folder (`a/b.jpg` for `images/a/b.jpg`), or by
/// file name alone. `downscale` is relative to these photographs.
///
/// # Errors
/// When none of them is found.
pub(super) fn relocate(declared: &mut DeclaredDataset, folder: &Path, downscale: f32) -> Result<(), FormatError> {
    for view in &mut declared.views {
        let name = Path::new(&view.name);
        let below = Path::new(view.name_without_folder());
        let candidates = [Some(name), Some(below), name.file_name().map(Path::new)];
        let found = candidates
            .into_iter()
            .flatten()
            .find_map(|name| find_image(&folder.join(name)));
        view.image = found;
    }
    if declared.views.iter().all(|view| view.image.is_none()) {
        let first = declared.views.first().map_or("", |view| view.name.as_str());
        let message = format!("has none of the dataset's photographs, such as {first}");
        return Err(FormatError::malformed(folder, message));
    }
    declared.downscale = downscale;
    Ok(())
}
