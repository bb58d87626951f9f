//! Frames on the GPU.

use crate::render::{FramePlanes, RenderOptions};
use crate::shaders::Kernels;
use crate::{Splats, ViewParams};
use irradia_compute::DeviceError;
use irradia_compute::gpu::{Array, Gpu, PART_ALIGN, Readback, Scan, Sort, WORKGROUP_SIZE, Work, flags};
use std::sync::{Arc, OnceLock};

/// Width and height of a tile, pixels.
pub(super) const TILE: u32 = 16;
/// Entries of a segment; the state of pixels is kept at the beginnings of segments.
const SEGMENT: usize = 256;
/// Words of a segment's state: five channels of each pixel of a tile.
const SEGMENT_STATE: usize = 5 * (TILE * TILE) as usize;
/// Planes of a frame: red, green, blue, alpha, depth.
pub(super) const FRAME_PLANES: usize = 5;
/// Planes of the geometry: means, quaternions, ln scales, opacity logit.
pub(super) const GEOMETRY: usize = 11;

/// Bits of `View.flags` in `view.wgsl`.
pub(super) mod flag {
    pub const ANTIALIAS: u32 = 1;
    pub const FILTER: u32 = 2;
    pub const CLAMP: u32 = 4;
    pub const TRAINS: u32 = 8;
    pub const DEPTH: u32 = 16;
    pub const ALPHA: u32 = 32;
    pub const GATHER_ABSOLUTE: u32 = 64;
    pub const GATHER_ERROR: u32 = 128;
    pub const CAMERA: u32 = 256;
}

/// Sizes of the uploaded splats.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SplatsShape {
    /// Number of splats.
    pub count: usize,
    /// Stride of their planes.
    pub stride: usize,
    /// SH degree for which the harmonics have room.
    pub degree: u32,
}

/// A renderer on the GPU: the twin of [`crate::Renderer`], with its conventions and formulas; sums are computed in another order.
///
/// The shapes of its arrays are those of their content; they have room for more. An entry is a splat in the list of a tile, and a slot is
/// the place of that pair in the list by splats, front to back.
pub struct GpuRenderer {
    pub(super) gpu: Arc<Gpu>,
    pub(super) kernels: Kernels,
    /// Words of `View` in `view.wgsl`.
    pub(super) view: Array,
    /// `[GEOMETRY, stride]` f32: means, quaternions, ln scales, opacity logits.
    pub(super) geometry: Array,
    /// `[coefficients, 3, stride]` f32: SH coefficients.
    pub(super) harmonics: Array,
    /// `[stride]` f32: variances of the splats' 3D smoothing filter, world units squared; empty without a filter.
    pub(super) filter: Array,
    pub(super) shape: SplatsShape,
    /// Whether splats are convolved with `filter`.
    pub(crate) filters: bool,
    /// `[splats, 12]` f32: x, y, a, b, c, log2 of the opacity, red, green, blue, depth, half width and half height of the bounding box;
    /// valid for visible splats.
    pub(super) footprints: Array,
    /// `[splats]` u32: 1 for visible splats, else 0.
    pub(super) visible: Array,
    /// `[splats]` u32: number of tiles that each touches; 0 for those that are not visible.
    pub(super) touched: Array,
    /// `[4]` u32: numbers of visible splats, of entries, and of splats whose gradient is not finite; the last word is unused.
    pub(super) found: Array,
    /// `[visible]` u32: the visible splats, first ascending, then front to back.
    pub(super) order: Array,
    /// `[visible]` u32: the first slot of each visible splat, front to back.
    pub(super) firsts: Array,
    /// `[entries]` u32: the slot of each entry, first ascending, then tile by tile, front to back.
    pub(super) slots: Array,
    /// `[entries]` u32: the splat of each slot.
    pub(super) splat_of_slot: Array,
    /// `[tiles + 1, 2]` u32: where each tile's entries begin and end in `slots`; the last range is that of entries without a tile.
    pub(super) ranges: Array,
    /// `[tiles + 1]` u32: the first segment of each tile, then the number of segments.
    pub(super) first_segments: Array,
    /// `[segments]` u32: the tile of each segment, in training.
    pub(super) tile_of_segment: Array,
    /// `[tiles]` u32: number of segments of each tile that some pixel needs, in training.
    pub(super) reached: Array,
    /// `[segments, 5, TILE * TILE]` f32: red, green, blue, depth and transmittance of a tile's pixels before each of its segments but the
    /// first, in training.
    pub(super) states: Array,
    /// `[FRAME_PLANES, H, W]` f32: red, green, blue, alpha, depth.
    pub(super) planes: Array,
    /// `[splats]` u32: place of each visible splat among the visible ones, first in their own order, then front to back.
    pub(super) places: Array,
    /// `[visible]` u32: bits of the depths of the splats in `order`, by which these are sorted.
    depths: Array,
    /// `[visible]` u32: number of tiles that each visible splat touches, front to back.
    counts: Array,
    /// `[entries]` u32: the tile of each slot; sorted, that of each entry.
    tiles: Array,
    /// `[tiles + 1]` u32: number of segments of each tile; 0 for entries without a tile.
    segment_counts: Array,
    scan: Scan,
    /// Parameters of the prefix sums of `visible`, of `counts` and of `segment_counts`.
    scan_params: [Array; 3],
    sort_depths: Sort,
    sort_tiles: Sort,
    /// `[1]` u32 each: numbers of visible splats and of entries if there is room for these, else 0; parts of `all_counted`.
    counted: [Array; 2],
    all_counted: Array,
    /// Number of tile entries for which there is room.
    room: usize,
    readback: Readback,
    pub(super) last: Option<Last>,
    /// Non-finite gradients that a void frame reported: its repetition counts from zero again.
    void_non_finite: usize,
    /// `planes` on the host, once they are read.
    host: OnceLock<Vec<f32>>,
}

