//! The dominant directions of the gradients around an extremum (Lowe 2004, 5; details as in VLFeat).

use super::extrema::Extremum;
use super::gradients::{exp_minus, polar, rows_around};
use super::scale_space::Plane;
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Scalar, Simd};
use std::f32::consts::TAU;

const BINS: usize = 36;
/// Standard deviation of the window, in sigmas of the extremum.
const WINDOW_SIGMAS: f32 = 1.5;
/// Number of passes of a box filter over three bins that smooth the histogram.
const SMOOTHING_PASSES: usize = 6;
/// Further peaks are directions too if they reach this fraction of the highest.
const MIN_PEAK_RATIO: f32 = 0.8;
/// Pixels across the window of the largest extremum, plus the length of a vector.
const MAX_ROW_PIXELS: usize = 64;

/// The strongest directions, at most two, in radians from +x towards +y.
pub(super) fn orientations(level: Level, plane: &Plane, extremum: &Extremum) -> [Option<f32>; 2] {
    let mut histogram = level.run(Histogram { plane, extremum });
    for _ in 0..SMOOTHING_PASSES {
        let old = histogram;
        for i in 0..BINS {
            histogram[i] = (old[(i + BINS - 1) % BINS] + old[i] + old[(i + 1) % BINS]) / 3.0;
        }
    }
    let highest = histogram.iter().fold(0.0f32, |a, b| a.max(*b));
    let mut peaks: Vec<[f32; 2]> = Vec::new();
    for i in 0..BINS {
        let [before, at, after] = [BINS - 1, 0, 1].map(|by| histogram[(i + by) % BINS]);
        if at > before && at > after && at >= MIN_PEAK_RATIO * highest {
            let offset = -0.5 * (after - before) / (after + before - 2.0 * at);
            peaks.push([at, TAU * (i as f32 + 0.5 + offset) / BINS as f32]);
        }
    }
    // The sort is stable: of equal peaks, the first wins.
    peaks.sort_by(|a, b| b[0].total_cmp(&a[0]));
    [0, 1].map(|i| peaks.get(i).map(|peak| peak[1]))
}

/// Magnitudes of gradients by direction, in a Gaussian window; bin `i` is centred at `i + 1/2`.
struct Histogram<'a> {
    plane: &'a Plane,
    extremum: &'a Extremum,
}

impl Kernel for Histogram<'_> {
    type Output = [f32; BINS];
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f32; BINS]
    where
        S::F: Lanes<Scalar = f32>,
    {
        let Self { plane, extremum } = self;
        let sigma = WINDOW_SIGMAS * extremum.sigma;
        let radius = (3.0 * sigma).floor().max(1.0);
        // Columns or rows that have neighbours on both sides.
        let span = |centre: f32, side: usize| {
            let middle = (centre as usize).min(side - 1);
            let radius = radius as usize;
            middle.saturating_sub(radius).max(1)..(middle + radius + 1).min(side - 1)
        };
        let columns = span(extremum.x, plane.width);
        let limit = simd.set(radius * radius + 0.6);
        let scale = simd.set(0.5 / (sigma * sigma));
        let ramp = simd.lanes(|i| i as f32 + 0.5);
        let mut histogram = [0.0f32; BINS + 1];
        let (mut low, mut fraction, mut weight) = (
            [0.0f32; MAX_ROW_PIXELS],
            [0.0f32; MAX_ROW_PIXELS],
            [0.0f32; MAX_ROW_PIXELS],
        );
        for y in span(extremum.y, plane.height) {
            let rows = rows_around(plane, y);
            let dy = simd.set(y as f32 + 0.5 - extremum.y);
            for (i, x) in columns.clone().step_by(S::LANES).enumerate() {
                let [magnitude, eighths] = polar(simd, rows, x);
                let dx = ramp + simd.set(x as f32 - extremum.x);
                let r2 = dx * dx + dy * dy;
                let at = eighths * simd.splat(BINS as f64 / 8.0) + simd.splat(0.5);
                let bin = at.floor();
                let to = i * S::LANES;
                bin.store(&mut low[to..]);
                (at - bin).store(&mut fraction[to..]);
                (magnitude * exp_minus(simd, r2 * scale))
                    .masked(r2.lt(limit))
                    .store(&mut weight[to..]);
            }
            for i in 0..columns.len() {
                // Bins are shifted by one: directions less than half a bin above 0 also contribute to the last bin.
                let bin = low[i].to_u32() as usize;
                let upper = weight[i] * fraction[i];
                histogram[bin] += weight[i] - upper;
                histogram[if bin == BINS { 1 } else { bin + 1 }] += upper;
            }
        }
        histogram[BINS] += histogram[0];
        std::array::from_fn(|i| histogram[i + 1])
    }
}
