//! Extrema of the difference of Gaussians, located between pixels and scales (Lowe 2004, 3.1 and 4; details as in VLFeat).

use super::Sift;
use super::scale_space::{BASE_SIGMA, FIRST_SCALE, Octave, Plane, SCALES};
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};

/// Number of differences in an octave.
const DIFFERENCES: usize = SCALES + 2;
/// The fraction of the peak threshold that a sample must reach before its position is refined (VLFeat).
const COARSE_PEAK_FRACTION: f32 = 0.8;
/// Maximum number of moves by whole pixels during refinement (VLFeat).
const MAX_MOVES: usize = 5;

/// An extremum of one octave.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extremum {
    pub octave: usize,
    /// The level of the sample from which the extremum was refined.
    pub level: usize,
    /// Column in the octave's pixels; the centre of the first pixel is at 0.5.
    pub x: f32,
    /// Row in the octave's pixels; the centre of the first pixel is at 0.5.
    pub y: f32,
    /// In the octave's pixels.
    pub sigma: f32,
    /// Absolute difference of Gaussians at the extremum.
    pub peak: f32,
}

/// The extrema of `octave`, whose number is `number`, sorted by scale, row and column of the sample that each starts from.
pub(super) fn find_extrema(sift: &Sift, octave: &Octave, number: usize) -> Vec<Extremum> {
    let mut samples = sift.level.run(Samples {
        octave,
        threshold: COARSE_PEAK_FRACTION * sift.peak_threshold,
    });
    samples.sort_unstable_by_key(|[x, y, scale]| [*scale, *y, *x]);
    samples
        .into_iter()
        .filter_map(|[x, y, scale]| refine(sift, octave, number, [x as usize, y as usize, scale as usize]))
        .collect()
}

/// Samples `[x, y, scale]` beyond the threshold that are larger, or smaller, than their 26 neighbours.
struct Samples<'a> {
    octave: &'a Octave,
    threshold: f32,
}

impl Kernel for Samples<'_> {
    type Output = Vec<[u32; 3]>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<[u32; 3]>
    where
        S::F: Lanes<Scalar = f32>,
    {
        let levels = &self.octave.levels;
        let (width, height) = (levels[0].width, levels[0].height);
        let stride = levels[0].row(0).len();
        let mut found = Vec::new();
        // Three rows of each difference are enough and stay in cache. Loads also begin one pixel to the left and to the right.
        let mut rows: [[Vec<f32>; 3]; DIFFERENCES] =
            std::array::from_fn(|_| std::array::from_fn(|_| vec![0.0; stride + 2 + S::LANES]));
        for y in 0..height {
            for scale in 0..DIFFERENCES {
                let (finer, coarser) = (levels[scale].row(y), levels[scale + 1].row(y));
                let to = &mut rows[scale][y % 3];
                for x in (0..stride).step_by(S::LANES) {
                    (simd.load(&coarser[x..]) - simd.load(&finer[x..])).store(&mut to[x..]);
                }
            }
            if y < 2 {
                continue;
            }
            let order = [(y - 2) % 3, (y - 1) % 3, y % 3];
            for scale in FIRST_SCALE..=SCALES {
                let near: [[&[f32]; 3]; 3] =
                    [scale, scale - 1, scale + 1].map(|scale| order.map(|slot| &rows[scale][slot][..]));
                for x in (1..width - 1).step_by(S::LANES) {
                    let bits = extreme_lanes(simd, &near, x, self.threshold);
                    let valid = (width - 1 - x).min(S::LANES);
                    let mut bits = bits & ((1u32 << valid) - 1);
                    while bits != 0 {
                        found.push([x as u32 + bits.trailing_zeros(), y as u32 - 1, scale as u32]);
                        bits &= bits - 1;
                    }
                }
            }
        }
        found
    }
}

/// The lanes from column `x` on that are extrema. `near` holds three rows of the difference itself, of the finer one and of the
/// coarser one.
#[inline(always)]
fn extreme_lanes<S: Simd>(simd: S, near: &[[&[f32]; 3]; 3], x: usize, threshold: f32) -> u32
where
    S::F: Lanes<Scalar = f32>,
{
    let value = simd.load(&near[0][1][x..]);
    let mut candidates = simd.set(threshold).le(value.abs());
    // Most vectors have no candidates left after the first plane.
    for plane in 0..3 {
        if candidates.none() {
            return 0;
        }
        let first = simd.load(&near[plane][0][x..]);
        let (mut high, mut low) = (first, first);
        for (row, shift) in [(0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 0), (2, 1)] {
            let neighbour = simd.load(&near[plane][row][x.wrapping_add_signed(shift)..]);
            high = high.max(neighbour);
            low = low.min(neighbour);
        }
        if plane > 0 {
            let middle = simd.load(&near[plane][1][x..]);
            high = high.max(middle);
            low = low.min(middle);
        }
        // A maximum must be positive and a minimum negative, as in VLFeat.
        let zero = simd.splat(0.0);
        let maximum = high.max(zero).lt(value);
        let minimum = value.lt(low.min(zero));
        candidates = candidates.and(maximum.or(minimum));
    }
    candidates.bits()
}

