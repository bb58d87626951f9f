//! Small fields learn a small scene with every sampler, with the same bits for any number of threads and after resuming.

use glam::{Quat, Vec3};
use irradia_field::encoding::{Frequency, HashGrid, PositionEncoding};
use irradia_field::net::NetShape;
use irradia_field::{
    Background, Draw, Field, FieldConfig, FieldError, FieldState, KnownDepth, RayBatch, RenderOptions, Sampler, Space,
    StepLoss, StepOptions, TrainView, render_view, train_step, train_views,
};
use irradia_scene::{Camera, Intrinsics, Pose, Rng};

const SIDE: u32 = 24;

/// Cameras on a ring around the centre, three units away.
fn cameras(n: usize) -> Vec<Camera> {
    (0..n)
        .map(|i| {
            let rotation = Quat::from_rotation_y(i as f32 / n as f32 * std::f32::consts::TAU);
            let pose = Pose {
                position: rotation * Vec3::new(0.0, 0.0, -3.0),
                rotation,
            };
            Camera::new(pose, Intrinsics::from_fov_x(SIDE, SIDE, 0.6))
        })
        .collect()
}

/// An image of a ball of radius 0.6 with a red and a blue half over white, with alpha and depth.
struct Ball {
    rgb: Vec<u8>,
    alpha: Vec<u8>,
    depths: Vec<KnownDepth>,
}

fn ball(camera: &Camera) -> Ball {
    let mut ball = Ball {
        rgb: Vec::new(),
        alpha: Vec::new(),
        depths: Vec::new(),
    };
    for pixel in 0..SIDE * SIDE {
        let (_, d) = camera.ray(glam::Vec2::new(
            (pixel % SIDE) as f32 + 0.5,
            (pixel / SIDE) as f32 + 0.5,
        ));
        let o = camera.pose.position;
        let half = o.dot(d);
        let root = half * half - o.dot(o) + 0.36;
        let hit = (root > 0.0).then(|| -half - root.sqrt());
        let color = match hit {
            Some(t) if (o + t * d).x > 0.0 => [220, 40, 40],
            Some(_) => [40, 40, 220],
            None => [255; 3],
        };
        ball.rgb.extend(color);
        ball.alpha.push(if hit.is_some() { 255 } else { 0 });
        let depth = |t: f32| t * d.dot(camera.pose.rotation * Vec3::Z);
        ball.depths.extend(hit.map(|t| KnownDepth { pixel, depth: depth(t) }));
    }
    ball
}

fn views<'a>(cameras: &'a [Camera], balls: &'a [Ball], with_depth: bool) -> Vec<TrainView<'a>> {
    let view = |i: usize| TrainView {
        camera: &cameras[i],
        rgb: &balls[i].rgb,
        alpha: Some(&balls[i].alpha),
        over: [1.0; 3],
        mask: None,
        depths: if with_depth { &balls[i].depths } else { &[] },
        image: i as u32,
    };
    (0..cameras.len()).map(view).collect()
}

fn grid(finest: u32) -> PositionEncoding {
    PositionEncoding::HashGrid(HashGrid {
        levels: 4,
        features: 2,
        log2_table: 12,
        coarsest: 4,
        finest,
    })
}

fn configs() -> Vec<(&'static str, FieldConfig)> {
    let mut hash = FieldConfig::hash_grid();
    hash.net.encoding = grid(32);
    hash.net.width = 16;
    if let Sampler::Occupancy(o) = &mut hash.sampler {
        o.side = 32;
        o.steps.shortest = 0.03;
    }
    let round = NetShape {
        encoding: grid(16),
        color: None,
        ..hash.net
    };
    let proposal = FieldConfig {
        sampler: Sampler::Proposal {
            rounds: vec![(round, 24)],
            last: 16,
        },
        ..hash.clone()
    };
    let mut nerf = FieldConfig::nerf(16, 16, 16);
    nerf.net.depth = 3;
    nerf.net.skip = Some(2);
    nerf.net.encoding = PositionEncoding::Frequency(Frequency { octaves: 4 });
    vec![("hash grid", hash), ("proposal", proposal), ("nerf", nerf)]
}

fn options() -> StepOptions {
    StepOptions {
        samples: 1 << 13,
        distortion: 0.001,
        ..StepOptions::default()
    }
}

