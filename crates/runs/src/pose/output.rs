//! Writing of the reconstructed dataset and its report.

use super::import;
use super::stages::Work;
use super::{CameraReport, LeftOutPhoto, PoseReport, PoseSource, pose_source};
use crate::RunError;
use irradia_formats::{
    ColmapCamera, ColmapImage, ColmapModel, ColmapPoint, PhotoEntry, PhotoFolder, PosedImage, TrackedPoint,
    write_colmap,
};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::map::{Model, ModelPoint, PhotoInfo, Reconstruction};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Writes `images` and `sparse`, or replaces the model in the folder `known_model`, to which photographs were added. Without `known_model`,
/// files of other photographs that an earlier call imported are moved to `unused`.
pub(super) fn write(
    out: &Path,
    folder: &PhotoFolder,
    work: &Work,
    infos: &[PhotoInfo],
    found: &Reconstruction,
    known_model: Option<&Path>,
) -> Result<(), RunError> {
    let has_pose = |(photo, i): (usize, &usize)| {
        let mut models = found.models.iter();
        models
            .any(|model| model.poses[photo].is_some())
            .then_some(&folder.photos[*i])
    };
    let posed: Vec<&PhotoEntry> = work.photos().iter().enumerate().filter_map(has_pose).collect();
    posed.iter().try_for_each(|photo| import::import_photo(out, photo))?;
    let written = begin_models(out)?;
    for (number, model) in found.models.iter().enumerate() {
        let to = written.join(number.to_string());
        write_colmap(&to, &colmap_model(work, infos, model))?;
    }
    match known_model {
        Some(model) => replace_model(out, model, &written)?,
        None => end_models(out, &written)?,
    }
    import::record(out, &posed, known_model.is_some())
}

/// An empty folder for models, beside those of an earlier call, which may be more and remain until the new ones are complete.
pub(super) fn begin_models(out: &Path) -> Result<PathBuf, RunError> {
    let written = out.join("sparse.new");
    if written.exists() {
        fs::remove_dir_all(&written).map_err(RunError::io("clear", &written))?;
    }
    fs::create_dir_all(&written).map_err(RunError::io("create", &written))?;
    Ok(written)
}

/// Moves the complete models of [`begin_models`] into place.
pub(super) fn end_models(out: &Path, written: &Path) -> Result<(), RunError> {
    let sparse = out.join("sparse");
    fs::remove_dir_all(&sparse)
        .or_else(absent)
        .map_err(RunError::io("clear", &sparse))?;
    fs::rename(written, &sparse).map_err(RunError::io("rename", written))
}

/// Replaces the model in the folder `model` by the first one of `written`. The old model is moved to `unused` if another program made it;
/// other models and files stay.
fn replace_model(out: &Path, model: &Path, written: &Path) -> Result<(), RunError> {
    let tables = ["cameras", "images", "points3D", "rigs", "frames"];
    let names = tables
        .into_iter()
        .flat_map(|table| ["bin", "txt"].map(|extension| format!("{table}.{extension}")));
    let names: Vec<String> = names.collect();
    if pose_source(out).is_none() {
        let place = model.strip_prefix(out).unwrap_or(model);
        let files = names.iter().map(|name| place.join(name).to_string_lossy().into_owned());
        import::move_to_unused(out, files)?;
        // The folder was removed with the last of its files.
        fs::create_dir_all(model).map_err(RunError::io("create", model))?;
    }
    for name in names {
        let (old, new) = (model.join(&name), written.join("0").join(&name));
        if new.exists() {
            fs::rename(&new, &old).map_err(RunError::io("rename", &new))?;
        } else {
            fs::remove_file(&old)
                .or_else(absent)
                .map_err(RunError::io("remove", &old))?;
        }
    }
    fs::remove_dir_all(written).map_err(RunError::io("clear", written))
}

/// Ignores the error that a file to remove does not exist.
fn absent(error: io::Error) -> io::Result<()> {
    match error.kind() {
        io::ErrorKind::NotFound => Ok(()),
        _ => Err(error),
    }
}

