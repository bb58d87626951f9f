//! The differentiable renderer: project, bin, blend, and the same backwards.
//!
//! One [`Renderer`] owns every buffer, so that a training step allocates next to nothing. Work is split into pieces of a
//! fixed size and reduced in a fixed order: the number of threads never changes a bit.

mod bin;
mod blend;
mod project;
mod sh;
mod view;

#[cfg(test)]
mod gradients;

pub use blend::{ALPHA_MAX, TRANSMITTANCE_MIN};
pub use project::{ALPHA_MIN, DILATION};
pub use view::ViewParams;

use crate::Splats;
use bin::{Bins, TILE};
use blend::{BlendTile, BlendTileVjp, CHANNELS, Footprint2d, SUMS, TILE_PIXELS};
use irradia_compute::Planes;
use irradia_compute::simd::{Kernel, Lanes, Level, Mask, Simd};
use project::{Footprint, FootprintGradient, Geometry, project, project_vjp};
use rayon::prelude::*;
use sh::{basis, basis_vjp, direction, direction_vjp};
use std::cell::RefCell;
use std::f64::consts::LOG2_E;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// How a frame is rendered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Colour behind everything, sRGB.
    pub background: [f32; 3],
    /// SH bands used; those above are not looked at.
    pub sh_degree: u32,
    /// Scale opacity by the area ratio that dilation adds (Mip-Splatting's 2D filter, gsplat's "antialiased").
    pub antialias: bool,
    /// Fill [`Renderer::depth`].
    pub depth: bool,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            background: [0.0; 3],
            sh_degree: 3,
            antialias: false,
            depth: false,
        }
    }
}

/// Gradients of the loss with regard to a frame.
#[derive(Clone, Copy, Debug)]
pub struct OutputGradient<'a> {
    /// `[3, H, W]`.
    pub color: &'a [f32],
    /// `[H, W]`.
    pub alpha: Option<&'a [f32]>,
    /// `[H, W]`, of the accumulated depth; the frame must have been rendered with depth.
    pub depth: Option<&'a [f32]>,
}

/// Gradients of the loss with regard to the splats.
#[derive(Clone, Debug, Default)]
pub struct SplatGradients {
    /// Column by column. Items that are not active hold unspecified numbers.
    pub splats: Splats,
    /// `[stride]`: 1 where the splat was visible and its gradient is finite, else 0.
    pub active: Vec<f32>,
    /// Gradient of the projected centre, pixels: 2 planes.
    pub screen: Planes,
    /// Splats left out because a gradient was not finite.
    pub non_finite: usize,
}

/// Splats a task projects: a multiple of every vector length.
const CHUNK: usize = 1024;

/// The renderer with its buffers, which are also the tape that [`Renderer::backward`] plays.
pub struct Renderer {
    /// Instruction set to use.
    pub level: Level,
    view: Option<ViewParams>,
    options: RenderOptions,
    footprints: Vec<Footprint2d>,
    depth_keys: Vec<u32>,
    bins: Bins,
    /// Tile-major `[tiles, CHANNELS, TILE, TILE]`.
    tiles: Vec<f32>,
    color: Vec<f32>,
    alpha: Vec<f32>,
    depth: Vec<f32>,
    /// `[slots, SUMS]` as bits: tiles write them in any order, each to its own place.
    sums: Vec<AtomicU32>,
}

impl Default for Renderer {
    fn default() -> Self {
        Self::new()
    }
}

impl Renderer {
    /// With the best instructions this processor has.
    pub fn new() -> Self {
        Self::with_level(Level::detect())
    }

    /// With a given instruction set.
    pub fn with_level(level: Level) -> Self {
        Self {
            level,
            view: None,
            options: RenderOptions::default(),
            footprints: Vec::new(),
            depth_keys: Vec::new(),
            bins: Bins::default(),
            tiles: Vec::new(),
            color: Vec::new(),
            alpha: Vec::new(),
            depth: Vec::new(),
            sums: Vec::new(),
        }
    }

