use super::*;
use crate::batch::{Background, Draw, KnownDepth, RayBatch, TrainView};
use crate::config::FieldConfig;
use crate::encoding::HashGrid;
use crate::engine::FieldEngine;
use crate::render::view::{RenderOptions, render_view};
use crate::space::Space;
use crate::state::FieldState;
use crate::train::{StepOptions, train_step, train_views};
use glam::Vec3;
use irradia_compute::Device;
use irradia_compute::gpu::Wanted;
use irradia_scene::{Camera, Intrinsics, Pose, Rng};

fn gpu() -> Option<Arc<Gpu>> {
    irradia_testkit::gpu_or_skip(|| Gpu::open(&Wanted::Any))
}

/// A small field; every second level is hashed.
fn config() -> FieldConfig {
    let mut config = FieldConfig::hash_grid();
    config.net.encoding = PositionEncoding::HashGrid(HashGrid {
        levels: 3,
        features: 2,
        log2_table: 10,
        coarsest: 4,
        finest: 40,
    });
    config.net.width = 16;
    config.net.geometry = 12;
    config.net.density_bias = 1.0;
    if let Sampler::Occupancy(options) = &mut config.sampler {
        options.side = 16;
        options.steps.shortest = 0.05;
    }
    config
}

const SIDE: u32 = 24;

fn cameras() -> Vec<Camera> {
    (0..4)
        .map(|i| {
            let angle = 1.3 * i as f32;
            let eye = 3.0 * Vec3::new(angle.sin(), 0.3, -angle.cos());
            Camera::new(
                Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y),
                Intrinsics::from_fov_x(SIDE, SIDE, 0.7),
            )
        })
        .collect()
}

/// Photographs of smooth colours, two of them with alpha and the others with known depths.
struct Photographs {
    cameras: Vec<Camera>,
    rgb: Vec<Vec<u8>>,
    alpha: Vec<u8>,
    depths: Vec<KnownDepth>,
}

impl Photographs {
    fn new() -> Self {
        let pixels = (SIDE * SIDE) as usize;
        let shade = |i: usize, p: usize| (40 + 50 * i + p % SIDE as usize * 3 + p / 64) as u8;
        Self {
            cameras: cameras(),
            rgb: (0..4)
                .map(|i| (0..3 * pixels).map(|p| shade(i, p / 3)).collect())
                .collect(),
            alpha: (0..pixels).map(|p| if p % 5 == 0 { 0 } else { 255 }).collect(),
            depths: (0..pixels as u32)
                .step_by(7)
                .map(|pixel| KnownDepth { pixel, depth: 2.5 })
                .collect(),
        }
    }

    fn views(&self) -> Vec<TrainView<'_>> {
        (0..4)
            .map(|i| TrainView {
                camera: &self.cameras[i],
                rgb: &self.rgb[i],
                alpha: (i < 2).then_some(&self.alpha[..]),
                over: [0.0; 3],
                mask: None,
                depths: if i < 2 { &[] } else { &self.depths },
                image: i as u32,
            })
            .collect()
    }

    /// 200 random rays, `known` of them through known depths.
    fn batch(&self, known: usize, space: &Space) -> RayBatch {
        let mut batch = RayBatch::default();
        let what = Draw {
            rays: 200,
            known,
            background: Background::Random,
        };
        batch.draw(&self.views(), &what, space, &mut Rng::new(1, 1));
        batch
    }
}

/// Fields of every space and activation, with and without a learnt background.
fn variants() -> Vec<(&'static str, FieldConfig, Space)> {
    let cube = Space::cube([0.0; 3], 1.2);
    let mut softplus = config();
    softplus.net.activation = Activation::Softplus;
    softplus.net.depth = 2;
    softplus.background_degree = Some(2);
    let mut unbounded = config();
    if let Sampler::Occupancy(options) = &mut unbounded.sampler {
        options.steps.cone = 0.1;
    }
    let mut relu = config();
    relu.net.activation = Activation::Relu;
    let facing: Vec<Camera> = (0..3)
        .map(|i| {
            let eye = Vec3::new(0.2 * i as f32 - 0.2, 0.0, -3.0);
            Camera::new(
                Pose::look_at(eye, eye + Vec3::Z, Vec3::NEG_Y),
                Intrinsics::from_fov_x(SIDE, SIDE, 0.7),
            )
        })
        .collect();
    vec![
        ("cube", config(), cube),
        ("softplus", softplus, cube),
        ("contracted", unbounded, Space::contracted([0.0; 3], 1.0)),
        ("ndc", relu, Space::ndc(&facing, 0.5).expect("they face forward")),
    ]
}

