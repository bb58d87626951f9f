//! Bytes and operations of a training step on a GPU, stage by stage, beside the same counts for gsplat's kernels: a lower bound that
//! needs no graphics card. The numbers of visible splats and of entries are those of the scenes of `speed -- gpu`, found by the kernels
//! themselves.
//!
//! A word of 4 bytes counts each time a kernel reads or writes it, cached or not, except where neighbouring threads read the same word.
//! Every entry of a tile is blended with all 256 pixels: early termination is not subtracted, on either side.

use crate::scale::{camera, scene};
use anyhow::Result;
use irradia_compute::Planes;
use irradia_compute::gpu::{Gpu, Wanted};
use irradia_splat::{GpuRenderer, RenderOptions, Renderer, Splats, ViewParams};

/// Bytes per second and operations (float32, fused as two) per second of an H100 SXM, by its data sheet.
const H100_LIMITS: [f64; 2] = [3.35e12, 67e12];

/// Splats and pixel rows of a part. Rows are whole tiles, so that the counts of parts add up; a part fits into the smallest arrays.
const PART_SPLATS: usize = 500_000;
const PART_ROWS: u32 = 1088;

/// What a frame consists of.
struct Frame {
    splats: f64,
    visible: f64,
    /// Entries of tiles of 16 x 16: exact ellipses here, boxes in gsplat.
    entries: f64,
    boxes: f64,
    pixels: f64,
    tiles: f64,
}