/// The last frame.
#[derive(Clone, Debug)]
pub(super) struct Last {
    pub view: ViewParams,
    pub options: RenderOptions,
    /// Whether the backward pass may follow.
    pub trains: bool,
    /// Number of tile entries for which there is room.
    pub room: usize,
    /// Numbers of visible splats and of entries of tiles, once the host knows them.
    pub found: [usize; 2],
    /// Number of splats whose gradient was not finite in the backward pass before this frame, once the host knows it.
    pub non_finite: usize,
}

impl Last {
    pub fn pixels(&self) -> usize {
        self.view.width as usize * self.view.height as usize
    }

    fn tiles(&self) -> [u32; 2] {
        [self.view.width, self.view.height].map(|size| size.div_ceil(TILE))
    }

    pub fn tile_count(&self) -> usize {
        let [x, y] = self.tiles();
        x as usize * y as usize
    }

    /// Maximum number of segments.
    pub fn segments(&self) -> usize {
        self.room / SEGMENT + self.tile_count()
    }
}

impl GpuRenderer {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// When the device refuses one.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, DeviceError> {
        let array = |label| Array::zeros(&gpu, label, 0);
        let all_counted = Array::zeros(&gpu, "counts", 2 * PART_ALIGN);
        let renderer = Self {
            kernels: Kernels::new(&gpu, ""),
            view: Array::zeros(&gpu, "view", VIEW_WORDS),
            geometry: array("geometry"),
            harmonics: array("harmonics"),
            filter: array("filter"),
            shape: SplatsShape::default(),
            filters: false,
            footprints: array("footprints"),
            visible: array("visible splats"),
            touched: array("touched tiles"),
            found: Array::zeros(&gpu, "found", 4),
            order: array("order of splats"),
            firsts: array("first slots"),
            slots: array("slots"),
            splat_of_slot: array("splats of slots"),
            ranges: array("ranges of tiles"),
            first_segments: array("first segments"),
            tile_of_segment: array("tiles of segments"),
            reached: array("reached segments"),
            states: array("states of pixels"),
            planes: array("frame"),
            places: array("places of visible splats"),
            depths: array("depths"),
            counts: array("counts of tiles"),
            tiles: array("tiles"),
            segment_counts: array("counts of segments"),
            scan: Scan::new(&gpu),
            counted: [0, PART_ALIGN].map(|at| all_counted.part(at, 4)),
            all_counted,
            room: 0,
            readback: Readback::new(&gpu, 4),
            scan_params: [(); 3].map(|()| Scan::params(&gpu)),
            sort_depths: Sort::new(&gpu, 32),
            sort_tiles: Sort::new(&gpu, 32),
            last: None,
            void_non_finite: 0,
            host: OnceLock::new(),
            gpu,
        };
        renderer.gpu.check()?;
        Ok(renderer)
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Uploads the splats of the next frames, and the variances of their 3D smoothing filter, if any.
    pub fn upload(&mut self, splats: &Splats, filter: &[f32]) {
        self.harmonics.reserve(&self.gpu, splats.sh.as_slice().len());
        self.harmonics.write(&self.gpu, 0, splats.sh.as_slice());
        self.upload_geometry(splats, filter, splats.sh_degree());
        self.filters = !filter.is_empty();
        self.last = None;
    }