/// A field with some empty cells, perturbed away from its initial symmetry.
fn state(config: FieldConfig, space: Space) -> FieldState {
    let mut field = Field::new(config, space, 5).expect("valid");
    let mut rng = Rng::new(2, 7);
    field.parameters[0]
        .table
        .iter_mut()
        .for_each(|v| *v = rng.range(-0.5, 0.5));
    field.background.iter_mut().for_each(|v| *v = rng.range(-0.5, 0.5));
    let grid = field.occupancy.as_mut().expect("an occupancy grid");
    for (cell, density) in grid.density.iter_mut().enumerate() {
        *density = if cell / 7 % 3 == 0 { 0.0 } else { 10.0 };
    }
    field.mark_occupied();
    FieldState::new(field)
}

/// The largest difference between two lists, relative to the largest expected value.
fn difference(got: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(got.len(), expected.len());
    let scale = expected.iter().fold(1e-12f32, |m, v| m.max(v.abs()));
    let pairs = got.iter().zip(expected);
    pairs.fold(0.0f32, |m, (a, b)| m.max((a - b).abs() / scale))
}

#[test]
fn every_shader_is_valid() {
    let layout = Layout::new(&crate::net::Net::new(config().net));
    let constants = layout.constants(&crate::net::Net::new(config().net));
    for shader in crate::shaders::SHADERS {
        irradia_testkit::validate_shader(shader.name, &format!("{constants}{}", shader.source()));
    }
}

#[test]
fn a_step_has_the_gradients_and_losses_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let photographs = Photographs::new();
    for (name, config, space) in variants() {
        let mut cpu = state(config, space);
        let batch = photographs.batch(50, &space);
        let options = StepOptions {
            depth: 0.1,
            ..StepOptions::default()
        };
        let mut host = cpu.clone();
        let mut training = GpuFieldTraining::new(gpu.clone(), &host).unwrap();
        let got = training.step(&mut host, &batch, &options);
        let expected = train_step(&mut cpu, &batch, &options);
        gpu.check().unwrap();
        assert!(expected.samples > 500, "{name}: {} samples", expected.samples);
        assert!(
            got.samples.abs_diff(expected.samples) <= 2 && got.rays == expected.rays,
            "{name}: {got:?} {expected:?}"
        );
        for (a, b) in [(got.color, expected.color), (got.total, expected.total)] {
            assert!((a - b).abs() < 1e-4 * b, "{name}: {got:?} {expected:?}");
        }
        // After the first step the first moments are a tenth of the gradients.
        let host = training.download(&host);
        let [got, expected] = [&host, &cpu].map(|state| &state.moments[0][0]);
        for (what, got, expected) in [
            ("table", &got.table, &expected.table),
            ("density", &got.density, &expected.density),
            ("color", &got.color, &expected.color),
            ("background", &host.background_moments[0], &cpu.background_moments[0]),
        ] {
            let difference = difference(got, expected);
            assert!(difference < 2e-3, "{name}, {what}: {difference}");
        }
        let untouched = |list: &[f32]| list.iter().filter(|v| **v == 0.0).count();
        assert!(
            untouched(&got.table).abs_diff(untouched(&expected.table)) <= got.table.len() / 100,
            "{name}: entries that no sample touches stay unchanged"
        );
    }
}

#[test]
fn rays_beyond_the_most_samples_are_left_out() {
    let Some(gpu) = gpu() else { return };
    let photographs = Photographs::new();
    let (_, config, space) = variants().into_iter().next().expect("a variant");
    let mut state = state(config, space);
    let batch = photographs.batch(0, &space);
    let options = StepOptions {
        samples: 50,
        ..StepOptions::default()
    };
    let mut training = GpuFieldTraining::new(gpu.clone(), &state).unwrap();
    let loss = training.step(&mut state, &batch, &options);
    gpu.check().unwrap();
    assert!((150..=200).contains(&loss.samples), "{loss:?}");
    assert!((1..200).contains(&loss.rays) && loss.color.is_finite(), "{loss:?}");
}

