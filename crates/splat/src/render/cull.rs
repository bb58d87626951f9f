//! Which chunks of splats a view may see: most splats of a large scene are out of view, and are not even read.
//!
//! Splats are in Morton order, so that a chunk is small in space. The test is conservative: a chunk is left out only if
//! [`super::project`] would find every splat of it invisible.

use super::ViewParams;
use super::harmonics::CHUNK;
use crate::Splats;
use irradia_compute::simd::{Kernel, Lanes, Level, Simd};
use irradia_compute::unroll;
use rayon::prelude::*;

/// Bounds of the splats of a chunk.
#[derive(Clone, Copy, Debug, Default)]
struct Bound {
    /// The box of the means, world.
    low: [f32; 3],
    high: [f32; 3],
    /// The largest standard deviation, with the smoothing filter, world units.
    deviation: f32,
}

/// Bounds of every chunk of 512 splats.
#[derive(Clone, Debug, Default)]
pub struct ChunkBounds {
    bounds: Vec<Bound>,
}

impl ChunkBounds {
    /// Updates the bounds of the chunks for which `changed` holds, or of all if their number has changed. `filter` holds the
    /// smoothing filter's variances with padding, or nothing.
    pub fn update(&mut self, level: Level, splats: &Splats, filter: &[f32], changed: impl Fn(usize) -> bool + Sync) {
        let chunks = splats.stride().div_ceil(CHUNK);
        let all = self.bounds.len() != chunks;
        self.bounds.resize(chunks, Bound::default());
        self.bounds
            .par_iter_mut()
            .enumerate()
            .with_min_len(16)
            .filter(|(chunk, _)| all || changed(*chunk))
            .for_each(|(chunk, bound)| {
                let range = chunk * CHUNK..splats.stride().min((chunk + 1) * CHUNK);
                *bound = level.run(Enclose { splats, filter, range });
            });
    }

    /// For each chunk, whether `view` may see some of its splats.
    pub(super) fn visible_chunks(&self, view: &ViewParams, seen: &mut Vec<bool>) {
        let planes = view_planes(view);
        // The sides of a lens's image are not planes: only chunks behind the camera are left out, unless the lens shows them.
        let planes = match &view.lens {
            None => &planes[..],
            Some(lens) if lens.is_wide() => &[],
            Some(_) => &planes[..1],
        };
        self.bounds
            .par_iter()
            .with_min_len(256)
            .map(|bound| !planes.iter().any(|plane| plane.excludes(bound)))
            .collect_into_vec(seen);
    }
}

struct Enclose<'a> {
    splats: &'a Splats,
    filter: &'a [f32],
    range: std::ops::Range<usize>,
}

impl Kernel for Enclose<'_> {
    type Output = Bound;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Bound
    where
        S::F: Lanes<Scalar = f32>,
    {
        let mut low = [simd.splat(f64::INFINITY); 3];
        let mut high = [simd.splat(f64::NEG_INFINITY); 3];
        let mut log_scale = simd.splat(f64::NEG_INFINITY);
        let mut variance = simd.splat(0.0);
        for at in self.range.step_by(S::LANES) {
            let mean = unroll!(c in 3 => simd.load(&self.splats.means.plane(c)[at..]));
            low = unroll!(c in 3 => mean[c].min(low[c]));
            high = unroll!(c in 3 => mean[c].max(high[c]));
            for c in 0..3 {
                log_scale = simd.load(&self.splats.log_scales.plane(c)[at..]).max(log_scale);
            }
            if !self.filter.is_empty() {
                variance = simd.load(&self.filter[at..]).max(variance);
            }
        }
        let fold = |v: S::F, from: f32, f: fn(f32, f32) -> f32| {
            let mut values = [from; 16];
            v.store(&mut values);
            values[..S::LANES].iter().copied().fold(from, f)
        };
        let deviation = fold(log_scale, f32::NEG_INFINITY, f32::max).exp();
        let variance = fold(variance, 0.0, f32::max);
        Bound {
            low: [0, 1, 2].map(|c| fold(low[c], f32::INFINITY, f32::min)),
            high: [0, 1, 2].map(|c| fold(high[c], f32::NEG_INFINITY, f32::max)),
            deviation: (deviation * deviation + variance).sqrt(),
        }
    }
}

/// A half space in which splats cannot be seen: `normal . mean + per_deviation s + offset < 0`.
struct Plane {
    normal: [f64; 3],
    per_deviation: f64,
    offset: f64,
}

/// A footprint's half size is at most this many standard deviations on the image: sqrt(2 ln 255) = 3.33, and 2 % for rounding.
const EXTENT_DEVIATIONS: f64 = 3.4;
/// Pixels added to that for the dilation, sqrt(2 ln 255 times 0.3) = 1.82, and for the half pixel to the outermost centre; the
/// rest is for rounding.
const PIXEL_MARGIN: f64 = 2.0;
/// Relative rounding of a projected coordinate in single precision, several times over.
const RELATIVE_ROUNDING: f64 = 1e-5;

