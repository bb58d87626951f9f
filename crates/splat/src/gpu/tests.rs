//! The GPU against its twin on the CPU.

use super::{GpuRenderer, GpuTraining};
use crate::densify::{classic, fast, mcmc, taming};
use crate::engine::{Noise, Update};
use crate::regularize::{AngleCap, Regularized, Regularizers};
use crate::render::splat_beside_camera;
use crate::render::{Gather, OutputGradient};
use crate::shaders::SHADERS;
use crate::{
    Engine, Optimizer, Rates, RenderOptions, Renderer, SplatGradients, SplatState, Splats, Statistics, ViewParams,
};
use glam::Vec3;
use irradia_compute::Device;
use irradia_compute::adam::AdamStep;
use irradia_compute::gpu::{Gpu, Wanted};
use irradia_scene::{Camera, Intrinsics, Pose, Rng};
use std::sync::Arc;

pub(super) fn gpu() -> Option<Arc<Gpu>> {
    irradia_testkit::gpu_or_skip(|| Gpu::open(&Wanted::Any))
}

#[test]
fn every_shader_is_valid() {
    for shader in SHADERS {
        irradia_testkit::validate_shader(shader.name, &shader.source());
    }
}

/// `n` splats of all sizes around the origin, some behind the camera, a few needles, and a camera with unusual intrinsics.
pub(super) fn scene(n: usize, degree: u32, seed: u64) -> (Splats, Camera) {
    let mut rng = Rng::new(seed, 7);
    let mut splats = Splats::zeros(n, degree);
    for i in 0..n {
        for c in 0..3 {
            splats.means.set(c, i, rng.range(-1.6, 1.6));
            splats.log_scales.set(c, i, rng.range(-5.0, -1.5));
        }
        for c in 0..4 {
            splats.quats.set(c, i, rng.normal());
        }
        splats.opacity_logits.set(0, i, rng.range(-4.0, 4.0));
        for plane in 0..splats.sh.count() {
            let spread = if plane < 3 { 1.5 } else { 0.3 };
            splats.sh.set(plane, i, rng.range(-spread, spread));
        }
    }
    let pose = Pose::look_at(Vec3::new(0.4, -0.3, -2.0), Vec3::new(0.1, 0.0, 0.2), Vec3::NEG_Y);
    let mut k = Intrinsics::from_fov_x(83, 61, 1.1);
    k.cx += 7.0;
    k.fy *= 1.1;
    (splats, Camera::new(pose, k))
}

/// Largest difference, and the share of values that differ by more than `most`.
fn apart(a: &[f32], b: &[f32], most: f32) -> (f32, f64) {
    assert_eq!(a.len(), b.len());
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    let largest = differences.clone().fold(0.0, f32::max);
    let beyond = differences.filter(|d| d.is_nan() || *d > most).count();
    (largest, beyond as f64 / a.len().max(1) as f64)
}

#[test]
fn frames_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = GpuRenderer::new(gpu.clone()).unwrap();
    for (case, (n, degree)) in [(0, 0), (1, 3), (3000, 0), (3000, 3), (20_000, 2)]
        .into_iter()
        .enumerate()
    {
        let (splats, camera) = scene(n, degree, case as u64);
        let filter: Vec<f32> = (0..splats.stride()).map(|i| 1e-5 * (i % 7) as f32).collect();
        for (antialias, filter) in [(false, &[][..]), (true, &filter[..])] {
            let options = RenderOptions {
                background: [0.2, 0.5, 0.9],
                antialias,
                depth: true,
                ..RenderOptions::default()
            };
            let view = ViewParams::new(&camera);
            let mut cpu = Renderer::new();
            cpu.set_filter(filter);
            cpu.render(&splats, &view, &options);
            renderer.upload(&splats, filter);
            renderer.render(&view, &options);
            let (got, expected) = (renderer.frame(), cpu.frame());
            for (name, got, expected, most) in [
                ("color", got.color, expected.color, 2e-4),
                ("alpha", got.alpha, expected.alpha, 2e-4),
                ("depth", got.depth, expected.depth, 2e-3),
            ] {
                // Where rounding decides whether a fragment of alpha 1/255 is drawn, a pixel may differ by that much.
                let (largest, beyond) = apart(got, expected, most);
                assert!(
                    beyond < 2e-3 && largest < 0.05,
                    "case {case}: {name} {largest} {beyond}"
                );
            }
            assert_eq!(renderer.visible(), cpu.visible(), "case {case}");
        }
    }
    gpu.check().unwrap();
}

