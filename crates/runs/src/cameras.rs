//! The cameras beside a scene: `cameras.json` of its run or folder, or a file of its own if the whole scene was moved.

use crate::RunError;
use crate::folder::to_json;
use glam::{DQuat, DVec3, Quat};
use irradia_edit::Transform;
use irradia_formats::write_atomic;
use irradia_scene::{Camera, Intrinsics, Pose, Similarity};
use irradia_train::Trainer;
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::{Path, PathBuf};

/// The cameras of a run, or of the folder of an edited scene.
pub(crate) const CAMERAS: &str = "cameras.json";

/// A camera in `cameras.json`: enough to orbit the scene later without its photographs.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct CameraRecord {
    name: String,
    width: u32,
    height: u32,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    /// Camera centre, in the dataset's coordinates.
    position: [f64; 3],
    /// World from camera (x right, y down, z forward): w, x, y, z.
    rotation: [f32; 4],
}

/// An `f64` with the digits of an `f32`, so that files do not show digits beyond its precision.
fn shortest(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}

/// The content of `cameras.json`: the training views' cameras, with refined poses.
pub(crate) fn cameras_json(trainer: &Trainer) -> Vec<u8> {
    let dataset = &trainer.dataset;
    let world = dataset.world_from_dataset;
    let records: Vec<CameraRecord> = dataset
        .train
        .iter()
        .map(|i| {
            let view = &dataset.views[*i];
            let Camera {
                intrinsics: k, pose, ..
            } = trainer.camera(*i);
            let q = pose.rotation;
            let position = if world.is_identity() {
                pose.position.to_array().map(shortest)
            } else {
                world.invert(pose.position.as_dvec3()).to_array()
            };
            CameraRecord {
                name: view.name.clone(),
                width: k.width,
                height: k.height,
                fx: k.fx,
                fy: k.fy,
                cx: k.cx,
                cy: k.cy,
                position,
                rotation: [q.w, q.x, q.y, q.z],
            }
        })
        .collect();
    to_json(&records)
}

/// The file of the cameras of the scene `scene` alone, such as `scene.edited.cameras.json`. It exists if the scene was moved away from the
/// photographs of its run, and the cameras with it.
fn own_cameras_file(scene: &Path) -> PathBuf {
    scene.with_extension("cameras.json")
}

/// Whether the file `scene` was moved away from the photographs of the run whose folder contains it.
pub fn is_moved(scene: &Path) -> bool {
    own_cameras_file(scene).is_file()
}

/// How the whole scene in the file `scene` was moved away from the photographs of the run whose folder contains it, in the dataset's
/// coordinates: by its own cameras and those of the run.
pub fn moved_from_run(scene: &Path) -> Transform {
    let of_run = camera_records(&scene.with_file_name(CAMERAS));
    match of_run.zip(camera_records(&own_cameras_file(scene))) {
        Some((before, after)) => moved_between(&before, &after),
        None => Transform::IDENTITY,
    }
}

/// The transform that moves the cameras `before` to where they are `after`. Cameras that are all in one place do not determine a scale.
fn moved_between(before: &[CameraRecord], after: &[CameraRecord]) -> Transform {
    let pairs: Vec<_> = before.iter().zip(after).filter(|(a, b)| a.name == b.name).collect();
    let Some(&(a, b)) = pairs.first() else {
        return Transform::IDENTITY;
    };
    let rotation = |record: &CameraRecord| {
        let [w, x, y, z] = record.rotation.map(f64::from);
        DQuat::from_xyzw(x, y, z, w).normalize()
    };
    let distance = |from: &CameraRecord, to: &CameraRecord| DVec3::from(from.position).distance(to.position.into());
    let spread: f64 = pairs.iter().map(|(other, _)| distance(a, other)).sum();
    let moved_spread: f64 = pairs.iter().map(|(_, other)| distance(b, other)).sum();
    let turn = Transform {
        scale: if spread > 0.0 { moved_spread / spread } else { 1.0 },
        rotation: (rotation(b) * rotation(a).inverse()).normalize(),
        translation: DVec3::ZERO,
    };
    Transform {
        translation: DVec3::from(b.position) - turn.apply(a.position.into()),
        ..turn
    }
}

/// The cameras in `file`, if it can be read.
fn camera_records(file: &Path) -> Option<Vec<CameraRecord>> {
    serde_json::from_slice(&fs::read(file).ok()?).ok()
}

/// The file of the cameras of `scene`.
fn cameras_file(scene: &Path) -> PathBuf {
    if is_moved(scene) {
        own_cameras_file(scene)
    } else {
        scene.with_file_name(CAMERAS)
    }
}

/// Writes the cameras of the scene `to`, in the folder of a run: those of `from`, after moving the whole scene in the dataset's coordinates.
/// A scene that was not moved has no file of its own.
///
/// # Errors
/// When the file cannot be written or removed.
pub fn write_own_cameras(from: &Path, to: &Path, moved: &Transform) -> Result<(), RunError> {
    let file = own_cameras_file(to);
    let is_in_run = to.with_file_name(CAMERAS).is_file();
    let has_own = is_in_run && (is_moved(from) || !moved.is_identity());
    match has_own.then(|| moved_cameras_json(from, moved)).flatten() {
        Some(text) => Ok(write_atomic(&file, |out| out.write_all(&text))?),
        None if is_in_run && file.is_file() => fs::remove_file(&file).map_err(RunError::io("remove", &file)),
        None => Ok(()),
    }
}

/// The cameras of the run that contains the file `scene`, if there is one, in the world of `world_from_dataset`.
pub(crate) fn cameras_beside(scene: &Path, world_from_dataset: &Similarity) -> Option<Vec<Camera>> {
    let camera = |r: &CameraRecord| {
        let [w, x, y, z] = r.rotation;
        let mut k = Intrinsics::from_fov_x(r.width, r.height, 1.0);
        (k.fx, k.fy, k.cx, k.cy) = (r.fx, r.fy, r.cx, r.cy);
        Camera::new(
            Pose {
                rotation: Quat::from_xyzw(x, y, z, w),
                position: world_from_dataset.apply(DVec3::from(r.position)).as_vec3(),
            },
            k,
        )
    };
    Some(camera_records(&cameras_file(scene))?.iter().map(camera).collect())
}

/// The names of the views of [`cameras_beside`].
pub(crate) fn camera_names_beside(scene: &Path) -> Option<Vec<String>> {
    let records = camera_records(&cameras_file(scene))?;
    Some(records.into_iter().map(|record| record.name).collect())
}

/// The content of `cameras.json` beside the file `scene`, if there is one, after moving the whole scene in the dataset's coordinates.
pub(crate) fn moved_cameras_json(scene: &Path, moved: &Transform) -> Option<Vec<u8>> {
    let text = fs::read(cameras_file(scene)).ok()?;
    if moved.is_identity() {
        return Some(text);
    }
    let mut records: Vec<CameraRecord> = serde_json::from_slice(&text).ok()?;
    for record in &mut records {
        record.position = moved.apply(DVec3::from(record.position)).to_array();
        let [w, x, y, z] = record.rotation;
        let turned = (moved.rotation.as_quat() * Quat::from_xyzw(x, y, z, w)).normalize();
        record.rotation = [turned.w, turned.x, turned.y, turned.z];
    }
    Some(to_json(&records))
}
