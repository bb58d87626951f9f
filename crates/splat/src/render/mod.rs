//! The differentiable renderer: project, bin, blend, and the backward pass of each.
//!
//! One [`Renderer`] owns every buffer, so that a training step hardly allocates. Work is split into pieces of fixed size and
//! reduced in a fixed order: results are bit-identical for any number of threads.

mod bin;
mod blend;
mod chunk;
mod harmonics;
mod inspect;
mod project;
mod sh;
mod view;

#[cfg(test)]
mod gradients;

pub use blend::{ALPHA_MAX, TRANSMITTANCE_MIN};
pub use inspect::{Hit, Shape};
pub use project::{ALPHA_MIN, DILATION};
pub use view::ViewParams;

use crate::Splats;
use bin::{BAND_BLOCKS, BLOCK_HEIGHT, BLOCK_WIDTH, Bins, TILE};
use blend::{BLOCK, BlendTile, BlendTileVjp, CHANNELS, Footprint2d, SUMS, TILE_PIXELS, gather};
use chunk::{GradientChunk, ProjectChunk, ProjectChunkVjp};
use harmonics::CHUNK;
use irradia_compute::Planes;
use irradia_compute::simd::Level;
use rayon::prelude::*;

/// How a frame is rendered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Background colour, sRGB.
    pub background: [f32; 3],
    /// SH degree in use; higher bands are ignored.
    pub sh_degree: u32,
    /// Scale opacity by the area ratio of the dilation (Mip-Splatting's 2D filter, gsplat's "antialiased").
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

/// Gradients of the loss with respect to a frame.
#[derive(Clone, Copy, Debug)]
pub struct OutputGradient<'a> {
    /// `[3, H, W]`.
    pub color: &'a [f32],
    /// `[H, W]`.
    pub alpha: Option<&'a [f32]>,
    /// `[H, W]`, of the accumulated depth; requires a frame rendered with depth.
    pub depth: Option<&'a [f32]>,
    /// What else to accumulate per splat.
    pub gather: Gather<'a>,
    /// Whether to compute [`SplatGradients::camera`].
    pub camera: bool,
}

impl<'a> OutputGradient<'a> {
    /// Gradient of the colour only, `[3, H, W]`.
    pub fn of_color(color: &'a [f32]) -> Self {
        Self {
            color,
            alpha: None,
            depth: None,
            gather: Gather::Nothing,
            camera: false,
        }
    }
}

/// A rendered frame, as planes.
#[derive(Clone, Copy, Debug)]
pub struct FramePlanes<'a> {
    /// `[3, H, W]`, not clamped.
    pub color: &'a [f32],
    /// `[H, W]`, one minus the remaining transmittance.
    pub alpha: &'a [f32],
    /// `[H, W]`, depth along +Z accumulated with the blending weights; empty if not requested.
    pub depth: &'a [f32],
}

/// What the backward pass accumulates for density control, beside the gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Gather<'a> {
    /// Nothing.
    Nothing,
    /// The screen gradient of the centre with absolute values summed over fragments (AbsGS, Ye et al. 2024, eq. 6).
    Absolute,
    /// `[H, W]`, an error per pixel: each splat accumulates the error, weighted by its blending weight in the pixel, and the sum of
    /// these weights (Rota Bulo et al. 2024, "Revising Densification in Gaussian Splatting", eq. 5). The weights include pixels
    /// beyond the image's right and lower border in its last tiles; errors are 0 there.
    Error(&'a [f32]),
}

/// The gradient of the loss with respect to a camera: `x_cam = R x + t`, the entries of R taken as independent.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraGradient {
    /// With respect to R, row-major.
    pub rotation: [[f64; 3]; 3],
    /// With respect to t.
    pub translation: [f64; 3],
}