#[test]
fn the_same_frame_has_the_same_bytes() {
    let Some(gpu) = gpu() else { return };
    let (splats, camera) = scene(5000, 1, 3);
    let mut renderer = GpuRenderer::new(gpu).unwrap();
    let mut frame = || {
        renderer.upload(&splats, &[]);
        renderer.render(&ViewParams::new(&camera), &RenderOptions::default());
        renderer.frame().color.to_vec()
    };
    assert!(frame() == frame());
}

/// Random gradients of a frame: colour, alpha, depth; and an error per pixel.
pub(super) fn gradients(camera: &Camera, seed: u64) -> [Vec<f32>; 4] {
    let pixels = camera.intrinsics.width as usize * camera.intrinsics.height as usize;
    let mut rng = Rng::new(seed, 9);
    [3 * pixels, pixels, pixels, pixels].map(|n| (0..n).map(|_| rng.range(-1.0, 1.0) / pixels as f32).collect())
}

#[test]
fn gradients_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    for (case, n) in [3000, 12_000].into_iter().enumerate() {
        let (splats, camera) = scene(n, 3, 20 + case as u64);
        let view = ViewParams::new(&camera);
        let [v_color, v_alpha, v_depth, error] = gradients(&camera, 5);
        for (antialias, gather) in [
            (false, Gather::Absolute),
            (true, Gather::Error(&error)),
            (true, Gather::Nothing),
        ] {
            let options = RenderOptions {
                antialias,
                depth: true,
                background: [0.1, 0.6, 0.3],
                ..RenderOptions::default()
            };
            let v_out = OutputGradient {
                color: &v_color,
                alpha: Some(&v_alpha),
                depth: Some(&v_depth),
                gather,
                camera: true,
            };
            let (mut cpu, mut expected) = (Renderer::new(), SplatGradients::default());
            let state = SplatState::new(splats.clone());
            cpu.render(&state.splats, &view, &options);
            cpu.backward(&state.splats, &v_out, &mut expected);
            let mut training = GpuTraining::new(gpu.clone()).unwrap();
            training.upload(&state, false);
            training.render(&view, &options);
            training.backward(&v_out);
            let mut got = SplatGradients::default();
            training.read_gradients(&mut got);
            let active: Vec<usize> = (0..n).filter(|i| expected.active[*i] != 0.0).collect();
            assert!(active.len() > n / 4);
            let pairs = got.splats.columns().into_iter().zip(expected.splats.columns());
            for ((got, expected), name) in pairs.zip(crate::COLUMN_NAMES) {
                for c in 0..got.count() {
                    let of =
                        |planes: &irradia_compute::Planes| active.iter().map(|i| planes.get(c, *i)).collect::<Vec<_>>();
                    let (got, expected) = (of(got), of(expected));
                    let norm = (expected.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>()).sqrt();
                    let error = got
                        .iter()
                        .zip(&expected)
                        .map(|(a, b)| f64::from(a - b).powi(2))
                        .sum::<f64>()
                        .sqrt();
                    // Fragments at the threshold of 1/255 are drawn by one and not by the other.
                    assert!(error < 2e-3 * norm, "case {case}: {name} {c}: {error:e} of {norm:e}");
                }
            }
            let (got, expected) = (training.camera_gradient().unwrap(), expected.camera.unwrap());
            let norm = expected.translation.iter().map(|v| v.abs()).fold(0.0, f64::max);
            for i in 0..3 {
                assert!(
                    (got.translation[i] - expected.translation[i]).abs() < 2e-3 * norm,
                    "{got:?} {expected:?}"
                );
                for j in 0..3 {
                    assert!(
                        (got.rotation[i][j] - expected.rotation[i][j]).abs() < 4e-3 * norm,
                        "{got:?} {expected:?}"
                    );
                }
            }
        }
    }
    gpu.check().unwrap();
}