fn colmap_model(work: &Work, infos: &[PhotoInfo], model: &Model) -> ColmapModel {
    let cameras = (0u32..)
        .zip(&model.cameras)
        .filter_map(|(group, camera)| Some(colmap_camera(group + 1, camera.as_ref()?)))
        .collect();
    let posed: Vec<usize> = (0..infos.len()).filter(|photo| model.poses[*photo].is_some()).collect();
    let mut image_of = vec![0u32; infos.len()];
    let mut images: Vec<PosedImage> = Vec::new();
    for &photo in &posed {
        image_of[photo] = images.len() as u32;
        let pose = model.poses[photo].expect("a posed photograph");
        let camera_from_world = pose.rotation.inverse();
        let translation = -(camera_from_world * pose.position);
        let [x, y, z, w] = camera_from_world.to_array();
        images.push(PosedImage {
            image: ColmapImage {
                rotation: [w, x, y, z],
                translation: translation.to_array(),
                camera_id: infos[photo].group as u32 + 1,
                name: infos[photo].name.clone(),
                points: Vec::new(),
            },
            keypoints: work.features()[photo]
                .keypoints
                .iter()
                .map(|k| ([k.x.into(), k.y.into()], None))
                .collect(),
        });
    }
    let mut points = Vec::with_capacity(model.points.len());
    for (id, point) in (1u64..).zip(&model.points) {
        let mut track = Vec::with_capacity(point.track.len());
        for &(photo, keypoint) in &point.track {
            let image = image_of[photo as usize];
            images[image as usize].keypoints[keypoint as usize].1 = Some(id);
            track.push([image, keypoint]);
        }
        points.push(TrackedPoint {
            point: ColmapPoint {
                id,
                position: point.position.to_array(),
                color: mean_color(point, work.colors()),
            },
            error: point.error,
            track,
        });
    }
    ColmapModel {
        cameras,
        images,
        points,
    }
}

/// The mean colour of the features of `point`, of `[photos][features]` colours.
pub(super) fn mean_color(point: &ModelPoint, colors: &[Vec<[u8; 3]>]) -> [u8; 3] {
    let mut sum = [0u32; 3];
    for &(photo, keypoint) in &point.track {
        let color = colors[photo as usize][keypoint as usize];
        sum = [0, 1, 2].map(|c| sum[c] + u32::from(color[c]));
    }
    let count = point.track.len().max(1) as u32;
    sum.map(|sum| ((sum + count / 2) / count) as u8)
}

/// The simplest of COLMAP's camera models that represents the camera.
fn colmap_camera(id: u32, camera: &DCamera) -> ColmapCamera {
    let [fx, fy, cx, cy, k1, k2, p1, p2] = camera.parameters;
    let (model, params) = if camera.fisheye {
        ("OPENCV_FISHEYE", camera.parameters.to_vec())
    } else if fx == fy && [k2, p1, p2] == [0.0; 3] {
        ("SIMPLE_RADIAL", vec![fx, cx, cy, k1])
    } else {
        ("OPENCV", camera.parameters.to_vec())
    };
    ColmapCamera {
        id,
        model: model.into(),
        width: camera.width.into(),
        height: camera.height.into(),
        params,
    }
}

/// The report without times, warnings, findings, scale, attempts and the number of matched pairs, which the caller adds.
pub(super) fn report(folder: &PhotoFolder, work: &Work, infos: &[PhotoInfo], found: &Reconstruction) -> PoseReport {
    let model = &found.models[0];
    let unused = folder.unused().chain(work.undecodable());
    let mut left_out: Vec<(String, String)> = unused.cloned().collect();
    left_out.extend(
        found
            .left_out
            .iter()
            .map(|left| (infos[left.photo].name.clone(), left.reason.to_string())),
    );
    for other in &found.models[1..] {
        let photos = (0..infos.len()).filter(|photo| other.poses[*photo].is_some());
        left_out.extend(photos.filter(|photo| model.poses[*photo].is_none()).map(|photo| {
            let reason = format!(
                "in another model of {} photographs, with too little in common with the largest",
                other.registered()
            );
            (infos[photo].name.clone(), reason)
        }));
    }
    left_out.sort();
    left_out.dedup_by(|a, b| a.0 == b.0);
    let cameras = (0..model.cameras.len())
        .filter_map(|group| {
            let camera = model.cameras[group]?;
            let mut photos = infos
                .iter()
                .zip(&model.poses)
                .filter(|(info, _)| info.group == group)
                .peekable();
            Some(CameraReport {
                focal_known: photos.peek().is_some_and(|(info, _)| info.focal_prior_px.is_some()),
                photos: photos.filter(|(_, pose)| pose.is_some()).count(),
                size: [camera.width, camera.height],
                focal_px: camera.focal(),
                principal_px: [camera.parameters[2], camera.parameters[3]],
                focal_held: model.focal_held[group],
            })
        })
        .collect();
    PoseReport {
        photos: folder.photos.len() + folder.left_out.len(),
        registered: model.registered(),
        left_out: left_out
            .into_iter()
            .map(|(name, reason)| LeftOutPhoto { name, reason })
            .collect(),
        models: found.models.iter().map(Model::registered).collect(),
        points: model.points.len(),
        mean_error_px: model.mean_error(),
        scale: None,
        cameras,
        attempts: Vec::new(),
        pairs: 0,
        verified_pairs: found.pairs.len(),
        stages: Vec::new(),
        seconds: 0.0,
        warnings: Vec::new(),
        findings: Vec::new(),
        poses_by: PoseSource::Irradia,
    }
}
