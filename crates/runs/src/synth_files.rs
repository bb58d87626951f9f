//! A ray-traced scene on disk, in the layout of the Blender datasets (Mildenhall et al. 2020), with additional ground truth: depth
//! and normals, and points like those of structure from motion.
//!
//! ```text
//! transforms_train.json  transforms_val.json  transforms_test.json
//! train/r_000.png ..     RGBA, 8 bits, opaque
//! depth/train/r_000.png  16 bits: distance along the optical axis (from the camera if the lens is wide) = value * depth_scale, world units
//! normal/train/r_000.png 8 bits: world normal = value / 255 * 2 - 1, towards the camera
//! points.ply             surface points with colours
//! ```

use crate::RunError;
use crate::folder::to_json;
use glam::{Mat4, Vec3};
use irradia_formats::{write_atomic, write_png, write_png_16, write_points_ply};
use irradia_scene::{Camera, Lens, PointCloud};
use irradia_synth::{Capture, SceneName, Split, SynthFrame, SynthOptions};
use serde_json::{Value, json};
use std::path::Path;
use std::{fmt, fs};

/// World units per step of the depth images: 16 bits reach 32.8 units, the demo's backdrop has its far side at 25.
const DEPTH_SCALE: f32 = 0.0005;
/// The same for outdoor scenes: 16 bits reach 655 units.
const DEPTH_SCALE_OUTDOOR: f32 = 0.01;
/// Readout time of photographs by moving cameras, seconds; only its product with the velocities matters.
const READOUT_SECONDS: f32 = 0.02;

/// Summary of the dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SynthSummary {
    /// Training views.
    pub train: u32,
    /// Validation views.
    pub val: u32,
    /// Held-out views.
    pub test: u32,
    /// Points in `points.ply`.
    pub points: u32,
}

impl fmt::Display for SynthSummary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self {
            train,
            val,
            test,
            points,
        } = self;
        write!(
            f,
            "{train} views to train on, {val} to validate, {test} held out, {points} points"
        )
    }
}

/// Traces a scene and writes it under `out`, which is created if missing. Existing files of the same names are
/// replaced; the `transforms_*.json` come last, so that a folder that contains them is complete.
///
/// # Errors
/// Invalid sizes or counts; a file that cannot be written, by name.
pub fn write_synth_dataset(out: impl AsRef<Path>, options: &SynthOptions) -> Result<SynthSummary, RunError> {
    let out = out.as_ref();
    let capture = Capture::new(options)?;
    let depth_scale = match options.scene {
        SceneName::Outdoor => DEPTH_SCALE_OUTDOOR,
        _ => DEPTH_SCALE,
    };
    let mut points = PointCloud::default();
    let mut frames: [Vec<Value>; 3] = Default::default();
    for split in Split::ALL {
        for folder in ["", "depth", "normal"] {
            let folder = out.join(folder).join(split.name());
            fs::create_dir_all(&folder).map_err(RunError::io("create", &folder))?;
        }
    }
    for shot in capture.shots() {
        let (frame, name) = (capture.trace(shot), shot.name());
        write_frame(out, &name, &frame, depth_scale)?;
        let found = capture.points(shot, &frame);
        points.positions.extend(found.positions);
        points.colors.extend(found.colors);
        let mut entry = json!({
            "file_path": format!("./{name}"),
            "depth_file_path": format!("./depth/{name}.png"),
            "normal_file_path": format!("./normal/{name}.png"),
            "transform_matrix": blender_matrix(&shot.camera),
        });
        if let Some(shutter) = &shot.camera.shutter {
            let velocity = |way: Vec3| (way * Vec3::new(1.0, -1.0, -1.0) / READOUT_SECONDS).to_array();
            entry["camera_linear_velocity"] = json!(velocity(shutter.translation));
            entry["camera_angular_velocity"] = json!(velocity(shutter.rotation));
        }
        frames[shot.split as usize].push(entry);
    }
    write_points_ply(&out.join("points.ply"), &points)?;
    let [train, val, test] = [0, 1, 2].map(|split| frames[split].len() as u32);
    for (split, frames) in Split::ALL.into_iter().zip(frames) {
        let mut shots = capture.shots().iter().filter(|shot| shot.split == split);
        let k = shots.next().expect("every split has views").camera.intrinsics;
        let mut transforms = json!({
            "w": k.width,
            "h": k.height,
            "depth_scale": depth_scale,
            "frames": frames,
        });
        if options.turn > 0.0 {
            transforms["rolling_shutter_time"] = json!(READOUT_SECONDS);
        }
        match k.lens {
            Lens::Fisheye { .. } => {
                transforms["camera_model"] = json!("OPENCV_FISHEYE");
                transforms["fl_x"] = json!(k.fx);
                transforms["fl_y"] = json!(k.fy);
            }
            Lens::Equirectangular => transforms["camera_model"] = json!("EQUIRECTANGULAR"),
            _ => transforms["camera_angle_x"] = json!(capture.fov_x()),
        }
        if split == Split::Train {
            transforms["ply_file_path"] = json!("points.ply");
        }
        let path = out.join(format!("transforms_{}.json", split.name()));
        write_atomic(&path, |file| file.write_all(&to_json(&transforms)))?;
    }
    Ok(SynthSummary {
        train,
        val,
        test,
        points: points.len() as u32,
    })
}