/// Words and operations of a stage.
type Stage = (&'static str, fn(&Frame) -> [f64; 2]);

/// Read off the shaders in `crates/splat/src/gpu/shaders` and `crates/measure/src/gpu/shaders`; harmonics of degree 3, a photograph of 8
/// bits, errors gathered.
const IRRADIA_STAGES: [Stage; 9] = [
    ("project", |f| {
        [13.0 * f.splats + 60.0 * f.visible, 250.0 * f.splats + 160.0 * f.visible]
    }),
    ("bin: prefix sums, lists", |f| {
        let words = 7.0 * f.splats + 23.0 * f.visible + 4.0 * f.entries + 12.0 * f.tiles;
        [words, 20.0 * f.splats + 60.0 * f.visible + 40.0 * f.entries]
    }),
    // Passes of eight bits, each of which reads keys three times, values once, and writes both; 256 counts for 2,048 keys, four times.
    ("bin: sort by depth, 4 passes", |f| {
        [26.0 * f.visible, 240.0 * f.visible]
    }),
    ("bin: sort by tile, 2 passes", |f| [13.0 * f.entries, 120.0 * f.entries]),
    // Slot, splat, footprint; the state of 256 pixels for each 256 entries.
    ("blend", |f| {
        [19.0 * f.entries + 5.0 * f.pixels, 256.0 * 24.0 * f.entries]
    }),
    ("losses: L1, SSIM", |f| [31.5 * f.pixels, 1480.0 * f.pixels]),
    ("blend_vjp", |f| {
        [41.0 * f.entries + 1920.0 * f.tiles, 256.0 * 62.0 * f.entries]
    }),
    ("project_vjp", |f| {
        [
            12.0 * f.entries + f.splats + 93.0 * f.visible,
            12.0 * f.entries + 900.0 * f.visible,
        ]
    }),
    ("update: Adam of visible splats", |f| {
        [2.0 * f.splats + 392.0 * f.visible, 960.0 * f.visible]
    }),
];

/// Read off gsplat's `cuda/csrc` (`ProjectionEWA3DGSFused.cu`, `SphericalHarmonicsCUDA.cu`, `IntersectTile.cu`,
/// `RasterizeToPixels3DGSFwd.cu` and `Bwd.cu`), not packed; CUB's radix sort in passes of eight bits; PyTorch's fused Adam. Losses are
/// not gsplat's.
const GSPLAT_STAGES: [Stage; 8] = [
    ("projection", |f| [19.0 * f.splats, 300.0 * f.splats]),
    ("spherical harmonics", |f| [60.0 * f.splats, 160.0 * f.splats]),
    ("intersections", |f| {
        [
            16.0 * f.splats + 5.0 * f.boxes + f.tiles,
            40.0 * f.splats + 20.0 * f.boxes,
        ]
    }),
    // Keys of 64 bits, of which 46 to 48 are sorted, and values of 32.
    ("sort by tile and depth, 6 passes", |f| {
        [38.0 * f.boxes, 120.0 * f.boxes]
    }),
    ("rasterize forward", |f| {
        [10.0 * f.boxes + 5.0 * f.pixels, 256.0 * 20.0 * f.boxes]
    }),
    // Nine sums of each of eight warps are added by atomics in the L2 cache.
    ("rasterize backward", |f| {
        [82.0 * f.boxes + 9.0 * f.splats + 6.0 * f.pixels, 256.0 * 50.0 * f.boxes]
    }),
    ("projection, harmonics backward", |f| {
        [136.0 * f.splats, 900.0 * f.splats]
    }),
    ("Adam of all parameters", |f| [413.0 * f.splats, 830.0 * f.splats]),
];

/// Prints the tables of RESULTS.md.
pub fn run() -> Result<()> {
    let gpu = Gpu::open(&Wanted::Any)?;
    let mut renderer = GpuRenderer::new(gpu.clone())?;
    for number in [100_000, 1_000_000, 3_000_000] {
        let splats = scene(number);
        for size in [[1920, 1080], [3840, 2160]] {
            let frame = count(&mut renderer, &splats, size);
            gpu.check()?;
            let millions = |n: f64| format!("{:.2} M", 1e-6 * n);
            println!(
                "\n{number} splats, {} x {}: {} visible, {} entries, {} in boxes\n",
                size[0],
                size[1],
                millions(frame.visible),
                millions(frame.entries),
                millions(frame.boxes)
            );
            table("irradia", &IRRADIA_STAGES, &frame);
            table("gsplat", &GSPLAT_STAGES, &frame);
        }
    }
    Ok(())
}

fn table(name: &str, stages: &[Stage], frame: &Frame) {
    println!("| {name} | MB | Gflop | H100: ms by memory | by arithmetic |\n|---|---:|---:|---:|---:|");
    let row = |name: &str, [words, operations]: [f64; 2]| {
        let bytes = 4.0 * words;
        println!(
            "| {name} | {:.0} | {:.1} | {:.3} | {:.3} |",
            1e-6 * bytes,
            1e-9 * operations,
            1e3 * bytes / H100_LIMITS[0],
            1e3 * operations / H100_LIMITS[1]
        );
    };
    let mut sum = [0.0; 2];
    for (name, count) in stages {
        let counts = count(frame);
        row(name, counts);
        if !name.starts_with("losses") {
            sum = [sum[0] + counts[0], sum[1] + counts[1]];
        }
    }
    row("sum without losses", sum);
    println!();
}

fn count(renderer: &mut GpuRenderer, splats: &Splats, [width, height]: [u32; 2]) -> Frame {
    let camera = camera(width, height, 1.0);
    let view = ViewParams::new(&camera);
    let tiles = [width, height].map(|side| side.div_ceil(16));
    let (mut visible, mut entries, mut boxes) = (0, 0, 0u64);
    let mut cpu = Renderer::new();
    for first in (0..splats.len()).step_by(PART_SPLATS) {
        let part: Vec<u32> = (first as u32..splats.len().min(first + PART_SPLATS) as u32).collect();
        let mut part = splats.gather(&part);
        // Harmonics do not affect the counts.
        let mut base = Planes::zeros(3, part.len());
        (0..3).for_each(|c| base.plane_mut(c).copy_from_slice(part.sh.plane(c)));
        part.sh = base;
        renderer.upload(&part, &[]);
        for top in (0..height).step_by(PART_ROWS as usize) {
            let rows = ViewParams {
                principal: [view.principal[0], view.principal[1] - f64::from(top)],
                height: PART_ROWS.min(height - top),
                ..view.clone()
            };
            renderer.render(&rows, &RenderOptions::default());
            entries += renderer.intersections();
        }
        cpu.project(&part, &view, &RenderOptions::default());
        visible += cpu.in_view().len();
        for i in cpu.in_view() {
            let mean = part.mean(*i as usize).into();
            let (Some((center, _)), Some(extent)) = (camera.project(mean), cpu.screen_extent(*i as usize)) else {
                continue;
            };
            // Whole tiles of the box, as `intersect_tile_kernel` counts them.
            let along = |axis: usize| {
                let tile = |x: f32| (x / 16.0).clamp(0.0, tiles[axis] as f32);
                let [low, high] = [-1.0, 1.0].map(|side| tile(center[axis] + side * extent[axis].ceil()));
                (high.ceil() - low.floor()).max(0.0) as u64
            };
            boxes += along(0) * along(1);
        }
    }
    Frame {
        splats: splats.len() as f64,
        visible: visible as f64,
        entries: entries as f64,
        boxes: boxes as f64,
        pixels: f64::from(width) * f64::from(height),
        tiles: f64::from(tiles[0] * tiles[1]),
    }
}
