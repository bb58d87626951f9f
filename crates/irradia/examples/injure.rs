//! Writes a copy of a dataset with artificial faults, to measure how well they are corrected:
//!
//! ```text
//! cargo run --release --example injure -- DATA OUT --gains 0.6,1.6 --balance 0.15      # exposure and white balance per photograph
//! cargo run --release --example injure -- DATA OUT --local-gains 0.7,1.4               # a gradient and a vignette per photograph
//! cargo run --release --example injure -- DATA OUT --vignette 0.7                      # the same in all photographs
//! cargo run --release --example injure -- DATA OUT --pose-noise 0.5,0.005              # degrees, fraction of the scene's extent
//! cargo run --release --example injure -- DATA OUT --people 0.33                       # share of the training photographs
//! ```
//!
//! The copy is a nerfstudio folder with the split of the original, undistorted PNG images and its points. Faults affect all
//! photographs, including held-out ones, except people, who walk through training views only. Tracks of points are not copied.

use anyhow::{Context, Result, bail};
use clap::Parser;
use glam::{Mat4, Quat, Vec3};
use irradia_formats::{DatasetOptions, read_dataset, write_atomic, write_png, write_points_ply};
use irradia_scene::{Camera, Dataset, Photo, Rng};
use irradia_splat::init::camera_extent;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::path::PathBuf;

#[derive(Parser)]
struct Args {
    /// The dataset
    data: PathBuf,
    /// Folder for the copy
    out: PathBuf,
    /// Divide the images' sides by this factor
    #[arg(long, default_value_t = 1.0)]
    downscale: f32,
    /// A factor per photograph on its sRGB colours, log-uniform between these
    #[arg(long, value_name = "FROM,TO", value_parser = pair)]
    gains: Option<[f32; 2]>,
    /// A factor per channel and photograph, uniform between 1 - this and 1 + this
    #[arg(long, default_value_t = 0.0)]
    balance: f32,
    /// Factors over each photograph on its sRGB colours: a gradient in a random direction whose values at the corners are within this
    /// range, darkened by a vignette of random strength
    #[arg(long, value_name = "FROM,TO", value_parser = pair)]
    local_gains: Option<[f32; 2]>,
    /// Factor at the corners of all photographs on their sRGB colours; its logarithm grows with the squared distance from the centre
    #[arg(long, default_value_t = 1.0)]
    vignette: f32,
    /// Standard deviations of the poses' rotation in degrees and of their position in extents of the scene
    #[arg(long, value_name = "DEG,FRACTION", value_parser = pair)]
    pose_noise: Option<[f32; 2]>,
    /// Share of the training photographs with a textured box the size of a person, at a random position in each
    #[arg(long, default_value_t = 0.0)]
    people: f32,
    /// Random seed
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// `0.6,1.6`
fn pair(text: &str) -> Result<[f32; 2], String> {
    let numbers = text
        .split_once(',')
        .and_then(|(a, b)| Some([a.trim().parse().ok()?, b.trim().parse().ok()?]));
    numbers.ok_or_else(|| "must be two numbers with a comma between them, such as 0.6,1.6".into())
}

fn main() -> Result<()> {
    let args = Args::parse();
    let options = DatasetOptions {
        downscale: args.downscale,
        ..DatasetOptions::default()
    };
    let dataset = read_dataset(&args.data, &options)?;
    if args.out.join("transforms.json").exists() {
        bail!(
            "{} already contains a dataset; choose another folder",
            args.out.display()
        );
    }
    std::fs::create_dir_all(args.out.join("images"))
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    let cameras: Vec<Camera> = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
    let extent = camera_extent(&cameras);
    let frames: Vec<Value> = (0..dataset.views.len())
        .into_par_iter()
        .map(|view| write_view(&args, &dataset, extent, view))
        .collect::<Result<_>>()?;
    let files = |views: &[usize]| -> Vec<Value> { views.iter().map(|i| frames[*i]["file_path"].clone()).collect() };
    let mut transforms = json!({
        "train_filenames": files(&dataset.train), "test_filenames": files(&dataset.test),
        "val_filenames": [], "frames": frames,
    });
    if let Some(points) = &dataset.points {
        transforms["ply_file_path"] = json!("points.ply");
        write_points_ply(&args.out.join("points.ply"), points)?;
    }
    let bytes = serde_json::to_vec_pretty(&transforms)?;
    write_atomic(&args.out.join("transforms.json"), |file| file.write_all(&bytes))?;
    println!("{}: {} photographs", args.out.display(), dataset.views.len());
    Ok(())
}

/// A smooth gain over a photograph: a gradient of its logarithm and a vignette.
struct LocalGain {
    /// ln gain at the centre, and its change from there to a corner in each direction.
    log: f32,
    slope: [f32; 2],
    /// ln gain at the corners relative to the centre, not above 0; it grows with the squared distance.
    vignette: f32,
}

impl LocalGain {
    /// A gradient in a random direction with gains between `from` and `to`, and a vignette with a gain of at least `from`.
    fn random([from, to]: [f32; 2], rng: &mut Rng) -> Self {
        let (from, to) = (from.ln(), to.ln());
        let ends = [rng.range(from, to), rng.range(from, to)];
        let angle = rng.range(0.0, std::f32::consts::PI);
        // At the corner that the gradient reaches last, |x| |cos| + |y| |sin| is up to the root of 2.
        let steep = 0.5 * (ends[1] - ends[0]) / (angle.cos().abs() + angle.sin().abs());
        Self {
            log: 0.5 * (ends[0] + ends[1]),
            slope: [steep * angle.cos(), steep * angle.sin()],
            vignette: rng.range(from.min(0.0), 0.0),
        }
    }

