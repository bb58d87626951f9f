//! Projection of a chunk of splats, and its vector-Jacobian product: connects the planar columns in memory to the arithmetic
//! of [`super::project`] and [`super::sh`].

use super::bin::Part;
use super::blend::{Footprint2d, SUMS};
use super::harmonics::{CHUNK, Harmonics};
use super::project::{Footprint, Geometry, footprint_gradient, project, project_vjp, quadratic};
use super::sh::MAX_COEFFICIENTS;
use super::touch::{Outline, Spans};
use super::{CameraGradient, RenderOptions, Renderer, SplatGradients, ViewParams};
use crate::Splats;
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};
use irradia_compute::unroll;

/// Rows that are kept of the footprints of a chunk, in this order: x, y, a, b, c, log2 of the opacity, depth, and the half width and half
/// height of the bounding box.
const FOOTPRINT_ROWS: usize = 9;
/// Rows that the backward pass takes from the footprints of a vector, in this order: a, b, c, log2 of the opacity, red, green, blue.
const SHOWN_ROWS: usize = 7;

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

/// How many splats ahead geometry is prefetched.
const PREFETCH_DISTANCE: usize = 64;

/// Prefetches what [`load_geometry`] will read.
#[inline(always)]
fn prefetch_geometry<S: Simd>(simd: S, splats: &Splats, at: usize) {
    let at = at.min(splats.stride() - 1);
    let [means, quats, log_scales, opacity_logits, _] = splats.columns();
    for column in [means, quats, log_scales, opacity_logits] {
        for c in 0..column.count() {
            simd.prefetch(&column.plane(c)[at]);
        }
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

/// A chunk of splats to project.
pub(super) struct ChunkJob<'a> {
    pub chunk: usize,
    pub footprints: &'a mut [Footprint2d],
    pub depth_keys: &'a mut [u32],
    /// Output: number of its visible splats.
    pub visible: &'a mut u32,
}

/// Projects chunks and lists the tiles that their splats touch.
pub(super) struct ProjectPart<'a, 'b> {
    pub splats: &'a Splats,
    /// As passed to [`Renderer::set_filter`].
    pub filter: &'a [f32],
    pub view: &'a ViewParams,
    pub options: &'a RenderOptions,
    /// Whether colours are final: clamped at 0.
    pub clamp: bool,
    /// Columns and rows of tiles.
    pub tiles: [usize; 2],
    /// In ascending order.
    pub jobs: &'a mut [ChunkJob<'b>],
    pub part: &'a mut Part,
}

impl Kernel for ProjectPart<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.part.clear();
        for i in 0..self.jobs.len() {
            self.project_chunk(simd, i);
        }
        self.part.group(self.tiles[0] * self.tiles[1]);
    }
}

impl ProjectPart<'_, '_> {
    #[inline(always)]
    fn project_chunk<S: Simd>(&mut self, simd: S, job: usize)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let view = self.view.lanes(simd);
        let degree = self.options.sh_degree.min(self.splats.sh_degree());
        let n = self.splats.len();
        let job = &mut self.jobs[job];
        let base = job.chunk * CHUNK;
        let mut harmonics = Harmonics::new(degree);
        let mut rows = [[0.0f32; CHUNK]; FOOTPRINT_ROWS];
        let mut visible_bits = [0u32; CHUNK / 4];
        job.depth_keys.fill(u32::MAX);
        for at in (0..job.footprints.len()).step_by(S::LANES) {
            let first = base + at;
            prefetch_geometry(simd, self.splats, first + PREFETCH_DISTANCE);
            let geometry = load_geometry(simd, self.splats, first);
            let filter = load_filter(simd, self.filter, first);
            let (footprint, visible) = project(&view, &geometry, filter, self.options.antialias);
            let inside = (1u32 << S::LANES.min(n.saturating_sub(first))) - 1;
            let bits = visible.bits() & inside;
            if bits == 0 {
                continue;
            }
            visible_bits[at / S::LANES] = bits;
            harmonics.evaluate_basis(at, geometry.mean, view.center);
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
            for (to, value) in rows.iter_mut().zip(values) {
                value.store(&mut to[at..]);
            }
        }
        let colors = harmonics.colors(simd, self.splats, base, self.clamp);
        let [tiles_x, tiles_y] = self.tiles;
        let largest = simd.splat(f64::from(f32::MAX));
        let mut count = 0;
        for at in harmonics.starts() {
            // Splats that are not finite are not drawn; the file reader and the optimiser report them.
            let mut finite = simd.splat(0.0).le(simd.splat(0.0));
            for row in rows.iter().chain(&colors) {
                finite = finite.and(simd.load(&row[at..]).abs().le(largest));
            }
            let [x, y, a, b, c, log2_opacity, _, half_width, half_height] =
                unroll!(row in 9 => simd.load(&rows[row][at..]));
            let outline = Outline {
                xy: [x, y],
                extent: [half_width, half_height],
                quadratic: [a, b, c],
                log2_opacity,
            };
            let spans = Spans::new(&outline, finite, tiles_x, tiles_y);
            let mut bits = visible_bits[at / S::LANES] & finite.bits();
            count += bits.count_ones();
            while bits != 0 {
                let lane = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let i = at + lane;
                let [x, y, a, b, c, log2_opacity, depth, half_width, half_height] = unroll!(row in 9 => rows[row][i]);
                let mut footprint = Footprint2d {
                    xy: [x, y],
                    quadratic: [a, b, c],
                    log2_opacity,
                    color: unroll!(c in 3 => colors[c][i]),
                    depth,
                    extent: [half_width, half_height],
                    hits: [self.part.len() as u32, 0],
                };
                let splat = (base + i) as u32;
                spans.tiles(lane, &footprint, tiles_x, tiles_y, |tile, blocks| {
                    self.part.push(splat, tile, blocks);
                });
                footprint.hits[1] = self.part.len() as u32 - footprint.hits[0];
                job.depth_keys[i] = depth.to_bits();
                job.footprints[i] = footprint;
            }
        }
        *job.visible = count;
    }
}