    /// Colour of the last frame, `[3, H, W]`, not clamped.
    pub fn color(&self) -> &[f32] {
        &self.color
    }

    /// One minus the transmittance that is left, `[H, W]`.
    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// Depth along +Z accumulated with the blending weights, `[H, W]` (divide by alpha for the expected depth); empty
    /// when not asked for.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// Splats that touched the last frame.
    pub fn visible(&self) -> usize {
        self.bins.visible()
    }

    /// Splat-tile pairs of the last frame.
    pub fn tile_entries(&self) -> usize {
        self.bins.entry_count()
    }

    /// Half size of splat `i`'s box in the last frame in pixels, `None` where it was not visible.
    pub fn screen_extent(&self, i: usize) -> Option<[f32; 2]> {
        (self.depth_keys[i] != u32::MAX).then(|| self.footprints[i].extent)
    }

    /// Splat-pixel pairs that the last frame's blending visited (whole rows of 16), for benchmarks.
    pub fn pairs(&self) -> u64 {
        let mut entries = Vec::new();
        (0..self.bins.tile_count())
            .map(|tile| {
                self.bins.tile_entries(tile, &mut entries);
                entries
                    .iter()
                    .map(|e| u64::from(e.row_mask().count_ones()) * TILE as u64)
                    .sum::<u64>()
            })
            .sum()
    }

    /// Renders `splats` into this renderer's buffers.
    pub fn render(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions) {
        self.project(splats, view, options);
        self.bins
            .build(view.width, view.height, &self.footprints, &self.depth_keys);
        self.blend(view, options);
        self.view = Some(view.clone());
        self.options = *options;
    }

    fn project(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions) {
        let stride = splats.stride();
        self.footprints.resize(stride, Footprint2d::default());
        self.depth_keys.resize(stride, u32::MAX);
        let level = self.level;
        self.footprints
            .par_chunks_mut(CHUNK)
            .zip(self.depth_keys.par_chunks_mut(CHUNK))
            .enumerate()
            .for_each(|(chunk, (footprints, depth_keys))| {
                level.run(ProjectChunk {
                    splats,
                    view,
                    options,
                    first: chunk * CHUNK,
                    footprints,
                    depth_keys,
                });
            });
    }

    fn blend(&mut self, view: &ViewParams, options: &RenderOptions) {
        let (width, height) = (view.width as usize, view.height as usize);
        let pixels = width * height;
        self.tiles.resize(self.bins.tile_count() * CHANNELS * TILE_PIXELS, 0.0);
        let (level, bins, footprints) = (self.level, &self.bins, &self.footprints);
        self.tiles
            .as_chunks_mut::<{ CHANNELS * TILE_PIXELS }>()
            .0
            .par_iter_mut()
            .enumerate()
            .for_each(|(tile, out)| {
                with_entries(bins, tile, |entries| {
                    level.run(BlendTile {
                        footprints,
                        entries,
                        corner: corner(bins, tile),
                        with_depth: options.depth,
                        out,
                    });
                });
            });

        self.color.resize(3 * pixels, 0.0);
        self.alpha.resize(pixels, 0.0);
        self.depth.resize(if options.depth { pixels } else { 0 }, 0.0);
        let tiles = &self.tiles;
        let row = |channel: usize, y: usize, x: usize| {
            let tile = (y / TILE) * bins.tiles_x + x / TILE;
            let at = (tile * CHANNELS + channel) * TILE_PIXELS + (y % TILE) * TILE;
            &tiles[at..at + TILE]
        };
        self.color.par_chunks_mut(width).enumerate().for_each(|(line, to)| {
            let (channel, y) = (line / height, line % height);
            let background = options.background[channel];
            for (i, to) in to.chunks_mut(TILE).enumerate() {
                let (color, t) = (row(channel, y, i * TILE), row(CHANNELS - 1, y, i * TILE));
                for ((to, color), t) in to.iter_mut().zip(color).zip(t) {
                    *to = color + t.abs() * background;
                }
            }
        });
        self.alpha.par_chunks_mut(width).enumerate().for_each(|(y, to)| {
            for (i, to) in to.chunks_mut(TILE).enumerate() {
                for (to, t) in to.iter_mut().zip(row(CHANNELS - 1, y, i * TILE)) {
                    *to = 1.0 - t.abs();
                }
            }
        });
        self.depth.par_chunks_mut(width).enumerate().for_each(|(y, to)| {
            for (i, to) in to.chunks_mut(TILE).enumerate() {
                let len = to.len();
                to.copy_from_slice(&row(3, y, i * TILE)[..len]);
            }
        });
    }

