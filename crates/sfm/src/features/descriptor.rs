//! RootSIFT descriptors: histograms of gradients on a rotated grid of 4 x 4 cells (Lowe 2004, 6; details as in VLFeat).

use super::extrema::Extremum;
use super::gradients::{exp_minus, polar, rows_around};
use super::scale_space::Plane;
use crate::DESCRIPTOR_BYTES;
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Scalar, Simd};
use std::f32::consts::TAU;

/// Cells along a side.
const CELLS: usize = 4;
/// Direction bins of a cell.
const DIRECTIONS: usize = 8;
/// Side of a cell, in sigmas of the extremum.
const CELL_SIGMAS: f32 = 3.0;
/// Half the side of the square of pixels that contribute to some cell, in cells.
const RADIUS_CELLS: f32 = 0.5 * (CELLS as f32 + 1.0);
/// Maximum entry of the normalised histogram, which limits the influence of highlights.
const MAX_BIN: f32 = 0.2;
/// Pixels across the square of the largest extremum, plus the length of a vector.
const MAX_ROW_PIXELS: usize = 128;

/// Cells along a side with a margin of one cell on both sides, so that pixels at the border need no test.
const PADDED_CELLS: usize = CELLS + 2;
/// Direction bins of a cell with margin: the last bin repeats the first.
const WRAPPED_DIRECTIONS: usize = DIRECTIONS + 1;

/// The descriptor at `extremum`, rotated by `angle`, `[row][column][direction]`; `None` where the photograph is flat.
pub(super) fn describe(level: Level, plane: &Plane, extremum: &Extremum, angle: f32) -> Option<[u8; DESCRIPTOR_BYTES]> {
    let bins = level.run(Histograms { plane, extremum, angle });
    let mut values = [0.0f32; DESCRIPTOR_BYTES];
    for (cell, values) in values.chunks_exact_mut(DIRECTIONS).enumerate() {
        let at = ((cell / CELLS + 1) * PADDED_CELLS + cell % CELLS + 1) * WRAPPED_DIRECTIONS;
        values.copy_from_slice(&bins[at..at + DIRECTIONS]);
        values[0] += bins[at + DIRECTIONS];
    }
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    for value in &mut values {
        *value = value.min(MAX_BIN * norm);
    }
    let sum = values.iter().sum::<f32>();
    (sum > 0.0).then(|| values.map(|value| (512.0 * (value / sum).sqrt() + 0.5).min(255.0) as u8))
}

struct Histograms<'a> {
    plane: &'a Plane,
    extremum: &'a Extremum,
    angle: f32,
}

impl Kernel for Histograms<'_> {
    type Output = [f32; PADDED_CELLS * PADDED_CELLS * WRAPPED_DIRECTIONS];
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output
    where
        S::F: Lanes<Scalar = f32>,
    {
        let Self { plane, extremum, angle } = self;
        let cell = CELL_SIGMAS * extremum.sigma;
        let reach = RADIUS_CELLS * cell;
        let (sin, cos) = angle.sin_cos();
        // Half the side of the upright square around the rotated one.
        let half = reach * (sin.abs() + cos.abs());
        let (right, down) = ([cos / cell, sin / cell], [-sin / cell, cos / cell]);
        let rotation = simd.set(angle * (DIRECTIONS as f32 / TAU));
        let centre = simd.splat(0.5 * CELLS as f64 + 0.5);
        let inside = simd.set(RADIUS_CELLS);
        let ramp = simd.lanes(|i| i as f32 + 0.5);
        let mut bins = [0.0f32; PADDED_CELLS * PADDED_CELLS * WRAPPED_DIRECTIONS];
        let mut samples = [[0.0f32; MAX_ROW_PIXELS]; 5];
        for y in pixels(extremum.y - half, extremum.y + half, plane.height) {
            let rows = rows_around(plane, y);
            let dy = y as f32 + 0.5 - extremum.y;
            // The part of the row inside the rotated square, where |cos dx + sin dy| and |cos dy - sin dx| are below `reach`.
            let mut from_to = [-half, half];
            for [by_x, by_y] in [[cos, sin * dy], [-sin, cos * dy]] {
                if by_x.abs() > 1e-6 {
                    let ends = [(-reach - by_y) / by_x, (reach - by_y) / by_x];
                    from_to[0] = from_to[0].max(ends[0].min(ends[1]));
                    from_to[1] = from_to[1].min(ends[0].max(ends[1]));
                }
            }
            let columns = pixels(extremum.x + from_to[0], extremum.x + from_to[1], plane.width);
            for (i, x) in columns.clone().step_by(S::LANES).enumerate() {
                let [magnitude, eighths] = polar(simd, rows, x);
                let dx = ramp + simd.set(x as f32 - extremum.x);
                let u = dx * simd.set(right[0]) + simd.set(right[1] * dy);
                let v = dx * simd.set(down[0]) + simd.set(down[1] * dy);
                // A Gaussian whose standard deviation is half the grid's side: 2 cells.
                let weight = magnitude * exp_minus(simd, (u * u + v * v) * simd.splat(1.0 / 8.0));
                let weight = weight.masked(u.abs().lt(inside)).masked(v.abs().lt(inside));
                let direction = eighths - rotation;
                let direction = (direction + simd.splat(8.0)).select(direction.lt(simd.splat(0.0)), direction);
                let direction = (direction - simd.splat(8.0)).select(simd.splat(8.0).le(direction), direction);
                // Lanes outside the square have no weight; their indices are clamped to the array.
                let bound = |at: S::F, last: f64| at.max(simd.splat(0.0)).min(simd.splat(last));
                let (u, v) = (u + centre, v + centre);
                let (column, row, bin) = (
                    bound(u.floor(), CELLS as f64),
                    bound(v.floor(), CELLS as f64),
                    bound(direction.floor(), DIRECTIONS as f64 - 1.0),
                );
                let index =
                    (row * simd.splat(PADDED_CELLS as f64) + column) * simd.splat(WRAPPED_DIRECTIONS as f64) + bin;
                let to = i * S::LANES;
                index.store(&mut samples[0][to..]);
                weight.store(&mut samples[1][to..]);
                (u - column).store(&mut samples[2][to..]);
                (v - row).store(&mut samples[3][to..]);
                (direction - bin).store(&mut samples[4][to..]);
            }
            let [index, weight, u, v, t] = &samples;
            for i in 0..columns.len() {
                const LAST: usize = ((CELLS - 1 + 1) * PADDED_CELLS + CELLS) * WRAPPED_DIRECTIONS + DIRECTIONS - 1;
                let at = (index[i].to_u32() as usize).min(LAST);
                let below = weight[i] * v[i];
                for (row, weight) in [(0, weight[i] - below), (PADDED_CELLS * WRAPPED_DIRECTIONS, below)] {
                    let beside = weight * u[i];
                    for (column, weight) in [(0, weight - beside), (WRAPPED_DIRECTIONS, beside)] {
                        let next = weight * t[i];
                        bins[at + row + column] += weight - next;
                        bins[at + row + column + 1] += next;
                    }
                }
            }
        }
        bins
    }
}

/// The pixels whose centres are between `from` and `to` and whose neighbours exist.
#[inline(always)]
fn pixels(from: f32, to: f32, side: usize) -> std::ops::Range<usize> {
    let first = (from + 0.5).max(1.0) as usize;
    let end = (to + 0.5).max(1.0) as usize;
    first..end.clamp(first, (side - 1).max(first))
}
