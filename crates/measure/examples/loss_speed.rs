//! Timings of the loss and the metrics: `cargo run --release -p irradia-measure --example loss_speed [WEIGHTS]`,
//! with the path of LPIPS weights to time LPIPS, too. `IRRADIA_SIMD=avx2` or `portable` selects narrower instructions.
//!
//! On one thread wall time is CPU time; each figure is the median of many runs.

use irradia_compute::Level;
use irradia_measure::{
    CoarseLoss, Crop, DepthGradient, DepthKind, DepthLoss, DepthPlanes, DepthSample, LossWeights, Lpips,
    PhotometricLoss, SmoothLoss, Smoothed, Target, Truth, perceptual, psnr, ssim,
};
use irradia_scene::{Image, Rng};
use std::hint::black_box;
use std::time::Instant;

/// Median seconds of `work`.
fn seconds(runs: usize, mut work: impl FnMut()) -> f64 {
    work();
    let mut times: Vec<f64> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[runs / 2]
}

fn with_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.expect("a pool of threads").install(work)
}

/// The photometric loss, in milliseconds: on one thread, and on two.
fn loss_times(width: usize, height: usize, weights: &LossWeights, eight_bits: bool, mask: Option<&[u8]>) -> [f64; 2] {
    let mut rng = Rng::new(1, 0);
    let count = 3 * width * height;
    let render: Vec<f32> = (0..count).map(|_| rng.uniform()).collect();
    let planes: Vec<f32> = (0..count).map(|_| rng.uniform()).collect();
    let bytes: Vec<u8> = (0..count).map(|_| rng.below(256) as u8).collect();
    let target = Target {
        width,
        height,
        truth: if eight_bits {
            Truth::Rgb8(&bytes)
        } else {
            Truth::Planar(&planes)
        },
        mask,
    };
    [1, 2].map(|threads| {
        with_threads(threads, || {
            let mut v_render = vec![0.0; count];
            let mut loss = PhotometricLoss::new();
            1e3 * seconds(200, || {
                black_box(loss.evaluate(black_box(&render), &target, weights, &mut v_render));
            })
        })
    })
}

/// The losses other than the photometric one, on one thread.
fn curriculum_times(width: usize, height: usize, net: Option<&Lpips>) {
    let mut rng = Rng::new(3, 0);
    let pixels = width * height;
    let render: Vec<f32> = (0..3 * pixels).map(|_| rng.uniform()).collect();
    let bytes: Vec<u8> = (0..3 * pixels).map(|_| rng.below(256) as u8).collect();
    let depth: Vec<f32> = (0..pixels).map(|_| 1.0 + rng.uniform()).collect();
    let alpha = vec![1.0; pixels];
    let samples: Vec<DepthSample> = (0..2000)
        .map(|_| DepthSample {
            pixel: rng.below(pixels as u32),
            depth: 1.0 + rng.uniform(),
            weight: 1.0,
        })
        .collect();
    let target = Target {
        width,
        height,
        truth: Truth::Rgb8(&bytes),
        mask: None,
    };
    let (mut v, mut v_depth, mut v_alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels], vec![0.0; pixels]);
    let print = |name: &str, seconds: f64| println!("{width}x{height} {name:<30} {:7.3} ms of CPU", 1e3 * seconds);
    for factor in [2, 8] {
        let mut loss = CoarseLoss::default();
        let time = seconds(100, || {
            _ = black_box(loss.evaluate(&render, &target, factor, 1.0, &mut v))
        });
        print(&format!("coarse, cells of {factor}"), time);
    }
    let frame = DepthPlanes {
        depth: &depth,
        alpha: &alpha,
    };
    let mut gradient = DepthGradient {
        depth: &mut v_depth,
        alpha: &mut v_alpha,
    };
    let mut loss = DepthLoss::default();
    let kind = DepthKind::Relative;
    let time = seconds(100, || {
        _ = black_box(loss.evaluate(frame, &samples, kind, 1.0, &mut gradient));
    });
    print("depth, 2000 samples", time);
    let mut loss = SmoothLoss::default();
    let of = Smoothed::Disparity;
    let time = seconds(100, || {
        _ = black_box(loss.evaluate(frame, &target, of, 10.0, 1.0, &mut gradient));
    });
    print("smoothness", time);
    let Some(net) = net else { return };
    for side in [64, 128, usize::MAX] {
        let crop = Crop::random(width, height, side, &mut rng);
        let time = seconds(10, || {
            _ = black_box(perceptual(net, &render, &target, crop, 1.0, &mut v));
        });
        print(&format!("LPIPS of {}x{}", crop.width, crop.height), time);
    }
}

fn main() {
    println!("instructions: {}", Level::detect().name());
    let classic = LossWeights::photometric(0.2);
    for (width, height) in [(270, 480), (540, 960), (1080, 1920)] {
        let pixels = width * height;
        let mask = vec![255; pixels];
        for (name, weights, eight_bits, mask) in [
            ("L1 + SSIM, 8-bit truth", classic, true, None),
            ("L1 + SSIM, 8-bit truth, mask", classic, true, Some(mask.as_slice())),
            ("L1 + SSIM, planar truth", classic, false, None),
            ("L1 alone, 8-bit truth", LossWeights::photometric(0.0), true, None),
        ] {
            let [one, two] = loss_times(width, height, &weights, eight_bits, mask);
            println!(
                "{width}x{height} {name:<30} {one:7.3} ms of CPU, {:6.2} ns per pixel; {two:7.3} ms with 2 threads",
                1e6 * one / pixels as f64
            );
        }
    }
    let net = std::env::args()
        .nth(1)
        .map(|path| Lpips::load(path).unwrap_or_else(|error| panic!("{error}")));
    with_threads(1, || curriculum_times(270, 480, net.as_ref()));
    for (width, height) in [(270, 480), (540, 960)] {
        let mut rng = Rng::new(2, 0);
        let mut image = || {
            Image::new(
                width,
                height,
                3,
                (0..3 * width * height).map(|_| rng.uniform()).collect(),
            )
        };
        let (a, b) = (image(), image());
        for threads in [1, 2] {
            let (psnr, ssim, lpips) = with_threads(threads, || {
                let psnr = seconds(20, || _ = black_box(psnr(&a, &b)));
                let ssim = seconds(20, || _ = black_box(ssim(&a, &b)));
                let lpips = net
                    .as_ref()
                    .map(|net| seconds(10, || drop(black_box(net.distance(&a, &b)))));
                (psnr, ssim, lpips)
            });
            let lpips = lpips.map_or("not timed".into(), |s| format!("{:.1} ms", 1e3 * s));
            println!(
                "{width}x{height} metrics, {threads} threads: PSNR {:.2} ms, SSIM {:.1} ms, LPIPS {lpips}",
                1e3 * psnr,
                1e3 * ssim
            );
        }
    }
}
