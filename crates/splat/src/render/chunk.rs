//! Projection of a chunk of splats, and its vector-Jacobian product: connects the planar columns in memory to the arithmetic
//! of [`super::project`] and [`super::sh`].

use super::blend::{Footprint2d, SUMS};
use super::harmonics::{CHUNK, Harmonics};
use super::project::{Footprint, Geometry, footprint_gradient, project, project_vjp, quadratic};
use super::{CameraGradient, RenderOptions, Renderer, ViewParams};
use crate::Splats;
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};
use irradia_compute::unroll;

#[inline(always)]
fn load_geometry<S: Simd>(simd: S, splats: &Splats, at: usize) -> Geometry<S::F>
where
    S::F: Lanes<Scalar = f32>,
{
    Geometry {
        mean: unroll!(c in 3 => simd.load(&splats.means.plane(c)[at..])),
        quat: unroll!(c in 4 => simd.load(&splats.quats.plane(c)[at..])),
        log_scale: unroll!(c in 3 => simd.load(&splats.log_scales.plane(c)[at..])),
        opacity_logit: simd.load(&splats.opacity_logits.plane(0)[at..]),
    }
}

/// The filter's variances from splat `at` on, if there is a filter.
#[inline(always)]
fn load_filter<S: Simd>(simd: S, filter: &[f32], at: usize) -> Option<S::F>
where
    S::F: Lanes<Scalar = f32>,
{
    if filter.is_empty() {
        None
    } else {
        Some(simd.load(&filter[at..]))
    }
}

pub(super) struct ProjectChunk<'a> {
    pub splats: &'a Splats,
    /// As passed to [`Renderer::set_filter`].
    pub filter: &'a [f32],
    pub view: &'a ViewParams,
    pub options: &'a RenderOptions,
    /// Whether colours are final: clamped at 0.
    pub clamp: bool,
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
        let mut harmonics = Harmonics::new(degree);
        for at in (0..self.footprints.len()).step_by(S::LANES) {
            let first = self.first + at;
            let geometry = load_geometry(simd, self.splats, first);
            let filter = load_filter(simd, self.filter, first);
            let (footprint, visible) = project(&view, &geometry, filter, self.options.antialias);
            let inside = (1u32 << S::LANES.min(n.saturating_sub(first))) - 1;
            let visible = visible.bits() & inside;
            let keys = &mut self.depth_keys[at..at + S::LANES];
            keys.fill(u32::MAX);
            if visible == 0 {
                continue;
            }
            harmonics.evaluate_basis(at, geometry.mean, view.center);
            let mut columns = [[0.0f32; 16]; 9];
            let Footprint {
                xy,
                depth,
                conic,
                opacity,
                extent,
            } = footprint;
            let [a, b, c] = quadratic(conic);
            let log2_opacity = opacity.map(f32::log2);
            let values = [xy[0], xy[1], a, b, c, log2_opacity, depth, extent[0], extent[1]];
            for (to, value) in columns.iter_mut().zip(values) {
                value.store(to);
            }
            for lane in (0..S::LANES).filter(|lane| visible >> lane & 1 == 1) {
                let v = unroll!(i in 9 => columns[i][lane]);
                if v.iter().any(|v| !v.is_finite()) {
                    continue; // Splats that are not finite are not drawn; the file reader and the optimiser report them.
                }
                keys[lane] = v[6].to_bits();
                self.footprints[at + lane] = Footprint2d {
                    xy: [v[0], v[1]],
                    quadratic: [v[2], v[3], v[4]],
                    log2_opacity: v[5],
                    color: [0.0; 3],
                    depth: v[6],
                    extent: [v[7], v[8]],
                };
            }
        }
        let colors = harmonics.colors(simd, self.splats, self.first, self.clamp);
        for at in harmonics.starts() {
            for i in at..at + S::LANES {
                let color = unroll!(c in 3 => colors[c][i]);
                self.footprints[i].color = color;
                if color.iter().any(|v| !v.is_finite()) {
                    self.depth_keys[i] = u32::MAX;
                }
            }
        }
    }
}

/// The columns of [`SplatGradients`] for one chunk of splats.
pub(super) struct GradientChunk<'a> {
    pub active: &'a mut [f32],
    pub screen: Vec<&'a mut [f32]>,
    pub gathered: Vec<&'a mut [f32]>,
    pub columns: [Vec<&'a mut [f32]>; 5],
    pub non_finite: usize,
    /// This chunk's contribution to the camera's gradient.
    pub camera: CameraGradient,
}

pub(super) struct ProjectChunkVjp<'a, 'b> {
    pub renderer: &'a Renderer,
    pub splats: &'a Splats,
    pub view: &'a ViewParams,
    pub degree: u32,
    /// Whether the camera's gradient is requested.
    pub camera: bool,
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
        if self.camera {
            self.backward::<S, true>(simd);
        } else {
            self.backward::<S, false>(simd);
        }
    }
}