impl Plane {
    /// Whether no splat within `bound` can be seen; false if a bound is NaN.
    fn excludes(&self, bound: &Bound) -> bool {
        let (mut highest, mut size) = (0.0f64, self.offset.abs());
        for c in 0..3 {
            let ends = [bound.low[c], bound.high[c]].map(|v| self.normal[c] * f64::from(v));
            highest += ends[0].max(ends[1]);
            size += ends[0].abs().max(ends[1].abs());
        }
        let reach = self.per_deviation * f64::from(bound.deviation);
        highest + reach + self.offset + RELATIVE_ROUNDING * size < 0.0
    }
}

/// The near plane and the four sides of the image. The condition of a side, such as `f X / Z + c + extent < 0.5`, is multiplied
/// by the depth Z, which makes it linear: it holds for all splats in front of the camera, and the others are invisible.
fn view_planes(view: &ViewParams) -> [Plane; 5] {
    let (r, t) = (&view.rotation, &view.translation);
    let limits = view.tangent_limits();
    let size = [view.width, view.height].map(f64::from);
    let side = |i: usize, sign: f64, depth: f64| {
        let focal = sign * view.focal[i];
        let tangent = limits[i][0].abs().max(limits[i][1].abs());
        // The norm of row i of the projection's Jacobian, times Z.
        let jacobian = view.focal[i].abs() * (1.0 + tangent * tangent).sqrt();
        Plane {
            normal: [0, 1, 2].map(|c| focal * r[i][c] + depth * r[2][c]),
            per_deviation: EXTENT_DEVIATIONS * jacobian,
            offset: focal * t[i] + depth * t[2],
        }
    };
    let (x, y) = (view.principal[0], view.principal[1]);
    [
        Plane {
            normal: r[2],
            per_deviation: 0.0,
            offset: t[2] - view.near,
        },
        side(0, 1.0, x + PIXEL_MARGIN),
        side(0, -1.0, size[0] - x + PIXEL_MARGIN),
        side(1, 1.0, y + PIXEL_MARGIN),
        side(1, -1.0, size[1] - y + PIXEL_MARGIN),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RenderOptions, Renderer};
    use irradia_scene::Rng;

    /// Random scenes and views, near and far, with and without filter: what is visible without bounds is visible with them.
    #[test]
    fn no_visible_splat_is_left_out_and_most_chunks_out_of_view_are() {
        let mut rng = Rng::new(11, 2);
        let (mut left_out, mut chunks_seen) = (0, 0);
        for round in 0..24 {
            let n = 40 * CHUNK - 100;
            let mut splats = Splats::zeros(n, 0);
            let size = rng.range(-6.0, 0.5);
            for i in 0..n {
                let place = (i / CHUNK) as f32;
                for c in 0..3 {
                    let center = ((place + 1.0) * (c as f32 + 1.3)).sin() * 10.0;
                    splats.means.set(c, i, center + 0.5 * rng.normal());
                    splats.log_scales.set(c, i, size + rng.normal());
                }
                (0..4).for_each(|c| splats.quats.set(c, i, rng.normal()));
                splats.opacity_logits.set(0, i, 3.0 * rng.normal());
            }
            splats.means.set(1, 5, f32::NAN);
            let (sin, cos) = rng.range(0.0, 6.3).sin_cos();
            let (sin, cos) = (f64::from(sin), f64::from(cos));
            let view = ViewParams {
                rotation: [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]],
                translation: [0, 1, 2].map(|_| f64::from(rng.range(-8.0, 8.0))),
                focal: [f64::from(rng.range(20.0, 300.0)); 2],
                principal: [f64::from(rng.range(0.0, 64.0)), 30.0],
                width: 64,
                height: 48,
                near: 0.01,
                lens: None,
            };
            let filter = vec![0.04; if round % 2 == 0 { 0 } else { splats.stride() }];
            let mut renderer = Renderer::new();
            renderer.set_filter(&filter);
            let mut bounds = ChunkBounds::default();
            bounds.update(renderer.level, &splats, &filter, |_| true);
            let mut seen = Vec::new();
            bounds.visible_chunks(&view, &mut seen);
            renderer.render(&splats, &view, &RenderOptions::default());
            let visible: Vec<bool> = (0..n).map(|i| renderer.screen_extent(i).is_some()).collect();
            for (chunk, seen) in visible.chunks(CHUNK).zip(&seen) {
                assert!(*seen || !chunk.contains(&true), "round {round}");
                left_out += usize::from(!*seen);
                chunks_seen += usize::from(chunk.contains(&true));
            }
        }
        assert!(left_out > 24 * 40 / 3 && chunks_seen > 24, "{left_out}, {chunks_seen}");
    }

    #[test]
    fn only_changed_chunks_are_updated() {
        let mut splats = Splats::zeros(3 * CHUNK, 0);
        let mut bounds = ChunkBounds::default();
        bounds.update(Level::detect(), &splats, &[], |_| false);
        splats.means.set(0, 0, -9.0);
        splats.means.set(0, CHUNK, 7.0);
        bounds.update(Level::detect(), &splats, &[], |chunk| chunk == 1);
        assert_eq!((bounds.bounds[0].low[0], bounds.bounds[1].high[0]), (0.0, 7.0));
        assert_eq!(bounds.bounds[2].deviation, 1.0);
    }
}
