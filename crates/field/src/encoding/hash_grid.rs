//! Multi-resolution hash tables with trilinear interpolation (Mueller et al. 2022, section 3).
//!
//! A level of N cells per side has its features at the (N + 1)^3 corners: stored directly if they fit the table, else indexed by
//! the corner's hash (equation 4). The features of a corner are contiguous, so that reading them is one access.

use crate::Num;
use crate::mlp::PANEL;
use irradia_compute::simd::{Lanes, Scalar, Simd};
use irradia_compute::unroll;
use serde::{Deserialize, Serialize};

/// Maximum number of features per level.
pub const MAX_FEATURES: usize = 8;

/// Sizes of the encoding.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HashGrid {
    /// L, number of resolutions.
    pub levels: usize,
    /// F, features per corner: 1, 2, 4 or 8.
    pub features: usize,
    /// log2 of T, the maximum number of entries per level.
    pub log2_table: u32,
    /// N_min, cells per side of the coarsest level.
    pub coarsest: u32,
    /// N_max, cells per side of the finest level.
    pub finest: u32,
}

/// One level: its part of the table and how corners index it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridLevel {
    /// Cells per side.
    pub cells: u32,
    /// Number of entries.
    pub entries: usize,
    /// Index of the first entry in the whole table.
    pub first: usize,
    /// Whether corners are stored directly, x fastest, without hashing.
    pub dense: bool,
}

impl HashGrid {
    /// The levels, coarsest first (equations 2 and 3).
    pub fn level_table(&self) -> Vec<GridLevel> {
        let steps = (self.levels.max(2) - 1) as f64;
        let growth = ((f64::from(self.finest).ln() - f64::from(self.coarsest).ln()) / steps).exp();
        let mut levels: Vec<GridLevel> = Vec::new();
        for l in 0..self.levels {
            // The epsilon makes the last level exactly `finest` despite rounding.
            let cells = (f64::from(self.coarsest) * growth.powi(l as i32) + 1e-6).floor() as u32;
            let corners = (u64::from(cells) + 1).pow(3);
            let dense = corners <= 1 << self.log2_table;
            levels.push(GridLevel {
                cells,
                entries: if dense { corners as usize } else { 1 << self.log2_table },
                first: levels.last().map_or(0, |l| l.first + l.entries),
                dense,
            });
        }
        levels
    }

    /// Number of parameters in all tables.
    pub fn parameters(&self) -> usize {
        self.level_table().last().map_or(0, |l| l.first + l.entries) * self.features
    }
}

/// Panels of points, and where one level's features are among those of all levels.
#[derive(Clone, Copy, Debug)]
pub struct LevelPanels<'a, T> {
    /// `[panels, 3, 32]` points in \[0, 1\]; others are clamped.
    pub points: &'a [T],
    /// First row of the level's features, or of their gradients.
    pub row: usize,
    /// Rows of each panel, those of all levels.
    pub rows: usize,
}

/// The eight corners around each sample of a panel: entry indices and weights.
struct Corners<T> {
    index: [[u32; PANEL]; 8],
    weight: [[T; PANEL]; 8],
}

/// Primes of equation 4; x is not multiplied, so that neighbours along x are neighbours in memory.
const PRIMES: [u32; 2] = [2_654_435_761, 805_459_861];

