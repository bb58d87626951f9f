//! How each part of a step grows with the number of splats: 0.1, 1 and 5 million, at two sizes of image.
//!
//! The scene is made here and needs no file: flat splats on a floor and on spheres, whose sizes follow their density, so that
//! every number of splats shows the same surfaces.

use crate::machine::{self, Limits};
use crate::time;
use anyhow::Result;
use cpu_time::{ProcessTime, ThreadTime};
use glam::{Quat, Vec3};
use irradia_compute::adam::AdamStep;
use irradia_scene::{Camera, Dataset, GaussianCloud, Intrinsics, Photo, PointCloud, Pose, Rng, View, sh};
use irradia_splat::densify::fast::{self, FastOptions};
use irradia_splat::regularize::{Regularized, Regularizers};
use irradia_splat::{
    Engine, Gather, Optimizer, OutputGradient, Rates, RenderOptions, SplatState, Splats, Statistics, Update, ViewParams,
};
use irradia_train::checkpoint::Checkpoint;
use irradia_train::{Recipe, TrainOptions, Trainer};
use std::sync::Arc;
use std::time::Instant;

/// Numbers a splat of degree 3 has: 11 of geometry, 48 of colour.
const NUMBERS_PER_SPLAT: f64 = 59.0;

/// Operations of a splat's projection, of its colour, and of a splat-pixel pair forward and backward, counted in the source; an
/// exponential counts as 12. They are rough, and only tell how far a stage is from the processor's peak.
const PROJECT_OPERATIONS: f64 = 260.0;
const COLOR_OPERATIONS: f64 = 160.0;
const PAIR_OPERATIONS: f64 = 30.0;
const PAIR_VJP_OPERATIONS: f64 = 62.0;

/// Measures each of `numbers` of splats at both image sizes.
pub fn run(numbers: &[usize]) -> Result<()> {
    let limits = machine::limits();
    println!(
        "{} threads: {:.0} GFLOP/s in registers, {:.1} GB/s of memory",
        rayon::current_num_threads(),
        limits.gflops,
        limits.gbytes
    );
    for number in numbers {
        measure(*number, &limits)?;
    }
    Ok(())
}

/// A line of the table: wall and CPU milliseconds, the least wall time that memory and arithmetic allow, and the latter's share
/// of the CPU time over all threads.
fn line(what: &str, (wall, cpu): (f64, f64), bytes: f64, operations: f64, limits: &Limits) {
    let (memory, arithmetic) = (bytes / limits.gbytes / 1e6, operations / limits.gflops / 1e6);
    let least = memory.max(arithmetic);
    println!(
        "  {what:<34} {wall:>9.1} ms wall {cpu:>9.1} ms CPU; {:>8.1} MB {memory:>7.1} ms, {:>7.2} Gop {arithmetic:>6.1} ms; {:>3.0} % of the limit",
        bytes / 1e6,
        operations / 1e9,
        100.0 * least * rayon::current_num_threads() as f64 / cpu.max(1e-9)
    );
}

/// Wall and CPU milliseconds of one call without a warm-up.
fn time_once<T>(work: impl FnOnce() -> T) -> (T, (f64, f64)) {
    let (wall, cpu) = (Instant::now(), ProcessTime::now());
    let made = work();
    (
        made,
        (1e3 * wall.elapsed().as_secs_f64(), 1e3 * cpu.elapsed().as_secs_f64()),
    )
}

fn measure(number: usize, limits: &Limits) -> Result<()> {
    let splats = scene(number);
    let state_bytes = 4.0 * number as f64 * (3.0 * NUMBERS_PER_SPLAT + 6.0);
    println!("{number} splats, a state of {:.2} GB", state_bytes / 1e9);
    let mut trainer = trainer(&splats)?;
    *trainer.engine.state_mut() = SplatState::new(splats);
    let repeats = (4_000_000 / number).clamp(1, 10) as u32;
    for (width, height) in [(1280, 720), (1920, 1080)] {
        println!(" {width} x {height}");
        parts(&mut trainer.engine, &camera(width, height, 1.0), repeats, limits);
    }
    few_in_view(&mut trainer.engine, repeats);
    let (step, cpu) = time(repeats, || {
        trainer.step(&mut Vec::new()).expect("photographs in memory");
    });
    println!(
        " a training step at 1280 x 720: {step:.1} ms wall, {cpu:.1} ms CPU, {:.2} % of it serial",
        serial(&mut trainer, repeats)
    );
    let bytes = machine::resident();
    println!(
        " resident {:.2} GB, at most {:.2}",
        bytes[0] as f64 / 1e9,
        bytes[1] as f64 / 1e9
    );
    save(&trainer, state_bytes)?;
    density(&mut trainer.engine, state_bytes, step, limits);
    Ok(())
}

