//! The radiance fields' benchmark and a stand-alone trainer.
//!
//! ```text
//! cargo run --release -p irradia --example field -- bench
//! cargo run --release -p irradia --example field -- train DATA [--downscale N] [--seconds S] [--recipe hashgrid|nerf|proposal]
//!     [--space bounded|unbounded|ndc] [--out FOLDER]
//! ```
//!
//! CPU time is given beside wall time: on a shared machine it is more stable, and `--seconds` counts it.

mod bench;
mod memory;
#[path = "../machine/peak.rs"]
mod peak;

use anyhow::{Context, Result, bail};
use cpu_time::ProcessTime;
use irradia_field::encoding::{HashGrid, PositionEncoding};
use irradia_field::net::{Activation, NetShape};
use irradia_field::{
    Background, Field, FieldConfig, FieldState, PointsOptions, RenderOptions, Sampler, Space, StepOptions, TrainView,
    render_view, to_points, train_views,
};
use irradia_formats::{DatasetOptions, read_dataset, write_png};
use irradia_scene::{Camera, Photo};
use std::path::PathBuf;

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("bench") => bench::run(),
        Some("train") => train(&args[1..]),
        _ => bail!(
            "usage: bench, or train DATA [--downscale N] [--seconds S] [--recipe NAME] [--space NAME] [--out FOLDER]"
        ),
    }
}

/// The value of `--name`, or `default`.
fn flag<T: std::str::FromStr>(args: &[String], name: &str, default: T) -> Result<T> {
    match args.iter().position(|a| a == name) {
        Some(at) => match args.get(at + 1).map(|v| v.parse()) {
            Some(Ok(value)) => Ok(value),
            _ => bail!("{name} needs a value"),
        },
        None => Ok(default),
    }
}

/// A held-out view.
struct HeldOutView {
    camera: Camera,
    photo: Photo,
}

fn train(args: &[String]) -> Result<()> {
    let data = args.first().context("expected a dataset after `train`")?;
    let downscale: f32 = flag(args, "--downscale", 1.0)?;
    let seconds: f64 = flag(args, "--seconds", 90.0)?;
    let recipe: String = flag(args, "--recipe", "hashgrid".to_owned())?;
    let space: String = flag(args, "--space", "auto".to_owned())?;
    let out: String = flag(args, "--out", String::new())?;
    let options = DatasetOptions {
        downscale,
        ..DatasetOptions::default()
    };
    let dataset = read_dataset(data.as_ref(), &options)?;
    let background = [1.0; 3];
    let photos: Vec<Photo> = dataset
        .train
        .iter()
        .map(|i| dataset.views[*i].photo.load())
        .collect::<Result<_, _>>()?;
    let planes: Vec<_> = photos
        .iter()
        .map(|photo| (photo.over(background), photo.alpha()))
        .collect();
    let views: Vec<TrainView> = (0..photos.len())
        .map(|image| TrainView {
            camera: &dataset.views[dataset.train[image]].camera,
            rgb: &planes[image].0,
            alpha: planes[image].1.as_deref(),
            over: background,
            mask: photos[image].mask.as_deref(),
            depths: &[],
            image: image as u32,
        })
        .collect();
    let held: Vec<HeldOutView> = dataset
        .test
        .iter()
        .map(|i| {
            let view = &dataset.views[*i];
            Ok(HeldOutView {
                camera: view.camera,
                photo: view.photo.load()?,
            })
        })
        .collect::<Result<_>>()?;
    let cameras: Vec<Camera> = views.iter().map(|v| *v.camera).collect();
    let transparent = photos.iter().all(|p| p.channels == 4);
    let space = match (space.as_str(), transparent) {
        ("ndc", _) => {
            let near = dataset.views.iter().filter_map(|v| v.depth_bounds).map(|b| b[0]);
            Space::ndc(&cameras, near.fold(f32::INFINITY, f32::min).clamp(0.01, 1e6) * 0.95)
        }
        ("unbounded", _) | ("auto", false) => Space::around(&cameras, true),
        _ => Space::around(&cameras, false),
    }
    .context("the cameras do not look at a common region")?;
    println!(
        "{}x{}, {} + {} views, {space:?}",
        photos[0].width,
        photos[0].height,
        views.len(),
        held.len()
    );
    let config = configure(&recipe, args, &space)?;
    let field = Field::new(config, space, 0)?;
    println!("{} parameters", field.len());
    let mut state = FieldState::new(field);
    let base = StepOptions {
        net_rate: flag(args, "--rate", if recipe == "nerf" { 1e-3 } else { 1e-2 })?,
        table_rate: flag(args, "--table-rate", 1e-2)?,
        distortion: flag(args, "--distortion", 0.0)?,
        samples: flag(args, "--samples", 1 << 16)?,
        background: if args.iter().any(|a| a == "--white") {
            Background::Fixed(background)
        } else {
            Background::Random
        },
        ..StepOptions::default()
    };
    let mut spent = 0.0;
    // An untrained field is expensive to render.
    let mut next = seconds / 12.0;
    let mut smooth = 0.0f64;
    let mut looks = (1..=16).cycle();
    while spent < seconds {
        let began = ProcessTime::now();
        let time = spent / seconds;
        // Decay to a thirtieth, linearly in the logarithm, over the last two thirds.
        let decay = 0.033f32.powf(((time as f32 - 0.33) / 0.67).max(0.0));
        let options = StepOptions {
            net_rate: base.net_rate * decay,
            table_rate: base.table_rate * decay,
            update_occupancy: looks.next() == Some(16),
            ..base
        };
        let loss = train_views(&mut state, &views, &options);
        smooth = 0.95 * smooth + 0.05 * loss.color;
        spent += began.elapsed().as_secs_f64();
        if spent >= next {
            next += seconds / 12.0;
            let share = state.field.occupancy.as_ref().map_or(1.0, |g| g.occupied_fraction());
            println!(
                "{spent:6.1} s CPU, step {:5}: loss {:.2} dB, {:.2} dB held out, {} rays, {:.1} samples a ray, {:.2} % occupied",
                state.step,
                -10.0 * smooth.log10(),
                psnr(&state.field, &held[..held.len().min(2)], background),
                loss.rays,
                loss.samples as f64 / loss.rays as f64,
                100.0 * share,
            );
        }
    }
    println!(
        "{} steps, {:.2} dB held out, all views",
        state.step,
        psnr(&state.field, &held, background)
    );
    let began = ProcessTime::now();
    let wall = std::time::Instant::now();
    let options = RenderOptions {
        background,
        ..RenderOptions::default()
    };
    let view = render_view(&state.field, &held[0].camera, &options);
    println!(
        "one view of {}x{}: {:.2} s CPU, {:.2} s",
        view.width,
        view.height,
        began.elapsed().as_secs_f64(),
        wall.elapsed().as_secs_f64()
    );
    let began = ProcessTime::now();
    let points = to_points(&state.field, &cameras, &PointsOptions::default(), |_, _| true);
    println!("{} points: {:.2} s CPU", points.len(), began.elapsed().as_secs_f64());
    if !out.is_empty() {
        write_pictures(&PathBuf::from(out), &state.field, &held, background)?;
    }
    Ok(())
}

