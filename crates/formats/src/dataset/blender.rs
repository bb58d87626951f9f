//! Folders with one transforms file per split, like NeRF's synthetic scenes (Mildenhall et al. 2020).

use super::declared::{DeclaredDataset, Split};
use super::nerfstudio::declared_views;
use super::transforms::parse_transforms;
use crate::FormatError;
use crate::error::read_and_parse;
use crate::points_ply::read_declared_points;
use std::path::Path;

/// Training views are those of the train file; held out are the frames of the test file, or of the validation file if there
/// is no test file.
pub(super) fn read(root: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let train = "transforms_train.json";
    let held_out = ["transforms_test.json", "transforms_val.json"]
        .into_iter()
        .find(|name| root.join(name).is_file());
    let mut views = Vec::new();
    let mut warnings = Vec::new();
    let mut points = None;
    for (name, split) in [(Some(train), Split::Train), (held_out, Split::Test)] {
        let Some(name) = name else { continue };
        let file = root.join(name);
        let transforms = read_and_parse(&file, parse_transforms)?;
        let mut frames = declared_views(&file, root, &transforms)?;
        frames.iter_mut().for_each(|view| view.split = Some(split));
        views.extend(frames);
        if let (None, Some(ply)) = (&points, &transforms.ply_file_path) {
            match read_declared_points(&root.join(ply.replace('\\', "/"))) {
                Ok(read) => points = Some(read),
                Err(error) => warnings.push(format!("the initial points are ignored: {error}")),
            }
        }
    }
    if held_out.is_none() {
        // Then the rule for datasets without a split applies.
        views.iter_mut().for_each(|view| view.split = None);
    }
    Ok(DeclaredDataset {
        kind: "Blender",
        root: root.to_owned(),
        views,
        points,
        downscale,
        warnings,
    })
}