#[test]
fn splats_far_beside_the_image_are_not_drawn() {
    let Some(gpu) = gpu() else { return };
    for (sides, visible) in [(1.95, 1), (2.05, 0)] {
        let (splats, camera) = splat_beside_camera(sides);
        let mut engine = Engine::new(SplatState::new(splats));
        engine.use_device(&Device::Gpu(gpu.clone())).unwrap();
        engine.render(camera.into(), &RenderOptions::default());
        assert_eq!(engine.visible(), visible, "{sides}");
    }
    gpu.check().unwrap();
}

/// An update of every parameter, with the norms of screen gradients as statistics.
pub(super) fn usual_update() -> Update {
    Update {
        statistics: Some(Statistics::Gradient),
        regularizers: Regularizers::default(),
        regularized: Regularized::Visible,
        regularizer_unit: 1.7,
        trained_fraction: 1.0,
        rates: Rates {
            means: 1e-3,
            means_from: None,
            quats: 1e-3,
            log_scales: 5e-3,
            opacities: 2e-2,
            sh_dc: 2e-3,
            sh_rest: 1e-4,
        },
        sh_degree: 2,
        optimizer: Optimizer {
            step: AdamStep {
                beta1: 0.9,
                beta2: 0.999,
                // With a smaller one, Adam would make a full step of a gradient that is only rounding error.
                epsilon: 1e-8,
                step: 1,
            },
            dense: false,
        },
        noise: None,
        condition_cap: None,
        angle_cap: None,
    }
}

#[test]
fn steps_agree_with_the_cpu_under_every_option_of_an_update() {
    let Some(gpu) = gpu() else { return };
    let base = usual_update();
    let weights = Regularizers {
        opacity: 0.01,
        opacity_square: 0.002,
        scale: 0.01,
        covariance: 0.1,
    };
    let (splats, camera) = scene(4000, 2, 40);
    let updates = [
        base,
        Update {
            optimizer: Optimizer {
                dense: true,
                ..base.optimizer
            },
            statistics: Some(Statistics::Error),
            ..base
        },
        Update {
            regularizers: weights,
            statistics: Some(Statistics::AbsoluteGradient),
            condition_cap: Some(50.0),
            ..base
        },
        Update {
            regularizers: weights,
            regularized: Regularized::All,
            trained_fraction: 0.6,
            angle_cap: Some(AngleCap {
                center: camera.pose.position.to_array(),
                largest: 0.02,
            }),
            ..base
        },
    ];
    let by_distance = Update {
        rates: Rates {
            means_from: Some(camera.pose.position.to_array()),
            ..base.rates
        },
        ..base
    };
    let updates = updates.into_iter().chain([by_distance]);
    let [v_color, .., error] = gradients(&camera, 6);
    for (case, update) in updates.enumerate() {
        let mut engines = [0, 1].map(|_| Engine::new(SplatState::new(splats.clone())));
        engines[1].use_device(&Device::Gpu(gpu.clone())).unwrap();
        for step in 1..=3 {
            for engine in &mut engines {
                engine.render(camera.into(), &RenderOptions::default());
                engine.backward(&OutputGradient {
                    gather: match update.statistics {
                        Some(Statistics::AbsoluteGradient) => Gather::Absolute,
                        Some(Statistics::Error) => Gather::Error(&error),
                        _ => Gather::Nothing,
                    },
                    ..OutputGradient::of_color(&v_color)
                });
                let mut update = update;
                update.optimizer.step.step = step;
                engine.update(&update);
            }
        }
        let [cpu, gpu] = engines.each_ref().map(Engine::state);
        for (got, expected, name) in [
            (&gpu.splats.means, &cpu.splats.means, "means"),
            (&gpu.splats.quats, &cpu.splats.quats, "quats"),
            (&gpu.splats.log_scales, &cpu.splats.log_scales, "log scales"),
            (&gpu.splats.opacity_logits, &cpu.splats.opacity_logits, "opacity logits"),
            (&gpu.splats.sh, &cpu.splats.sh, "sh"),
            (&gpu.moments[0].means, &cpu.moments[0].means, "first moments of means"),
            (&gpu.moments[1].sh, &cpu.moments[1].sh, "second moments of sh"),
            (&gpu.statistics, &cpu.statistics, "statistics"),
        ] {
            for c in 0..expected.count() {
                let (got, expected) = (got.plane(c), expected.plane(c));
                let scale = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
                let (largest, beyond) = apart(got, expected, 1e-3 * scale);
                assert!(beyond < 2e-3, "case {case}: {name} {c}: {largest} of {scale}, {beyond}");
            }
        }
        assert_eq!(engines[0].visible(), engines[1].visible());
    }
    gpu.check().unwrap();
}