#[inline(always)]
fn find_corners<S: Simd>(simd: S, level: &GridLevel, points: &[Num<S>], out: &mut Corners<Num<S>>) {
    let mut whole = [[0u32; PANEL]; 3];
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let cells = simd.splat(f64::from(level.cells));
    // A point on the far face belongs to the last cell.
    let last = simd.splat(f64::from(level.cells - 1));
    for s in (0..PANEL).step_by(S::LANES) {
        let mut fraction = [zero; 3];
        for c in 0..3 {
            let p = simd.load(&points[c * PANEL + s..]).max(zero).min(one) * cells;
            let floor = p.floor().min(last);
            fraction[c] = p - floor;
            let mut floors = [Num::<S>::default(); PANEL];
            floor.store(&mut floors);
            for i in 0..S::LANES {
                whole[c][s + i] = floors[i].to_u32();
            }
        }
        let [x, y, z] = fraction;
        let (x0, y0, z0) = (one - x, one - y, one - z);
        let plane = [y0 * z0, y * z0, y0 * z, y * z];
        for k in 0..4 {
            (x0 * plane[k]).store(&mut out.weight[2 * k][s..]);
            (x * plane[k]).store(&mut out.weight[2 * k + 1][s..]);
        }
    }
    let [x, y, z] = whole;
    if level.dense {
        let side = level.cells + 1;
        for s in 0..PANEL {
            let at = x[s] + side * (y[s] + side * z[s]);
            let rows = [at, at + side, at + side * side, at + side * side + side];
            for k in 0..4 {
                out.index[2 * k][s] = rows[k];
                out.index[2 * k + 1][s] = rows[k] + 1;
            }
        }
    } else {
        let mask = level.entries as u32 - 1;
        for s in 0..PANEL {
            let y0 = y[s].wrapping_mul(PRIMES[0]);
            let z0 = z[s].wrapping_mul(PRIMES[1]);
            let (y1, z1) = (y0.wrapping_add(PRIMES[0]), z0.wrapping_add(PRIMES[1]));
            let rows = [y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1];
            for k in 0..4 {
                out.index[2 * k][s] = (x[s] ^ rows[k]) & mask;
                out.index[2 * k + 1][s] = ((x[s] + 1) ^ rows[k]) & mask;
            }
        }
    }
}

impl<T: Scalar> Corners<T> {
    #[inline(always)]
    fn new() -> Self {
        Self {
            index: [[0; PANEL]; 8],
            weight: [[T::default(); PANEL]; 8],
        }
    }
}

/// Encodes panels of points at one level, to rows `row..row + F` of `to [panels, rows, 32]`.
#[inline(always)]
pub fn encode_level<S: Simd>(
    simd: S,
    grid: &HashGrid,
    level: &GridLevel,
    table: &[Num<S>],
    panels: LevelPanels<'_, Num<S>>,
    to: &mut [Num<S>],
) {
    match grid.features {
        1 => encode_features::<S, 1>(simd, level, table, panels, to),
        2 => encode_features::<S, 2>(simd, level, table, panels, to),
        4 => encode_features::<S, 4>(simd, level, table, panels, to),
        _ => encode_features::<S, 8>(simd, level, table, panels, to),
    }
}

#[inline(always)]
fn encode_features<S: Simd, const F: usize>(
    simd: S,
    level: &GridLevel,
    table: &[Num<S>],
    panels: LevelPanels<'_, Num<S>>,
    to: &mut [Num<S>],
) {
    let LevelPanels { points, row, rows } = panels;
    let table = &table.as_chunks::<F>().0[level.first..level.first + level.entries];
    let mut corners = Corners::new();
    for (points, to) in points.chunks_exact(3 * PANEL).zip(to.chunks_exact_mut(rows * PANEL)) {
        find_corners(simd, level, points, &mut corners);
        let to = &mut to.as_chunks_mut::<PANEL>().0[row..row + F];
        for s in 0..PANEL {
            let mut sum = [Num::<S>::default(); F];
            for k in 0..8 {
                let entry = &table[corners.index[k][s] as usize];
                let weight = corners.weight[k][s];
                for f in 0..F {
                    sum[f] = sum[f] + entry[f] * weight;
                }
            }
            for f in 0..F {
                to[f][s] = sum[f];
            }
        }
    }
}

/// The VJP of [`encode_level`] in the table: adds to one level's `grads [entries, F]`, in sample order.
///
/// `v [panels, rows, 32]` holds this level in rows `row..row + F`. A sample whose gradient is zero costs one test.
#[inline(always)]
pub fn encode_level_vjp<S: Simd>(
    simd: S,
    grid: &HashGrid,
    level: &GridLevel,
    panels: LevelPanels<'_, Num<S>>,
    v: &[Num<S>],
    grads: &mut [Num<S>],
) {
    match grid.features {
        1 => features_vjp::<S, 1>(simd, level, panels, v, grads),
        2 => features_vjp::<S, 2>(simd, level, panels, v, grads),
        4 => features_vjp::<S, 4>(simd, level, panels, v, grads),
        _ => features_vjp::<S, 8>(simd, level, panels, v, grads),
    }
}