/// Amdahl's serial share of a training step, percent: parallel work runs on the threads of the pool, so that the CPU time of this
/// thread is that of everything else.
fn serial(trainer: &mut Trainer, repeats: u32) -> f64 {
    let (alone, all) = (ThreadTime::now(), ProcessTime::now());
    for _ in 0..repeats {
        trainer.step(&mut Vec::new()).expect("photographs in memory");
    }
    100.0 * alone.elapsed().as_secs_f64() / all.elapsed().as_secs_f64()
}

/// Forward, backward and update with all splats in view.
fn parts(engine: &mut Engine, camera: &Camera, repeats: u32, limits: &Limits) {
    let options = RenderOptions::default();
    let forward = time(repeats, || engine.render((*camera).into(), &options));
    let n = engine.len() as f64;
    let (seen, pairs) = (engine.visible() as f64, engine.pairs() as f64);
    let pixels = f64::from(camera.intrinsics.width * camera.intrinsics.height);
    println!("  {:.0} k in view, {:.1} M pairs", seen / 1e3, pairs / 1e6);
    // Geometry of all splats and colour of those in view are read, a footprint of 64 bytes is written and read, pixels are written.
    let bytes = 4.0 * (11.0 * n + 48.0 * seen) + 128.0 * seen + 16.0 * pixels;
    let operations = PROJECT_OPERATIONS * n + COLOR_OPERATIONS * seen + PAIR_OPERATIONS * pairs;
    line("forward", forward, bytes, operations, limits);
    let v_color = vec![1e-6; 3 * pixels as usize];
    let error = vec![0.1; pixels as usize];
    let v_out = OutputGradient {
        gather: Gather::Error(&error),
        ..OutputGradient::of_color(&v_color)
    };
    let backward = time(repeats, || engine.backward(&v_out));
    let bytes = 4.0 * seen * (2.0 * NUMBERS_PER_SPLAT + 4.0) + 64.0 * seen + 12.0 * pixels;
    let operations = 2.0 * (PROJECT_OPERATIONS + COLOR_OPERATIONS) * seen + PAIR_VJP_OPERATIONS * pairs;
    line("backward", backward, bytes, operations, limits);
    let adam = |touched: f64| 4.0 * NUMBERS_PER_SPLAT * 7.0 * touched;
    let operations = 12.0 * NUMBERS_PER_SPLAT;
    let sparse = update(false, Regularizers::default());
    let spent = time(repeats, || engine.update(&sparse));
    line("update, sparse Adam", spent, adam(seen), operations * seen, limits);
    let dense = update(true, Regularizers::default());
    let spent = time(repeats, || engine.update(&dense));
    line("update, dense Adam", spent, adam(n), operations * n, limits);
    let with_all = Update {
        condition_cap: Some(1e6),
        angle_cap: None,
        trained_fraction: 0.9,
        ..update(
            false,
            Regularizers {
                opacity: 1e-9,
                scale: 1e-9,
                ..Regularizers::default()
            },
        )
    };
    let spent = time(repeats, || engine.update(&with_all));
    line(
        "sparse, regularised, capped",
        spent,
        adam(seen),
        operations * seen,
        limits,
    );
}

/// An update with rates so small that the scene does not change.
pub fn update(dense: bool, regularizers: Regularizers) -> Update {
    let rate = 1e-9;
    Update {
        statistics: Some(Statistics::Error),
        regularizers,
        regularized: Regularized::Visible,
        regularizer_unit: 1.0,
        trained_fraction: 1.0,
        rates: Rates {
            means: rate,
            means_from: None,
            quats: rate,
            log_scales: rate,
            opacities: rate,
            sh_dc: rate,
            sh_rest: rate,
        },
        sh_degree: 3,
        optimizer: Optimizer {
            step: AdamStep {
                beta1: 0.9,
                beta2: 0.999,
                epsilon: 1e-15,
                step: 10,
            },
            dense,
        },
        noise: None,
        condition_cap: None,
        angle_cap: None,
    }
}