    /// Uploads everything but the harmonics, whose array has room for `degree`.
    pub(super) fn upload_geometry(&mut self, splats: &Splats, filter: &[f32], degree: u32) {
        let (gpu, stride) = (&self.gpu, splats.stride());
        self.shape = SplatsShape {
            count: splats.len(),
            stride,
            degree,
        };
        self.geometry.reserve(gpu, GEOMETRY * stride);
        write_geometry(gpu, &self.geometry, 0, splats);
        self.filter.reserve(gpu, filter.len());
        self.filter.write(gpu, 0, filter);
        self.footprints.reserve(gpu, 12 * stride);
        for array in [
            &mut self.visible,
            &mut self.touched,
            &mut self.places,
            &mut self.depths,
            &mut self.order,
            &mut self.counts,
            &mut self.firsts,
        ] {
            array.reserve(gpu, stride);
        }
    }

    /// Renders the uploaded splats.
    pub fn render(&mut self, view: &ViewParams, options: &RenderOptions) {
        self.draw_whole(view, options, false);
    }

    /// As [`Self::render`]; if `trains` is set, the backward pass may follow.
    pub(super) fn draw_whole(&mut self, view: &ViewParams, options: &RenderOptions, trains: bool) {
        loop {
            self.draw(view, options, trains);
            if self.finish_frame() {
                break;
            }
        }
    }

    /// Waits for the last frame's numbers of visible splats and of entries. If there was no room for all entries, makes room and returns
    /// `false`: the frame and everything derived from it are void and must be repeated.
    pub(crate) fn finish_frame(&mut self) -> bool {
        let Some(last) = self.last.as_mut().filter(|_| self.readback.is_pending()) else {
            return true;
        };
        let mut found = [0u32; 4];
        self.readback.take(&self.gpu, &mut found);
        let [visible, entries, non_finite, _] = found.map(|n| n as usize);
        last.found = [visible, entries];
        last.non_finite = non_finite.max(std::mem::take(&mut self.void_non_finite));
        if entries > last.room {
            self.void_non_finite = last.non_finite;
        }
        // An eighth more, since the next view may need it.
        if entries + entries / 8 > self.room {
            self.room = entries + entries / 4;
        }
        entries <= last.room
    }

    /// Submits a frame. The numbers of visible splats and of tile entries stay on the device: arrays have room for the most so far, and
    /// enough workgroups are dispatched for that many. [`Self::finish_frame`] must follow.
    pub(super) fn draw(&mut self, view: &ViewParams, options: &RenderOptions, trains: bool) {
        let gpu = self.gpu.clone();
        let count = self.shape.count;
        self.host = OnceLock::new();
        // One entry per splat to begin with, which takes little memory.
        self.room = self.room.max(count);
        let last = Last {
            view: view.clone(),
            options: *options,
            trains,
            room: self.room,
            found: [0; 2],
            non_finite: 0,
        };
        let tiles = last.tile_count();
        for array in [&mut self.tiles, &mut self.slots, &mut self.splat_of_slot] {
            array.reserve(&gpu, last.room);
        }
        // After the tiles, one range for entries that belong to none.
        self.ranges.reserve(&gpu, 2 * (tiles + 1));
        for array in [&mut self.segment_counts, &mut self.first_segments, &mut self.reached] {
            array.reserve(&gpu, tiles + 1);
        }
        if trains {
            self.tile_of_segment.reserve(&gpu, last.segments());
            self.states.reserve(&gpu, SEGMENT_STATE * last.segments());
        }
        self.planes.reserve(&gpu, FRAME_PLANES * last.pixels());
        self.view.write(&gpu, 0, &self.view_words(&last));

        let mut work = Work::new(&gpu);
        self.project(&mut work);
        self.bin(&mut work, &last);
        self.blend(&mut work, &last);
        work.submit_reading(&self.found, &mut self.readback);
        self.last = Some(last);
    }

