//! The radiance fields' benchmark and a stand-alone trainer.
//!
//! ```text
//! cargo run --release -p irradia --example field -- bench
//! cargo run --release -p irradia --example field -- train DATA [--downscale N] [--seconds S] [--recipe hashgrid|nerf|proposal]
//!     [--space bounded|unbounded|ndc] [--out FOLDER]
//! ```
//!
//! CPU time stands beside wall time: on a shared machine it is the steadier of the two, and `--seconds` counts it.

use anyhow::{Context, Result, bail};
use cpu_time::ProcessTime;
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Simd};
use irradia_field::encoding::{HashGrid, PositionEncoding};
use irradia_field::mlp::{Mlp, MlpShape, MlpTape, PANEL};
use irradia_field::net::{Activation, NetShape};
use irradia_field::{
    Background, Field, FieldConfig, FieldState, PointsOptions, RenderOptions, Rows, Sampler, Space, StepOptions,
    TrainView, render_view, to_points, train_views,
};
use irradia_formats::{DatasetOptions, read_dataset, write_png};
use irradia_scene::{Camera, Photo, Rng};
use std::path::PathBuf;

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("bench") => bench(),
        Some("train") => train(&args[1..]),
        _ => bail!(
            "say: bench, or train DATA [--downscale N] [--seconds S] [--recipe NAME] [--space NAME] [--out FOLDER]"
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
struct Held {
    camera: Camera,
    photo: Photo,
}

fn train(args: &[String]) -> Result<()> {
    let data = args.first().context("which data?")?;
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
    let behind = [1.0; 3];
    let photos: Vec<Photo> = dataset
        .train
        .iter()
        .map(|i| dataset.views[*i].photo.load())
        .collect::<Result<_, _>>()?;
    let planes: Vec<_> = photos.iter().map(|photo| (photo.over(behind), photo.alpha())).collect();
    let views: Vec<TrainView> = (0..photos.len())
        .map(|image| TrainView {
            camera: &dataset.views[dataset.train[image]].camera,
            rgb: &planes[image].0,
            alpha: planes[image].1.as_deref(),
            over: behind,
            mask: photos[image].mask.as_deref(),
            depth: None,
            image: image as u32,
        })
        .collect();
    let held: Vec<Held> = dataset
        .test
        .iter()
        .map(|i| {
            let view = &dataset.views[*i];
            Ok(Held {
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
    .context("the cameras do not look at anything together")?;
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
            Background::Fixed(behind)
        } else {
            Background::Random
        },
        ..StepOptions::default()
    };
    let mut spent = 0.0;
    // A field that has learnt nothing is dear to look at.
    let mut next = seconds / 12.0;
    let mut smooth = 0.0f64;
    let mut looks = (1..=16).cycle();
    while spent < seconds {
        let began = ProcessTime::now();
        let time = spent / seconds;
        // Down to a thirtieth, evenly in the logarithm, over the last two thirds.
        let decay = 0.033f32.powf(((time as f32 - 0.33) / 0.67).max(0.0));
        let options = StepOptions {
            net_rate: base.net_rate * decay,
            table_rate: base.table_rate * decay,
            look: looks.next() == Some(16),
            ..base
        };
        let loss = train_views(&mut state, &views, &options);
        smooth = 0.95 * smooth + 0.05 * loss.color;
        spent += began.elapsed().as_secs_f64();
        if spent >= next {
            next += seconds / 12.0;
            let share = state.field.occupancy.as_ref().map_or(1.0, |g| g.share());
            println!(
                "{spent:6.1} s CPU, step {:5}: loss {:.2} dB, {:.2} dB held out, {} rays, {:.1} samples a ray, {:.2} % occupied",
                state.step,
                -10.0 * smooth.log10(),
                psnr(&state.field, &held[..held.len().min(2)], behind),
                loss.rays,
                loss.samples as f64 / loss.rays as f64,
                100.0 * share,
            );
        }
    }
    println!(
        "{} steps, {:.2} dB held out, all views",
        state.step,
        psnr(&state.field, &held, behind)
    );
    let began = ProcessTime::now();
    let wall = std::time::Instant::now();
    let options = RenderOptions {
        background: behind,
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
    let points = to_points(&state.field, &cameras, &PointsOptions::default());
    let mut sizes = points.sizes.clone();
    sizes.sort_by(f32::total_cmp);
    println!(
        "{} points, median size {:.5}: {:.2} s CPU",
        sizes.len(),
        sizes.get(sizes.len() / 2).unwrap_or(&0.0),
        began.elapsed().as_secs_f64()
    );
    if !out.is_empty() {
        write_pictures(&PathBuf::from(out), &state.field, &held, behind)?;
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
fn psnr(field: &Field, held: &[Held], background: [f32; 3]) -> f64 {
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

fn write_pictures(folder: &std::path::Path, field: &Field, held: &[Held], background: [f32; 3]) -> Result<()> {
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

/// CPU seconds of one call, the mean of `repeats` after one to warm up.
fn time(repeats: u32, mut work: impl FnMut()) -> f64 {
    work();
    let began = ProcessTime::now();
    (0..repeats).for_each(|_| work());
    began.elapsed().as_secs_f64() / f64::from(repeats)
}

fn bench() -> Result<()> {
    let level = Level::detect();
    let peak = level.run(Peak);
    println!("{}: {peak:.1} GFLOP/s a core in registers", level.name());
    for (inputs, outputs, width, depth) in [
        (32, 16, 32, 1),
        (32, 3, 32, 2),
        (32, 16, 64, 1),
        (64, 4, 64, 8),
        (64, 257, 256, 8),
        (40, 40, 40, 2),
    ] {
        let shape = MlpShape {
            inputs,
            outputs,
            width,
            depth,
            skip: None,
        };
        let [forward, backward] = level.run(Through { shape });
        println!(
            "{inputs} -> {depth} x {width} -> {outputs}: forward {forward:.1} GFLOP/s ({:.0} %), backward {backward:.1} ({:.0} %)",
            100.0 * forward / peak,
            100.0 * backward / peak
        );
    }
    for grid in [(16, 2, 17), (16, 2, 15), (8, 4, 15), (8, 4, 17)] {
        encoding(level, grid);
    }
    Ok(())
}

/// The most multiply-adds that one core does, in registers.
struct Peak;

impl Kernel for Peak {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f64
    where
        S::F: Lanes<Scalar = f32>,
    {
        let (a, b) = (
            simd.set(std::hint::black_box(0.999)),
            simd.set(std::hint::black_box(0.001)),
        );
        let mut sums = [simd.splat(1.0); 12];
        let rounds = 20_000_000u32;
        let began = ProcessTime::now();
        for _ in 0..rounds {
            for k in 0..12 {
                sums[k] = sums[k].mul_add(a, b);
            }
        }
        let seconds = began.elapsed().as_secs_f64();
        std::hint::black_box(sums);
        f64::from(rounds) * 12.0 * 2.0 * S::LANES as f64 / seconds / 1e9
    }
}

/// GFLOP/s forward and backward through a network, 512 samples at a time.
struct Through {
    shape: MlpShape,
}

impl Kernel for Through {
    type Output = [f64; 2];

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f64; 2]
    where
        S::F: Lanes<Scalar = f32>,
    {
        let mlp = Mlp::new(self.shape);
        let mut rng = Rng::new(1, 2);
        let parameters = mlp.init(&mut rng);
        let turned = mlp.transposed(&parameters);
        let panels = 16;
        let mut x = Rows::default();
        x.resize(panels * mlp.inputs() * PANEL, 0.0);
        x.iter_mut().for_each(|x| *x = rng.range(-1.0, 1.0));
        let mut tape = MlpTape::default();
        let (mut grads, mut v_x) = (vec![0.0; parameters.len()], Rows::default());
        let work = (mlp.products() * panels * PANEL * 2) as f64;
        let repeats = (3e10 / work) as u32;
        // Loops written out, since a closure would not be compiled for these lanes.
        let began = ProcessTime::now();
        for _ in 0..repeats {
            mlp.forward(simd, &parameters, &x, &mut tape);
        }
        let forward = began.elapsed().as_secs_f64() / f64::from(repeats);
        let out = tape.output().to_vec();
        let began = ProcessTime::now();
        for _ in 0..repeats {
            let v = tape.output_gradient();
            v.resize(out.len(), 0.0);
            v.copy_from_slice(&out);
            mlp.backward(simd, &turned, &x, &mut tape, &mut grads, Some(&mut v_x));
        }
        let backward = began.elapsed().as_secs_f64() / f64::from(repeats);
        [work / forward / 1e9, 2.0 * work / backward / 1e9]
    }
}

/// Millions of samples a second through a hash grid, forward and with the way back, one core.
fn encoding(level: Level, (levels, features, log2_table): (usize, usize, u32)) {
    let grid = HashGrid {
        levels,
        features,
        log2_table,
        coarsest: 16,
        finest: 512,
    };
    let mut rng = Rng::new(3, 4);
    let samples = 1 << 15;
    let mut points: Vec<f32> = Vec::new();
    // Samples as rays have them: steps of 1/300 along straight lines.
    let mut at = [[0.0f32; 3]; 2];
    for i in 0..samples {
        if i % 16 == 0 {
            at = [
                [rng.uniform(), rng.uniform(), rng.uniform()],
                [rng.normal() / 500.0, rng.normal() / 500.0, rng.normal() / 500.0],
            ];
        }
        let here: [f32; 3] = std::array::from_fn(|c| at[0][c] + (i % 16) as f32 * at[1][c]);
        points.extend(here);
    }
    let points: Vec<f32> = points
        .chunks_exact(3 * PANEL)
        .flat_map(|panel| (0..3 * PANEL).map(|k| panel[k % PANEL * 3 + k / PANEL]))
        .collect();
    let table: Vec<f32> = (0..grid.parameters()).map(|_| rng.uniform()).collect();
    let v: Vec<f32> = (0..samples * levels * features).map(|_| rng.uniform()).collect();
    let mut grads = vec![0.0; table.len()];
    let mut encoded = vec![0.0; v.len()];
    let forward = time(20, || {
        level.run(Encode {
            grid: &grid,
            points: &points,
            table: &table,
            to: &mut encoded,
        });
    });
    let backward = time(20, || {
        level.run(Scatter {
            grid: &grid,
            points: &points,
            v: &v,
            grads: &mut grads,
        });
    });
    let million = samples as f64 / 1e6;
    println!(
        "{levels} levels of {features}, tables of 2^{log2_table}: {:.2} M samples/s forward, {:.2} backward, {:.2} both, a core; {:.2} ns a corner",
        million / forward,
        million / backward,
        million / (forward + backward),
        (forward + backward) * 1e9 / (samples * levels * 16) as f64,
    );
}

struct Encode<'a> {
    grid: &'a HashGrid,
    points: &'a [f32],
    table: &'a [f32],
    to: &'a mut [f32],
}

impl Kernel for Encode<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let rows = self.grid.levels * self.grid.features;
        for (l, level) in self.grid.level_table().iter().enumerate() {
            let row = l * self.grid.features;
            irradia_field::encoding::hash_grid::encode_level(
                simd,
                self.grid,
                level,
                self.table,
                self.points,
                row,
                rows,
                self.to,
            );
        }
    }
}

struct Scatter<'a> {
    grid: &'a HashGrid,
    points: &'a [f32],
    v: &'a [f32],
    grads: &'a mut [f32],
}

impl Kernel for Scatter<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let rows = self.grid.levels * self.grid.features;
        for (l, level) in self.grid.level_table().iter().enumerate() {
            let row = l * self.grid.features;
            let grads = &mut self.grads[level.first * self.grid.features..];
            irradia_field::encoding::hash_grid::encode_level_vjp(
                simd,
                self.grid,
                level,
                self.points,
                self.v,
                row,
                rows,
                grads,
            );
        }
    }
}