impl ProjectChunkVjp<'_, '_> {
    #[inline(always)]
    fn backward<S: Simd, const CAMERA: bool>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let view = self.view.lanes(simd);
        let chunk = self.chunk;
        let renderer = self.renderer;
        let antialias = renderer.options.antialias;
        let mut harmonics = Harmonics::new(self.degree);
        let mut v_colors = [[0.0f32; CHUNK]; 3];
        let mut magnitudes = [0.0f32; CHUNK];
        // Sums over the chunk of the gradients of R, of t, and of the camera's centre through the viewing direction.
        let mut v_rotation = [[simd.splat(0.0); 3]; 3];
        let mut v_translation = [simd.splat(0.0); 3];
        let mut v_center = [simd.splat(0.0); 3];
        for at in (0..chunk.active.len()).step_by(S::LANES) {
            let first = self.first + at;
            // Sum each visible splat's entries, in their order; [sum, lane]. Invisible lanes are masked below.
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
            let [s0, sx, sy, sxx, sxy, syy, red, green, blue, v_depth] = unroll!(i in 10 => simd.load(&sums[i]));
            let [a, b, c, log2_opacity, shown_red, shown_green, shown_blue] = unroll!(i in 7 => simd.load(&image[i]));
            let moments = [s0, sx, sy, sxx, sxy, syy];
            let v_footprint = footprint_gradient([a, b, c], log2_opacity, moments, v_depth);
            let geometry = load_geometry(simd, self.splats, first);
            let filter = load_filter(simd, &renderer.filter, first);
            let (v, v_camera) = project_vjp(&view, &geometry, filter, antialias, &v_footprint);

            // Colours not above 0 were clamped.
            let v_color = [
                red.masked(zero.lt(shown_red)),
                green.masked(zero.lt(shown_green)),
                blue.masked(zero.lt(shown_blue)),
            ];
            harmonics.evaluate_basis(at, geometry.mean, view.center);
            for c in 0..3 {
                v_color[c].store(&mut v_colors[c][at..]);
            }

            // A sum of magnitudes is finite exactly if all of them are.
            let mut magnitude = v.opacity_logit.abs() + v_color[0].abs() + v_color[1].abs() + v_color[2].abs();
            for value in v.mean.into_iter().chain(v.quat).chain(v.log_scale) {
                magnitude += value.abs();
            }
            magnitude.store(&mut magnitudes[at..]);
            if CAMERA {
                let counts = shown.and(magnitude.lt(simd.splat(f64::from(f32::MAX))));
                for i in 0..3 {
                    v_translation[i] += v_camera.translation[i].masked(counts);
                    for j in 0..3 {
                        v_rotation[i][j] += v_camera.rotation[i][j].masked(counts);
                    }
                }
            }
            for (sum, to) in sums[10..].iter().zip(&mut chunk.gathered) {
                simd.load(sum).store(&mut to[at..]);
            }
            visible.store(&mut chunk.active[at..]);
            for (value, to) in v_footprint.xy.iter().zip(&mut chunk.screen) {
                value.store(&mut to[at..]);
            }
            let [means, quats, log_scales, opacity_logits, _] = &mut chunk.columns;
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
        }

        harmonics.vjp(simd, self.splats, self.first, &v_colors, &mut chunk.columns[4]);
        for at in harmonics.starts() {
            let visible = simd.load(&chunk.active[at..]);
            let shown = simd.splat(0.0).lt(visible);
            let mut magnitude = simd.load(&magnitudes[at..]);
            if self.degree > 0 {
                let mean = load_geometry(simd, self.splats, self.first + at).mean;
                let v_mean = harmonics.v_mean(at, mean, view.center);
                if CAMERA {
                    for c in 0..3 {
                        let finite = v_mean[c].abs().lt(simd.splat(f64::from(f32::MAX)));
                        v_center[c] -= v_mean[c].masked(shown.and(finite));
                    }
                }
                for (v, to) in v_mean.iter().zip(&mut chunk.columns[0]) {
                    (simd.load(&to[at..]) + *v).store(&mut to[at..]);
                    magnitude += v.abs();
                }
            }
            let finite = magnitude.lt(simd.splat(f64::from(f32::MAX)));
            chunk.non_finite += shown.and_not(finite).bits().count_ones() as usize;
            visible.masked(shown.and(finite)).store(&mut chunk.active[at..]);
        }
        if CAMERA {
            chunk.camera = self.view.gradient(
                unroll!(i in 3 => unroll!(j in 3 => f64::from(v_rotation[i][j].sum()))),
                unroll!(i in 3 => f64::from(v_translation[i].sum())),
                unroll!(i in 3 => f64::from(v_center[i].sum())),
            );
        }
    }
}