/// Gradients of the loss with respect to the splats.
#[derive(Clone, Debug, Default)]
pub struct SplatGradients {
    /// Column by column. Inactive splats hold unspecified numbers.
    pub splats: Splats,
    /// `[stride]`: 1 where the splat was visible and its gradient is finite, else 0.
    pub active: Vec<f32>,
    /// Gradient of the projected centre, pixels: 2 planes.
    pub screen: Planes,
    /// As [`OutputGradient::gather`] requests, 2 planes: absolute screen gradients, or error and weight.
    pub gathered: Planes,
    /// Gradient of the camera, if [`OutputGradient::camera`] requests it.
    pub camera: Option<CameraGradient>,
    /// Number of splats skipped because a gradient was not finite.
    pub non_finite: usize,
}

/// The renderer with its buffers, which also hold the intermediate values for [`Renderer::backward`].
pub struct Renderer {
    /// Instruction set to use.
    pub level: Level,
    /// Variance of each splat's 3D smoothing filter, world units squared, padded to the splats' stride; empty for none.
    filter: Vec<f32>,
    view: Option<ViewParams>,
    options: RenderOptions,
    footprints: Vec<Footprint2d>,
    depth_keys: Vec<u32>,
    in_view: Vec<u32>,
    bins: Bins,
    /// Tile-major `[tiles, CHANNELS, blocks, BLOCK]`.
    tiles: Vec<f32>,
    color: Vec<f32>,
    alpha: Vec<f32>,
    depth: Vec<f32>,
    /// Gradients of each entry, tile by tile.
    sums: Vec<[f32; SUMS]>,
}

impl Default for Renderer {
    fn default() -> Self {
        Self::new()
    }
}

impl Renderer {
    /// At the best SIMD level of this processor.
    pub fn new() -> Self {
        Self::with_level(Level::detect())
    }

    /// At a given SIMD level.
    pub fn with_level(level: Level) -> Self {
        Self {
            level,
            filter: Vec::new(),
            view: None,
            options: RenderOptions::default(),
            footprints: Vec::new(),
            depth_keys: Vec::new(),
            in_view: Vec::new(),
            bins: Bins::default(),
            tiles: Vec::new(),
            color: Vec::new(),
            alpha: Vec::new(),
            depth: Vec::new(),
            sums: Vec::new(),
        }
    }

    /// Convolves every splat with an isotropic Gaussian of this variance (world units squared, one per splat) from the next
    /// frame on: the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, eq. 8). Empty for none.
    pub fn set_filter(&mut self, variances: &[f32]) {
        self.filter.clear();
        self.filter.extend_from_slice(variances);
    }

    /// Colour of the last frame, `[3, H, W]`, not clamped.
    pub fn color(&self) -> &[f32] {
        &self.color
    }

