//! Speed and size of every splat format: `cargo run --release -p irradia-formats --example formats [COUNT] [DEGREE]`.
//!
//! Writes a synthetic scene to a temporary folder, reads it back from the warm file system, and prints splats and bytes per second (the
//! best of three), the size, and the peak memory of each beyond the scene itself.

use irradia_formats::{
    Quality, SplatFormat, SpzVersion, WriteOptions, read_splats, splat_file_size, write_splats_with,
};
use irradia_scene::{GaussianCloud, Rng, sh};
use rayon::prelude::*;
use std::time::Instant;

/// A scene with the statistics of trained ones: surfaces, sizes over a few powers of e, colours that vary slowly, small harmonics.
fn scene(count: usize, sh_degree: u32) -> GaussianCloud {
    let width = 3 * sh::coefficients(sh_degree);
    let mut cloud = GaussianCloud {
        means: vec![[0.0; 3]; count],
        quats: vec![[0.0; 4]; count],
        log_scales: vec![[0.0; 3]; count],
        opacity_logits: vec![0.0; count],
        sh: vec![0.0; count * width],
        sh_degree,
        ..GaussianCloud::default()
    };
    let columns = cloud
        .means
        .par_iter_mut()
        .zip(&mut cloud.quats)
        .zip(&mut cloud.log_scales);
    let rest = cloud.opacity_logits.par_iter_mut().zip(cloud.sh.par_chunks_mut(width));
    columns
        .zip(rest)
        .enumerate()
        .for_each(|(i, (((mean, quat), scale), (opacity, sh)))| {
            let rng = &mut Rng::new(i as u64, 5);
            let mut normal = || (0..4).map(|_| rng.range(-1.0, 1.0)).sum::<f32>();
            let (u, v) = (4.0 * normal(), 4.0 * normal());
            *mean = [u, v, (0.7 * u).sin() + (0.9 * v).cos() + 0.02 * normal()];
            *quat = [0; 4].map(|_| normal());
            *scale = [0; 3].map(|_| -5.0 + normal());
            *opacity = 2.0 * normal();
            for (k, value) in sh.iter_mut().enumerate() {
                *value = match k {
                    ..3 => (u + k as f32).sin() + 0.3 * normal(),
                    _ => 0.08 * normal(),
                };
            }
        });
    cloud
}

/// Peak resident memory of the process since the last reset, bytes; 0 if the system does not report it.
fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM"));
    line.and_then(|line| line.split_whitespace().nth(1)?.parse::<u64>().ok())
        .unwrap_or(0)
        * 1024
}

/// Processor seconds of all threads so far, in steps of 0.01; 0 if the system does not report them.
fn cpu_seconds() -> f64 {
    let status = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The fields after the parenthesised name, which may contain spaces.
    let fields = status.rsplit(')').next().unwrap_or_default();
    let ticks = |field: usize| fields.split_whitespace().nth(field).and_then(|v| v.parse::<f64>().ok());
    (ticks(11).unwrap_or(0.0) + ticks(12).unwrap_or(0.0)) / 100.0
}

/// Seconds of the best of three runs, their mean processor seconds, and the peak memory beyond that before the first.
fn measure<T>(mut run: impl FnMut() -> T) -> (f64, f64, u64) {
    // Writing 5 resets the peak (proc(5)).
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    let (memory_before, cpu_before) = (peak_memory(), cpu_seconds());
    let seconds = (0..3).map(|_| {
        let started = Instant::now();
        std::hint::black_box(run());
        started.elapsed().as_secs_f64()
    });
    let seconds = seconds.fold(f64::INFINITY, f64::min);
    (
        seconds,
        (cpu_seconds() - cpu_before) / 3.0,
        peak_memory().saturating_sub(memory_before),
    )
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let count: usize = arguments
        .next()
        .map_or(1_000_000, |count| count.parse().expect("a number of splats"));
    let degree: u32 = arguments.next().map_or(3, |degree| degree.parse().expect("a degree"));
    let cloud = scene(count, degree);
    let bytes = 4.0 * (14 + 3 * (sh::coefficients(degree) - 1)) as f64 * count as f64;
    println!(
        "{count} splats of degree {degree}, {:.0} MB; {} threads",
        bytes / 1e6,
        rayon::current_num_threads()
    );
    println!(
        "format              size MB   write Msplat/s (MB/s)   read Msplat/s (MB/s)   CPU s/Msplat: write read   extra memory, scenes: write read"
    );
    let folder = tempfile::tempdir().expect("a temporary folder");
    let normal = WriteOptions::default();
    let cases = [
        ("a.ply", normal),
        ("a.compressed.ply", normal),
        ("a.spz", normal),
        (
            "a.spz",
            WriteOptions {
                spz_version: SpzVersion::V4,
                ..normal
            },
        ),
        ("a.splat", normal),
        ("a.ksplat", normal),
        (
            "a.ksplat",
            WriteOptions {
                quality: Quality::High,
                ..normal
            },
        ),
        ("a.glb", normal),
        ("a.spz.glb", normal),
        (
            "a.sog",
            WriteOptions {
                quality: Quality::Low,
                ..normal
            },
        ),
        ("a.sog", normal),
        ("a.npz", normal),
    ];
    for (name, options) in cases {
        let path = folder.path().join(name);
        let format = SplatFormat::of(&path).expect("known");
        let (write, write_cpu, write_memory) = measure(|| write_splats_with(&path, &cloud, &options).expect("written"));
        let size = splat_file_size(&path).expect("written");
        let (read, read_cpu, read_memory) = if format.is_readable() {
            measure(|| read_splats(&path).expect("read"))
        } else {
            (f64::NAN, f64::NAN, 0)
        };
        let rate = |seconds: f64| {
            format!(
                "{:8.2} ({:5.0})",
                count as f64 / seconds / 1e6,
                size as f64 / seconds / 1e6
            )
        };
        println!(
            "{:<18} {:>8.1}   {:>20}   {:>20}   {:>6.2} {:>6.2}   {:>6.2} {:>6.2}   {:?}",
            format!(
                "{} {}",
                &name[1..],
                if name == "a.spz" {
                    format!("{:?}", options.spz_version)
                } else {
                    String::new()
                }
            ),
            size as f64 / 1e6,
            rate(write),
            rate(read),
            write_cpu / count as f64 * 1e6,
            read_cpu / count as f64 * 1e6,
            write_memory as f64 / bytes,
            read_memory as f64 / bytes,
            options.quality
        );
    }
}