#[test]
fn rays_that_remain_keep_their_samples() {
    let Some(gpu) = gpu() else { return };
    let (_, config, space) = variants().into_iter().next().expect("a variant");
    let field = state(config, space).field;
    let mut on_device = GpuField::new(gpu.clone(), &field).unwrap();
    let rays = Photographs::new().batch(0, &space).rays;
    let mut middles = |max_samples: usize| {
        let mut batch = Batch {
            rays: rays
                .iter()
                .map(|ray| GpuField::ray(ray, 0.5, [0.0; 4], [0.0; 4]))
                .collect(),
            weights: [1.0, 0.0],
        };
        let samples = on_device.march_within(&mut batch, max_samples);
        on_device.prepare(&batch, samples);
        let mut work = Work::new(&gpu);
        on_device.evaluate(&mut work, batch.rays.len(), samples);
        work.submit();
        let mut middles = vec![0.0f32; samples];
        on_device.points.read(&gpu, 3 * on_device.stride, &mut middles);
        middles
    };
    let (all, some) = (middles(usize::MAX), middles(300));
    gpu.check().unwrap();
    assert!((200..=300).contains(&some.len()) && all.len() > 500);
    assert_eq!(some, all[..some.len()]);
}

#[test]
fn two_trainings_on_the_device_have_the_same_bytes() {
    let Some(gpu) = gpu() else { return };
    let photographs = Photographs::new();
    let train = || {
        let state = FieldState::new(Field::new(config(), Space::cube([0.0; 3], 1.2), 1).expect("valid"));
        let mut engine = FieldEngine::new(state, &Device::Gpu(gpu.clone())).unwrap();
        let options = StepOptions {
            samples: 2000,
            ..StepOptions::default()
        };
        for _ in 0..5 {
            engine.train_views(&photographs.views(), &options);
        }
        engine.check_device().unwrap();
        engine.state().clone()
    };
    let (a, b) = (train(), train());
    assert_eq!(a.step, 5);
    assert!(a.field.parameters == b.field.parameters && a.moments == b.moments);
    assert_eq!(a.field.occupancy, b.field.occupancy);
}

#[test]
fn training_on_the_device_learns_what_the_cpu_learns() {
    let Some(gpu) = gpu() else { return };
    let photographs = Photographs::new();
    let options = StepOptions {
        samples: 3000,
        background: Background::Fixed([0.0; 3]),
        ..StepOptions::default()
    };
    let first = FieldState::new(Field::new(config(), Space::cube([0.0; 3], 1.2), 1).expect("valid"));
    let mut cpu = first.clone();
    let mut engine = FieldEngine::new(first, &Device::Gpu(gpu)).unwrap();
    let (mut of_cpu, mut of_gpu) = (Vec::new(), Vec::new());
    for _ in 0..60 {
        of_cpu.push(train_views(&mut cpu, &photographs.views(), &options).color);
        of_gpu.push(engine.train_views(&photographs.views(), &options).color);
    }
    engine.check_device().unwrap();
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    let (begin, cpu, gpu) = (mean(&of_gpu[..3]), mean(&of_cpu[50..]), mean(&of_gpu[50..]));
    assert!(
        gpu < 0.3 * begin && (gpu / cpu).ln().abs() < 0.25,
        "{begin} to {gpu}, CPU {cpu}"
    );
}

#[test]
fn views_look_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    for (name, config, space) in variants() {
        let field = state(config, space).field;
        let mut renderer = GpuFieldRenderer::new(gpu.clone(), &field).unwrap();
        let options = RenderOptions {
            background: [0.1, 0.5, 0.9],
            ..RenderOptions::default()
        };
        for camera in &cameras()[..2] {
            let got = renderer.render(&field, camera, &options).unwrap();
            let expected = render_view(&field, camera, &options);
            let planes = [
                (&got.color, &expected.color),
                (&got.alpha, &expected.alpha),
                (&got.depth, &expected.depth),
            ];
            for (got, expected) in planes {
                let off = got
                    .iter()
                    .zip(expected)
                    .filter(|(a, b)| (*a - *b).abs() > 2e-3 * b.abs().max(1.0));
                let off = off.count();
                // A sample on the face of a cell may fall on either side.
                assert!(off <= got.len() / 100, "{name}: {off} of {} values", got.len());
            }
        }
    }
}
