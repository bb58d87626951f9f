//! `reconstruction.json` of OpenSfM and OpenDroneMap (<https://opensfm.org/docs/dataset.html>, `geometry.html`). Poses are
//! camera-from-world, rotations are angle times axis. Lengths on the image are relative to its longer side, from its centre.

use super::declared::{
    DeclaredCamera, DeclaredDataset, DeclaredPoints, DeclaredPose, DeclaredView, Focal, lens_or_pinhole,
};
use super::files::{file_named, locate_image};
use crate::error::read_and_parse;
use crate::json::parse_json;
use crate::{FormatError, Malformed};
use glam::{DQuat, DVec3};
use irradia_scene::Lens;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where OpenSfM and OpenDroneMap write it.
const RECONSTRUCTION_PATHS: [&str; 3] = [
    "reconstruction.json",
    "opensfm/reconstruction.json",
    "undistorted/reconstruction.json",
];
/// Where the photographs are, relative to the file.
const IMAGE_FOLDERS: [&str; 3] = ["images", "", "../images"];

/// A connected part of a scene.
#[derive(Clone, Debug, Deserialize)]
pub struct Reconstruction {
    /// By name.
    pub cameras: BTreeMap<String, Camera>,
    /// By file name.
    pub shots: BTreeMap<String, Shot>,
    /// By number.
    #[serde(default)]
    pub points: BTreeMap<String, Point>,
}

/// A camera's intrinsics.
#[derive(Clone, Debug, Deserialize)]
#[allow(missing_docs)] // The format's own names.
pub struct Camera {
    /// Absent in files of old versions.
    #[serde(default = "perspective")]
    pub projection_type: String,
    pub width: f64,
    pub height: f64,
    pub focal: Option<f64>,
    pub focal_x: Option<f64>,
    pub focal_y: Option<f64>,
    #[serde(default)]
    pub c_x: f64,
    #[serde(default)]
    pub c_y: f64,
    #[serde(default)]
    pub k1: f64,
    #[serde(default)]
    pub k2: f64,
    #[serde(default)]
    pub k3: f64,
    #[serde(default)]
    pub k4: f64,
    #[serde(default)]
    pub p1: f64,
    #[serde(default)]
    pub p2: f64,
}

fn perspective() -> String {
    "perspective".to_owned()
}

/// A posed photograph.
#[derive(Clone, Debug, Deserialize)]
pub struct Shot {
    /// Angle times axis, camera-from-world.
    pub rotation: [f64; 3],
    /// Camera-from-world.
    pub translation: [f64; 3],
    /// Name of its [`Camera`].
    pub camera: String,
}

/// A point.
#[derive(Clone, Debug, Deserialize)]
pub struct Point {
    /// World.
    pub coordinates: [f64; 3],
    /// sRGB, 0 to 255.
    pub color: [f64; 3],
}

pub(super) fn find(path: &Path) -> Option<PathBuf> {
    RECONSTRUCTION_PATHS.into_iter().find_map(|name| file_named(path, name))
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = find(path).ok_or_else(|| FormatError::malformed(path, "contains no reconstruction.json"))?;
    let reconstructions = read_and_parse(&file, parse_opensfm)?;
    let root = file.parent().unwrap_or(Path::new(".")).to_owned();
    let count = reconstructions.len();
    // The first of the largest.
    let largest = reconstructions
        .into_iter()
        .rev()
        .max_by_key(|reconstruction| reconstruction.shots.len());
    let Some(reconstruction) = largest else {
        return Err(FormatError::malformed(&file, "it has no reconstruction"));
    };
    let mut warnings = Vec::new();
    if count > 1 {
        let n = reconstruction.shots.len();
        warnings.push(format!(
            "the largest of {count} reconstructions is used, with {n} photographs"
        ));
    }
    let mut views = Vec::with_capacity(reconstruction.shots.len());
    for (name, shot) in &reconstruction.shots {
        let camera = reconstruction.cameras.get(&shot.camera).ok_or_else(|| {
            FormatError::malformed(
                &file,
                format!("{name} uses camera `{}`, which is not in the file", shot.camera),
            )
        })?;
        let camera = declared_camera(camera).map_err(|source| FormatError::Malformed {
            path: file.clone(),
            source,
        })?;
        let image = locate_image(&root, &IMAGE_FOLDERS, name);
        views.push(DeclaredView::posed(&root, name, image, pose(shot), camera));
    }
    let mut points = DeclaredPoints::default();
    for point in reconstruction.points.values() {
        points.push(point.coordinates.into(), point.color.map(|v| v as u8));
    }
    Ok(DeclaredDataset {
        kind: "OpenSfM",
        root,
        views,
        points: Some(points),
        downscale,
        warnings,
    })
}

/// Parses a `reconstruction.json`.
///
/// # Errors
/// When it is not JSON of that structure; with line and column.
pub fn parse_opensfm(bytes: &[u8]) -> Result<Vec<Reconstruction>, Malformed> {
    parse_json(bytes, "reconstruction")
}

fn pose(shot: &Shot) -> Option<DeclaredPose> {
    let world_from_camera = DQuat::from_scaled_axis(shot.rotation.into()).inverse();
    DeclaredPose {
        rotation: world_from_camera,
        position: -(world_from_camera * DVec3::from(shot.translation)),
    }
    .checked()
}

fn declared_camera(camera: &Camera) -> Result<DeclaredCamera, Malformed> {
    if matches!(camera.projection_type.as_str(), "spherical" | "equirectangular") {
        return Ok(DeclaredCamera::panorama());
    }
    let Camera {
        k1, k2, k3, k4, p1, p2, ..
    } = *camera;
    let lens = match camera.projection_type.as_str() {
        "perspective" | "simple_radial" | "radial" => Lens::brown([k1, k2, 0.0], [0.0; 2]),
        "brown" => Lens::brown([k1, k2, k3], [p1, p2]),
        "fisheye" | "fisheye_opencv" => Lens::fisheye([k1, k2, k3, k4]),
        other => {
            return Err(Malformed(format!(
                "the projection type `{other}` is not supported; use perspective, brown, fisheye or spherical, or undistort the photographs"
            )));
        }
    };
    let longer_side = camera.width.max(camera.height);
    let focal_x = camera.focal_x.or(camera.focal).unwrap_or(f64::NAN);
    // OpenSfM writes no focal_y where it is focal_x.
    let focal_y = camera.focal_y.unwrap_or(focal_x);
    Ok(DeclaredCamera {
        size: Some([camera.width, camera.height]),
        focal: Focal::Pixels([focal_x * longer_side, focal_y * longer_side]),
        center: Some([
            0.5 * camera.width + camera.c_x * longer_side,
            0.5 * camera.height + camera.c_y * longer_side,
        ]),
        lens: lens_or_pinhole(lens),
    })
}
