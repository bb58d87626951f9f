//! A folder with one `transforms.json`, as written by nerfstudio and instant-ngp.

use super::declared::{DeclaredDataset, DeclaredView, Split};
use super::files::{locate_image, path_ends, relative_name};
use super::openmvg;
use super::transforms::{Frame, Transforms, parse_transforms};
use crate::FormatError;
use crate::error::read_and_parse;
use crate::points_ply::read_declared_points;
use std::collections::HashSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// JSON files of other layouts, which can be given by their path as well.
const OTHER_LAYOUT_FILES: [&str; 3] = ["reconstruction.json", "metadata.json", "dataset.json"];

/// The JSON file: `path` itself, or `transforms.json` in it.
pub(super) fn find(path: &Path) -> Option<PathBuf> {
    let is_other = |name: &OsStr| OTHER_LAYOUT_FILES.iter().any(|other| name == *other);
    if path.file_name().is_some_and(is_other) || openmvg::is_file_name(path) {
        return None;
    }
    let is_json = path
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("json"));
    let file = if is_json {
        path.to_owned()
    } else {
        path.join("transforms.json")
    };
    file.is_file().then_some(file)
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let Some(file) = find(path) else {
        return Err(FormatError::malformed(path, "contains no transforms.json"));
    };
    let transforms = read_and_parse(&file, parse_transforms)?;
    let root = match file.parent() {
        Some(parent) if parent != Path::new("") => parent.to_owned(),
        _ => PathBuf::from("."),
    };
    let views = declared_views(&file, &root, &transforms)?;
    let mut warnings = missing_files(&transforms.frames, &views);

    let points = transforms.ply_file_path.as_ref().and_then(|ply| {
        let read = read_declared_points(&root.join(ply.replace('\\', "/")));
        read.map_err(|error| warnings.push(format!("the initial points are ignored: {error}")))
            .ok()
    });
    Ok(DeclaredDataset {
        kind: "nerfstudio",
        root,
        views,
        points,
        downscale,
        warnings,
    })
}

/// Warnings about masks and maps that frames name but that do not exist; `views` are in the order of `frames`.
fn missing_files(frames: &[Frame], views: &[DeclaredView]) -> Vec<String> {
    type DeclaredPath = fn(&Frame) -> &Option<String>;
    type ExistingFile = fn(&DeclaredView) -> &Option<PathBuf>;
    let kinds: [(&str, DeclaredPath, ExistingFile); 3] = [
        ("masks", |frame| &frame.mask_path, |view| &view.mask),
        ("depth maps", Frame::depth, |view| &view.depth),
        ("normal maps", Frame::normals, |view| &view.normals),
    ];
    let warning = |(kind, declared_path, existing_file): (&str, DeclaredPath, ExistingFile)| {
        let missing_path = |(frame, view)| declared_path(frame).as_ref().filter(|_| existing_file(view).is_none());
        let missing: Vec<&String> = frames.iter().zip(views).filter_map(missing_path).collect();
        let first = missing.first()?;
        Some(format!(
            "{} {kind} are missing, such as {first}: their photographs are used without them",
            missing.len()
        ))
    };
    kinds.into_iter().filter_map(warning).collect()
}

/// The frames of a transforms file.
pub(super) fn declared_views(
    file: &Path,
    root: &Path,
    transforms: &Transforms,
) -> Result<Vec<DeclaredView>, FormatError> {
    // Paths are compared, not texts: `./images/a.png` is `images/a.png`.
    let path_of = |name: &str| relative_name(Path::new(""), Path::new(&name.replace('\\', "/")));
    let set = |names: &Option<Vec<String>>| -> HashSet<String> { names.iter().flatten().map(|n| path_of(n)).collect() };
    let train = set(&transforms.train_filenames);
    // If a dataset lists only validation frames, those are held out.
    let (test, validation) = (set(&transforms.test_filenames), set(&transforms.val_filenames));
    let (test, unused) = if test.is_empty() {
        (validation, HashSet::new())
    } else {
        (test, validation)
    };
    let split_of = |name: &String| {
        let name = &path_of(name);
        if train.is_empty() && test.is_empty() {
            None
        } else if test.contains(name) {
            Some(Split::Test)
        } else if train.contains(name) || (train.is_empty() && !unused.contains(name)) {
            Some(Split::Train)
        } else if test.is_empty() {
            Some(Split::Test)
        } else {
            Some(Split::Unlisted)
        }
    };
    // A file beside the photograph, if it exists.
    let existing_file = |path: &Option<String>| {
        let mut paths = path_ends(path.as_ref()?).map(|end| root.join(end));
        paths.find(|path| path.is_file())
    };
    transforms
        .frames
        .iter()
        .map(|frame| {
            let camera = frame
                .camera
                .or(&transforms.camera)
                .camera()
                .map_err(|source| FormatError::Malformed {
                    path: file.to_owned(),
                    source,
                })?;
            let image = locate_image(root, &[""], &frame.file_path);
            let path = root.join(frame.file_path.replace('\\', "/"));
            Ok(DeclaredView {
                name: relative_name(root, image.as_deref().unwrap_or(&path)),
                image,
                mask: existing_file(&frame.mask_path),
                depth: existing_file(frame.depth()),
                normals: existing_file(frame.normals()),
                pose: frame.pose(),
                camera,
                depth_bounds: None,
                time: frame.time.map(|time| time as f32).filter(|time| time.is_finite()),
                points_seen: Vec::new(),
                shutter: frame.shutter(transforms.rolling_shutter_time),
                split: split_of(&frame.file_path),
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_name_frames_however_their_paths_are_written() {
        let text = br#"{"fl_x": 50, "frames": [
            {"file_path": "./images/a.png", "transform_matrix": []},
            {"file_path": "images\\b.png", "transform_matrix": []},
            {"file_path": "images/c.png", "transform_matrix": []}],
            "train_filenames": ["images/a.png", "images/c.png"], "test_filenames": ["./images/b.png"]}"#;
        let transforms = parse_transforms(text).unwrap();
        let root = Path::new("absent");
        let views = declared_views(&root.join("transforms.json"), root, &transforms).unwrap();
        let splits: Vec<_> = views.iter().map(|view| view.split).collect();
        assert_eq!(splits, [Some(Split::Train), Some(Split::Test), Some(Split::Train)]);
    }
}
