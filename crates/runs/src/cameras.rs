//! The cameras beside a scene: `cameras.json` of its run or folder, or a file of its own if the whole scene was moved.

use crate::folder::to_json;
use crate::{RunError, RunFolder};
use glam::{DQuat, DVec3, Quat};
use irradia_edit::Transform;
use irradia_formats::write_atomic;
use irradia_scene::{Camera, Dataset, Intrinsics, Pose, Similarity, View, with_f32_digits};
use irradia_sfm::geometry::pose::DPose;
use irradia_train::Trainer;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The cameras of a run, or of the folder of an edited scene.
pub(crate) const CAMERAS: &str = "cameras.json";

/// The [`difference`] from which on poses are of another world: that of refined poses is far smaller.
const OTHER_POSES: f64 = 0.25;
/// The [`difference`] up to which poses are equal but for rounding.
const SAME_POSES: f64 = 1e-4;

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

impl CameraRecord {
    fn pose(&self) -> DPose {
        let [w, x, y, z] = self.rotation.map(f64::from);
        DPose {
            position: self.position.into(),
            rotation: DQuat::from_xyzw(x, y, z, w).normalize(),
        }
    }
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
                pose.position.to_array().map(with_f32_digits)
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

/// The file of the cameras of the scene `scene` alone, such as `scene.edited.ply.cameras.json`. It exists if the scene was moved away from
/// the photographs of its run, and the cameras with it.
fn own_cameras_file(scene: &Path) -> PathBuf {
    let mut name = scene.file_name().unwrap_or_default().to_owned();
    name.push(".cameras.json");
    scene.with_file_name(name)
}

/// [`own_cameras_file`], or the file that an earlier version wrote, without the extension of the scene.
fn existing_own_cameras_file(scene: &Path) -> Option<PathBuf> {
    let files = [own_cameras_file(scene), scene.with_extension("cameras.json")];
    files.into_iter().find(|file| file.is_file())
}

/// Whether the file `scene` was moved away from the photographs of the run whose folder contains it.
pub fn is_moved(scene: &Path) -> bool {
    existing_own_cameras_file(scene).is_some()
}

/// How the whole scene in the file `scene` was moved away from the photographs of the run whose folder contains it, in the dataset's
/// coordinates: by its own cameras and those of the run.
pub fn moved_from_run(scene: &Path) -> Transform {
    let of_run = camera_records(&scene.with_file_name(CAMERAS)).unwrap_or_default();
    let own = existing_own_cameras_file(scene).and_then(|file| camera_records(&file));
    let same = of_run
        .iter()
        .zip(own.iter().flatten())
        .filter(|(a, b)| a.name == b.name);
    moved_between(&same.map(|(a, b)| [a.pose(), b.pose()]).collect::<Vec<_>>())
}

/// How the whole scene in the file `scene` was moved away from the photographs of `dataset`, in the dataset's coordinates: by the poses of
/// the cameras that both have, by their names. The identity if there are none; `None` if no move explains their differences, since the scene
/// was trained with other poses.
pub fn moved_from_dataset(scene: &Path, dataset: &Dataset) -> Option<Transform> {
    let views: HashMap<&str, &View> = dataset.views.iter().map(|view| (view.name.as_str(), view)).collect();
    let records = camera_records(&cameras_file(scene)).unwrap_or_default();
    let pair = |record: &CameraRecord| {
        let pose = views.get(record.name.as_str())?.camera.pose;
        let given = DPose {
            position: dataset.world_from_dataset.invert(pose.position.as_dvec3()),
            rotation: pose.rotation.as_dquat().normalize(),
        };
        Some([given, record.pose()])
    };
    let pairs: Vec<[DPose; 2]> = records.iter().filter_map(pair).collect();
    let unmoved = difference(&pairs, &Transform::IDENTITY);
    // The refined poses of a run may have drifted together, but its own scene is where its photographs are.
    if unmoved > SAME_POSES && (is_moved(scene) || RunFolder::containing(scene).is_none()) {
        let moved = moved_between(&pairs);
        let rest = difference(&pairs, &moved);
        // Refinement leaves a rest, too, but most of its differences are not a common move.
        if rest < OTHER_POSES && 2.0 * rest < unmoved {
            return Some(moved);
        }
    }
    (unmoved < OTHER_POSES).then_some(Transform::IDENTITY)
}

/// The median difference between the second pose of each pair and the first one moved by `by`: the distance in units of the cameras' mean
/// distance from their centre, plus the angle in radians. 0 without pairs.
fn difference(pairs: &[[DPose; 2]], by: &Transform) -> f64 {
    let (_, spread) = center_and_spread(pairs, 1);
    let unit = if spread > 0.0 { spread } else { 1.0 };
    let each = pairs.iter().map(|[from, to]| {
        let angle = (by.rotation * from.rotation).angle_between(to.rotation);
        by.apply(from.position).distance(to.position) / unit + angle
    });
    let mut each: Vec<f64> = each.collect();
    each.sort_by(f64::total_cmp);
    each.get(each.len() / 2).copied().unwrap_or(0.0)
}

/// The transform that moves the first poses of `pairs` to the second ones. Cameras that are all in one place do not determine a scale.
fn moved_between(pairs: &[[DPose; 2]]) -> Transform {
    let Some([first, moved_first]) = pairs.first() else {
        return Transform::IDENTITY;
    };
    let [(center, spread), (moved_center, moved_spread)] = [0, 1].map(|i| center_and_spread(pairs, i));
    let some_rotation = moved_first.rotation * first.rotation.inverse();
    let rotations = pairs.iter().map(|[from, to]| {
        let rotation = to.rotation * from.rotation.inverse();
        // Of the two quaternions of a rotation those that can be added.
        if rotation.dot(some_rotation) < 0.0 {
            -rotation
        } else {
            rotation
        }
    });
    let turn = Transform {
        scale: if spread > 0.0 { moved_spread / spread } else { 1.0 },
        rotation: rotations
            .fold(DQuat::from_array([0.0; 4]), |sum, rotation| sum + rotation)
            .normalize(),
        translation: DVec3::ZERO,
    };
    Transform {
        translation: moved_center - turn.apply(center),
        ..turn
    }
}

/// The mean of the positions at place `at` of each pair, and their mean distance from it.
fn center_and_spread(pairs: &[[DPose; 2]], at: usize) -> (DVec3, f64) {
    let (count, positions) = (pairs.len() as f64, pairs.iter().map(|pair| pair[at].position));
    let center = positions.clone().sum::<DVec3>() / count;
    (
        center,
        positions.map(|position| position.distance(center)).sum::<f64>() / count,
    )
}

/// `dataset` after moving all of it in its own coordinates. As in edits, only rotations change coordinates of its world.
pub(crate) fn moved(mut dataset: Dataset, by: &Transform) -> Dataset {
    let turn = by.rotation.as_quat();
    for view in &mut dataset.views {
        let pose = &mut view.camera.pose;
        pose.position = turn * pose.position;
        pose.rotation = (turn * pose.rotation).normalize();
    }
    let points = dataset.points.iter_mut().flat_map(|points| &mut points.positions);
    points.for_each(|point| *point = turn * *point);
    dataset.world_from_dataset = by.moved_world(&dataset.world_from_dataset);
    dataset
}

/// The cameras in `file`, if it can be read.
fn camera_records(file: &Path) -> Option<Vec<CameraRecord>> {
    serde_json::from_slice(&fs::read(file).ok()?).ok()
}

/// The file of the cameras of `scene`.
fn cameras_file(scene: &Path) -> PathBuf {
    existing_own_cameras_file(scene).unwrap_or_else(|| scene.with_file_name(CAMERAS))
}

/// Writes the cameras of the scene `to`, in the folder of a run: those of `from`, after moving the whole scene in the dataset's coordinates.
/// A scene that was not moved has no file of its own.
///
/// # Errors
/// When the file cannot be written or removed.
pub fn write_own_cameras(from: &Path, to: &Path, moved: &Transform) -> Result<(), RunError> {
    if !to.with_file_name(CAMERAS).is_file() {
        return Ok(());
    }
    let has_own = is_moved(from) || !moved.is_identity();
    let own = has_own.then(|| moved_cameras_json(from, moved)).flatten();
    match (own, existing_own_cameras_file(to)) {
        (Some(text), _) => Ok(write_atomic(&own_cameras_file(to), |out| out.write_all(&text))?),
        (None, Some(file)) => fs::remove_file(&file).map_err(RunError::io("remove", &file)),
        (None, None) => Ok(()),
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

/// The names of the views whose cameras [`Scene::read`](crate::Scene::read) finds beside the file `scene`, in the same order.
pub fn camera_names(scene: &Path) -> Option<Vec<String>> {
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
