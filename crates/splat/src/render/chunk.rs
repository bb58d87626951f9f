//! Projection of a chunk of splats, and its vector-Jacobian product: what lies between the planar columns in memory and
//! the arithmetic of [`super::project`] and [`super::sh`].

use super::blend::{Footprint2d, SUMS};
use super::project::{Footprint, Geometry, footprint_gradient, project, project_vjp, quadratic};
use super::sh::{MAX_COEFFICIENTS, basis, basis_vjp, direction, direction_vjp};
use super::{RenderOptions, Renderer, ViewParams};
use crate::Splats;
use irradia_compute::each;
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};
use irradia_scene::sh::coefficients;

#[inline(always)]
fn load_geometry<S: Simd>(simd: S, splats: &Splats, at: usize) -> Geometry<S::F>
where
    S::F: Lanes<Scalar = f32>,
{
    Geometry {
        mean: each!(c in 3 => simd.load(&splats.means.plane(c)[at..])),
        quat: each!(c in 4 => simd.load(&splats.quats.plane(c)[at..])),
        log_scale: each!(c in 3 => simd.load(&splats.log_scales.plane(c)[at..])),
        opacity_logit: simd.load(&splats.opacity_logits.plane(0)[at..]),
    }
}

pub(super) struct ProjectChunk<'a> {
    pub splats: &'a Splats,
    pub view: &'a ViewParams,
    pub options: &'a RenderOptions,
    pub first: usize,
    pub footprints: &'a mut [Footprint2d],
    pub depth_keys: &'a mut [u32],
}

impl Kernel for ProjectChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let view = self.view.lanes(simd);
        let degree = self.options.sh_degree.min(self.splats.sh_degree());
        let n = self.splats.len();
        for at in (0..self.footprints.len()).step_by(S::LANES) {
            let first = self.first + at;
            let geometry = load_geometry(simd, self.splats, first);
            let (footprint, visible) = project(&view, &geometry, self.options.antialias);
            let inside = (1u32 << S::LANES.min(n.saturating_sub(first))) - 1;
            let visible = visible.bits() & inside;
            let keys = &mut self.depth_keys[at..at + S::LANES];
            keys.fill(u32::MAX);
            if visible == 0 {
                continue;
            }
            let color = sh_color(self.splats, degree, first, geometry.mean, view.center);
            let mut columns = [[0.0f32; 16]; 12];
            let Footprint {
                xy,
                depth,
                conic,
                opacity,
                extent,
            } = footprint;
            let [a, b, c] = quadratic(conic);
            let log2_opacity = opacity.map(f32::log2);
            let values = [
                xy[0],
                xy[1],
                a,
                b,
                c,
                log2_opacity,
                color[0],
                color[1],
                color[2],
                depth,
                extent[0],
                extent[1],
            ];
            for (to, value) in columns.iter_mut().zip(values) {
                value.store(to);
            }
            for lane in (0..S::LANES).filter(|lane| visible >> lane & 1 == 1) {
                let v = each!(i in 12 => columns[i][lane]);
                if v.iter().any(|v| !v.is_finite()) {
                    continue; // A poisoned splat is not drawn; the file reader and the optimiser are where it is told.
                }
                keys[lane] = v[9].to_bits();
                self.footprints[at + lane] = Footprint2d {
                    xy: [v[0], v[1]],
                    quadratic: [v[2], v[3], v[4]],
                    log2_opacity: v[5],
                    color: [v[6], v[7], v[8]],
                    depth: v[9],
                    extent: [v[10], v[11]],
                };
            }
        }
    }
}

#[inline(always)]
fn sh_color<F: Lanes<Scalar = f32>>(splats: &Splats, degree: u32, at: usize, mean: [F; 3], center: [F; 3]) -> [F; 3] {
    let (d, _) = direction(mean, center);
    let b = basis(degree, d);
    let simd = mean[0].simd();
    let mut color = [simd.splat(0.5); 3];
    for k in 0..coefficients(degree) {
        for (c, color) in color.iter_mut().enumerate() {
            *color = b[k].mul_add(simd.load(&splats.sh.plane(3 * k + c)[at..]), *color);
        }
    }
    each!(c in 3 => color[c].max(simd.splat(0.0)))
}

/// The columns of [`SplatGradients`] for one chunk of splats.
pub(super) struct GradientChunk<'a> {
    pub active: &'a mut [f32],
    pub screen: Vec<&'a mut [f32]>,
    pub columns: [Vec<&'a mut [f32]>; 5],
    pub non_finite: usize,
}