#[inline(always)]
fn features_vjp<S: Simd, const F: usize>(
    simd: S,
    level: &GridLevel,
    panels: LevelPanels<'_, Num<S>>,
    v: &[Num<S>],
    grads: &mut [Num<S>],
) {
    let LevelPanels { points, row, rows } = panels;
    let grads = &mut grads.as_chunks_mut::<F>().0[..level.entries];
    let mut corners = Corners::new();
    for (points, v) in points.chunks_exact(3 * PANEL).zip(v.chunks_exact(rows * PANEL)) {
        find_corners(simd, level, points, &mut corners);
        let v = &v.as_chunks::<PANEL>().0[row..row + F];
        for s in 0..PANEL {
            let mut g = [Num::<S>::default(); F];
            for f in 0..F {
                g[f] = v[f][s];
            }
            if g == [Num::<S>::default(); F] {
                continue;
            }
            for k in 0..8 {
                let entry = &mut grads[corners.index[k][s] as usize];
                let weight = corners.weight[k][s];
                for f in 0..F {
                    entry[f] = entry[f] + g[f] * weight;
                }
            }
        }
    }
}

/// The VJP of [`encode_level`] in the points, for normals: adds to `v_points [panels, 3, 32]`.
#[inline(always)]
pub fn encode_level_point_vjp<S: Simd>(
    simd: S,
    grid: &HashGrid,
    level: &GridLevel,
    table: &[Num<S>],
    panels: LevelPanels<'_, Num<S>>,
    v: &[Num<S>],
    v_points: &mut [Num<S>],
) {
    let LevelPanels { points, row, rows } = panels;
    let features = grid.features;
    let table = &table[level.first * features..(level.first + level.entries) * features];
    let cells = simd.splat(f64::from(level.cells));
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let last = simd.splat(f64::from(level.cells - 1));
    let mut corners = Corners::new();
    let panels = points.chunks_exact(3 * PANEL).zip(v.chunks_exact(rows * PANEL));
    for ((points, v), v_points) in panels.zip(v_points.chunks_exact_mut(3 * PANEL)) {
        find_corners(simd, level, points, &mut corners);
        // The gradient of each corner's weight.
        let mut v_weight = [[Num::<S>::default(); PANEL]; 8];
        for k in 0..8 {
            for s in 0..PANEL {
                let entry = &table[corners.index[k][s] as usize * features..][..features];
                for f in 0..features {
                    v_weight[k][s] = v_weight[k][s] + entry[f] * v[(row + f) * PANEL + s];
                }
            }
        }
        for s in (0..PANEL).step_by(S::LANES) {
            let mut fraction = [zero; 3];
            let mut inside = [zero; 3];
            for c in 0..3 {
                let p = simd.load(&points[c * PANEL + s..]);
                inside[c] = cells.masked(mask_between(zero, p, one));
                let p = p.max(zero).min(one) * cells;
                fraction[c] = p - p.floor().min(last);
            }
            let high = fraction;
            let low = unroll!(c in 3 => one - high[c]);
            for c in 0..3 {
                let (d, e) = ((c + 1) % 3, (c + 2) % 3);
                let mut slope = zero;
                for k in 0..8 {
                    let side = |axis: usize| (k >> axis) & 1 == 1;
                    let w_d = if side(d) { high[d] } else { low[d] };
                    let w_e = if side(e) { high[e] } else { low[e] };
                    let term = w_d * w_e * simd.load(&v_weight[k][s..]);
                    slope = if side(c) { slope + term } else { slope - term };
                }
                let to = &mut v_points[c * PANEL + s..];
                slope.mul_add(inside[c], simd.load(to)).store(to);
            }
        }
    }
}

#[inline(always)]
fn mask_between<F: Lanes>(low: F, p: F, high: F) -> F::Mask {
    use irradia_compute::simd::Mask;
    low.le(p).and(p.le(high))
}
