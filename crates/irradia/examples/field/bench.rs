//! Speed of networks and encodings, beside the limits of the machine.

use crate::memory;
use crate::peak::Peak;
use anyhow::Result;
use cpu_time::ProcessTime;
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Simd};
use irradia_field::Rows;
use irradia_field::encoding::HashGrid;
use irradia_field::encoding::hash_grid::{LevelPanels, encode_level, encode_level_vjp};
use irradia_field::mlp::{Mlp, MlpShape, MlpTape, PANEL};
use irradia_scene::Rng;

/// CPU seconds of one call: the best of `repeats` after one to warm up. Other load on the machine can only slow a call down,
/// through the caches.
pub fn time(repeats: u32, mut work: impl FnMut()) -> f64 {
    work();
    let calls = (0..repeats).map(|_| {
        let began = ProcessTime::now();
        work();
        began.elapsed().as_secs_f64()
    });
    calls.fold(f64::INFINITY, f64::min)
}

pub fn run() -> Result<()> {
    let level = Level::detect();
    let rate = |_| {
        let began = ProcessTime::now();
        level.run(Peak) / began.elapsed().as_secs_f64() / 1e9
    };
    let peak = (0..ROUNDS).map(rate).fold(0.0, f64::max);
    println!("{}: {peak:.1} GFLOP/s per core in registers", level.name());
    for (inputs, outputs, width, depth) in [
        (32, 16, 32, 1),
        (32, 3, 32, 2),
        (32, 16, 64, 1),
        (64, 4, 64, 8),
        (64, 16, 128, 4),
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
        let [forward, backward] = level.run(NetworkThroughput { shape });
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

/// Rounds of a measurement; the best one counts.
const ROUNDS: u32 = 5;

/// GFLOP/s forward and backward through a network, 512 samples at a time.
struct NetworkThroughput {
    shape: MlpShape,
}

impl Kernel for NetworkThroughput {
    type Output = [f64; 2];

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f64; 2]
    where
        S::F: Lanes<Scalar = f32>,
    {
        let mlp = Mlp::new(self.shape);
        let mut rng = Rng::new(1, 2);
        let parameters = mlp.init(&mut rng);
        let transposed = mlp.transposed(&parameters);
        let panels = 16;
        let mut x = Rows::default();
        x.resize(panels * mlp.inputs() * PANEL, 0.0);
        x.iter_mut().for_each(|x| *x = rng.range(-1.0, 1.0));
        let mut tape = MlpTape::default();
        let (mut grads, mut v_x) = (vec![0.0; parameters.len()], Rows::default());
        let work = (mlp.products() * panels * PANEL * 2) as f64;
        let repeats = (5e9 / work) as u32;
        let (mut forward, mut backward) = (f64::INFINITY, f64::INFINITY);
        // Explicit loops, since a closure would not be compiled for these lanes.
        for _ in 0..ROUNDS {
            let began = ProcessTime::now();
            for _ in 0..repeats {
                mlp.forward(simd, &parameters, &x, &mut tape);
            }
            forward = forward.min(began.elapsed().as_secs_f64() / f64::from(repeats));
            let out = tape.output().to_vec();
            let began = ProcessTime::now();
            for _ in 0..repeats {
                let v = tape.output_gradient();
                v.resize(out.len(), 0.0);
                v.copy_from_slice(&out);
                mlp.backward(simd, &transposed, &x, &mut tape, &mut grads, Some(&mut v_x));
            }
            backward = backward.min(began.elapsed().as_secs_f64() / f64::from(repeats));
        }
        [work / forward / 1e9, 2.0 * work / backward / 1e9]
    }
}

/// Millions of samples per second through a hash grid, forward and including backward, one core, and the limits of memory.
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
    // Samples as along rays: steps of 1/300 on straight lines.
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
    let limits = memory::limits(&grid, samples);
    let million = samples as f64 / 1e6;
    let corners = (samples * levels * 8) as f64;
    println!(
        "{levels} levels of {features}, tables of 2^{log2_table}: {:.2} M samples/s forward, {:.2} backward, {:.2} both, per core; {:.2} ns per corner",
        million / forward,
        million / backward,
        million / (forward + backward),
        (forward + backward) * 1e9 / (2.0 * corners),
    );
    println!(
        "    memory alone, at random places: {:.2} forward ({:.0} %), {:.2} backward ({:.0} %), {:.2} both ({:.0} %); {:.2} ns per read, {:.2} per update",
        million / limits.forward,
        100.0 * limits.forward / forward,
        million / limits.backward,
        100.0 * limits.backward / backward,
        million / (limits.forward + limits.backward),
        100.0 * (limits.forward + limits.backward) / (forward + backward),
        limits.forward * 1e9 / corners,
        limits.backward * 1e9 / corners,
    );
    let gigabytes = (grid.parameters() * size_of::<f32>()) as f64 / 1e9;
    println!(
        "    sequentially: {:.1} GB/s read, {:.1} GB/s read and written",
        gigabytes / limits.read,
        2.0 * gigabytes / limits.update,
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
            let panels = LevelPanels {
                points: self.points,
                row: l * self.grid.features,
                rows,
            };
            encode_level(simd, self.grid, level, self.table, panels, self.to);
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
            let panels = LevelPanels {
                points: self.points,
                row: l * self.grid.features,
                rows,
            };
            let grads = &mut self.grads[level.first * self.grid.features..];
            encode_level_vjp(simd, self.grid, level, panels, self.v, grads);
        }
    }
}