    /// The vector-Jacobian product of the last [`Renderer::render`]: `splats` must be what was rendered.
    ///
    /// SH gradients are written for the bands that were used; the others keep what they held.
    ///
    /// # Panics
    /// When nothing was rendered, sizes differ, or a depth gradient comes without a rendered depth.
    pub fn backward(&mut self, splats: &Splats, v_out: &OutputGradient, gradients: &mut SplatGradients) {
        let view = self.view.clone().expect("render comes first");
        let pixels = view.width as usize * view.height as usize;
        assert_eq!(v_out.color.len(), 3 * pixels, "a colour gradient per pixel");
        assert!(
            v_out.alpha.is_none_or(|v| v.len() == pixels),
            "an alpha gradient per pixel"
        );
        assert!(
            v_out.depth.is_none_or(|v| v.len() == pixels && self.options.depth),
            "a depth gradient per pixel of a frame with depth"
        );
        assert_eq!(self.depth_keys.len(), splats.stride(), "the splats that were rendered");
        self.blend_vjp(&view, v_out);
        self.project_vjp(splats, &view, gradients);
    }

    fn blend_vjp(&mut self, view: &ViewParams, v_out: &OutputGradient) {
        let (width, height) = (view.width as usize, view.height as usize);
        let needed = self.bins.entry_count() * SUMS;
        if self.sums.len() < needed {
            self.sums.resize_with(needed, AtomicU32::default);
        }
        let (level, bins, footprints, sums) = (self.level, &self.bins, &self.footprints, &self.sums);
        let background = self.options.background;
        self.tiles
            .as_chunks::<{ CHANNELS * TILE_PIXELS }>()
            .0
            .par_iter()
            .enumerate()
            .for_each(|(tile, state)| {
                let mut v_tile = [0.0f32; (CHANNELS - 1) * TILE_PIXELS];
                let mut rest = [0.0f32; TILE_PIXELS];
                let (x0, y0) = ((tile % bins.tiles_x) * TILE, (tile / bins.tiles_x) * TILE);
                let columns = TILE.min(width - x0);
                for row in 0..TILE.min(height - y0) {
                    let image = (y0 + row) * width + x0;
                    let at = row * TILE;
                    for c in 0..3 {
                        let from = &v_out.color[c * width * height + image..][..columns];
                        v_tile[c * TILE_PIXELS + at..][..columns].copy_from_slice(from);
                    }
                    if let Some(v_depth) = v_out.depth {
                        v_tile[3 * TILE_PIXELS + at..][..columns].copy_from_slice(&v_depth[image..][..columns]);
                    }
                    for i in 0..columns {
                        let pixel = at + i;
                        let t = state[(CHANNELS - 1) * TILE_PIXELS + pixel].abs();
                        let mut total = v_out.alpha.map_or(0.0, |v| -t * v[image + i]);
                        for c in 0..3 {
                            total +=
                                (state[c * TILE_PIXELS + pixel] + t * background[c]) * v_tile[c * TILE_PIXELS + pixel];
                        }
                        if v_out.depth.is_some() {
                            total += state[3 * TILE_PIXELS + pixel] * v_tile[3 * TILE_PIXELS + pixel];
                        }
                        rest[pixel] = total;
                    }
                }
                with_entries(bins, tile, |entries| {
                    level.run(BlendTileVjp {
                        footprints,
                        entries,
                        corner: corner(bins, tile),
                        v_out: &v_tile,
                        rest: &mut rest,
                        with_depth: v_out.depth.is_some(),
                        emit: |entry: &bin::Entry, values: [f32; SUMS]| {
                            let to = &sums[entry.slot as usize * SUMS..][..SUMS];
                            for (to, value) in to.iter().zip(values) {
                                to.store(value.to_bits(), Relaxed);
                            }
                        },
                    });
                });
            });
    }

