//! Captures by phones with ARKit: Polycam's and Record3D's folders. Poses are world-from-camera with OpenGL axes (x right, y up, z
//! backward).

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredPose, DeclaredView, Focal, pose_from_axes};
use super::files::{find_image, list_files};
use crate::error::read_and_parse;
use crate::json::parse_json;
use crate::{FormatError, Malformed};
use glam::{DMat3, DQuat, DVec3};
use irradia_scene::Lens;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Polycam's folders of cameras and of their photographs, the adjusted ones first.
const POLYCAM_FOLDERS: [(&str, &str); 2] = [
    ("keyframes/corrected_cameras", "keyframes/corrected_images"),
    ("keyframes/cameras", "keyframes/images"),
];

/// A camera of Polycam: `t_RC` is row R and column C of its pose.
#[derive(Clone, Debug, Deserialize)]
#[allow(missing_docs)] // The format's own names.
pub struct PolycamCamera {
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub width: f64,
    pub height: f64,
    t_00: f64,
    t_01: f64,
    t_02: f64,
    t_03: f64,
    t_10: f64,
    t_11: f64,
    t_12: f64,
    t_13: f64,
    t_20: f64,
    t_21: f64,
    t_22: f64,
    t_23: f64,
}

/// `metadata.json` of Record3D.
#[derive(Clone, Debug, Deserialize)]
pub struct Record3d {
    /// Width and height of the photographs, pixels.
    pub w: f64,
    /// See `w`.
    pub h: f64,
    /// Column by column.
    #[serde(rename = "K")]
    pub k: [f64; 9],
    /// `x, y, z, w` of the rotation, then the position.
    pub poses: Vec<[f64; 7]>,
    /// `fx, fy, cx, cy` of each frame.
    #[serde(default, rename = "perFrameIntrinsicCoeffs")]
    pub per_frame: Vec<[f64; 4]>,
}

pub(super) fn find_polycam(path: &Path) -> Option<(PathBuf, PathBuf)> {
    POLYCAM_FOLDERS
        .map(|(cameras, images)| (path.join(cameras), path.join(images)))
        .into_iter()
        .find(|(cameras, images)| cameras.is_dir() && images.is_dir())
}

pub(super) fn find_record3d(path: &Path) -> Option<PathBuf> {
    let file = path.join("metadata.json");
    (file.is_file() && path.join("rgb").is_dir()).then_some(file)
}

pub(super) fn read_polycam(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let Some((cameras, images)) = find_polycam(path) else {
        return Err(FormatError::malformed(path, "contains no Polycam keyframes"));
    };
    let mut views = Vec::new();
    for file in list_files(&cameras, |file| file.extension().is_some_and(|e| e == "json"))? {
        let camera = read_and_parse(&file, parse_polycam)?;
        let stem = file.file_stem().unwrap_or_default();
        let image = find_image(&images.join(stem));
        let name = stem.to_string_lossy();
        let depth = find_image(&path.join("keyframes/depth").join(stem));
        views.push(DeclaredView {
            depth,
            ..DeclaredView::posed(path, &name, image, camera.pose(), camera.intrinsics())
        });
    }
    Ok(declared_dataset("Polycam", path, views, downscale))
}

pub(super) fn read_record3d(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let Some(file) = find_record3d(path) else {
        return Err(FormatError::malformed(path, "contains no Record3D capture"));
    };
    let capture = read_and_parse(&file, parse_record3d)?;
    let view = |(i, numbers): (usize, &[f64; 7])| {
        let [x, y, z, w, px, py, pz] = *numbers;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        let length = rotation.length();
        let matrix = (length.is_finite() && length > 1e-6).then(|| DMat3::from_quat(rotation / length));
        let pose = matrix.and_then(|matrix| pose_from_opengl(matrix, DVec3::new(px, py, pz)));
        let k = &capture.k;
        let [fx, fy, cx, cy] = capture.per_frame.get(i).copied().unwrap_or([k[0], k[4], k[6], k[7]]);
        let camera = pinhole([capture.w, capture.h], [fx, fy], [cx, cy]);
        let name = format!("rgb/{i}");
        DeclaredView::posed(path, &name, find_image(&path.join(&name)), pose, camera)
    };
    let views = capture.poses.iter().enumerate().map(view).collect();
    Ok(declared_dataset("Record3D", path, views, downscale))
}

/// Parses a camera of Polycam.
///
/// # Errors
/// When it is not JSON with these keys.
pub fn parse_polycam(bytes: &[u8]) -> Result<PolycamCamera, Malformed> {
    parse_json(bytes, "Polycam camera")
}

/// Parses the `metadata.json` of Record3D.
///
/// # Errors
/// When it is not JSON with these keys.
pub fn parse_record3d(bytes: &[u8]) -> Result<Record3d, Malformed> {
    parse_json(bytes, "Record3D capture")
}

impl PolycamCamera {
    fn pose(&self) -> Option<DeclaredPose> {
        let right = DVec3::new(self.t_00, self.t_10, self.t_20);
        let up = DVec3::new(self.t_01, self.t_11, self.t_21);
        let backward = DVec3::new(self.t_02, self.t_12, self.t_22);
        pose_from_opengl(
            DMat3::from_cols(right, up, backward),
            DVec3::new(self.t_03, self.t_13, self.t_23),
        )
    }

    fn intrinsics(&self) -> DeclaredCamera {
        pinhole([self.width, self.height], [self.fx, self.fy], [self.cx, self.cy])
    }
}

fn pose_from_opengl(rotation: DMat3, position: DVec3) -> Option<DeclaredPose> {
    pose_from_axes(rotation.x_axis, -rotation.y_axis, -rotation.z_axis, position)
}

fn pinhole(size: [f64; 2], focal: [f64; 2], center: [f64; 2]) -> DeclaredCamera {
    DeclaredCamera {
        size: Some(size).filter(|[w, h]| *w >= 1.0 && *h >= 1.0),
        focal: Focal::Pixels(focal),
        center: Some(center),
        lens: Lens::Pinhole,
    }
}

fn declared_dataset(kind: &'static str, root: &Path, views: Vec<DeclaredView>, downscale: f32) -> DeclaredDataset {
    DeclaredDataset {
        kind,
        root: root.to_owned(),
        views,
        points: None,
        downscale,
        warnings: Vec::new(),
    }
}
