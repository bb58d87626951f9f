//! Memory-bound limits of a hash grid, measured from its random accesses alone.
//!
//! The encoding can exceed a limit: neighbouring samples on a ray share corners and coarse cells, so that it hits the first-level
//! cache more often than random accesses do.

use crate::bench::time;
use cpu_time::ProcessTime;
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Simd};
use irradia_field::encoding::HashGrid;
use irradia_scene::Rng;
use std::hint::black_box;

/// Seconds of one core.
pub struct Limits {
    /// Eight reads per level and sample.
    pub forward: f64,
    /// Eight reads with a write at the same place per level and sample.
    pub backward: f64,
    /// Reading all tables sequentially.
    pub read: f64,
    /// Reading and writing all tables sequentially.
    pub update: f64,
}

/// The limits for `samples` samples through `grid`, level by level like the encoding.
pub fn limits(grid: &HashGrid, samples: usize) -> Limits {
    match grid.features {
        2 => of_features::<2>(grid, samples),
        4 => of_features::<4>(grid, samples),
        other => unreachable!("no benchmark of {other} features"),
    }
}

fn of_features<const F: usize>(grid: &HashGrid, samples: usize) -> Limits {
    let levels = grid.level_table();
    let mut table = vec![[1.0f32; F]; grid.parameters() / F];
    let mut rng = Rng::new(5, 6);
    // Few enough for the first-level cache; shifted from turn to turn so that they cover the whole table.
    let places: Vec<[u32; 8]> = (0..512).map(|_| std::array::from_fn(|_| rng.below(u32::MAX))).collect();
    let turn = |t: usize| (t as u32).wrapping_mul(2_654_435_761);
    let place =
        |p: u32, t: usize, entries: usize| ((u64::from(p.wrapping_add(turn(t))) * entries as u64) >> 32) as usize;
    let forward = time(20, || {
        let mut sums = [[0.0f32; F]; 8];
        for level in &levels {
            let table = &table[level.first..level.first + level.entries];
            for t in 0..samples / places.len() {
                for eight in &places {
                    for k in 0..8 {
                        let entry = &table[place(eight[k], t, level.entries)];
                        for f in 0..F {
                            sums[k][f] += entry[f];
                        }
                    }
                }
            }
        }
        black_box(sums);
    });
    let backward = time(20, || {
        for level in &levels {
            let table = &mut table[level.first..level.first + level.entries];
            for t in 0..samples / places.len() {
                for eight in &places {
                    for p in eight {
                        let entry = &mut table[place(*p, t, level.entries)];
                        for f in 0..F {
                            entry[f] += 1.0;
                        }
                    }
                }
            }
        }
    });
    let [read, update] = Level::detect().run(Stream {
        numbers: table.as_flattened_mut(),
    });
    Limits {
        forward,
        backward,
        read,
        update,
    }
}

/// Seconds to read all numbers in order, and to read and write them.
struct Stream<'a> {
    numbers: &'a mut [f32],
}

impl Kernel for Stream<'_> {
    type Output = [f64; 2];

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f64; 2]
    where
        S::F: Lanes<Scalar = f32>,
    {
        let mut best = [f64::INFINITY; 2];
        let mut sums = [simd.splat(0.0); 4];
        for _ in 0..20 {
            let began = ProcessTime::now();
            for four in self.numbers.chunks_exact(4 * S::LANES) {
                for k in 0..4 {
                    sums[k] += simd.load(&four[k * S::LANES..]);
                }
            }
            best[0] = best[0].min(began.elapsed().as_secs_f64());
            let began = ProcessTime::now();
            for one in self.numbers.chunks_exact_mut(S::LANES) {
                (simd.load(one) + simd.splat(1.0)).store(one);
            }
            best[1] = best[1].min(began.elapsed().as_secs_f64());
        }
        black_box(sums);
        best
    }
}
