//! Bundler's `bundle.out`, version 0.3 (<https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html>, S6). Poses are
//! camera-from-world with x right, y up and z backward; pixels are counted from the image's centre.

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredPose, DeclaredView, Focal, lens_or_pinhole};
use super::files::{first_file, locate_image};
use super::tokens::Tokens;
use super::tracks::{TrackPoint, declared_points, parse_track_point};
use crate::error::read_and_parse;
use crate::text::text;
use crate::{FormatError, Malformed};
use glam::{DMat3, DVec3};
use irradia_scene::Lens;
use std::path::{Path, PathBuf};

/// Names of the list of photographs, beside the bundle or in the folder above.
const LIST_NAMES: [&str; 4] = ["list.txt", "bundle.out.list.txt", "bundle.list.txt", "image_list.txt"];
/// Where the photographs are, relative to the list.
const IMAGE_FOLDERS: [&str; 3] = ["", "images", "../images"];

/// A file of cameras and points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bundle {
    /// In the order of the list of photographs.
    pub cameras: Vec<BundleCamera>,
    /// Coloured points, each with the numbers of the cameras that see it.
    pub points: Vec<TrackPoint>,
}

/// A camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BundleCamera {
    /// Focal length, pixels; 0 for a photograph without a pose.
    pub focal: f64,
    /// Radial distortion.
    pub k: [f64; 2],
    /// Row by row, camera-from-world.
    pub rotation: [f64; 9],
    /// Camera-from-world.
    pub translation: [f64; 3],
}

pub(super) fn find(path: &Path) -> Option<PathBuf> {
    let is_bundle = |file: &Path| file.extension().is_some_and(|e| e == "out") && is_bundle_file(file);
    first_file(path, is_bundle).or_else(|| first_file(&path.join("bundle"), is_bundle))
}

fn is_bundle_file(file: &Path) -> bool {
    super::files::start_matches(file, |start| start.starts_with(b"# Bundle file"))
}

/// The name in a line of a list, which may have a focal length and other numbers after it.
fn name_in_list_line(line: &str) -> &str {
    let mut name = line.trim();
    while let Some((before, last)) = name.rsplit_once(char::is_whitespace)
        && last.parse::<f64>().is_ok()
    {
        name = before.trim_end();
    }
    name
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = find(path).ok_or_else(|| FormatError::malformed(path, "contains no bundle.out"))?;
    let bundle = read_and_parse(&file, parse_bundle)?;
    let parent = file.parent().unwrap_or(Path::new("."));
    let folders = [Some(parent), parent.parent()];
    let list = folders
        .into_iter()
        .flatten()
        .flat_map(|folder| LIST_NAMES.map(|name| folder.join(name)))
        .find(|list| list.is_file());
    let Some(list) = list else {
        let message = format!(
            "it names no photographs, and there is no {} beside it",
            LIST_NAMES.join(" or ")
        );
        return Err(FormatError::malformed(&file, message));
    };
    let names = read_and_parse(&list, |bytes| {
        let text = text(bytes);
        let names = text.lines().map(name_in_list_line).filter(|name| !name.is_empty());
        Ok(names.map(str::to_owned).collect::<Vec<String>>())
    })?;
    if names.len() != bundle.cameras.len() {
        let (cameras, names) = (bundle.cameras.len(), names.len());
        let message = format!("it names {names} photographs, but the bundle has {cameras} cameras");
        return Err(FormatError::malformed(&list, message));
    }
    let root = list.parent().unwrap_or(Path::new(".")).to_owned();
    let (points, mut points_seen) = declared_points(bundle.points);
    let mut views = Vec::with_capacity(names.len());
    // A focal length of 0 says that the photograph has no pose.
    let entries = names.iter().zip(&bundle.cameras).enumerate();
    for (i, (name, camera)) in entries.filter(|(_, (_, camera))| camera.focal != 0.0) {
        let name = name.replace('\\', "/");
        let image = locate_image(&root, &IMAGE_FOLDERS, &name);
        views.push(DeclaredView {
            points_seen: points_seen.remove(&i).unwrap_or_default(),
            ..DeclaredView::posed(&root, &name, image, pose(camera), declared_camera(camera))
        });
    }
    Ok(DeclaredDataset {
        kind: "Bundler",
        root,
        views,
        points: Some(points),
        downscale,
        warnings: Vec::new(),
    })
}

/// Parses a `bundle.out`.
///
/// # Errors
/// When it is of another version, truncated, or has a word where a number is expected.
pub fn parse_bundle(bytes: &[u8]) -> Result<Bundle, Malformed> {
    let text = text(bytes);
    let body = text
        .strip_prefix("# Bundle file v0.3")
        .ok_or_else(|| Malformed("not a bundle of version 0.3".into()))?;
    let mut tokens = Tokens::new(body);
    let (cameras, points): (usize, usize) = (tokens.next("a count of cameras")?, tokens.next("a count of points")?);
    let mut bundle = Bundle::default();
    for _ in 0..cameras {
        let [focal, k1, k2] = tokens.numbers("a focal length or distortion")?;
        bundle.cameras.push(BundleCamera {
            focal,
            k: [k1, k2],
            rotation: tokens.numbers("a rotation")?,
            translation: tokens.numbers("a translation")?,
        });
    }
    for _ in 0..points {
        bundle.points.push(parse_track_point(&mut tokens)?);
    }
    Ok(bundle)
}

fn pose(camera: &BundleCamera) -> Option<DeclaredPose> {
    // Rows: the camera's axes (right, up, backward) in the world.
    let [right, up, backward] = [0, 1, 2].map(|row| DVec3::from_slice(&camera.rotation[3 * row..]));
    let camera_from_world = DMat3::from_cols(right, up, backward).transpose();
    let position = -(camera_from_world.transpose() * DVec3::from(camera.translation));
    super::declared::pose_from_axes(right, -up, -backward, position)
}

fn declared_camera(camera: &BundleCamera) -> DeclaredCamera {
    DeclaredCamera {
        size: None,
        focal: Focal::Pixels([camera.focal; 2]),
        center: None,
        lens: lens_or_pinhole(Lens::brown([camera.k[0], camera.k[1], 0.0], [0.0; 2])),
    }
}