/// Writes the photograph, depth and normals of one view.
fn write_frame(out: &Path, name: &str, frame: &SynthFrame, depth_scale: f32) -> Result<(), RunError> {
    let (width, height) = (frame.color.width, frame.color.height);
    let step = |depth: &f32| (depth / depth_scale).round().clamp(0.0, 65535.0) as u16;
    let depth: Vec<u16> = frame.depth.data.iter().map(step).collect();
    let byte = |n: &f32| ((0.5 * n + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8;
    let normals: Vec<u8> = frame.normals.data.iter().map(byte).collect();
    let file = |folder: &str| out.join(folder).join(format!("{name}.png"));
    write_png(&file(""), width, height, 4, &frame.rgba())?;
    write_png(&file("normal"), width, height, 3, &normals)?;
    write_png_16(&file("depth"), width, height, &depth)?;
    Ok(())
}

/// `world_from_camera`, 4 rows, with Blender's camera axes: x right, y up, z back.
fn blender_matrix(camera: &Camera) -> [[f32; 4]; 4] {
    let flip = Mat4::from_scale(Vec3::new(1.0, -1.0, -1.0));
    let world_from_camera = Mat4::from_rotation_translation(camera.pose.rotation, camera.pose.position);
    (world_from_camera * flip).transpose().to_cols_array_2d()
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_synth::SynthLens;
    use std::path::PathBuf;

    const SMALL: SynthOptions = SynthOptions {
        scene: SceneName::Demo,
        views: 4,
        width: 24,
        height: 16,
        seed: 5,
        lens: SynthLens::Pinhole,
        turn: 0.0,
    };

    fn all_files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
        let mut files = Vec::new();
        for entry in fs::read_dir(folder).expect("folder") {
            let path = entry.expect("entry").path();
            if path.is_dir() {
                files.extend(all_files(&path));
            } else {
                files.push((path.clone(), fs::read(&path).expect("file")));
            }
        }
        files.sort();
        files
    }

    #[test]
    fn equal_seeds_write_equal_bytes_and_no_temporary_files() {
        let (a, b) = (tempfile::tempdir().expect("dir"), tempfile::tempdir().expect("dir"));
        let summary = write_synth_dataset(a.path(), &SMALL).expect("writes");
        assert_eq!(write_synth_dataset(b.path(), &SMALL).expect("writes"), summary);
        let (first, second) = (all_files(a.path()), all_files(b.path()));
        // Three images per view, three lists, the points.
        assert_eq!(first.len() as u32, 3 * (summary.train + summary.val + summary.test) + 4);
        for ((path, bytes), (other, others)) in first.iter().zip(&second) {
            assert_eq!(path.strip_prefix(a.path()).ok(), other.strip_prefix(b.path()).ok());
            assert!(bytes == others, "{}", path.display());
            assert!(!path.to_string_lossy().ends_with(".tmp"));
        }
    }

    #[test]
    fn the_files_contain_what_was_traced() {
        let dir = tempfile::tempdir().expect("dir");
        write_synth_dataset(dir.path(), &SMALL).expect("writes");
        let text = fs::read_to_string(dir.path().join("transforms_train.json")).expect("file");
        let value: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let frame = &value["frames"][1];
        let capture = Capture::new(&SMALL).expect("options");
        let camera = capture.shots()[1].camera;
        let entry = |row: usize, column: usize| frame["transform_matrix"][row][column].as_f64().expect("number") as f32;
        let column = |c: usize| Vec3::new(entry(0, c), entry(1, c), entry(2, c));
        assert!((column(3) - camera.pose.position).length() < 1e-5);
        assert!(
            (column(2) + camera.pose.rotation * Vec3::Z).length() < 1e-5,
            "z points back"
        );
        assert!((column(1) + camera.pose.rotation * Vec3::Y).length() < 1e-5, "y is up");

        let at = |key: &str| dir.path().join(frame[key].as_str().expect("path"));
        let truth = capture.trace(&capture.shots()[1]);
        let depth = image::open(at("depth_file_path")).expect("depth").into_luma16();
        for (stored, exact) in depth.as_raw().iter().zip(&truth.depth.data) {
            assert!((f32::from(*stored) * DEPTH_SCALE - exact).abs() <= 0.51 * DEPTH_SCALE);
        }
        let normals = image::open(at("normal_file_path")).expect("normals").into_rgb8();
        for (stored, exact) in normals.as_raw().iter().zip(&truth.normals.data) {
            assert!((f32::from(*stored) / 127.5 - 1.0 - exact).abs() <= 0.0041);
        }
        let mut picture = at("file_path").into_os_string();
        picture.push(".png");
        let picture = image::open(picture).expect("picture").into_rgba8();
        assert!(picture.dimensions() == (24, 16) && picture.pixels().all(|p| p.0[3] == 255));
    }

    #[test]
    fn our_own_reader_finds_the_same_cameras_splits_and_points() {
        let dir = tempfile::tempdir().expect("dir");
        let summary = write_synth_dataset(dir.path(), &SMALL).expect("writes");
        let dataset = irradia_formats::read_dataset(dir.path(), &Default::default()).expect("reads");
        assert_eq!(dataset.train.len() as u32, summary.train);
        assert_eq!(dataset.test.len() as u32, summary.test);
        assert_eq!(
            dataset.points.as_ref().map(PointCloud::len),
            Some(summary.points as usize)
        );
        let traced = irradia_synth::dataset(&SMALL).expect("options");
        assert_eq!(
            (dataset.views.len(), &dataset.train),
            (traced.views.len(), &traced.train)
        );
        assert_eq!(dataset.points, traced.points);
        for (read, made) in dataset.views.iter().zip(&traced.views) {
            let (camera, truth) = (&read.camera, &made.camera);
            assert!((camera.pose.position - truth.pose.position).length() < 1e-5);
            assert!(camera.pose.rotation.dot(truth.pose.rotation).abs() > 1.0 - 1e-5);
            assert!((camera.intrinsics.fx - truth.intrinsics.fx).abs() < 1e-3);
            let photos = [read, made].map(|view| view.photo.load().expect("loads"));
            assert!(photos[0] == photos[1], "{}", read.name);
        }
    }

    #[test]
    fn invalid_options_are_rejected_in_one_line() {
        for options in [SynthOptions { views: 0, ..SMALL }, SynthOptions { width: 0, ..SMALL }] {
            let error = write_synth_dataset("never-made", &options).expect_err("refused");
            assert!(error.to_string().contains("must be"), "{error}");
        }
        assert!(!Path::new("never-made").exists());
    }

    #[test]
    fn movements_are_read_as_they_were() {
        let dir = tempfile::tempdir().expect("dir");
        let options = SynthOptions { turn: 0.05, ..SMALL };
        write_synth_dataset(dir.path(), &options).expect("writes");
        let capture = Capture::new(&options).expect("options");
        let read = irradia_formats::read_dataset(dir.path(), &Default::default()).expect("a dataset");
        for (index, shot) in read.train.iter().zip(capture.shots()) {
            let [found, made] =
                [read.views[*index].camera, shot.camera].map(|camera| camera.shutter.expect("it moves"));
            assert_eq!(found.first, made.first);
            assert!(
                found.translation.distance(made.translation) < 1e-6,
                "{found:?} {made:?}"
            );
            assert!(found.rotation.distance(made.rotation) < 1e-6 && made.rotation.length() > 0.049);
        }
        assert!(read.test.iter().all(|index| read.views[*index].camera.is_pinhole()));
    }
}