    fn project_vjp(&mut self, splats: &Splats, view: &ViewParams, gradients: &mut SplatGradients) {
        let (stride, n) = (splats.stride(), splats.len());
        for (to, like) in gradients.splats.columns_mut().into_iter().zip(splats.columns()) {
            to.reshape(like.count(), n);
        }
        gradients.screen.reshape(2, n);
        gradients.active.resize(stride, 0.0);
        let degree = self.options.sh_degree.min(splats.sh_degree());
        let mut chunks: Vec<GradientChunk> = gradients
            .active
            .chunks_mut(CHUNK)
            .map(|active| GradientChunk {
                active,
                screen: Vec::with_capacity(2),
                columns: Default::default(),
                non_finite: 0,
            })
            .collect();
        if stride > 0 {
            for plane in gradients.screen.as_mut_slice().chunks_mut(stride) {
                for (chunk, part) in chunks.iter_mut().zip(plane.chunks_mut(CHUNK)) {
                    chunk.screen.push(part);
                }
            }
            for (c, column) in gradients.splats.columns_mut().into_iter().enumerate() {
                for plane in column.as_mut_slice().chunks_mut(stride) {
                    for (chunk, part) in chunks.iter_mut().zip(plane.chunks_mut(CHUNK)) {
                        chunk.columns[c].push(part);
                    }
                }
            }
        }
        let (level, this) = (self.level, &*self);
        chunks.par_iter_mut().enumerate().for_each(|(i, chunk)| {
            level.run(ProjectChunkVjp {
                renderer: this,
                splats,
                view,
                degree,
                first: i * CHUNK,
                chunk,
            });
        });
        gradients.non_finite = chunks.iter().map(|chunk| chunk.non_finite).sum();
    }
}

fn corner(bins: &Bins, tile: usize) -> [f32; 2] {
    [
        ((tile % bins.tiles_x) * TILE) as f32,
        ((tile / bins.tiles_x) * TILE) as f32,
    ]
}

/// Lists a tile's entries in a buffer that each thread keeps.
fn with_entries(bins: &Bins, tile: usize, work: impl FnOnce(&[bin::Entry])) {
    thread_local! {
        static ENTRIES: RefCell<Vec<bin::Entry>> = const { RefCell::new(Vec::new()) };
    }
    ENTRIES.with_borrow_mut(|entries| {
        bins.tile_entries(tile, entries);
        work(entries);
    });
}

#[inline(always)]
fn load_geometry<S: Simd>(simd: S, splats: &Splats, at: usize) -> Geometry<S::F>
where
    S::F: Lanes<Scalar = f32>,
{
    Geometry {
        mean: std::array::from_fn(|c| simd.load(&splats.means.plane(c)[at..])),
        quat: std::array::from_fn(|c| simd.load(&splats.quats.plane(c)[at..])),
        log_scale: std::array::from_fn(|c| simd.load(&splats.log_scales.plane(c)[at..])),
        opacity_logit: simd.load(&splats.opacity_logits.plane(0)[at..]),
    }
}

