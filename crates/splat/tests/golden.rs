//! Forward and backward against an independent double-precision implementation (`../shared/golden`).

use irradia_compute::Planes;
use irradia_compute::simd::Level;
use irradia_scene::GaussianCloud;
use irradia_splat::{FramePlanes, Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams};
use irradia_testkit::{Golden, max_abs_difference, relative_difference, shared};

/// The cases in this project's conventions. `c1` (off-centre principal point) and `c4` test the projection's clamp; their
/// `symclamp` variants test Inria's, symmetric about the axis, which is not used here.
const CASES: [&str; 5] = [
    "c0_n50_64x64_sh0",
    "c1_n500_128x96_sh1",
    "c2_n500_128x96_sh2_aa",
    "c3_n3000_200x120_sh3",
    "c4_n60_edge_77x53_sh3",
];

/// A gradient's elements must be accurate to two thousandths of their value plus this fraction of the array's largest: the error of
/// single precision in cancelling sums over hundreds of pixels (1.7e-3 was seen).
const GRADIENT_TOLERANCE: f64 = 1e-3;

fn splats(golden: &Golden) -> Splats {
    let columns = |name: &str| golden.get_f32(name);
    Splats::from_cloud(&GaussianCloud {
        means: columns("means").as_chunks().0.to_vec(),
        quats: columns("quats").as_chunks().0.to_vec(),
        log_scales: columns("log_scales").as_chunks().0.to_vec(),
        opacity_logits: columns("logit_opac"),
        sh: columns("sh"),
        sh_degree: golden.scalar("sh_degree") as u32,
        ..GaussianCloud::default()
    })
}

fn view(golden: &Golden) -> ViewParams {
    let (v, k) = (golden.get("viewmat"), golden.get("K"));
    ViewParams {
        rotation: std::array::from_fn(|i| std::array::from_fn(|j| v[4 * i + j])),
        translation: std::array::from_fn(|i| v[4 * i + 3]),
        focal: [k[0], k[4]],
        principal: [k[2], k[5]],
        width: golden.scalar("width") as u32,
        height: golden.scalar("height") as u32,
        near: 0.01,
        lens: None,
    }
}

fn options(golden: &Golden) -> RenderOptions {
    RenderOptions {
        background: golden.get_f32("background").try_into().expect("three channels"),
        sh_degree: golden.scalar("sh_degree") as u32,
        antialias: golden.scalar("antialias") != 0.0,
        depth: true,
        ..RenderOptions::default()
    }
}

/// `[3, H, W]` from `[H, W, 3]`.
fn planar(interleaved: &[f64]) -> Vec<f32> {
    (0..3)
        .flat_map(|c| interleaved.iter().skip(c).step_by(3).map(|v| *v as f32))
        .collect()
}

fn interleaved(planar: &[f32]) -> Vec<f64> {
    let pixels = planar.len() / 3;
    (0..planar.len())
        .map(|i| f64::from(planar[(i % 3) * pixels + i / 3]))
        .collect()
}

fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// 1e-4 would do; 2e-5 is what single precision achieves (golden/README.md).
const IMAGE_TOLERANCE: f64 = 2e-5;

fn check_images(case: &str, device: &str, golden: &Golden, frame: FramePlanes) {
    let robust = golden.get("fragile");
    for (name, got, channels, scale) in [
        ("out_rgb", interleaved(frame.color), 3, 1.0),
        ("out_alpha", widen(frame.alpha), 1, 1.0),
        ("out_depth_acc", widen(frame.depth), 1, 10.0),
    ] {
        let d = max_abs_difference(&got, golden.get(name), |i| robust[i / channels] == 0.0);
        println!("{case} {device} {name}: {:.2e}", d.worst);
        assert!(d.worst < IMAGE_TOLERANCE * scale, "{case} {device} {name}: {d:?}");
    }
}

