//! The project's speed benchmark.
//!
//! ```text
//! cargo run --release -p irradia --example speed -- steps DATA [STEPS]   a training step and its parts
//! cargo run --release -p irradia --example speed -- blend                the inner loop of blending
//! cargo run --release -p irradia --example speed -- frame SCENE.ply      a frame of a million splats, and how its cost scales
//! cargo run --release -p irradia --example speed -- scale [SPLATS ..]    every stage at 0.1, 1 and 5 million splats
//! cargo run --release -p irradia --example speed -- gpu [CASE ..]        frames, steps and kernels on a GPU
//! cargo run --release -p irradia --example speed -- export FILE CASE      the splats of such a case, for other renderers
//! cargo run --release -p irradia --example speed -- counts               bytes and operations of a step on a GPU, beside gsplat's
//! ```
//!
//! CPU time is given beside wall time: on a shared machine it is more stable.

#[cfg(feature = "gpu")]
mod counts;
#[cfg(feature = "gpu")]
mod gpu;
mod machine;
#[path = "../machine/peak.rs"]
mod peak;
mod scale;

use anyhow::{Context, Result, bail};
use cpu_time::ProcessTime;
use glam::Vec3;
use irradia_formats::{DatasetOptions, read_dataset, read_splats};
use irradia_scene::{Camera, GaussianCloud, Intrinsics, Pose, Rng};
use irradia_splat::{OutputGradient, RenderOptions, Renderer, SplatGradients, SplatState, Splats, ViewParams};
use irradia_train::{Recipe, TrainOptions, Trainer};
use std::sync::Arc;
use std::time::Instant;

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["steps", data] => steps(data, 500),
        ["steps", data, count] => steps(data, count.parse()?),
        ["blend"] => blend(),
        ["frame", scene] => frame(scene),
        ["scale"] => scale::run(&[100_000, 1_000_000, 5_000_000]),
        ["scale", ..] => scale::run(&args[1..].iter().map(|n| n.parse()).collect::<Result<Vec<_>, _>>()?),
        #[cfg(feature = "gpu")]
        ["gpu", ..] => gpu::run(&args[1..]),
        #[cfg(feature = "gpu")]
        ["export", path, case] => gpu::export(path, case),
        #[cfg(feature = "gpu")]
        ["counts"] => counts::run(),
        _ => bail!(
            "usage: steps DATA [STEPS], blend, frame SCENE.ply, scale [SPLATS ..], gpu [SPLATS@WIDTHxHEIGHT ..], export FILE SPLATS@WIDTHxHEIGHT, or counts"
        ),
    }
}

/// Wall and CPU milliseconds of one call, the mean of `repeats` after one to warm up.
fn time(repeats: u32, mut work: impl FnMut()) -> (f64, f64) {
    work();
    let (wall, cpu) = (Instant::now(), ProcessTime::now());
    for _ in 0..repeats {
        work();
    }
    let each = |seconds: f64| 1e3 * seconds / f64::from(repeats);
    (each(wall.elapsed().as_secs_f64()), each(cpu.elapsed().as_secs_f64()))
}

/// The first steps of the recipe `classic` at full resolution without density control; then forward and backward separately.
fn steps(data: &str, steps: u64) -> Result<()> {
    let dataset = Arc::new(read_dataset(data.as_ref(), &DatasetOptions::default())?);
    let mut recipe = Recipe::parse("classic", Recipe::built_in("classic")?, &[])?;
    for stage in &mut recipe.stage {
        stage.density = None;
    }
    let mut trainer = Trainer::new(dataset.clone(), recipe, TrainOptions::default())?;
    for _ in 0..steps {
        trainer.step(&mut Vec::new())?;
    }
    println!(
        "{steps} steps, {} splats: {:.2} ms wall, {:.2} ms CPU per step",
        trainer.engine.len(),
        1e3 * trainer.seconds / steps as f64,
        1e3 * trainer.cpu_seconds / steps as f64,
    );
    let views = |factor: f32| -> Vec<ViewParams> {
        let mut cameras: Vec<Camera> = dataset
            .train
            .iter()
            .take(10)
            .map(|i| dataset.views[*i].camera)
            .collect();
        for camera in &mut cameras {
            camera.intrinsics = camera.intrinsics.scaled(factor);
        }
        cameras.iter().map(ViewParams::new).collect()
    };
    let options = RenderOptions {
        sh_degree: 0,
        ..RenderOptions::default()
    };
    let splats = &trainer.engine.state().splats;
    report_parts("as trained", splats, &views(1.0), &options);
    report_parts("twice the pixels", splats, &views(std::f32::consts::SQRT_2), &options);
    report_parts(
        "twice the splats",
        &multiplied(splats, 2 * splats.len()),
        &views(1.0),
        &options,
    );
    Ok(())
}