/// A step with about 5 % of the splats in view, beside a step on those 5 % alone.
fn few_in_view(engine: &mut Engine, repeats: u32) {
    let options = RenderOptions::default();
    let n = engine.len();
    let (mut narrow, mut wide) = (0.02f32, 1.0f32);
    for _ in 0..12 {
        let middle = (narrow * wide).sqrt();
        engine.render(camera(1280, 720, middle).into(), &options);
        if engine.visible() * 20 > n {
            wide = middle
        } else {
            narrow = middle
        }
    }
    let camera = camera(1280, 720, narrow);
    engine.project(camera.into(), &options);
    let v_color = vec![1e-6; 3 * 1280 * 720];
    let v_out = OutputGradient::of_color(&v_color);
    let whole_step = |engine: &mut Engine| {
        engine.render(camera.into(), &options);
        engine.backward(&v_out);
        engine.update(&update(false, Regularizers::default()));
    };
    let mut alone = {
        let mut renderer = irradia_splat::Renderer::new();
        renderer.project(&engine.state().splats, &ViewParams::new(&camera), &options);
        Engine::new(SplatState::new(engine.state().splats.gather(renderer.in_view())))
    };
    let repeats = repeats.max(3);
    let of_all = time(repeats, || whole_step(engine));
    let of_few = time(repeats, || whole_step(&mut alone));
    println!(
        " 1280 x 720 with {} of {n} in view: {:.1} ms wall, {:.1} CPU; those alone {:.1} wall, {:.1} CPU: {:.2} times the CPU time",
        engine.visible(),
        of_all.0,
        of_all.1,
        of_few.0,
        of_few.1,
        of_all.1 / of_few.1
    );
}

/// Writes a checkpoint to the system's temporary folder.
fn save(trainer: &Trainer, state_bytes: f64) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("checkpoint");
    let before = machine::resident()[0];
    machine::reset_peak();
    let (written, (wall, cpu)) =
        time_once(|| irradia_formats::write_atomic(&path, |out| Checkpoint::of(trainer).write(out)));
    written?;
    println!(
        " checkpoint: {wall:.0} ms wall, {cpu:.0} ms CPU, {:.0} MB/s; {:.2} times the state's memory in addition",
        state_bytes / wall / 1e3,
        machine::resident()[1].saturating_sub(before) as f64 / state_bytes
    );
    let state = trainer.engine.state();
    let (mut spare, (wall, cpu)) = time_once(|| SplatState::resident(state.len(), state.splats.sh_degree()));
    println!(" memory for a copy, which a run obtains beside its steps: {wall:.0} ms wall, {cpu:.0} ms CPU");
    for what in ["first copy", "another copy"] {
        let copy = || Checkpoint::of(trainer).copied_into(std::mem::take(&mut spare));
        let (copied, (wall, cpu)) = time_once(copy);
        spare = copied.into_state();
        println!(" {what} for a checkpoint in the background: {wall:.0} ms wall, {cpu:.0} ms CPU");
    }
    Ok(())
}

/// A round of density control that splits a twentieth and prunes.
fn density(engine: &mut Engine, state_bytes: f64, step: f64, limits: &Limits) {
    let n = engine.len();
    for seen in engine.state_mut().statistics.plane_mut(SplatState::SEEN) {
        *seen += 2.0;
    }
    let options = FastOptions {
        floor: 0,
        target: n + n / 20,
        min_opacity: 0.13,
        min_weight: 0.0,
        min_frames: 2.0,
        error_threshold: 0.0,
        min_extent: 0.0,
    };
    let before = machine::resident()[0];
    machine::reset_peak();
    let (change, spent) = time_once(|| fast::densify(engine.state_mut(), &options));
    let peak = machine::resident()[1].saturating_sub(before) as f64;
    line("density round", spent, 2.0 * state_bytes, 0.0, limits);
    println!(
        "  {} split, {} pruned; {:.1} steps' time; {:.2} times the state's memory at its peak",
        change.split,
        change.pruned,
        spent.0 / step,
        1.0 + peak / state_bytes
    );
}