/// Results of a chunk's backward pass other than the columns.
#[derive(Clone, Copy, Default)]
pub(super) struct ChunkOutcome {
    /// Splats skipped because a gradient was not finite.
    pub non_finite: usize,
    /// The chunk's contribution to the camera's gradient.
    pub camera: CameraGradient,
}

/// A run of splats in all planes of [`SplatGradients`] and in the arrays kept per chunk; can be split among threads.
pub(super) struct GradientRun<'a> {
    pub active: &'a mut [f32],
    pub screen: [&'a mut [f32]; 2],
    pub gathered: [&'a mut [f32]; 2],
    pub means: [&'a mut [f32]; 3],
    pub quats: [&'a mut [f32]; 4],
    pub log_scales: [&'a mut [f32]; 3],
    pub opacity_logits: [&'a mut [f32]; 1],
    /// One slice per plane in use; the others are empty.
    pub sh: [&'a mut [f32]; 3 * MAX_COEFFICIENTS],
    /// Number of active splats, chunk by chunk.
    pub counts: &'a mut [u32],
    pub outcomes: &'a mut [ChunkOutcome],
}

impl<'a> GradientRun<'a> {
    /// All splats.
    pub fn new(gradients: &'a mut SplatGradients, outcomes: &'a mut [ChunkOutcome]) -> Self {
        let SplatGradients {
            splats,
            active,
            counts,
            screen,
            gathered,
            ..
        } = gradients;
        Self {
            active,
            screen: screen.planes_mut(),
            gathered: gathered.planes_mut(),
            means: splats.means.planes_mut(),
            quats: splats.quats.planes_mut(),
            log_scales: splats.log_scales.planes_mut(),
            opacity_logits: splats.opacity_logits.planes_mut(),
            sh: splats.sh.planes_mut(),
            counts,
            outcomes,
        }
    }

    /// The first `chunks` chunks, and the others.
    fn split_at(self, chunks: usize) -> (Self, Self) {
        let at = chunks * CHUNK;
        let (active, active_rest) = self.active.split_at_mut(at);
        let (counts, counts_rest) = self.counts.split_at_mut(chunks);
        let (outcomes, outcomes_rest) = self.outcomes.split_at_mut(chunks);
        let [screen, gathered] = [self.screen, self.gathered].map(|planes| split_planes(planes, at));
        let [means, log_scales] = [self.means, self.log_scales].map(|planes| split_planes(planes, at));
        let (quats, opacity_logits) = (split_planes(self.quats, at), split_planes(self.opacity_logits, at));
        let sh = split_planes(self.sh, at);
        let left = Self {
            active,
            screen: screen.0,
            gathered: gathered.0,
            means: means.0,
            quats: quats.0,
            log_scales: log_scales.0,
            opacity_logits: opacity_logits.0,
            sh: sh.0,
            counts,
            outcomes,
        };
        let right = Self {
            active: active_rest,
            screen: screen.1,
            gathered: gathered.1,
            means: means.1,
            quats: quats.1,
            log_scales: log_scales.1,
            opacity_logits: opacity_logits.1,
            sh: sh.1,
            counts: counts_rest,
            outcomes: outcomes_rest,
        };
        (left, right)
    }

    /// Calls `work` in parallel for each chunk that has visible splats, and clears the flags of the others. `visible` counts them,
    /// and `first` is the number of the first chunk.
    pub fn for_each_chunk(self, first: usize, visible: &[u32], work: &(impl Fn(usize, GradientRun<'_>) + Sync)) {
        if visible.iter().all(|n| *n == 0) && self.counts.iter().all(|n| *n == 0) {
            return;
        }
        if visible.len() > 1 {
            let half = visible.len() / 2;
            let (left, right) = self.split_at(half);
            rayon::join(
                || left.for_each_chunk(first, &visible[..half], work),
                || right.for_each_chunk(first + half, &visible[half..], work),
            );
        } else if visible[0] > 0 {
            work(first, self);
        } else {
            self.active.fill(0.0);
            self.counts[0] = 0;
        }
    }
}

fn split_planes<const N: usize>(planes: [&mut [f32]; N], at: usize) -> ([&mut [f32]; N], [&mut [f32]; N]) {
    let mut left: [&mut [f32]; N] = std::array::from_fn(|_| Default::default());
    let mut right: [&mut [f32]; N] = std::array::from_fn(|_| Default::default());
    for (i, plane) in planes.into_iter().enumerate() {
        let at = at.min(plane.len());
        (left[i], right[i]) = plane.split_at_mut(at);
    }
    (left, right)
}

pub(super) struct ProjectChunkVjp<'a, 'b> {
    pub renderer: &'a Renderer,
    pub splats: &'a Splats,
    pub view: &'a ViewParams,
    pub degree: u32,
    /// Whether the camera's gradient is requested.
    pub camera: bool,
    /// The chunk's number.
    pub chunk: usize,
    pub to: GradientRun<'b>,
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
        let mut chunk = self.to;
        let base = self.chunk * CHUNK;
        let part = self.renderer.part_of[self.chunk] as usize;
        let mut count = 0;
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
            let first = base + at;
            // Sum each visible splat's entries, in their order; [sum, lane]. Invisible lanes are masked below.
            let mut sums = [[0.0f32; 16]; SUMS];
            let mut shown = [[1.0f32; 16]; SHOWN_ROWS];
            let mut visible = [0.0f32; 16];
            for lane in 0..S::LANES {
                if renderer.depth_keys[first + lane] == u32::MAX {
                    continue;
                }
                visible[lane] = 1.0;
                let s = &renderer.footprints[first + lane];
                let mut total = [0.0f32; SUMS];
                for position in renderer.bins.positions(part, s.hits) {
                    for (total, from) in total.iter_mut().zip(&renderer.sums[position]) {
                        *total += from;
                    }
                }
                for (to, total) in sums.iter_mut().zip(total) {
                    to[lane] = total;
                }
                let [a, b, c] = s.quadratic;
                let [red, green, blue] = s.color;
                for (to, value) in shown.iter_mut().zip([a, b, c, s.log2_opacity, red, green, blue]) {
                    to[lane] = value;
                }
            }
            let zero = simd.splat(0.0);
            let visible = simd.load(&visible);
            let is_visible = zero.lt(visible);
            if is_visible.none() {
                visible.store(&mut chunk.active[at..]);
                continue;
            }
            let [s0, sx, sy, sxx, sxy, syy, red, green, blue, v_depth] = unroll!(i in 10 => simd.load(&sums[i]));
            let [a, b, c, log2_opacity, shown_red, shown_green, shown_blue] = unroll!(i in 7 => simd.load(&shown[i]));
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
                let counts = is_visible.and(magnitude.lt(simd.splat(f64::from(f32::MAX))));
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
            for (value, to) in v.mean.iter().zip(&mut chunk.means) {
                value.store(&mut to[at..]);
            }
            for (value, to) in v.quat.iter().zip(&mut chunk.quats) {
                value.store(&mut to[at..]);
            }
            for (value, to) in v.log_scale.iter().zip(&mut chunk.log_scales) {
                value.store(&mut to[at..]);
            }
            v.opacity_logit.store(&mut chunk.opacity_logits[0][at..]);
        }

        harmonics.vjp(simd, self.splats, base, &v_colors, &mut chunk.sh);
        let mut non_finite = 0;
        for at in harmonics.starts() {
            let visible = simd.load(&chunk.active[at..]);
            let is_visible = simd.splat(0.0).lt(visible);
            let mut magnitude = simd.load(&magnitudes[at..]);
            if self.degree > 0 {
                let mean = load_geometry(simd, self.splats, base + at).mean;
                let v_mean = harmonics.v_mean(at, mean, view.center);
                if CAMERA {
                    for c in 0..3 {
                        let finite = v_mean[c].abs().lt(simd.splat(f64::from(f32::MAX)));
                        v_center[c] -= v_mean[c].masked(is_visible.and(finite));
                    }
                }
                for (v, to) in v_mean.iter().zip(&mut chunk.means) {
                    (simd.load(&to[at..]) + *v).store(&mut to[at..]);
                    magnitude += v.abs();
                }
            }
            let finite = magnitude.lt(simd.splat(f64::from(f32::MAX)));
            non_finite += is_visible.and_not(finite).bits().count_ones() as usize;
            count += is_visible.and(finite).bits().count_ones();
            visible.masked(is_visible.and(finite)).store(&mut chunk.active[at..]);
        }
        chunk.counts[0] = count;
        let outcome = &mut chunk.outcomes[0];
        outcome.non_finite = non_finite;
        if CAMERA {
            outcome.camera = self.view.gradient(
                unroll!(i in 3 => unroll!(j in 3 => f64::from(v_rotation[i][j].sum()))),
                unroll!(i in 3 => f64::from(v_translation[i].sum())),
                unroll!(i in 3 => f64::from(v_center[i].sum())),
            );
        }
    }
}