/// Forward and backward over `views`.
fn report_parts(what: &str, splats: &Splats, views: &[ViewParams], options: &RenderOptions) {
    let mut renderer = Renderer::new();
    let mut gradients = SplatGradients::default();
    let n = views.len() as f64;
    let (mut pairs, mut entries) = (0, 0);
    for view in views {
        renderer.render(splats, view, options);
        pairs += renderer.pairs();
        entries += renderer.intersections();
    }
    let forward = time(3, || {
        views.iter().for_each(|view| renderer.render(splats, view, options))
    });
    let both = time(3, || {
        for view in views {
            renderer.render(splats, view, options);
            let v_color = vec![1e-6; renderer.color().len()];
            let v_out = OutputGradient::of_color(&v_color);
            renderer.backward(splats, &v_out, &mut gradients);
        }
    });
    println!(
        "a frame, {what}: forward {:.2} ms CPU, backward {:.2}; {:.2} M pairs, {:.1} k tile entries",
        forward.1 / n,
        (both.1 - forward.1) / n,
        pairs as f64 / n / 1e6,
        entries as f64 / n / 1e3,
    );
}

/// 1,000 faint splats, each larger than the image: every pair is visited, so that only the inner loop counts.
fn blend() -> Result<()> {
    let n = 1000;
    let mut cloud = GaussianCloud {
        sh_degree: 0,
        ..Default::default()
    };
    for i in 0..n {
        cloud.means.push([0.0, 0.0, 5.0 + 1e-3 * i as f32]);
        cloud.quats.push([1.0, 0.0, 0.0, 0.0]);
        cloud.log_scales.push([2.0, 2.1, 2.0]);
        cloud.opacity_logits.push(-4.8); // Alpha 0.008: the pixels do not terminate.
        cloud.sh.extend([0.1, 0.2, 0.3]);
    }
    let splats = Splats::from_cloud(&cloud);
    let camera = Camera::new(
        Pose {
            rotation: glam::Quat::IDENTITY,
            position: Vec3::ZERO,
        },
        Intrinsics::from_fov_x(512, 512, 0.5),
    );
    let view = ViewParams::new(&camera);
    let options = RenderOptions {
        sh_degree: 0,
        ..RenderOptions::default()
    };
    let mut renderer = Renderer::new();
    renderer.render(&splats, &view, &options);
    let pairs = renderer.pairs() as f64;
    let mut gradients = SplatGradients::default();
    let v_color = vec![1e-6; renderer.color().len()];
    let forward = time(5, || renderer.render(&splats, &view, &options));
    let both = time(5, || {
        renderer.render(&splats, &view, &options);
        renderer.backward(&splats, &OutputGradient::of_color(&v_color), &mut gradients);
    });
    println!(
        "{} on {} threads: forward {:.2} G pairs per CPU second, backward {:.2}",
        renderer.level.name(),
        rayon::current_num_threads(),
        pairs / forward.1 / 1e6,
        pairs / (both.1 - forward.1) / 1e6,
    );
    Ok(())
}