struct ProjectChunk<'a> {
    splats: &'a Splats,
    view: &'a ViewParams,
    options: &'a RenderOptions,
    first: usize,
    footprints: &'a mut [Footprint2d],
    depth_keys: &'a mut [u32],
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
            let half = simd.splat(-0.5 * LOG2_E);
            let log2_opacity = opacity.map(f32::log2);
            let values = [
                xy[0],
                xy[1],
                conic[0] * half,
                conic[1] * (half + half),
                conic[2] * half,
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
                let v = columns.map(|c| c[lane]);
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
    for k in 0..irradia_scene::sh::coefficients(degree) {
        for (c, color) in color.iter_mut().enumerate() {
            *color = b[k].mul_add(simd.load(&splats.sh.plane(3 * k + c)[at..]), *color);
        }
    }
    color.map(|c| c.max(simd.splat(0.0)))
}

/// The columns of [`SplatGradients`] for one chunk of splats.
struct GradientChunk<'a> {
    active: &'a mut [f32],
    screen: Vec<&'a mut [f32]>,
    columns: [Vec<&'a mut [f32]>; 5],
    non_finite: usize,
}

struct ProjectChunkVjp<'a, 'b> {
    renderer: &'a Renderer,
    splats: &'a Splats,
    view: &'a ViewParams,
    degree: u32,
    first: usize,
    chunk: &'a mut GradientChunk<'b>,
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
            // Sum each visible splat's slots, in their order; [sum, lane]. What invisible lanes hold is masked below.
            let mut sums = [[0.0f32; 16]; SUMS];
            let mut image = [[1.0f32; 16]; 7];
            let mut visible = [0.0f32; 16];
            for lane in 0..S::LANES {
                if renderer.depth_keys[first + lane] == u32::MAX {
                    continue;
                }
                visible[lane] = 1.0;
                let mut total = [0.0f32; SUMS];
                for slot in renderer.bins.slots(first + lane) {
                    let from = &renderer.sums[slot * SUMS..][..SUMS];
                    for (total, from) in total.iter_mut().zip(from) {
                        *total += f32::from_bits(from.load(Relaxed));
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
            let [s0, sx, sy, sxx, sxy, syy, red, green, blue, v_depth] = sums.map(|s| simd.load(&s));
            let [a, b, c, log2_opacity, shown_red, shown_green, shown_blue] = image.map(|s| simd.load(&s));

            // p = a dx^2 + b dx dy + c dy^2 + log2 opacity, dx = pixel - centre.
            let two = simd.splat(2.0);
            let v_xy = [-(two * a * sx + b * sy), -(b * sx + two * c * sy)];
            let half = simd.splat(-0.5 * LOG2_E);
            let v_footprint = FootprintGradient {
                xy: v_xy,
                depth: v_depth,
                conic: [half * sxx, (half + half) * sxy, half * syy],
                opacity: s0 * simd.splat(LOG2_E) * (-log2_opacity).exp2(),
            };
            let geometry = load_geometry(simd, self.splats, first);
            let mut v = project_vjp(&view, &geometry, antialias, &v_footprint);

            // Colour was clamped at 0 where it is not above.
            let v_color: [S::F; 3] = [(red, shown_red), (green, shown_green), (blue, shown_blue)]
                .map(|(v, shown)| v.zero_where_not(zero.lt(shown)));
            let (d, inv_distance) = direction(geometry.mean, view.center);
            let basis = basis(self.degree, d);
            if self.degree > 0 {
                let mut v_basis = [zero; sh::MAX_COEFFICIENTS];
                for k in 1..irradia_scene::sh::coefficients(self.degree) {
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
            for (value, to) in v_xy.iter().zip(&mut chunk.screen) {
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
            for k in 0..irradia_scene::sh::coefficients(self.degree) {
                for c in 0..3 {
                    (basis[k] * v_color[c]).store(&mut sh[3 * k + c][at..]);
                }
            }
        }
    }
}
