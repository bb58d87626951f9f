//! The differentiable renderer: project, bin, blend, and the backward pass of each.
//!
//! One [`Renderer`] owns every buffer, so that a training step hardly allocates. Work is split into pieces of fixed size and
//! reduced in a fixed order: results are bit-identical for any number of threads.

mod bin;
mod blend;
mod chunk;
mod cull;
mod harmonics;
mod inspect;
mod lens;
mod project;
mod sh;
mod touch;
mod untile;
mod view;

#[cfg(test)]
mod gradients;

pub use blend::{ALPHA_MAX, TRANSMITTANCE_MIN};
pub use cull::ChunkBounds;
pub use harmonics::CHUNK;
pub use inspect::{Hit, Shape};
pub use lens::LensParams;
pub use project::{ALPHA_MIN, DILATION};
pub use view::ViewParams;
#[cfg(all(test, feature = "gpu"))]
pub(crate) use view::tests::splat_beside_camera;

use crate::Splats;
use bin::{Bins, Part, TILE};
use blend::{BLOCK, BlendTile, BlendTileVjp, CHANNELS, Footprint2d, SUMS, TILE_PIXELS, gather};
use chunk::{ChunkJob, ChunkOutcome, GradientRun, ProjectChunkVjp, ProjectPart};
use irradia_compute::Planes;
use irradia_compute::simd::Level;
use rayon::prelude::*;
use untile::{Content, GatherTile, Tiles, UntileLine};

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
    /// Fill colour, alpha and depth at all: [`Renderer::hits`], [`Renderer::counts`] and [`Renderer::shapes`] need none of them.
    /// Without, they are those of an earlier frame, and there is no [`Renderer::backward`].
    pub blend: bool,
    /// Number of splats to draw, counted from the first and rounded up to a multiple of [`CHUNK`].
    pub first: usize,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            background: [0.0; 3],
            sh_degree: 3,
            antialias: false,
            depth: false,
            blend: true,
            first: usize::MAX,
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
    /// `[H, W]`, [depth](irradia_scene::Intrinsics::depth) accumulated with the blending weights; empty if not requested.
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
    /// Number of active splats in each run of [`CHUNK`].
    pub counts: Vec<u32>,
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
    /// Number of visible splats in each chunk; where it is 0, all depth keys are `u32::MAX`.
    visible: Vec<u32>,
    /// Whether the last view may see each chunk.
    seen: Vec<bool>,
    in_view: Vec<u32>,
    parts: Vec<Part>,
    /// The part of each chunk with visible splats.
    part_of: Vec<u32>,
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
            visible: Vec::new(),
            seen: Vec::new(),
            in_view: Vec::new(),
            parts: Vec::new(),
            part_of: Vec::new(),
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

    /// The filter's variances, as passed to [`Self::set_filter`].
    pub(crate) fn filter(&self) -> &[f32] {
        &self.filter
    }

    /// Colour of the last frame, `[3, H, W]`, not clamped.
    pub fn color(&self) -> &[f32] {
        &self.color
    }

    /// One minus the remaining transmittance, `[H, W]`.
    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// [Depth](irradia_scene::Intrinsics::depth) accumulated with the blending weights, `[H, W]` (divide by alpha for the expected depth);
    /// empty if not requested.
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
        self.visible.iter().map(|n| *n as usize).sum()
    }

    /// Width and height of the last frame, pixels.
    pub(crate) fn size(&self) -> Option<[u32; 2]> {
        self.view.as_ref().map(|view| [view.width, view.height])
    }

    /// Half size of splat `i`'s bounding box in the last frame, pixels; `None` if it was not visible.
    pub fn screen_extent(&self, i: usize) -> Option<[f32; 2]> {
        (self.depth_keys[i] != u32::MAX).then(|| self.footprints[i].extent)
    }

    /// Intersections of splats and tiles in the last frame.
    pub fn intersections(&self) -> usize {
        self.bins.entry_count()
    }

    /// Splat-pixel pairs visited by blending in the last frame (whole blocks of 16): a frame's cost.
    pub fn pairs(&self) -> u64 {
        (0..self.bins.tile_count())
            .into_par_iter()
            .flat_map_iter(|tile| self.bins.tile(tile))
            .map(|entry| u64::from(entry.blocks.count_ones()) * BLOCK as u64)
            .sum()
    }

    /// Renders `splats` into this renderer's buffers.
    pub fn render(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions) {
        self.render_within(splats, None, view, options);
    }

    /// As [`Self::render`], skipping chunks that are out of view by their `bounds`, which must be those of `splats`.
    pub fn render_within(
        &mut self,
        splats: &Splats,
        bounds: Option<&ChunkBounds>,
        view: &ViewParams,
        options: &RenderOptions,
    ) {
        self.project_chunks(splats, bounds, view, options, true);
        self.composite();
    }

    /// The first half of a frame with added colours: projects `splats`, without clamping colours. [`Self::add_colors`] and
    /// [`Self::composite`] must follow.
    pub fn project(&mut self, splats: &Splats, view: &ViewParams, options: &RenderOptions) {
        self.project_within(splats, None, view, options);
    }

    /// As [`Self::project`], with `bounds` as in [`Self::render_within`].
    pub fn project_within(
        &mut self,
        splats: &Splats,
        bounds: Option<&ChunkBounds>,
        view: &ViewParams,
        options: &RenderOptions,
    ) {
        self.project_chunks(splats, bounds, view, options, false);
        let keys = &self.depth_keys;
        let chunks = self.visible.par_iter().enumerate().filter(|(_, visible)| **visible > 0);
        self.in_view.clear();
        self.in_view.par_extend(chunks.flat_map_iter(|(chunk, _)| {
            let range = chunk * CHUNK..keys.len().min((chunk + 1) * CHUNK);
            range.filter(|i| keys[*i] != u32::MAX).map(|i| i as u32)
        }));
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

    /// The second half of a frame: bins the projected splats, and blends them if requested.
    ///
    /// # Panics
    /// When nothing was projected.
    pub fn composite(&mut self) {
        let view = self.view.clone().expect("projection comes first");
        let options = self.options;
        self.bins.build(&self.parts, &self.depth_keys);
        if options.blend {
            self.blend(&view, &options);
        }
    }

    fn project_chunks(
        &mut self,
        splats: &Splats,
        bounds: Option<&ChunkBounds>,
        view: &ViewParams,
        options: &RenderOptions,
        clamp: bool,
    ) {
        let stride = splats.stride();
        assert!(
            self.filter.is_empty() || self.filter.len() == stride,
            "a filter for every splat, with padding"
        );
        self.view = Some(view.clone());
        self.options = *options;
        let chunks = stride.div_ceil(CHUNK);
        if self.depth_keys.len() != stride {
            self.footprints.resize(stride, Footprint2d::default());
            // Every chunk is now either projected or invisible.
            self.depth_keys.resize(stride, u32::MAX);
            self.visible.clear();
            self.visible.resize(chunks, 1);
            self.part_of.resize(chunks, 0);
        }
        if let Some(bounds) = bounds {
            bounds.visible_chunks(view, &mut self.seen);
            assert_eq!(self.seen.len(), chunks, "bounds of these splats");
        } else {
            self.seen.clear();
            self.seen.resize(chunks, true);
        }
        self.seen[options.first.div_ceil(CHUNK).min(chunks)..].fill(false);
        let footprints = self.footprints.chunks_mut(CHUNK);
        let depth_keys = self.depth_keys.chunks_mut(CHUNK);
        let mut jobs: Vec<ChunkJob> = footprints
            .zip(depth_keys)
            .zip(&mut self.visible)
            .zip(&self.seen)
            .enumerate()
            .filter_map(|(chunk, (((footprints, depth_keys), visible), seen))| {
                if !seen && *visible > 0 {
                    depth_keys.fill(u32::MAX);
                    *visible = 0;
                }
                seen.then_some(ChunkJob {
                    chunk,
                    footprints,
                    depth_keys,
                    visible,
                })
            })
            .collect();
        let chunks_per_part = jobs
            .len()
            .div_ceil(PARTS_PER_THREAD * rayon::current_num_threads())
            .max(1);
        let parts = jobs.len().div_ceil(chunks_per_part);
        self.parts.resize_with(parts, Part::default);
        for (i, job) in jobs.iter().enumerate() {
            self.part_of[job.chunk] = (i / chunks_per_part) as u32;
        }
        self.bins.begin(view.width, view.height);
        let (level, filter, tiles) = (self.level, &self.filter, [self.bins.tiles_x, self.bins.tiles_y]);
        jobs.par_chunks_mut(chunks_per_part)
            .zip(&mut self.parts)
            .for_each(|(jobs, part)| {
                level.run(ProjectPart {
                    splats,
                    filter,
                    view,
                    options,
                    clamp,
                    tiles,
                    jobs,
                    part,
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
        let tiles = Tiles {
            values: &self.tiles,
            tiles_x: bins.tiles_x,
        };
        self.color.par_chunks_mut(width).enumerate().for_each(|(line, to)| {
            let (channel, y) = (line / height, line % height);
            level.run(UntileLine {
                tiles,
                y,
                content: Content::Color(channel, options.background[channel]),
                to,
            });
        });
        self.alpha.par_chunks_mut(width).enumerate().for_each(|(y, to)| {
            level.run(UntileLine {
                tiles,
                y,
                content: Content::Alpha,
                to,
            });
        });
        self.depth.par_chunks_mut(width).enumerate().for_each(|(y, to)| {
            level.run(UntileLine {
                tiles,
                y,
                content: Content::Depth,
                to,
            });
        });
    }

    /// The vector-Jacobian product of the last [`Renderer::render`]: `splats` must be the rendered ones.
    ///
    /// SH gradients are written for the bands in use; the others keep their values.
    ///
    /// # Panics
    /// When nothing was rendered or blended, sizes differ, or a depth gradient is given without a rendered depth.
    pub fn backward(&mut self, splats: &Splats, v_out: &OutputGradient, gradients: &mut SplatGradients) {
        let view = self.view.clone().expect("render comes first");
        assert!(self.options.blend, "a frame that was blended");
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
        let gather = match v_out.gather {
            Gather::Nothing => gather::NOTHING,
            Gather::Absolute => gather::ABSOLUTE,
            Gather::Error(_) => gather::ERROR,
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
                level.run(GatherTile {
                    state,
                    v_out,
                    background,
                    size: [width, height],
                    corner: [(tile % bins.tiles_x) * TILE, (tile / bins.tiles_x) * TILE],
                    v_tile: &mut v_tile,
                    rest: &mut rest,
                });
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
        let chunks = stride.div_ceil(CHUNK);
        if (gradients.active.len(), gradients.counts.len()) != (stride, chunks) {
            gradients.active.clear();
            gradients.active.resize(stride, 0.0);
            gradients.counts.clear();
            gradients.counts.resize(chunks, 0);
        }
        let degree = self.options.sh_degree.min(splats.sh_degree());
        let mut outcomes = vec![ChunkOutcome::default(); chunks];
        let (level, this) = (self.level, &*self);
        GradientRun::new(gradients, &mut outcomes).for_each_chunk(0, &self.visible, &|chunk, to| {
            level.run(ProjectChunkVjp {
                renderer: this,
                splats,
                view,
                degree,
                camera,
                chunk,
                to,
            });
        });
        gradients.non_finite = outcomes.iter().map(|chunk| chunk.non_finite).sum();
        gradients.camera = camera.then(|| {
            let mut sum = CameraGradient::default();
            for chunk in &outcomes {
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

/// Results of the stages, with which those of other devices are compared.
#[cfg(all(test, feature = "gpu"))]
impl Renderer {
    /// Splat `i` on screen, if it is visible: the words of `footprints` in the shaders.
    pub(crate) fn footprint_words(&self, i: usize) -> Option<[f32; 12]> {
        let s = &self.footprints[i];
        let ([x, y], [a, b, c], [red, green, blue]) = (s.xy, s.quadratic, s.color);
        let words = [
            x,
            y,
            a,
            b,
            c,
            s.log2_opacity,
            red,
            green,
            blue,
            s.depth,
            s.extent[0],
            s.extent[1],
        ];
        (self.depth_keys[i] != u32::MAX).then_some(words)
    }

    /// The sums of blending of each splat over all tiles.
    pub(crate) fn sums_by_splat(&self) -> Vec<[f64; SUMS]> {
        let mut of_splats = vec![[0.0; SUMS]; self.footprints.len()];
        let entries = (0..self.bins.tile_count()).flat_map(|tile| self.bins.tile(tile));
        for (entry, sums) in entries.zip(&self.sums) {
            for (to, sum) in of_splats[entry.splat as usize].iter_mut().zip(sums) {
                *to += f64::from(*sum);
            }
        }
        of_splats
    }
}

/// Parts of a frame's projection per thread: more parts balance the load better, but each costs a counter for every tile.
const PARTS_PER_THREAD: usize = 4;

fn corner(bins: &Bins, tile: usize) -> [f32; 2] {
    [
        ((tile % bins.tiles_x) * TILE) as f32,
        ((tile / bins.tiles_x) * TILE) as f32,
    ]
}

/// The SH basis of the direction from `center` to `mean`.
#[cfg(feature = "gpu")]
pub(crate) fn basis_at(degree: u32, mean: [f32; 3], center: [f64; 3]) -> [f32; 16] {
    let (d, _) = sh::direction(mean.map(f64::from), center);
    sh::basis(degree, d).map(|v| v as f32)
}