    /// At `place`, from -1 to 1 across and down.
    fn at(&self, [x, y]: [f32; 2]) -> f32 {
        (self.log + self.slope[0] * x + self.slope[1] * y + self.vignette * 0.5 * (x * x + y * y)).exp()
    }
}

/// Covers a box of 0.55 x 0.2 times the height at a random place: dark legs, a chequered shirt, a head, the same in every photograph.
fn add_person(photo: &mut Photo, rng: &mut Rng) {
    let (columns, rows) = (photo.width as usize, photo.height as usize);
    let (tall, wide) = (rows * 11 / 20, rows / 5);
    let left = rng.below((columns.saturating_sub(wide) + 1) as u32) as usize;
    let top = rng.below((rows - tall + 1) as u32) as usize;
    let check = (wide / 8).max(1);
    let channels = photo.channels as usize;
    for y in 0..tall {
        for x in 0..wide.min(columns) {
            let color = match 100 * y / tall {
                0..15 => [224, 172, 140],
                15..55 if (x / check + y / check).is_multiple_of(2) => [200, 40, 40],
                15..55 => [235, 225, 210],
                _ => [40, 44, 70],
            };
            let at = channels * ((top + y) * columns + left + x);
            photo.data[at..at + 3].copy_from_slice(&color);
        }
    }
}

/// Writes one photograph; returns its frame of `transforms.json`.
fn write_view(args: &Args, dataset: &Dataset, extent: f32, view: usize) -> Result<Value> {
    let mut rng = Rng::new(args.seed, view as u64);
    let gain = args
        .gains
        .as_ref()
        .map_or(1.0, |range| rng.range(range[0].ln(), range[1].ln()).exp());
    let factors = [0; 3].map(|_| gain * rng.range(1.0 - args.balance, 1.0 + args.balance));
    let source = &dataset.views[view];
    let mut photo = source.photo.load()?;
    let local = args.local_gains.map(|range| {
        // A separate random sequence, so that the other faults stay the same.
        LocalGain::random(range, &mut Rng::new(args.seed, view as u64 | 1 << 32))
    });
    let lens = LocalGain {
        log: 0.0,
        slope: [0.0; 2],
        vignette: args.vignette.ln(),
    };
    let (channels, columns, rows) = (photo.channels as usize, photo.width, photo.height);
    for (i, pixel) in (0u32..).zip(photo.data.chunks_exact_mut(channels)) {
        let place =
            [(i % columns, columns), (i / columns, rows)].map(|(at, of)| 2.0 * (at as f32 + 0.5) / of as f32 - 1.0);
        let local = local.as_ref().map_or(1.0, |local| local.at(place)) * lens.at(place);
        for (value, factor) in pixel.iter_mut().zip(factors) {
            *value = (f32::from(*value) * factor * local).round().min(255.0) as u8;
        }
    }
    if args.people > 0.0 && dataset.train.contains(&view) && rng.uniform() < args.people {
        add_person(&mut photo, &mut rng);
    }
    let name = format!("images/{view:05}.png");
    write_png(
        &args.out.join(&name),
        photo.width,
        photo.height,
        photo.channels,
        &photo.data,
    )?;

    let Camera {
        mut pose,
        intrinsics: k,
        ..
    } = source.camera;
    if let Some(noise) = &args.pose_noise {
        let vector = |rng: &mut Rng| Vec3::from_array([0; 3].map(|_| rng.normal()));
        // Each axis gets a third of the variance.
        let turn = vector(&mut rng) * (noise[0].to_radians() / 3f32.sqrt());
        pose.rotation *= Quat::from_scaled_axis(turn);
        pose.position += vector(&mut rng) * (noise[1] * extent / 3f32.sqrt());
    }
    // OpenGL axes: y up, z backward.
    let rotation = pose.rotation * Quat::from_rotation_x(std::f32::consts::PI);
    let matrix = Mat4::from_rotation_translation(rotation, pose.position);
    let mut frame = json!({
        "file_path": name, "transform_matrix": matrix.transpose().to_cols_array_2d(),
        "w": k.width, "h": k.height, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy,
    });
    if let Some(mask) = &photo.mask {
        let name = format!("images/{view:05}.mask.png");
        write_png(&args.out.join(&name), photo.width, photo.height, 1, mask)?;
        frame["mask_path"] = json!(name);
    }
    Ok(frame)
}