/// A trained scene copied with jitter to a million splats, seen whole at 1280x720, SH degree 3.
fn frame(scene: &str) -> Result<()> {
    let cloud = read_splats(scene.as_ref())?;
    let cameras = cameras(scene).context("the scene must be in its run's folder, beside cameras.json")?;
    let original = Splats::from_cloud(&cloud);
    // Move back along the first camera's axis until the whole scene, except for outliers, is in view.
    let sees_most = |camera: &Camera| {
        let (k, n) = (&camera.intrinsics, cloud.means.len());
        let inside = |m: &&[f32; 3]| {
            let seen = camera.project(Vec3::from_array(**m));
            seen.is_some_and(|(p, _)| p.x > 0.0 && p.y > 0.0 && p.x < k.width as f32 && p.y < k.height as f32)
        };
        cloud.means.iter().filter(inside).count() * 20 > 19 * n
    };
    let mut whole = cameras[0];
    whole.intrinsics = Intrinsics::from_fov_x(1280, 720, 0.9);
    for _ in 0..40 {
        if sees_most(&whole) {
            break;
        }
        let back = 0.1
            * cameras[0]
                .pose
                .position
                .distance(irradia_splat::init::focus_point(&cameras));
        whole.pose.position -= whole.pose.rotation * Vec3::Z * back;
    }
    let camera = |width: u32, height: u32| {
        ViewParams::new(&Camera {
            intrinsics: whole.intrinsics.resized(width, height),
            ..whole
        })
    };
    let options = RenderOptions::default();
    let mut renderer = Renderer::new();
    let mut measure = |splats: &Splats, view: &ViewParams| {
        let (wall, cpu) = time(5, || renderer.render(splats, view, &options));
        println!(
            "{:>8} splats ({} visible) at {}x{}: {wall:.1} ms wall, {cpu:.1} ms CPU; {:.1} M pairs, {:.0} k tile entries",
            splats.len(),
            renderer.visible(),
            view.width,
            view.height,
            renderer.pairs() as f64 / 1e6,
            renderer.intersections() as f64 / 1e3,
        );
    };
    let view = camera(1280, 720);
    let full = multiplied(&original, 1_000_000);
    let half = multiplied(&original, 500_000);
    measure(&half, &view);
    measure(&full, &view);
    measure(&full, &camera(905, 509));
    Ok(())
}

/// `original` repeated to `count` splats; copies are shifted randomly and shrunk so that together they cover what one
/// original did.
fn multiplied(original: &Splats, count: usize) -> Splats {
    let indices: Vec<u32> = (0..count).map(|i| (i % original.len()) as u32).collect();
    let mut splats = original.gather(&indices);
    let mut rng = Rng::new(1, 1);
    let shrink = (count as f32 / original.len() as f32).ln() / 2.0;
    for i in 0..count {
        let size = (0..3)
            .map(|c| splats.log_scales.get(c, i))
            .fold(f32::MIN, f32::max)
            .exp();
        for c in 0..3 {
            splats.means.set(c, i, splats.means.get(c, i) + size * rng.normal());
            splats.log_scales.set(c, i, splats.log_scales.get(c, i) - shrink);
        }
    }
    SplatState::new(splats).splats
}

/// The training cameras, from the run's `cameras.json`.
fn cameras(scene: &str) -> Option<Vec<Camera>> {
    let text = std::fs::read_to_string(std::path::Path::new(scene).parent()?.join("cameras.json")).ok()?;
    let records: Vec<serde_json::Value> = serde_json::from_str(&text).ok()?;
    let number = |v: &serde_json::Value| v.as_f64().map(|v| v as f32);
    records
        .iter()
        .map(|r| {
            let p: Vec<f32> = r["position"].as_array()?.iter().filter_map(number).collect();
            let q: Vec<f32> = r["rotation"].as_array()?.iter().filter_map(number).collect();
            let (&[x, y, z], &[w, i, j, k]) = (&p[..], &q[..]) else {
                return None;
            };
            let mut intrinsics = Intrinsics::from_fov_x(r["width"].as_u64()? as u32, r["height"].as_u64()? as u32, 1.0);
            (intrinsics.fx, intrinsics.fy) = (number(&r["fx"])?, number(&r["fy"])?);
            let pose = Pose {
                rotation: glam::Quat::from_xyzw(i, j, k, w),
                position: Vec3::new(x, y, z),
            };
            Some(Camera::new(pose, intrinsics))
        })
        .collect()
}