fn configure(recipe: &str, args: &[String], space: &Space) -> Result<FieldConfig> {
    Ok(match recipe {
        "hashgrid" => {
            let mut config = FieldConfig::hash_grid();
            if let PositionEncoding::HashGrid(grid) = &mut config.net.encoding {
                grid.levels = flag(args, "--levels", grid.levels)?;
                grid.features = flag(args, "--features", grid.features)?;
                grid.log2_table = flag(args, "--table", grid.log2_table)?;
                grid.finest = flag(args, "--finest", grid.finest)?;
            }
            if let Sampler::Occupancy(o) = &mut config.sampler {
                o.side = flag(args, "--side", o.side)?;
                if matches!(space.outside, irradia_field::Outside::Contracted) {
                    o.steps.cone = 1.0 / 128.0;
                }
                o.steps.shortest = 2.0 * 3f32.sqrt() / flag(args, "--steps", 512.0)?;
            }
            config.net.width = flag(args, "--width", config.net.width)?;
            config
        }
        "nerf" => FieldConfig::nerf(
            flag(args, "--width", 64)?,
            flag(args, "--coarse", 32)?,
            flag(args, "--fine", 64)?,
        ),
        "proposal" => {
            let mut config = FieldConfig::hash_grid();
            let round = |finest| NetShape {
                encoding: PositionEncoding::HashGrid(HashGrid {
                    levels: 5,
                    features: 2,
                    log2_table: 14,
                    coarsest: 16,
                    finest,
                }),
                width: 16,
                color: None,
                activation: Activation::Exp,
                ..config.net
            };
            config.sampler = Sampler::Proposal {
                rounds: vec![(round(128), 64), (round(256), 48)],
                last: 24,
            };
            config
        }
        other => bail!("no recipe {other}"),
    })
}

/// Mean over views of the PSNR against 8-bit truth.
fn psnr(field: &Field, held: &[HeldOutView], background: [f32; 3]) -> f64 {
    let each = held.iter().map(|view| {
        let options = RenderOptions {
            background,
            ..RenderOptions::default()
        };
        let out = render_view(field, &view.camera, &options);
        let truth = view.photo.over(background);
        let pixels = out.alpha.len();
        let mut squares = 0.0f64;
        for (i, value) in truth.iter().enumerate() {
            let shown = (out.color[i % 3 * pixels + i / 3].clamp(0.0, 1.0) * 255.0).round();
            squares += f64::from((shown - f32::from(*value)) / 255.0).powi(2);
        }
        -10.0 * (squares / truth.len() as f64).log10()
    });
    each.sum::<f64>() / held.len() as f64
}

fn write_pictures(folder: &std::path::Path, field: &Field, held: &[HeldOutView], background: [f32; 3]) -> Result<()> {
    std::fs::create_dir_all(folder)?;
    for (n, view) in held.iter().enumerate().step_by(held.len().div_ceil(4)) {
        let options = RenderOptions {
            background,
            normals: true,
            ..RenderOptions::default()
        };
        let out = render_view(field, &view.camera, &options);
        let pixels = out.alpha.len();
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let near = out
            .depth
            .iter()
            .copied()
            .filter(|d| *d > 0.0)
            .fold(f32::INFINITY, f32::min);
        let color: Vec<u8> = (0..3 * pixels)
            .map(|i| byte(out.color[i % 3 * pixels + i / 3]))
            .collect();
        let depth: Vec<u8> = out.median_depth.iter().map(|d| byte(near / d)).collect();
        let (w, h) = (out.width, out.height);
        write_png(&folder.join(format!("{n}.color.png")), w, h, 3, &color)?;
        write_png(
            &folder.join(format!("{n}.truth.png")),
            w,
            h,
            3,
            &view.photo.over(background),
        )?;
        write_png(&folder.join(format!("{n}.depth.png")), w, h, 1, &depth)?;
        let normal = |i: usize| byte(0.5 + 0.5 * out.normals[i % 3 * pixels + i / 3]);
        let normals: Vec<u8> = (0..3 * pixels).map(normal).collect();
        write_png(&folder.join(format!("{n}.normal.png")), w, h, 3, &normals)?;
    }
    Ok(())
}