#[test]
fn rays_beyond_the_most_samples_are_left_out() {
    let cameras = cameras(4);
    let balls: Vec<Ball> = cameras.iter().map(ball).collect();
    let space = Space::cube([0.0; 3], 1.2);
    let (_, config) = configs().remove(0);
    let mut batch = RayBatch::default();
    let what = Draw {
        rays: 4000,
        known: 0,
        background: Background::Random,
    };
    batch.draw(&views(&cameras, &balls, false), &what, &space, &mut Rng::new(1, 0));
    let step = |samples: usize| {
        let mut state = FieldState::new(Field::new(config.clone(), space, 1).unwrap());
        train_step(&mut state, &batch, &StepOptions { samples, ..options() })
    };
    let whole = step(usize::MAX);
    assert_eq!(whole.rays, 4000);
    let most = 64 * 1024;
    assert!(whole.samples > 2 * most, "{whole:?}");
    assert_eq!(step(whole.samples), whole, "all fit");
    let cut = step(most / 4);
    // Each of the 32 groups ends with a whole chunk, of 512 samples and those of its last rays.
    assert!((most / 2..most + 32 * 1024).contains(&cut.samples), "{cut:?}");
    let share = |loss: StepLoss| loss.samples as f64 / loss.rays as f64;
    assert!((share(cut) / share(whole) - 1.0).abs() < 0.1, "{cut:?} {whole:?}");
    assert!((cut.color / whole.color - 1.0).abs() < 0.1, "{cut:?} {whole:?}");
}

fn run(state: &mut FieldState, views: &[TrainView], options: &StepOptions, steps: usize) -> StepLoss {
    (0..steps).fold(StepLoss::default(), |_, _| train_views(state, views, options))
}

fn start(config: &FieldConfig) -> FieldState {
    FieldState::new(Field::new(config.clone(), Space::cube([0.0; 3], 1.0), 3).unwrap())
}

/// All tensors of a state, as bits.
fn bits(state: &FieldState) -> Vec<u32> {
    state
        .tensors()
        .iter()
        .flat_map(|(_, _, values)| values.iter().map(|v| v.to_bits()))
        .collect()
}

#[test]
fn every_sampler_learns_a_ball() {
    let cameras = cameras(8);
    let balls: Vec<Ball> = cameras.iter().map(ball).collect();
    let views = views(&cameras[..7], &balls[..7], false);
    for (name, config) in configs() {
        let mut state = start(&config);
        let rates = StepOptions {
            net_rate: if name == "nerf" { 3e-3 } else { 1e-2 },
            ..options()
        };
        let first = train_views(&mut state, &views, &rates).color;
        run(&mut state, &views, &rates, if name == "nerf" { 250 } else { 150 });
        let render = RenderOptions {
            background: [1.0; 3],
            ..RenderOptions::default()
        };
        let out = render_view(&state.field, &cameras[7], &render);
        let pixels = out.alpha.len();
        let squares: f64 = (0..3 * pixels)
            .map(|i| f64::from(out.color[i % 3 * pixels + i / 3] - f32::from(balls[7].rgb[i]) / 255.0).powi(2))
            .sum();
        let psnr = -10.0 * (squares / (3 * pixels) as f64).log10();
        eprintln!("{name}: loss {first:.4} in the first step, {psnr:.1} dB in a held-out view");
        assert!(psnr > 18.0, "{name}: {psnr} dB");
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let cameras = cameras(3);
    let balls: Vec<Ball> = cameras.iter().map(ball).collect();
    let views = views(&cameras, &balls, true);
    for (name, config) in configs() {
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut state = start(&config);
                let loss = run(&mut state, &views, &options(), 18);
                (bits(&state), loss.total.to_bits(), state.rays)
            })
        };
        assert!(with(1) == with(2), "{name}");
    }
}