    /// Projects splats to footprints, and counts the tiles that each touches.
    pub(super) fn project(&self, work: &mut Work) {
        work.clear(&self.found, 2);
        work.run(
            &self.kernels.project,
            &[
                &self.view,
                &self.geometry,
                &self.harmonics,
                &self.filter,
                &self.footprints,
                &self.visible,
                &self.touched,
                &self.found,
            ],
            groups(self.shape.count),
        );
    }

    /// Builds the lists of all tiles, front to back, from the footprints, and the segments of these lists.
    pub(super) fn bin(&mut self, work: &mut Work, last: &Last) {
        let count = self.shape.count;
        let tiles = last.tile_count();
        self.scan
            .run(work, &self.scan_params[0], &self.visible, &self.places, count);
        let kernels = &self.kernels;
        work.run(
            &kernels.compact,
            &[
                &self.view,
                &self.visible,
                &self.places,
                &self.footprints,
                &self.depths,
                &self.order,
            ],
            groups(count),
        );
        work.run(&kernels.admit, &[&self.found, &self.view, &self.all_counted], 1);
        let [visible, entries] = &self.counted;
        self.sort_depths
            .run(work, &self.depths, &self.order, visible, count, u32::BITS);
        work.run(
            &kernels.count,
            &[&self.view, &self.order, &self.touched, &self.counts, &self.places],
            groups(count),
        );
        // Counts beyond the visible splats are stale, but are in no sum that is used.
        self.scan
            .run(work, &self.scan_params[1], &self.counts, &self.firsts, count);
        work.run(
            &kernels.emit,
            &[
                &self.view,
                &self.order,
                &self.firsts,
                &self.touched,
                &self.footprints,
                &self.tiles,
                &self.slots,
                &self.splat_of_slot,
            ],
            groups(count),
        );
        let bits = u32::BITS - (tiles as u32).leading_zeros();
        self.sort_tiles
            .run(work, &self.tiles, &self.slots, entries, last.room, bits);
        work.clear(&self.ranges, 2 * (tiles + 1));
        work.run(
            &kernels.ranges,
            &[&self.view, &self.tiles, &self.ranges],
            groups(last.room),
        );
        work.run(
            &kernels.segments,
            &[&self.view, &self.ranges, &self.segment_counts],
            groups(tiles + 1),
        );
        self.scan.run(
            work,
            &self.scan_params[2],
            &self.segment_counts,
            &self.first_segments,
            tiles + 1,
        );
    }

    /// Blends the lists of tiles into pixels.
    pub(super) fn blend(&self, work: &mut Work, last: &Last) {
        work.run(
            &self.kernels.blend,
            &[
                &self.view,
                &self.ranges,
                &self.slots,
                &self.splat_of_slot,
                &self.footprints,
                &self.first_segments,
                &self.tile_of_segment,
                &self.reached,
                &self.states,
                &self.planes,
            ],
            last.tile_count(),
        );
    }

    /// Sets the flags that the backward pass needs in addition to the frame's.
    pub(super) fn add_flags(&self, last: &Last, more: u32) {
        let at = VIEW_WORDS - 4;
        self.view.write(&self.gpu, at, &[self.view_words(last)[at] | more]);
    }