/// Fits a quadratic around the sample, moving to its neighbours; `None` if it is weak, on an edge, or does not converge.
fn refine(sift: &Sift, octave: &Octave, number: usize, [mut x, mut y, scale]: [usize; 3]) -> Option<Extremum> {
    let (width, height) = (octave.levels[0].width, octave.levels[0].height);
    let difference = |scale: usize, x: usize, y: usize| {
        let at = |level: &Plane| level.at(x, y);
        at(&octave.levels[scale + 1]) - at(&octave.levels[scale])
    };
    for moves in 0..MAX_MOVES {
        let d = |dx: isize, dy: isize, ds: isize| {
            let at = |v: usize, by: isize| v.wrapping_add_signed(by);
            difference(at(scale, ds), at(x, dx), at(y, dy))
        };
        let value = d(0, 0, 0);
        let gradient = [
            0.5 * (d(1, 0, 0) - d(-1, 0, 0)),
            0.5 * (d(0, 1, 0) - d(0, -1, 0)),
            0.5 * (d(0, 0, 1) - d(0, 0, -1)),
        ];
        let xx = d(1, 0, 0) + d(-1, 0, 0) - 2.0 * value;
        let yy = d(0, 1, 0) + d(0, -1, 0) - 2.0 * value;
        let ss = d(0, 0, 1) + d(0, 0, -1) - 2.0 * value;
        let xy = 0.25 * (d(1, 1, 0) + d(-1, -1, 0) - d(-1, 1, 0) - d(1, -1, 0));
        let xs = 0.25 * (d(1, 0, 1) + d(-1, 0, -1) - d(-1, 0, 1) - d(1, 0, -1));
        let ys = 0.25 * (d(0, 1, 1) + d(0, -1, -1) - d(0, -1, 1) - d(0, 1, -1));
        let offset = newton_step([xx, yy, ss, xy, xs, ys], gradient)?;
        let step = |offset: f32, v: usize, side: usize| match offset {
            o if o > 0.6 && v + 2 < side => 1,
            o if o < -0.6 && v > 1 => -1,
            _ => 0,
        };
        let (dx, dy) = (step(offset[0], x, width), step(offset[1], y, height));
        if (dx, dy) != (0, 0) && moves + 1 < MAX_MOVES {
            x = x.wrapping_add_signed(dx);
            y = y.wrapping_add_signed(dy);
            continue;
        }
        let peak = value + 0.5 * (gradient[0] * offset[0] + gradient[1] * offset[1] + gradient[2] * offset[2]);
        let determinant = xx * yy - xy * xy;
        // Lowe 2004, eq. 4: trace^2 / determinant is (r + 1)^2 / r for a ratio r of the principal curvatures.
        let r = sift.edge_threshold;
        let blob = determinant > 0.0 && (xx + yy) * (xx + yy) * r < (r + 1.0) * (r + 1.0) * determinant;
        let near = offset.iter().all(|o| o.abs() < 1.5);
        let place = [x as f32 + 0.5 + offset[0], y as f32 + 0.5 + offset[1]];
        let inside = (0.5..=width as f32 - 0.5).contains(&place[0]) && (0.5..=height as f32 - 0.5).contains(&place[1]);
        if !(peak.abs() > sift.peak_threshold && blob && near && inside) {
            return None;
        }
        return Some(Extremum {
            octave: number,
            level: scale,
            x: place[0],
            y: place[1],
            sigma: BASE_SIGMA * ((scale as f32 + offset[2]) / SCALES as f32).exp2(),
            peak: peak.abs(),
        });
    }
    None
}

/// Where the gradient of a quadratic vanishes: `-H^-1 g` by Cramer's rule, `H` given as `[xx, yy, ss, xy, xs, ys]`; `None` if `H` is
/// singular.
fn newton_step([xx, yy, ss, xy, xs, ys]: [f32; 6], gradient: [f32; 3]) -> Option<[f32; 3]> {
    let [xx, yy, ss, xy, xs, ys] = [xx, yy, ss, xy, xs, ys].map(f64::from);
    let g = gradient.map(|g| -f64::from(g));
    let minors = [yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy];
    let determinant = xx * minors[0] + xy * minors[1] + xs * minors[2];
    let step = [
        g[0] * minors[0] + g[1] * minors[1] + g[2] * minors[2],
        g[0] * minors[1] + g[1] * (xx * ss - xs * xs) + g[2] * (xy * xs - xx * ys),
        g[0] * minors[2] + g[1] * (xy * xs - xx * ys) + g[2] * (xx * yy - xy * xy),
    ];
    let offset = step.map(|step| (step / determinant) as f32);
    offset.iter().all(|o| o.is_finite()).then_some(offset)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newton_step_solves_the_system() {
        let h = [-3.0, -2.0, -4.0, 0.5, -0.25, 1.0];
        let [x, y, s] = newton_step(h, [0.3, -0.2, 0.1]).unwrap();
        let residual = [
            h[0] * x + h[3] * y + h[4] * s + 0.3,
            h[3] * x + h[1] * y + h[5] * s - 0.2,
            h[4] * x + h[5] * y + h[2] * s + 0.1,
        ];
        assert!(residual.iter().all(|r| r.abs() < 1e-6), "{residual:?}");
        assert_eq!(newton_step([1.0, 1.0, 0.0, 1.0, 0.0, 0.0], [1.0; 3]), None);
    }
}