#[test]
fn a_resumed_run_matches_an_uninterrupted_one() {
    let cameras = cameras(3);
    let balls: Vec<Ball> = cameras.iter().map(ball).collect();
    let mut views = views(&cameras, &balls, true);
    views[0].alpha = None;
    let options = || StepOptions {
        depth: 0.1,
        ..options()
    };
    for (name, mut config) in configs() {
        if let Some(color) = &mut config.net.color {
            color.appearance = 4;
        }
        config.images = 3;
        config.background_degree = Some(1);
        let mut uninterrupted = start(&config);
        run(&mut uninterrupted, &views, &options(), 20);
        let saved = uninterrupted.clone();
        let get = |name: &str| {
            let tensors = saved.tensors();
            let (_, shape, values) = tensors.iter().find(|(n, ..)| n == name)?;
            assert_eq!(shape.iter().product::<usize>(), values.len());
            Some(values.to_vec())
        };
        let space = saved.field.space;
        let mut resumed = FieldState::from_tensors(config.clone(), space, saved.step, saved.rays, get).unwrap();
        let losses = [&mut uninterrupted, &mut resumed].map(|state| run(state, &views, &options(), 20));
        assert_eq!(losses[0], losses[1], "{name}");
        assert!(bits(&uninterrupted) == bits(&resumed), "{name}");
        assert!(
            uninterrupted.field.codes.iter().any(|c| *c != 0.0),
            "{name}: codes are trained"
        );
        assert!(
            uninterrupted.field.background.iter().all(|c| *c != 0.0),
            "{name}: the background of the photograph without alpha is learnt"
        );
        let field = Field::from_tensors(config.clone(), space, get).unwrap();
        assert!(
            render_view(&field, &cameras[0], &RenderOptions::default())
                == render_view(&saved.field, &cameras[0], &RenderOptions::default())
        );
        // A surplus tensor is ignored; a missing one or one of another size is an error that names it.
        let error = FieldState::from_tensors(config.clone(), space, 0, 1, |name| {
            get(name).filter(|_| name != "second.net0.density")
        });
        let text = error.unwrap_err().to_string();
        assert!(
            text.contains("second.net0.density") && text.contains("0 values"),
            "{text}"
        );
        assert!(matches!(
            Field::from_tensors(config, space, |name| get(name).map(|mut v| {
                v.pop();
                v
            })),
            Err(FieldError::Tensor { .. })
        ));
    }
}

#[test]
fn sparse_depth_supervision_also_improves_depth_between_known_pixels() {
    let cameras = cameras(1);
    // Grey everywhere: a single photograph carries no depth. One pixel in nine is known, as for sparse points.
    let is_known = |pixel: u32| (pixel % SIDE) % 3 == 1 && (pixel / SIDE) % 3 == 1;
    let known = (0..SIDE * SIDE).filter(|pixel| is_known(*pixel));
    let grey = Ball {
        rgb: vec![128; (SIDE * SIDE * 3) as usize],
        alpha: vec![255; (SIDE * SIDE) as usize],
        depths: known.map(|pixel| KnownDepth { pixel, depth: 3.3 }).collect(),
    };
    let balls = [grey];
    // In the cube distances are compared directly; in the contracted world the wall lies in the far part, at 1.65 units, and so
    // few steps move it closer without reaching it.
    let cube = |(_, config)| (config, Space::cube([0.0; 3], 1.0), 0.25);
    let far = (configs().remove(1).1, Space::contracted([0.0, 0.0, -3.0], 2.0), 3.0);
    for (config, space, at_most) in configs().into_iter().map(cube).chain([far]) {
        let error = |with_depth: bool| {
            let field = Field::new(config.clone(), space, 3).unwrap();
            let mut state = FieldState::new(field);
            let options = StepOptions {
                depth: 1.0,
                net_rate: 3e-3,
                ..options()
            };
            run(&mut state, &views(&cameras, &balls, with_depth), &options, 150);
            let out = render_view(&state.field, &cameras[0], &RenderOptions::default());
            // The median: the mean along a contracted ray is dominated by faint density hundreds of units away.
            let held_out = (0u32..).zip(&out.median_depth).filter(|(pixel, _)| !is_known(*pixel));
            let errors: Vec<f32> = held_out.map(|(_, d)| (d - 3.3).abs()).collect();
            errors.iter().sum::<f32>() / errors.len() as f32
        };
        let (with, without) = (error(true), error(false));
        eprintln!("mean error of depth {with:.3} with and {without:.3} without supervision");
        assert!(with < at_most && without > 1.7 * with, "{with} and {without}");
    }
}