/// A trainer on synthetic photographs; the caller replaces its splats.
fn trainer(splats: &Splats) -> Result<Trainer> {
    let photo = Photo {
        width: 1280,
        height: 720,
        channels: 3,
        data: (0..1280 * 720 * 3).map(|i| (i / 977 % 251) as u8).collect(),
        mask: None,
    };
    let photo: Arc<Photo> = Arc::new(photo);
    let view = |i: usize| {
        View::new(
            format!("{i}"),
            Camera {
                pose: turned(0.01 * i as f32),
                ..camera(1280, 720, 1.0)
            },
            photo.clone(),
        )
    };
    let few: Vec<Vec3> = (0..splats.len())
        .step_by(splats.len() / 100)
        .map(|i| splats.mean(i).into())
        .collect();
    let dataset = Dataset {
        views: (0..4).map(view).collect(),
        train: (0..4).collect(),
        points: Some(PointCloud {
            colors: vec![[128; 3]; few.len()],
            positions: few,
        }),
        ..Dataset::default()
    };
    let mut recipe = Recipe::parse(
        "classic",
        Recipe::built_in("classic")?,
        &["params.sh_degree=3".to_owned()],
    )?;
    for stage in &mut recipe.stage {
        stage.density = None;
    }
    Ok(Trainer::new(Arc::new(dataset), recipe, TrainOptions::default())?)
}

/// The pose of a camera that sees the whole scene, turned by `angle` about its position.
fn turned(angle: f32) -> Pose {
    let position = Vec3::new(0.0, -3.0, -9.0);
    // Looks down at the origin: +Z forward, +Y down.
    let down = (3.0f32 / 9.0).atan();
    Pose {
        rotation: Quat::from_rotation_y(angle) * Quat::from_rotation_x(-down),
        position,
    }
}

/// A camera that sees the whole scene, or with `zoom` below 1 only its centre.
pub fn camera(width: u32, height: u32, zoom: f32) -> Camera {
    let intrinsics = Intrinsics::from_fov_x(width, height, 1.3 * zoom);
    Camera::new(turned(0.0), intrinsics)
}

/// `number` splats: two fifths on a floor of 12 x 8, the others on thirty spheres above it; +Y is down.
pub fn scene(number: usize) -> Splats {
    let mut rng = Rng::new(7, 3);
    let spheres: Vec<(Vec3, f32)> = (0..30)
        .map(|_| {
            let radius = rng.range(0.15, 0.6);
            let center = Vec3::new(
                rng.range(-4.5, 4.5),
                -radius - rng.range(0.0, 1.5),
                rng.range(-2.5, 3.0),
            );
            (center, radius)
        })
        .collect();
    let area: f32 = 96.0
        + spheres
            .iter()
            .map(|(_, r)| 4.0 * std::f32::consts::PI * r * r)
            .sum::<f32>();
    // Neighbours overlap at one standard deviation.
    let size = 0.7 * (area / number as f32).sqrt();
    let mut cloud = GaussianCloud {
        sh_degree: 3,
        ..Default::default()
    };
    for i in 0..number {
        let (mean, normal) = if i % 5 < 2 {
            (Vec3::new(rng.range(-6.0, 6.0), 0.0, rng.range(-4.0, 4.0)), Vec3::Y)
        } else {
            let (center, radius) = spheres[rng.below(30) as usize];
            let normal = Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize_or(Vec3::Y);
            (center + radius * normal, normal)
        };
        let q = Quat::from_rotation_arc(Vec3::Z, normal) * Quat::from_rotation_z(rng.range(0.0, 3.0));
        cloud.means.push((mean + 0.1 * size * rng.normal() * normal).to_array());
        cloud.quats.push([q.w, q.x, q.y, q.z]);
        let spread = |rng: &mut Rng| (size * (0.5 * rng.normal()).exp()).ln();
        cloud
            .log_scales
            .push([spread(&mut rng), spread(&mut rng), (0.2 * size).ln()]);
        let opacity = rng.range(0.1, 0.99);
        cloud.opacity_logits.push(irradia_splat::logit(opacity));
        cloud.sh.extend((0..3 * sh::coefficients(3)).map(|k| {
            if k < 3 {
                rng.range(-1.0, 1.0)
            } else {
                0.05 * rng.normal()
            }
        }));
    }
    Splats::from_cloud(&cloud)
}
