//! The demo scene on disk, in the layout of the Blender datasets (Mildenhall et al. 2020), with what only a made scene
//! can have: true depth and normals, and points as structure from motion would leave them.
//!
//! ```text
//! transforms_train.json  transforms_val.json  transforms_test.json
//! train/r_000.png ..     RGBA, 8 bits, opaque
//! depth/train/r_000.png  16 bits: distance along the optical axis = value * depth_scale, world units
//! normal/train/r_000.png 8 bits: world normal = value / 255 * 2 - 1, towards the camera
//! points.ply             surface points with colours
//! ```

use super::cameras::{self, FOV_X, Part};
use super::scene::scene;
use super::trace::SynthFrame;
use crate::Usage;
use anyhow::{Context, Result, ensure};
use glam::{Mat4, Vec2, Vec3};
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use irradia_formats::{write_atomic, write_png};
use irradia_scene::{Camera, PointCloud, Rng};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::{fmt, fs};

/// World units of one step of the depth images: 16 bits reach 32.8 units, the backdrop's far side is at 25.
pub const DEPTH_SCALE: f32 = 0.0005;
/// Most samples a pixel.
const SAMPLES: u32 = 16;
/// Points written, over all training views.
const POINTS: u32 = 6000;
/// Standard deviation of a point's error, as a part of its distance: what structure from motion reaches on good photos.
const POINT_ERROR: f32 = 0.001;

/// What to make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SynthOptions {
    /// Training views; one more in eight is held out, one more in twenty is for validation.
    pub views: u32,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Seed of cameras, samples and points: equal seeds write equal bytes.
    pub seed: u64,
}

impl Default for SynthOptions {
    fn default() -> Self {
        Self {
            views: 40,
            width: 256,
            height: 256,
            seed: 0,
        }
    }
}

/// What was made.
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

/// Traces the demo scene and writes it under `out`, which is made where it is missing. Existing files of the same names
/// are replaced; the `transforms_*.json` come last, so that a folder that has them is complete.
///
/// # Errors
/// Sizes or counts that make no dataset; a file that cannot be written, by name.
pub fn write_dataset(out: &Path, options: &SynthOptions) -> Result<SynthSummary> {
    let SynthOptions {
        views,
        width,
        height,
        seed,
    } = *options;
    ensure!(
        (3..=1000).contains(&views),
        Usage(format!("{views} views: give between 3 and 1000"))
    );
    let size = 8..=4096;
    ensure!(
        size.contains(&width) && size.contains(&height),
        Usage(format!("size {width}x{height}: give between 8 and 4096 pixels a side"))
    );
    let mut scene = scene();
    let parts = [
        (Part::Train, views),
        (Part::Val, (views / 20).max(1)),
        (Part::Test, (views / 8).max(2)),
    ];
    let mut points = PointCloud::default();
    let mut transforms: Vec<(PathBuf, serde_json::Value)> = Vec::new();
    let mut number_of_all = 0;
    for (part, count) in parts {
        for folder in ["", "depth", "normal"] {
            let folder = out.join(folder).join(part.name());
            fs::create_dir_all(&folder).with_context(|| format!("{}: cannot make this folder", folder.display()))?;
        }
        let mut frames = Vec::new();
        for (number, camera) in cameras::cameras(part, count, width, height, seed).iter().enumerate() {
            // Samples must differ from view to view, or their noise would look like texture on the lens.
            scene.seed = seed.wrapping_mul(1_000_003).wrapping_add(number_of_all);
            number_of_all += 1;
            let traced = scene.trace(camera, SAMPLES);
            let name = format!("{}/r_{number:03}", part.name());
            write_frame(out, &name, &traced)?;
            if part == Part::Train {
                let share = (POINTS / count).max(1);
                let mut rng = Rng::new(seed, 1000 + number as u64);
                (0..share).for_each(|_| add_point(&mut points, camera, &traced, &mut rng));
            }
            frames.push(json!({
                "file_path": format!("./{name}"),
                "depth_file_path": format!("./depth/{name}.png"),
                "normal_file_path": format!("./normal/{name}.png"),
                "transform_matrix": blender_matrix(camera),
            }));
        }
        let mut value = json!({
            "camera_angle_x": FOV_X,
            "w": width,
            "h": height,
            "depth_scale": DEPTH_SCALE,
            "frames": frames,
        });
        if part == Part::Train {
            value["ply_file_path"] = json!("points.ply");
        }
        transforms.push((out.join(format!("transforms_{}.json", part.name())), value));
    }
    write_atomic(&out.join("points.ply"), |file| file.write_all(&ply(&points)))?;
    for (path, value) in &transforms {
        let text = serde_json::to_vec_pretty(value)?;
        write_atomic(path, |file| file.write_all(&text))?;
    }
    let [train, val, test] = parts.map(|(_, count)| count);
    Ok(SynthSummary {
        train,
        val,
        test,
        points: points.len() as u32,
    })
}