#[test]
fn noise_moves_faint_splats_by_the_given_amount_and_opaque_ones_not_at_all() {
    let Some(gpu) = gpu() else { return };
    let (mut splats, camera) = scene(4000, 0, 50);
    for i in 0..4000 {
        splats.opacity_logits.set(0, i, if i < 2000 { -9.0 } else { 3.0 });
        (0..3).for_each(|c| splats.log_scales.set(c, i, 0.0));
    }
    let mut engine = Engine::new(SplatState::new(splats));
    engine.use_device(&Device::Gpu(gpu)).unwrap();
    engine.render(camera.into(), &RenderOptions::default());
    let before = engine.state().clone();
    let pixels = 83 * 61;
    engine.backward(&OutputGradient::of_color(&vec![0.0; 3 * pixels]));
    engine.update(&Update {
        statistics: None,
        regularizers: Regularizers::default(),
        regularized: Regularized::Visible,
        regularizer_unit: 1.0,
        trained_fraction: 1.0,
        rates: Rates::default(),
        sh_degree: 0,
        optimizer: Optimizer {
            step: AdamStep {
                beta1: 0.9,
                beta2: 0.999,
                epsilon: 1e-15,
                step: 1,
            },
            dense: false,
        },
        noise: Some(Noise {
            amount: 0.01,
            seed: 3,
            step: 17,
        }),
        condition_cap: None,
        angle_cap: None,
    });
    let after = engine.state();
    let (mut squares, mut faint) = (0.0, 0);
    for i in 0..4000 {
        let moved = (0..3).map(|c| f64::from(after.splats.means.get(c, i) - before.splats.means.get(c, i)));
        let square: f64 = moved.map(|d| d * d).sum();
        if before.splats.opacity_logits.get(0, i) < 0.0 {
            squares += square;
            faint += 1;
        } else {
            assert_eq!(square, 0.0);
        }
    }
    // Fade-out at an opacity of 1.2e-4: sigmoid(0.488) = 0.62. The mean of 6,000 squares is within 5 %.
    let deviation = (squares / (3.0 * f64::from(faint))).sqrt();
    assert!((deviation / 0.0062 - 1.0).abs() < 0.05, "{deviation}");
}