    /// One minus the remaining transmittance, `[H, W]`.
    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// Depth along +Z accumulated with the blending weights, `[H, W]` (divide by alpha for the expected depth); empty if not
    /// requested.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// The last frame.
    pub fn frame(&self) -> FramePlanes<'_> {
        FramePlanes {
            color: &self.color,
            alpha: &self.alpha,
            depth: &self.depth,
        }
    }

    /// Splats that touched the last frame.
    pub fn visible(&self) -> usize {
        self.bins.visible()
    }

    /// Splat-tile pairs of the last frame.
    pub fn tile_entries(&self) -> usize {
        self.bins.entry_count()
    }

    /// Width and height of the last frame, pixels.
    pub(crate) fn size(&self) -> Option<[u32; 2]> {
        self.view.as_ref().map(|view| [view.width, view.height])
    }

    /// Half size of splat `i`'s bounding box in the last frame, pixels; `None` if it was not visible.
    pub fn screen_extent(&self, i: usize) -> Option<[f32; 2]> {
        (self.depth_keys[i] != u32::MAX).then(|| self.footprints[i].extent)
    }

    /// Splat-pixel pairs visited by blending in the last frame (whole blocks of 16): a frame's cost.
    pub fn pairs(&self) -> u64 {
        (0..self.bins.tile_count())
            .flat_map(|tile| self.bins.tile(tile))
            .map(|entry| u64::from(entry.blocks.count_ones()) * BLOCK as u64)
            .sum()
    }

    /// Renders `splats` into this renderer's buffers.
    pub fn render(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions) {
        self.project_chunks(splats, view, options, true);
        self.composite();
    }

    /// The first half of a frame with added colours: projects `splats`, without clamping colours. [`Self::add_colors`] and
    /// [`Self::composite`] must follow.
    pub fn project(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions) {
        self.project_chunks(splats, view, options, false);
        self.in_view.clear();
        let seen = |i: &u32| self.depth_keys[*i as usize] != u32::MAX;
        self.in_view.extend((0..splats.len() as u32).filter(seen));
    }

    /// Splats in view of the last [`Self::project`], ascending.
    pub fn in_view(&self) -> &[u32] {
        &self.in_view
    }

    /// Adds `[r, g, b]` to the colour of each of [`Self::in_view`], then clamps it at 0. The gradient of the added colour is
    /// that of the splat's DC coefficient divided by [`irradia_scene::sh::C0`].
    ///
    /// # Panics
    /// When the number of colours differs from the number of splats in view.
    pub fn add_colors(&mut self, added: &[[f32; 3]]) {
        assert_eq!(added.len(), self.in_view.len(), "a colour for each splat in view");
        for (i, added) in self.in_view.iter().zip(added) {
            let color = &mut self.footprints[*i as usize].color;
            *color = std::array::from_fn(|c| (color[c] + added[c]).max(0.0));
        }
    }

    /// The second half of a frame: bins and blends the projected splats.
    ///
    /// # Panics
    /// When nothing was projected.
    pub fn composite(&mut self) {
        let view = self.view.clone().expect("projection comes first");
        let options = self.options;
        self.bins
            .build(self.level, view.width, view.height, &self.footprints, &self.depth_keys);
        self.blend(&view, &options);
    }

    fn project_chunks(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions, clamp: bool) {
        let stride = splats.stride();
        assert!(
            self.filter.is_empty() || self.filter.len() == stride,
            "a filter for every splat, with padding"
        );
        self.view = Some(view.clone());
        self.options = *options;
        self.footprints.resize(stride, Footprint2d::default());
        self.depth_keys.resize(stride, u32::MAX);
        let (level, filter) = (self.level, &self.filter);
        self.footprints
            .par_chunks_mut(CHUNK)
            .zip(self.depth_keys.par_chunks_mut(CHUNK))
            .enumerate()
            .for_each(|(chunk, (footprints, depth_keys))| {
                level.run(ProjectChunk {
                    splats,
                    filter,
                    view,
                    options,
                    clamp,
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
                level.run(BlendTile {
                    footprints,
                    entries: bins.tile(tile),
                    corner: corner(bins, tile),
                    with_depth: options.depth,
                    out,
                });
            });

        self.color.resize(3 * pixels, 0.0);
        self.alpha.resize(pixels, 0.0);
        self.depth.resize(if options.depth { pixels } else { 0 }, 0.0);
        let tiles = &self.tiles;
        // The eight pixels of a channel in row y starting at column x, a multiple of eight.
        let run = |channel: usize, y: usize, x: usize| {
            let tile = (y / TILE) * bins.tiles_x + x / TILE;
            let at = (tile * CHANNELS + channel) * TILE_PIXELS + pixel_in_tile(x % TILE, y % TILE);
            &tiles[at..at + BLOCK_WIDTH]
        };
        self.color.par_chunks_mut(width).enumerate().for_each(|(line, to)| {
            let (channel, y) = (line / height, line % height);
            let background = options.background[channel];
            for (i, to) in to.chunks_mut(BLOCK_WIDTH).enumerate() {
                let (color, t) = (run(channel, y, i * BLOCK_WIDTH), run(CHANNELS - 1, y, i * BLOCK_WIDTH));
                for ((to, color), t) in to.iter_mut().zip(color).zip(t) {
                    *to = color + t.abs() * background;
                }
            }
        });
        self.alpha.par_chunks_mut(width).enumerate().for_each(|(y, to)| {
            for (i, to) in to.chunks_mut(BLOCK_WIDTH).enumerate() {
                for (to, t) in to.iter_mut().zip(run(CHANNELS - 1, y, i * BLOCK_WIDTH)) {
                    *to = 1.0 - t.abs();
                }
            }
        });
        self.depth.par_chunks_mut(width).enumerate().for_each(|(y, to)| {
            for (i, to) in to.chunks_mut(BLOCK_WIDTH).enumerate() {
                let len = to.len();
                to.copy_from_slice(&run(3, y, i * BLOCK_WIDTH)[..len]);
            }
        });
    }

    /// The vector-Jacobian product of the last [`Renderer::render`]: `splats` must be the rendered ones.
    ///
    /// SH gradients are written for the bands in use; the others keep their values.
    ///
    /// # Panics
    /// When nothing was rendered, sizes differ, or a depth gradient is given without a rendered depth.
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
        assert!(
            !matches!(v_out.gather, Gather::Error(error) if error.len() != pixels),
            "an error per pixel"
        );
        assert_eq!(self.depth_keys.len(), splats.stride(), "the splats that were rendered");
        self.blend_vjp(&view, v_out);
        self.project_vjp(splats, &view, v_out.camera, gradients);
    }

    fn blend_vjp(&mut self, view: &ViewParams, v_out: &OutputGradient) {
        let (width, height) = (view.width as usize, view.height as usize);
        self.sums.resize(self.bins.entry_count(), [0.0; SUMS]);
        let (level, bins, footprints) = (self.level, &self.bins, &self.footprints);
        let mut rest_of_sums = &mut self.sums[..];
        let sums: Vec<&mut [[f32; SUMS]]> = (0..bins.tile_count())
            .map(|tile| {
                rest_of_sums
                    .split_off_mut(..bins.tile_range(tile).len())
                    .expect("as many as entries")
            })
            .collect();
        let background = self.options.background;
        let (gather, error) = match v_out.gather {
            Gather::Nothing => (gather::NOTHING, None),
            Gather::Absolute => (gather::ABSOLUTE, None),
            Gather::Error(error) => (gather::ERROR, Some(error)),
        };
        self.tiles
            .as_chunks::<{ CHANNELS * TILE_PIXELS }>()
            .0
            .par_iter()
            .zip(sums)
            .enumerate()
            .for_each(|(tile, (state, sums))| {
                let mut v_tile = [0.0f32; CHANNELS * TILE_PIXELS];
                let mut rest = [0.0f32; TILE_PIXELS];
                let (x0, y0) = ((tile % bins.tiles_x) * TILE, (tile / bins.tiles_x) * TILE);
                let columns = TILE.min(width - x0);
                for row in 0..TILE.min(height - y0) {
                    let image = (y0 + row) * width + x0;
                    for column in (0..columns).step_by(BLOCK_WIDTH) {
                        let (at, from) = (pixel_in_tile(column, row), image + column);
                        let v = |plane: &[f32], offset: usize| run_of(&plane[offset..], columns - column);
                        let state_at = |channel: usize| -> &[f32; BLOCK_WIDTH] {
                            state[channel * TILE_PIXELS + at..].first_chunk().expect("a run")
                        };
                        let t = state_at(CHANNELS - 1).map(f32::abs);
                        let mut total = [0.0f32; BLOCK_WIDTH];
                        let mut put = |channel: usize, v: [f32; BLOCK_WIDTH]| {
                            v_tile[channel * TILE_PIXELS + at..][..BLOCK_WIDTH].copy_from_slice(&v);
                        };
                        for c in 0..3 {
                            let (v, color) = (v(v_out.color, c * width * height + from), state_at(c));
                            for i in 0..BLOCK_WIDTH {
                                total[i] += (color[i] + t[i] * background[c]) * v[i];
                            }
                            put(c, v);
                        }
                        if let Some(v_depth) = v_out.depth {
                            let (v, depth) = (v(v_depth, from), state_at(3));
                            for i in 0..BLOCK_WIDTH {
                                total[i] += depth[i] * v[i];
                            }
                            put(3, v);
                        }
                        if let Some(error) = error {
                            put(4, v(error, from));
                        }
                        if let Some(v_alpha) = v_out.alpha {
                            let v = v(v_alpha, from);
                            for i in 0..BLOCK_WIDTH {
                                total[i] -= t[i] * v[i];
                            }
                        }
                        rest[at..at + BLOCK_WIDTH].copy_from_slice(&total);
                    }
                }
                level.run(BlendTileVjp {
                    footprints,
                    entries: bins.tile(tile),
                    corner: corner(bins, tile),
                    v_out: &v_tile,
                    rest: &mut rest,
                    with_depth: v_out.depth.is_some(),
                    gather,
                    sums,
                });
            });
    }

    fn project_vjp(&mut self, splats: &Splats, view: &ViewParams, camera: bool, gradients: &mut SplatGradients) {
        let (stride, n) = (splats.stride(), splats.len());
        for (to, like) in gradients.splats.columns_mut().into_iter().zip(splats.columns()) {
            to.reshape(like.count(), n);
        }
        gradients.screen.reshape(2, n);
        gradients.gathered.reshape(2, n);
        gradients.active.resize(stride, 0.0);
        let degree = self.options.sh_degree.min(splats.sh_degree());
        let mut chunks: Vec<GradientChunk> = gradients
            .active
            .chunks_mut(CHUNK)
            .map(|active| GradientChunk {
                active,
                screen: Vec::with_capacity(2),
                gathered: Vec::with_capacity(2),
                columns: Default::default(),
                non_finite: 0,
                camera: CameraGradient::default(),
            })
            .collect();
        if stride > 0 {
            for plane in gradients.screen.as_mut_slice().chunks_mut(stride) {
                for (chunk, part) in chunks.iter_mut().zip(plane.chunks_mut(CHUNK)) {
                    chunk.screen.push(part);
                }
            }
            for plane in gradients.gathered.as_mut_slice().chunks_mut(stride) {
                for (chunk, part) in chunks.iter_mut().zip(plane.chunks_mut(CHUNK)) {
                    chunk.gathered.push(part);
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
                camera,
                first: i * CHUNK,
                chunk,
            });
        });
        gradients.non_finite = chunks.iter().map(|chunk| chunk.non_finite).sum();
        gradients.camera = camera.then(|| {
            let mut sum = CameraGradient::default();
            for chunk in &chunks {
                for i in 0..3 {
                    sum.translation[i] += chunk.camera.translation[i];
                    for j in 0..3 {
                        sum.rotation[i][j] += chunk.camera.rotation[i][j];
                    }
                }
            }
            sum
        });
    }
}

/// The first eight of `values`, with zeros from index `len` on.
#[inline(always)]
fn run_of(values: &[f32], len: usize) -> [f32; BLOCK_WIDTH] {
    match values.first_chunk() {
        Some(whole) if len >= BLOCK_WIDTH => *whole,
        _ => std::array::from_fn(|i| if i < len { values[i] } else { 0.0 }),
    }
}

/// Index of pixel (x, y) of a tile in its block-wise order.
#[inline(always)]
fn pixel_in_tile(x: usize, y: usize) -> usize {
    let block = (x / BLOCK_WIDTH) * BAND_BLOCKS + y / BLOCK_HEIGHT;
    block * BLOCK + (y % BLOCK_HEIGHT) * BLOCK_WIDTH + x % BLOCK_WIDTH
}

fn corner(bins: &Bins, tile: usize) -> [f32; 2] {
    [
        ((tile % bins.tiles_x) * TILE) as f32,
        ((tile / bins.tiles_x) * TILE) as f32,
    ]
}