/// Picture, depth and normals of one view.
fn write_frame(out: &Path, name: &str, frame: &SynthFrame) -> Result<()> {
    let (width, height) = (frame.color.width, frame.color.height);
    let rgba: Vec<u8> = frame
        .color
        .to_u8()
        .chunks_exact(3)
        .flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255])
        .collect();
    // The codec takes 16-bit samples in the machine's byte order.
    let depth: Vec<u8> = frame
        .depth
        .data
        .iter()
        .flat_map(|depth| ((depth / DEPTH_SCALE).round().clamp(0.0, 65535.0) as u16).to_ne_bytes())
        .collect();
    let normals: Vec<u8> = frame
        .normals
        .data
        .iter()
        .map(|n| ((0.5 * n + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8)
        .collect();
    write_png(&out.join(format!("{name}.png")), width, height, 4, &rgba)?;
    write_png(&out.join(format!("normal/{name}.png")), width, height, 3, &normals)?;
    let mut encoded = Vec::new();
    PngEncoder::new(&mut encoded).write_image(&depth, width, height, ExtendedColorType::L16)?;
    write_atomic(&out.join(format!("depth/{name}.png")), |file| file.write_all(&encoded))?;
    Ok(())
}

/// The surface under a random pixel, a little off.
fn add_point(points: &mut PointCloud, camera: &Camera, frame: &SynthFrame, rng: &mut Rng) {
    let (x, y) = (rng.below(frame.color.width), rng.below(frame.color.height));
    let direction = camera.ray_direction(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
    let depth = frame.depth.pixel(x, y)[0];
    let distance = depth / direction.dot(camera.pose.rotation * Vec3::Z);
    let error = Vec3::new(rng.normal(), rng.normal(), rng.normal()) * (POINT_ERROR * distance);
    points
        .positions
        .push(camera.pose.position + direction * distance + error);
    let color = frame.color.pixel(x, y);
    points.colors.push([0, 1, 2].map(|c| (color[c] * 255.0).round() as u8));
}

/// `world_from_camera`, 4 rows, with Blender's camera axes: x right, y up, z back.
fn blender_matrix(camera: &Camera) -> [[f32; 4]; 4] {
    let flip = Mat4::from_scale(Vec3::new(1.0, -1.0, -1.0));
    let world_from_camera = Mat4::from_rotation_translation(camera.pose.rotation, camera.pose.position);
    (world_from_camera * flip).transpose().to_cols_array_2d()
}

/// A binary PLY of coloured points.
fn ply(points: &PointCloud) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for (position, color) in points.positions.iter().zip(&points.colors) {
        position.to_array().iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(color);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: SynthOptions = SynthOptions {
        views: 4,
        width: 24,
        height: 16,
        seed: 5,
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
    fn equal_seeds_write_equal_bytes_and_nothing_temporary_stays() {
        let (a, b) = (tempfile::tempdir().expect("dir"), tempfile::tempdir().expect("dir"));
        let summary = write_dataset(a.path(), &SMALL).expect("writes");
        assert_eq!(write_dataset(b.path(), &SMALL).expect("writes"), summary);
        let (first, second) = (all_files(a.path()), all_files(b.path()));
        // Three images a view, three lists, the points.
        assert_eq!(first.len() as u32, 3 * (summary.train + summary.val + summary.test) + 4);
        for ((path, bytes), (other, others)) in first.iter().zip(&second) {
            assert_eq!(path.strip_prefix(a.path()).ok(), other.strip_prefix(b.path()).ok());
            assert!(bytes == others, "{}", path.display());
            assert!(!path.to_string_lossy().ends_with(".tmp"));
        }
    }

    #[test]
    fn the_files_say_what_was_traced() {
        let dir = tempfile::tempdir().expect("dir");
        write_dataset(dir.path(), &SMALL).expect("writes");
        let text = fs::read_to_string(dir.path().join("transforms_train.json")).expect("file");
        let value: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let frame = &value["frames"][1];
        let camera = cameras::cameras(Part::Train, 4, 24, 16, 5)[1];
        let entry = |row: usize, column: usize| frame["transform_matrix"][row][column].as_f64().expect("number") as f32;
        let column = |c: usize| Vec3::new(entry(0, c), entry(1, c), entry(2, c));
        assert!((column(3) - camera.pose.position).length() < 1e-5);
        assert!(
            (column(2) + camera.pose.rotation * Vec3::Z).length() < 1e-5,
            "z looks back"
        );
        assert!((column(1) + camera.pose.rotation * Vec3::Y).length() < 1e-5, "y is up");

        let at = |key: &str| dir.path().join(frame[key].as_str().expect("path"));
        let truth = scene().trace(&camera, 1);
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
    fn our_own_reader_finds_the_same_cameras_parts_and_points() {
        let dir = tempfile::tempdir().expect("dir");
        let summary = write_dataset(dir.path(), &SMALL).expect("writes");
        let dataset = irradia_formats::read_dataset(dir.path(), &Default::default()).expect("reads");
        assert_eq!(dataset.train.len() as u32, summary.train);
        assert_eq!(dataset.test.len() as u32, summary.test);
        assert_eq!(
            dataset.points.as_ref().map(PointCloud::len),
            Some(summary.points as usize)
        );
        let made = cameras::cameras(Part::Train, 4, 24, 16, 5);
        for (index, camera) in dataset.train.iter().zip(&made) {
            let read = &dataset.views[*index].camera;
            assert!((read.pose.position - camera.pose.position).length() < 1e-5);
            assert!(read.pose.rotation.dot(camera.pose.rotation).abs() > 1.0 - 1e-5);
            assert!((read.intrinsics.fx - camera.intrinsics.fx).abs() < 1e-3);
        }
    }

    #[test]
    fn points_lie_on_what_a_ray_to_them_meets() {
        let scene = scene();
        let camera = cameras::cameras(Part::Train, 1, 32, 32, 0)[0];
        let frame = scene.trace(&camera, 4);
        let (mut points, mut rng) = (PointCloud::default(), Rng::new(0, 0));
        (0..50).for_each(|_| add_point(&mut points, &camera, &frame, &mut rng));
        for point in &points.positions {
            let (pixel, depth) = camera.project(*point).expect("in front");
            let seen = frame.depth.pixel((pixel.x as u32).min(31), (pixel.y as u32).min(31))[0];
            // Five standard deviations, and room for those that slid over an edge to the neighbour pixel.
            assert!((seen - depth).abs() < 5.0 * POINT_ERROR * depth + 0.5, "{seen} {depth}");
        }
    }

    #[test]
    fn senseless_options_are_refused_in_one_line() {
        for options in [SynthOptions { views: 0, ..SMALL }, SynthOptions { width: 0, ..SMALL }] {
            let error = write_dataset(Path::new("never-made"), &options).expect_err("refused");
            assert!(error.to_string().contains("give between"), "{error}");
        }
        assert!(!Path::new("never-made").exists());
    }
}