#[test]
fn a_learnt_background_represents_the_sky() {
    let cameras = cameras(6);
    // The ball in front of a sky whose blue increases upwards (+Y points down), which acts like distant walls outside the cube.
    let blue = |d: Vec3| 0.5 - 0.8 * d.y;
    let mut balls: Vec<Ball> = cameras.iter().map(ball).collect();
    for (camera, ball) in cameras.iter().zip(&mut balls) {
        for pixel in (0..SIDE * SIDE).filter(|pixel| ball.alpha[*pixel as usize] == 0) {
            let at = glam::Vec2::new((pixel % SIDE) as f32 + 0.5, (pixel / SIDE) as f32 + 0.5);
            let sky = [0.2, 0.5, blue(camera.ray(at).1)];
            ball.rgb[3 * pixel as usize..][..3].copy_from_slice(&sky.map(|v| (v * 255.0).round() as u8));
        }
    }
    let mut views = views(&cameras[1..], &balls[1..], false);
    views.iter_mut().for_each(|view| view.alpha = None);
    let (_, config) = configs().remove(0);
    let error = |degree: Option<u32>| {
        let mut state = start(&FieldConfig {
            background_degree: degree,
            ..config.clone()
        });
        run(&mut state, &views, &options(), 200);
        let out = render_view(&state.field, &cameras[0], &RenderOptions::default());
        let pixels = out.alpha.len();
        let squares = |i: usize| (out.color[i % 3 * pixels + i / 3] - f32::from(balls[0].rgb[i]) / 255.0).powi(2);
        (0..3 * pixels).map(squares).sum::<f32>() / (3 * pixels) as f32
    };
    let (with, without) = (error(Some(1)), error(None));
    eprintln!("squared error in a held-out view {with:.5} with a learnt background, {without:.5} without");
    assert!(2.0 * with < without, "{with} and {without}");
}

#[test]
fn a_step_lowers_the_loss_in_proportion_to_the_rate() {
    // A step along Adam's first direction, the sign of the gradient, must lower the loss of the same batch by the rate times the
    // sum of the gradients' magnitudes: at rates so small that the loss is linear, twice the rate doubles the decrease. Samples
    // stay in place, since the random numbers of a step follow from its number.
    let cameras = cameras(2);
    let balls: Vec<Ball> = cameras.iter().map(ball).collect();
    let mut views = views(&cameras, &balls, true);
    views[1].alpha = None;
    for (name, mut config) in configs() {
        config.background_degree = Some(2);
        let fall = |rate: f32| {
            let mut state = start(&config);
            let mut batch = RayBatch::default();
            let what = Draw {
                rays: 300,
                known: 75,
                background: Background::Random,
            };
            batch.draw(&views, &what, &state.field.space, &mut Rng::new(1, 1));
            assert_eq!(batch.depths.iter().filter(|depth| **depth > 0.0).count(), 75);
            let options = StepOptions {
                depth: 0.1,
                table_rate: rate,
                net_rate: rate,
                ..StepOptions::default()
            };
            let before = train_step(&mut state, &batch, &options).total;
            state.step = 0;
            before - train_step(&mut state, &batch, &options).total
        };
        let (once, twice) = (fall(2e-5), fall(4e-5));
        assert!(
            once > 0.0 && (1.7..2.3).contains(&(twice / once)),
            "{name}: {once} and {twice}"
        );
    }
}

#[test]
fn hostile_input_is_rejected_without_panics() {
    let space = Space::cube([0.0; 3], 1.0);
    let mut state = start(&configs()[0].1);
    let before = bits(&state);
    // No photographs, and a fully masked one with fewer pixels than its camera's image.
    assert_eq!(train_views(&mut state, &[], &options()).rays, 0);
    let camera = cameras(1)[0];
    let view = TrainView {
        camera: &camera,
        rgb: &[1, 2],
        alpha: Some(&[]),
        over: [0.0; 3],
        mask: Some(&[0]),
        depths: &[KnownDepth {
            pixel: u32::MAX,
            depth: f32::NAN,
        }],
        image: 77,
    };
    assert_eq!(train_views(&mut state, &[view], &options()).rays, 0);
    assert!(before == bits(&state), "an empty batch changes nothing");
    let tensors = state.tensors();
    let get = |name: &str| Some(tensors.iter().find(|(n, ..)| n == name)?.2.to_vec());
    let restored = FieldState::from_tensors(configs()[0].1.clone(), space, 0, usize::MAX, get).unwrap();
    assert!(
        restored.rays < 1 << 20,
        "a damaged number of rays does not fill the memory"
    );
    let rejected = |change: &dyn Fn(&mut FieldConfig)| {
        let mut config = FieldConfig::hash_grid();
        change(&mut config);
        Field::new(config, space, 0).unwrap_err().to_string()
    };
    assert!(rejected(&|c| c.background_degree = Some(4)).contains("background"));
    assert!(rejected(&|c| c.net.depth = usize::MAX).contains("hidden layers"));
    assert!(rejected(&|c| c.net.width = 12).contains("multiple of 8"));
    assert!(rejected(&|c| c.net.color = None).contains("colour"));
    assert!(rejected(&|c| c.net.encoding = grid(2)).contains("ascending"));
    assert!(rejected(&|c| c.sampler = Sampler::Hierarchy { coarse: 1, fine: 0 }).contains("at least 2"));
}