/// Every strategy in both ways: harmonics and moments stay on the device, or the whole state is read back, edited and uploaded.
#[test]
fn density_control_with_harmonics_on_the_device_gives_the_same_bits_as_the_whole_state_read_back() {
    type Edit = fn(&mut SplatState);
    let edits: [(&str, Edit); 8] = [
        ("classic", |state| {
            let options = classic::ClassicOptions {
                gradient_threshold: 1e-7,
                small: 0.05,
                min_opacity: 0.05,
                max_scale: Some(0.2),
                max_splats: 5000,
                revised_opacity: true,
            };
            let change = classic::densify(state, &options, &mut Rng::new(1, 1));
            assert!(
                change.cloned > 100 && change.split > 100 && change.pruned > 50,
                "{change:?}"
            );
        }),
        ("reset opacity", |state| classic::reset_opacity(state, 0.01)),
        ("mcmc", |state| {
            let options = mcmc::McmcOptions {
                min_opacity: 0.05,
                growth: 1.05,
                max_splats: 9000,
            };
            let change = mcmc::densify(state, &options, &mut Rng::new(1, 1));
            assert!(change.cloned > 100 && change.pruned > 100, "{change:?}");
        }),
        ("fast", |state| {
            let options = fast::FastOptions {
                target: 4500,
                floor: 100,
                min_opacity: 0.05,
                min_weight: 0.001,
                min_frames: 2.0,
                error_threshold: 1e-9,
                min_extent: 0.5,
            };
            let change = fast::densify(state, &options);
            assert!(change.split > 100 && change.pruned > 100, "{change:?}");
        }),
        ("taming", |state| {
            let options = taming::TamingOptions {
                target: 4500,
                gradient_threshold: 1e-7,
                small: 0.05,
                min_opacity: 0.05,
                max_scale: Some(0.2),
                prunes: true,
                weights: taming::ScoreWeights {
                    gradient: 25.0,
                    error: 10.0,
                    weight: 50.0,
                    opacity: 100.0,
                    extent: 10.0,
                    volume: 25.0,
                },
            };
            let change = taming::densify(state, &options, &mut Rng::new(1, 1));
            assert!(change.cloned > 50 && change.split > 50, "{change:?}");
        }),
        ("fewer", |state| {
            state.gather(&(0..state.len() as u32).filter(|i| i % 3 > 0).collect::<Vec<_>>());
        }),
        ("filter", |state| {
            let (_, camera) = scene(0, 0, 0);
            crate::filter::update(state, &[ViewParams::new(&camera)]);
        }),
        ("nothing", |_| {}),
    ];
    let Some(gpu) = gpu() else { return };
    let (splats, camera) = scene(4000, 2, 60);
    let [v_color, .., error] = gradients(&camera, 6);
    let update = Update {
        statistics: Some(Statistics::Error),
        ..usual_update()
    };
    let train = |engine: &mut Engine| {
        for step in 1..=2 {
            engine.render(camera.into(), &RenderOptions::default());
            engine.backward(&OutputGradient {
                gather: Gather::Error(&error),
                ..OutputGradient::of_color(&v_color)
            });
            let mut update = update;
            update.optimizer.step.step = step;
            engine.update(&update);
        }
    };
    let mut engine = Engine::new(SplatState::default());
    engine.use_device(&Device::Gpu(gpu.clone())).unwrap();
    engine.use_filter(true);
    for (name, edit) in edits {
        let [on_device, whole] = [true, false].map(|stays| {
            *engine.state_mut() = SplatState::new(splats.clone());
            train(&mut engine);
            if stays {
                engine.edit_density(edit);
            } else {
                edit(engine.state_mut());
            }
            let edited = engine.state().clone();
            assert!(stays || edited.moments[1].sh.as_slice().iter().any(|v| *v > 0.0) || edited.is_empty());
            train(&mut engine);
            [edited, engine.state().clone()]
        });
        assert!(on_device == whole, "{name}");
    }
    gpu.check().unwrap();
}

#[test]
fn a_step_without_room_changes_nothing_and_its_repetition_is_that_of_a_step_that_waits() {
    let Some(gpu) = gpu() else { return };
    // Large splats, which touch many tiles each.
    let (mut splats, camera) = scene(300, 1, 70);
    splats
        .log_scales
        .as_mut_slice()
        .iter_mut()
        .for_each(|s| *s = s.max(-2.0));
    let update = Update {
        optimizer: Optimizer {
            dense: true,
            ..usual_update().optimizer
        },
        regularizers: Regularizers {
            opacity: 0.01,
            ..Regularizers::default()
        },
        noise: Some(Noise {
            amount: 0.01,
            seed: 1,
            step: 1,
        }),
        ..usual_update()
    };
    let [v_color, ..] = gradients(&camera, 8);
    let mut engines = [0, 1].map(|_| Engine::new(SplatState::new(splats.clone())));
    for engine in &mut engines {
        engine.use_device(&Device::Gpu(gpu.clone())).unwrap();
    }
    let [ahead, waits] = &mut engines;
    let before = ahead.state().clone();
    let step = |engine: &mut Engine, ahead: bool| {
        if ahead {
            engine.render_ahead(&camera, &RenderOptions::default());
        } else {
            engine.render(camera.into(), &RenderOptions::default());
        }
        engine.backward(&OutputGradient::of_color(&v_color));
        engine.update(&update);
        engine.finish_frame()
    };
    assert!(!step(ahead, true), "there is no room for {}", ahead.intersections());
    assert!(*ahead.state() == before, "a void step changes nothing");
    assert!(step(ahead, true) && step(waits, false));
    assert!(*ahead.state() != before && ahead.state() == waits.state());
    assert_eq!(ahead.intersections(), waits.intersections());
    gpu.check().unwrap();
}
