//! Panoramas whose faces were posed by `irradia pose`: if photographs of wide lenses are kept whole, panoramas replace their faces.

use super::declared::{DeclaredCamera, DeclaredPose, DeclaredView};
use super::files::relative_name;
use crate::faces::cube_faces;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The folder of the panoramas within that of a dataset; their faces are named after them: `a_front.jpg` for `a.jpg`.
pub const PANORAMAS: &str = "faces/panoramas";
/// The folder of their masks: `a.jpg.png` for `a.jpg`.
pub const PANORAMA_MASKS: &str = "faces/panorama_masks";

/// The files of a folder by their name without the extension; none if there is no such folder.
fn by_stem(folder: &Path) -> BTreeMap<String, PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let stem = |path: PathBuf| Some((path.file_stem()?.to_str()?.to_owned(), path));
    entries.filter_map(|entry| stem(entry.path())).collect()
}

/// Replaces faces of the panoramas in the dataset's folder `root` by the panoramas.
pub(super) fn merge_faces(views: Vec<DeclaredView>, root: &Path) -> Vec<DeclaredView> {
    let panoramas = by_stem(&root.join(PANORAMAS));
    if panoramas.is_empty() {
        return views;
    }
    let masks = by_stem(&root.join(PANORAMA_MASKS));
    let mut joined: BTreeMap<&Path, DeclaredView> = BTreeMap::new();
    let mut others = Vec::new();
    for view in views {
        // A declared split may separate the faces of one panorama.
        let face = view.split.is_none().then(|| face_of(&view, &panoramas)).flatten();
        let Some((panorama, pose)) = face else {
            others.push(view);
            continue;
        };
        joined
            .entry(panorama)
            .and_modify(|joined| joined.points_seen.extend(&view.points_seen))
            .or_insert_with(|| {
                let name = panorama.file_name().unwrap_or_default().to_string_lossy();
                DeclaredView {
                    name: relative_name(root, panorama),
                    image: Some(panorama.to_owned()),
                    mask: masks.get(&*name).cloned(),
                    depth: None,
                    normals: None,
                    pose: Some(pose),
                    camera: DeclaredCamera::panorama(),
                    depth_bounds: None,
                    ..view
                }
            });
    }
    others.extend(joined.into_values().map(|mut view| {
        view.points_seen.sort_unstable();
        view.points_seen.dedup();
        view
    }));
    others
}

/// The panorama of which `view` is a face, and its pose.
fn face_of<'a>(view: &DeclaredView, panoramas: &'a BTreeMap<String, PathBuf>) -> Option<(&'a Path, DeclaredPose)> {
    let (stem, side) = Path::new(&view.name).file_stem()?.to_str()?.rsplit_once('_')?;
    let panorama = panoramas.get(stem)?;
    let (_, rotation) = cube_faces().into_iter().find(|(name, _)| *name == side)?;
    let pose = view.pose?;
    Some((
        panorama,
        DeclaredPose {
            rotation: pose.rotation * rotation.inverse(),
            ..pose
        },
    ))
}