pub(super) struct ProjectChunkVjp<'a, 'b> {
    pub renderer: &'a Renderer,
    pub splats: &'a Splats,
    pub view: &'a ViewParams,
    pub degree: u32,
    pub first: usize,
    pub chunk: &'a mut GradientChunk<'b>,
}

impl Kernel for ProjectChunkVjp<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let view = self.view.lanes(simd);
        let chunk = self.chunk;
        let renderer = self.renderer;
        let antialias = renderer.options.antialias;
        for at in (0..chunk.active.len()).step_by(S::LANES) {
            let first = self.first + at;
            // Sum each visible splat's entries, in their order; [sum, lane]. What invisible lanes hold is masked below.
            let mut sums = [[0.0f32; 16]; SUMS];
            let mut image = [[1.0f32; 16]; 7];
            let mut visible = [0.0f32; 16];
            for lane in 0..S::LANES {
                if renderer.depth_keys[first + lane] == u32::MAX {
                    continue;
                }
                visible[lane] = 1.0;
                let mut total = [0.0f32; SUMS];
                for position in renderer.bins.positions(first + lane) {
                    for (total, from) in total.iter_mut().zip(&renderer.sums[position]) {
                        *total += from;
                    }
                }
                for (to, total) in sums.iter_mut().zip(total) {
                    to[lane] = total;
                }
                let s = &renderer.footprints[first + lane];
                let [a, b, c] = s.quadratic;
                for (to, value) in image
                    .iter_mut()
                    .zip([a, b, c, s.log2_opacity, s.color[0], s.color[1], s.color[2]])
                {
                    to[lane] = value;
                }
            }
            let zero = simd.splat(0.0);
            let visible = simd.load(&visible);
            let shown = zero.lt(visible);
            if shown.none() {
                visible.store(&mut chunk.active[at..]);
                continue;
            }
            let [s0, sx, sy, sxx, sxy, syy, red, green, blue, v_depth] = each!(i in 10 => simd.load(&sums[i]));
            let [a, b, c, log2_opacity, shown_red, shown_green, shown_blue] = each!(i in 7 => simd.load(&image[i]));
            let moments = [s0, sx, sy, sxx, sxy, syy];
            let v_footprint = footprint_gradient([a, b, c], log2_opacity, moments, v_depth);
            let geometry = load_geometry(simd, self.splats, first);
            let mut v = project_vjp(&view, &geometry, antialias, &v_footprint);

            // Colour was clamped at 0 where it is not above.
            let v_color = [
                red.zero_where_not(zero.lt(shown_red)),
                green.zero_where_not(zero.lt(shown_green)),
                blue.zero_where_not(zero.lt(shown_blue)),
            ];
            let (d, inv_distance) = direction(geometry.mean, view.center);
            let basis = basis(self.degree, d);
            if self.degree > 0 {
                let mut v_basis = [zero; MAX_COEFFICIENTS];
                for k in 1..coefficients(self.degree) {
                    for c in 0..3 {
                        let coefficient = simd.load(&self.splats.sh.plane(3 * k + c)[first..]);
                        v_basis[k] = coefficient.mul_add(v_color[c], v_basis[k]);
                    }
                }
                let v_d = direction_vjp(d, inv_distance, basis_vjp(self.degree, d, &v_basis));
                for i in 0..3 {
                    v.mean[i] += v_d[i];
                }
            }

            // A sum of magnitudes is finite exactly where all of them are.
            let mut magnitude = v.opacity_logit.abs() + v_color[0].abs() + v_color[1].abs() + v_color[2].abs();
            for value in v.mean.into_iter().chain(v.quat).chain(v.log_scale) {
                magnitude += value.abs();
            }
            let finite = magnitude.lt(simd.splat(f64::from(f32::MAX)));
            let active = shown.and(finite);
            chunk.non_finite += shown.and_not(finite).bits().count_ones() as usize;
            visible.zero_where_not(active).store(&mut chunk.active[at..]);
            for (value, to) in v_footprint.xy.iter().zip(&mut chunk.screen) {
                value.store(&mut to[at..]);
            }
            let [means, quats, log_scales, opacity_logits, sh] = &mut chunk.columns;
            for (value, to) in v.mean.iter().zip(means) {
                value.store(&mut to[at..]);
            }
            for (value, to) in v.quat.iter().zip(quats) {
                value.store(&mut to[at..]);
            }
            for (value, to) in v.log_scale.iter().zip(log_scales) {
                value.store(&mut to[at..]);
            }
            v.opacity_logit.store(&mut opacity_logits[0][at..]);
            for k in 0..coefficients(self.degree) {
                for c in 0..3 {
                    (basis[k] * v_color[c]).store(&mut sh[3 * k + c][at..]);
                }
            }
        }
    }
}