    /// The last frame, which is read back on the first call.
    ///
    /// # Panics
    /// When nothing was rendered.
    pub fn frame(&self) -> FramePlanes<'_> {
        let last = self.last.as_ref().expect("render comes first");
        let pixels = last.pixels();
        let host = self
            .host
            .get_or_init(|| self.planes.to_vec(&self.gpu, FRAME_PLANES * pixels));
        FramePlanes {
            color: &host[..3 * pixels],
            alpha: &host[3 * pixels..4 * pixels],
            depth: if last.options.depth { &host[4 * pixels..] } else { &[] },
        }
    }

    /// SH degree for which the harmonics have room.
    pub(crate) fn sh_degree(&self) -> u32 {
        self.shape.degree
    }

    /// Pixels of the last frame.
    pub fn pixels(&self) -> usize {
        self.last.as_ref().map_or(0, Last::pixels)
    }

    /// Splats that touched the last frame.
    pub fn visible(&self) -> usize {
        self.last.as_ref().map_or(0, |last| last.found[0])
    }

    /// Intersections of splats and tiles in the last frame.
    pub fn intersections(&self) -> usize {
        self.last.as_ref().map_or(0, |last| last.found[1])
    }

    /// Splat-pixel pairs of the last frame, counting all pixels of each touched tile.
    pub fn pairs(&self) -> u64 {
        self.intersections() as u64 * u64::from(TILE * TILE)
    }

    /// The words of `View` before projection, with nothing found yet.
    fn view_words(&self, last: &Last) -> [u32; VIEW_WORDS] {
        let Last {
            view, options, trains, ..
        } = last;
        let SplatsShape { count, stride, degree } = self.shape;
        let mut floats = Vec::with_capacity(28);
        for (row, t) in view.rotation.iter().zip(view.translation) {
            floats.extend(row.iter().chain([&t]).map(|v| *v as f32));
        }
        floats.extend(view.center().map(|v| v as f32));
        floats.push(view.near as f32);
        floats.extend(view.focal.iter().chain(&view.principal).map(|v| *v as f32));
        floats.extend(view.tangent_limits().as_flattened().iter().map(|v| *v as f32));
        floats.extend(options.background.iter().chain([&0.0]));
        let [tiles_x, tiles_y] = last.tiles();
        let bits = [
            (options.antialias, flag::ANTIALIAS),
            (self.filters, flag::FILTER),
            (true, flag::CLAMP),
            (*trains, flag::TRAINS),
        ];
        // Whole chunks, as drawn by the twin.
        let drawn = options
            .first
            .div_ceil(crate::render::CHUNK)
            .saturating_mul(crate::render::CHUNK)
            .min(count);
        let integers = [
            view.width,
            view.height,
            tiles_x,
            tiles_y,
            count as u32,
            stride as u32,
            options.sh_degree.min(degree),
            drawn as u32,
            0,
            0,
            last.room as u32,
            0,
            flags(&bits),
            0,
            0,
            0,
        ];
        let mut words = [0; VIEW_WORDS];
        for (to, word) in words.iter_mut().zip(floats.iter().map(|v| v.to_bits()).chain(integers)) {
            *to = word;
        }
        words
    }
}

/// Words of `View` in `view.wgsl`.
const VIEW_WORDS: usize = 44;

/// Number of workgroups for `items` items.
fn groups(items: usize) -> usize {
    items.div_ceil(WORKGROUP_SIZE as usize)
}

/// Writes everything but the harmonics, plane by plane, from plane `first` on.
pub(super) fn write_geometry(gpu: &Gpu, to: &Array, first: usize, splats: &Splats) {
    let mut at = first * splats.stride();
    for column in [&splats.means, &splats.quats, &splats.log_scales, &splats.opacity_logits] {
        to.write(gpu, at, column.as_slice());
        at += column.as_slice().len();
    }
}

/// The reverse of [`write_geometry`].
pub(super) fn read_geometry(gpu: &Gpu, from: &Array, first: usize, splats: &mut Splats) {
    let mut at = first * splats.stride();
    for column in [
        &mut splats.means,
        &mut splats.quats,
        &mut splats.log_scales,
        &mut splats.opacity_logits,
    ] {
        from.read(gpu, at, column.as_mut_slice());
        at += column.as_slice().len();
    }
}
