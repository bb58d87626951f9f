//! A frame and a training step on the GPU, stage by stage, beside the CPU's.

use crate::scale::{camera, scene, update};
use anyhow::{Context, Result, bail};
use irradia_compute::Device;
use irradia_compute::gpu::{Gpu, Wanted};
use irradia_measure::gpu::{DeviceFrame, ExtraTerms, GpuLoss};
use irradia_measure::{LossWeights, Target, Truth};
use irradia_splat::regularize::Regularizers;
use irradia_splat::{DeviceGradient, Engine, RenderOptions, SplatState, Statistics, ViewParams};
use std::sync::Arc;
use std::time::Instant;

/// Each case is a number of splats and a size, such as `1000000@1920x1080`; without any, the cases of RESULTS.md.
pub fn run(cases: &[String]) -> Result<()> {
    println!("{}", Device::Gpu(Gpu::open(&Wanted::Any)?));
    let default_cases = [100_000, 1_000_000, 3_000_000].into_iter();
    let cases: Vec<(usize, [u32; 2])> = match cases {
        [] => default_cases
            .flat_map(|number| [[1920, 1080], [3840, 2160]].map(|size| (number, size)))
            .collect(),
        cases => cases.iter().map(|case| parse_case(case)).collect::<Result<_>>()?,
    };
    for (number, size) in cases {
        // A scene that does not fit does not end the measurement of the others.
        if let Err(error) = measure(number, size) {
            println!("  not measured: {error}");
        }
    }
    Ok(())
}

fn parse_case(case: &str) -> Result<(usize, [u32; 2])> {
    let parts = case
        .split_once('@')
        .and_then(|(number, size)| Some((number, size.split_once('x')?)));
    let Some((number, (width, height))) = parts else {
        bail!("{case}: expected SPLATS@WIDTHxHEIGHT")
    };
    Ok((number.parse()?, [width.parse()?, height.parse()?]))
}

/// Number of frames submitted before waiting for the last one.
const QUEUED_FRAMES: u32 = 200;

/// Writes a case for other renderers, such as `bench/peer_gsplat.py`: little endian, the numbers of splats, columns and rows (u32); as f32
/// fx, fy, cx, cy, the 4 x 4 matrix from world to camera row by row, and the splats' means, quaternions (w first), ln of scales, logits
/// of opacities and harmonics, 16 coefficients of three channels each.
pub fn export(path: &str, case: &str) -> Result<()> {
    let (number, [width, height]) = parse_case(case)?;
    let (splats, view) = (scene(number), ViewParams::new(&camera(width, height, 1.0)));
    let mut floats: Vec<f32> = view.focal.iter().chain(&view.principal).map(|v| *v as f32).collect();
    for (row, t) in view.rotation.iter().zip(view.translation) {
        floats.extend(row.iter().chain([&t]).map(|v| *v as f32));
    }
    floats.extend([0.0, 0.0, 0.0, 1.0]);
    for planes in splats.columns() {
        floats.extend(planes.to_interleaved());
    }
    let sizes = [number as u32, width, height].map(u32::to_le_bytes);
    let words = floats.iter().map(|v| v.to_le_bytes());
    let bytes: Vec<u8> = sizes.into_iter().chain(words).flatten().collect();
    std::fs::write(path, bytes).with_context(|| format!("{path}: cannot be written"))
}

/// Seconds per frame with a wait after each, per frame with a wait after many, and per step with loss, backward pass and update.
struct Timings {
    frame: f64,
    queued_frame: f64,
    step: f64,
}