/// The two sets of gradients: with and without that of depth.
fn gradient_sets(depth: &[f32]) -> [(&'static str, Option<&[f32]>); 2] {
    [("gradA", None), ("gradB", Some(depth))]
}

fn check_gradients(case: &str, device: &str, set: &str, golden: &Golden, gradients: &SplatGradients) {
    assert_eq!(gradients.non_finite, 0);
    // Inactive splats hold unspecified numbers.
    let active = |column: &Planes| {
        let mut got = column.to_interleaved();
        for (i, item) in got.chunks_mut(column.count()).enumerate() {
            if gradients.active[i] == 0.0 {
                item.fill(0.0);
            }
        }
        widen(&got)
    };
    let check = |name: &str, got: &[f64], expected: &[f64]| {
        let d = relative_difference(got, expected, GRADIENT_TOLERANCE);
        println!("{case} {device} {set}_{name}: {:.2e}", d.worst);
        assert!(d.worst < 2e-3, "{case} {device} {set}_{name}: {d:?}");
    };
    let names = ["means", "quats", "log_scales", "logit_opac", "sh"];
    for (name, column) in names.iter().zip(gradients.splats.columns()) {
        check(name, &active(column), golden.get(&format!("{set}_{name}")));
    }
    check(
        "means2d",
        &active(&gradients.screen),
        golden.get(&format!("{set}_means2d")),
    );
    if set == "gradA" {
        let expected = golden.get("gradA_means2d_abs");
        check("means2d_abs", &active(&gradients.gathered), expected);
    }
    let camera = gradients.camera.expect("requested");
    // The last row, 0 0 0 1, is not a parameter here.
    let mut got = vec![0.0; 12];
    for i in 0..3 {
        got[4 * i..4 * i + 3].copy_from_slice(&camera.rotation[i]);
        got[4 * i + 3] = camera.translation[i];
    }
    check("viewmat", &got, &golden.get(&format!("{set}_viewmat"))[..12]);
}

#[test]
fn images_agree() {
    for case in CASES {
        let Some(path) = shared(&format!("golden/{case}.safetensors")) else {
            return;
        };
        let golden = Golden::read(&path);
        for level in Level::all() {
            let mut renderer = Renderer::with_level(level);
            renderer.render(&splats(&golden), &view(&golden), &options(&golden));
            check_images(case, level.name(), &golden, renderer.frame());
        }
    }
}

#[test]
fn gradients_agree() {
    for case in CASES {
        let Some(path) = shared(&format!("golden/{case}.safetensors")) else {
            return;
        };
        let golden = Golden::read(&path);
        let splats = splats(&golden);
        for level in Level::all() {
            let mut renderer = Renderer::with_level(level);
            renderer.render(&splats, &view(&golden), &options(&golden));
            let color = planar(golden.get("W1"));
            let (alpha, depth) = (golden.get_f32("W2"), golden.get_f32("W3"));
            for (set, depth) in gradient_sets(&depth) {
                let v_out = OutputGradient {
                    color: &color,
                    alpha: Some(&alpha),
                    depth,
                    gather: Gather::Absolute,
                    camera: true,
                };
                let mut gradients = SplatGradients::default();
                renderer.backward(&splats, &v_out, &mut gradients);
                check_gradients(case, level.name(), set, &golden, &gradients);
            }
        }
    }
}

#[cfg(feature = "gpu")]
#[test]
fn images_and_gradients_agree_on_the_gpu() {
    use irradia_compute::{Device, DeviceChoice};
    use irradia_splat::{Engine, SplatState};

    let Some(device) = irradia_testkit::gpu_or_skip(|| Device::open(&DeviceChoice::Gpu)) else {
        return;
    };
    for case in CASES {
        let Some(path) = shared(&format!("golden/{case}.safetensors")) else {
            return;
        };
        let golden = Golden::read(&path);
        let splats = splats(&golden);
        // In the order of the file.
        let mut engine = Engine::new(SplatState {
            moments: [splats.clone(), splats.clone()],
            statistics: Planes::zeros(SplatState::STATISTICS, splats.len()),
            filter: Planes::zeros(1, splats.len()),
            splats,
        });
        engine.use_device(&device).expect("a usable GPU");
        engine.render_view(&view(&golden), &options(&golden));
        check_images(case, "gpu", &golden, engine.frame());
        let color = planar(golden.get("W1"));
        let (alpha, depth) = (golden.get_f32("W2"), golden.get_f32("W3"));
        for (set, depth) in gradient_sets(&depth) {
            engine.backward(&OutputGradient {
                color: &color,
                alpha: Some(&alpha),
                depth,
                gather: Gather::Absolute,
                camera: true,
            });
            check_gradients(case, "gpu", set, &golden, engine.read_gradients());
        }
        engine.check_device().expect("no failure");
    }
}