fn measure(number: usize, [width, height]: [u32; 2]) -> Result<()> {
    let state = SplatState::new(scene(number));
    println!("{number} splats, {width} x {height}");
    // Profiling stops the device after every kernel, so whole frames and steps are timed on a device without it.
    let [timed, profiled] = [Gpu::open(&Wanted::Any)?, Gpu::open(&Wanted::Any)?];
    let (spent, engine) = time(&timed, &state, [width, height], None)?;
    println!(
        "  {} in view, {} entries; a frame {:.2} ms, of many {:.2} ms ({:.0} frames/s), a step {:.2} ms ({:.1} steps/s)",
        engine.visible(),
        engine.intersections(),
        1e3 * spent.frame,
        1e3 * spent.queued_frame,
        1.0 / spent.queued_frame,
        1e3 * spent.step,
        1.0 / spent.step
    );
    drop(engine);
    if profiled.start_profile() {
        time(&profiled, &state, [width, height], Some(4))?;
        let mut spent: Vec<_> = profiled.take_profile().into_iter().collect();
        spent.sort_by(|a, b| b.1.0.total_cmp(&a.1.0));
        for (name, (seconds, calls)) in spent {
            println!("  {name:<18} {:>9.3} ms a step, {} calls", 250.0 * seconds, calls / 4);
        }
    }
    let cpu = cpu_step(state, [width, height]);
    println!("  the CPU's step {:.2} ms", 1e3 * cpu);
    timed.check()?;
    Ok(())
}

/// Repeats for about two seconds, or `repeats` steps.
fn time(
    gpu: &Arc<Gpu>,
    state: &SplatState,
    [width, height]: [u32; 2],
    repeats: Option<u32>,
) -> Result<(Timings, Engine)> {
    let mut engine = Engine::new(state.clone());
    engine.use_device(&Device::Gpu(gpu.clone()))?;
    let mut loss = GpuLoss::new(gpu.clone())?;
    let photo = vec![127u8; 3 * (width * height) as usize];
    let (camera, options, update) = (
        camera(width, height, 1.0),
        RenderOptions::default(),
        update(false, Regularizers::default()),
    );
    let mut step = |engine: &mut Engine| {
        engine.render_ahead(&camera, &options);
        let [planes, v_planes] = engine.device_frame().expect("on the GPU");
        let target = Target {
            width: width as usize,
            height: height as usize,
            truth: Truth::Rgb8(&photo),
            mask: None,
        };
        let beside = ExtraTerms {
            depths: &[],
            depth_weight: 0.0,
            cover_weight: 0.03,
            error: true,
        };
        loss.begin(
            &DeviceFrame { planes, v_planes },
            &target,
            &LossWeights::photometric(0.2),
            &beside,
        );
        engine.backward_on_device(&DeviceGradient {
            alpha: false,
            depth: false,
            gather: Some(Statistics::Error),
            camera: false,
        });
        engine.update(&update);
        loss.finish();
        // If there was no room, the next step serves as the repetition.
        let _ = engine.finish_frame();
    };
    let each = |engine: &mut Engine, work: &mut dyn FnMut(&mut Engine)| {
        if repeats.is_none() {
            work(engine);
            gpu.wait();
        }
        let (started, mut done) = (Instant::now(), 0);
        while repeats.map_or(started.elapsed().as_secs_f64() < 2.0, |repeats| done < repeats) {
            work(engine);
            done += 1;
        }
        gpu.wait();
        started.elapsed().as_secs_f64() / f64::from(done)
    };
    let step = each(&mut engine, &mut step);
    let (mut frame, mut queued_frame) = (0.0, 0.0);
    if repeats.is_none() {
        frame = each(&mut engine, &mut |engine| engine.render(camera.into(), &options));
        let started = Instant::now();
        for _ in 0..QUEUED_FRAMES {
            engine.render_ahead(&camera, &options);
        }
        gpu.wait();
        queued_frame = started.elapsed().as_secs_f64() / f64::from(QUEUED_FRAMES);
        let _ = engine.finish_frame();
    }
    let spent = Timings {
        frame,
        queued_frame,
        step,
    };
    Ok((spent, engine))
}

/// Seconds of a step without its loss.
fn cpu_step(state: SplatState, [width, height]: [u32; 2]) -> f64 {
    let mut engine = Engine::new(state);
    let camera = camera(width, height, 1.0);
    let v_color = vec![1e-6; 3 * (width * height) as usize];
    let update = update(false, Regularizers::default());
    let (wall, _) = crate::time(2, || {
        engine.render(camera.into(), &RenderOptions::default());
        engine.backward(&irradia_splat::OutputGradient::of_color(&v_color));
        engine.update(&irradia_splat::Update {
            statistics: Some(Statistics::Gradient),
            ..update
        });
    });
    1e-3 * wall
}
