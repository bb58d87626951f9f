//! Brings pixels from the tiles' order into the image's, and the gradients of the image back into the tiles' order. These are kernels
//! only so that the compiler uses wide instructions.

use super::bin::{BAND_BLOCKS, BLOCK_HEIGHT, BLOCK_WIDTH, TILE};
use super::blend::{BLOCK, CHANNELS, TILE_PIXELS};
use super::{Gather, OutputGradient};
use irradia_compute::simd::{Kernel, Lanes, Simd};

/// All tiles' pixels, `[tiles, CHANNELS, blocks, BLOCK]`.
#[derive(Clone, Copy)]
pub(super) struct Tiles<'a> {
    pub values: &'a [f32],
    pub tiles_x: usize,
}

impl Tiles<'_> {
    /// The eight pixels of a channel in row y starting at column x, a multiple of eight.
    #[inline(always)]
    fn run(&self, channel: usize, y: usize, x: usize) -> &[f32; BLOCK_WIDTH] {
        let tile = (y / TILE) * self.tiles_x + x / TILE;
        let at = (tile * CHANNELS + channel) * TILE_PIXELS + pixel_in_tile(x % TILE, y % TILE);
        self.values[at..].first_chunk().expect("a whole run")
    }
}

/// What a line of an image shows.
#[derive(Clone, Copy)]
pub(super) enum Content {
    /// A channel of the colour, over the background's.
    Color(usize, f32),
    Alpha,
    Depth,
}

/// Writes a line of an image.
pub(super) struct UntileLine<'a> {
    pub tiles: Tiles<'a>,
    pub y: usize,
    pub content: Content,
    pub to: &'a mut [f32],
}

impl Kernel for UntileLine<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let (tiles, y) = (self.tiles, self.y);
        let (whole, rest) = self.to.as_chunks_mut::<BLOCK_WIDTH>();
        let end = BLOCK_WIDTH * whole.len();
        for (i, to) in whole.iter_mut().enumerate() {
            *to = untiled(tiles, self.content, y, i * BLOCK_WIDTH);
        }
        if !rest.is_empty() {
            rest.copy_from_slice(&untiled(tiles, self.content, y, end)[..rest.len()]);
        }
    }
}

#[inline(always)]
fn untiled(tiles: Tiles, content: Content, y: usize, x: usize) -> [f32; BLOCK_WIDTH] {
    let mut to = [0.0; BLOCK_WIDTH];
    let t = tiles.run(CHANNELS - 1, y, x);
    match content {
        Content::Color(channel, background) => {
            let color = tiles.run(channel, y, x);
            for i in 0..BLOCK_WIDTH {
                to[i] = color[i] + t[i].abs() * background;
            }
        }
        Content::Alpha => {
            for i in 0..BLOCK_WIDTH {
                to[i] = 1.0 - t[i].abs();
            }
        }
        Content::Depth => to = *tiles.run(3, y, x),
    }
    to
}

/// Gathers what the backward pass of a tile reads.
pub(super) struct GatherTile<'a> {
    /// The tile's pixels after blending.
    pub state: &'a [f32; CHANNELS * TILE_PIXELS],
    pub v_out: &'a OutputGradient<'a>,
    pub background: [f32; 3],
    /// Width and height of the image, pixels.
    pub size: [usize; 2],
    /// The tile's first column and row.
    pub corner: [usize; 2],
    /// As [`super::blend::BlendTileVjp::v_out`]; zeros on entry.
    pub v_tile: &'a mut [f32; CHANNELS * TILE_PIXELS],
    /// As [`super::blend::BlendTileVjp::rest`]; zeros on entry.
    pub rest: &'a mut [f32; TILE_PIXELS],
}

impl Kernel for GatherTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let [width, height] = self.size;
        let [x0, y0] = self.corner;
        let columns = TILE.min(width - x0);
        for row in 0..TILE.min(height - y0) {
            let image = (y0 + row) * width + x0;
            for column in (0..columns).step_by(BLOCK_WIDTH) {
                let (at, from, left) = (pixel_in_tile(column, row), image + column, columns - column);
                let mut t = *run_at(self.state, CHANNELS - 1, at);
                for t in &mut t {
                    *t = t.abs();
                }
                let mut total = [0.0f32; BLOCK_WIDTH];
                for c in 0..3 {
                    let v = run_of(&self.v_out.color[c * width * height + from..], left);
                    let color = run_at(self.state, c, at);
                    for i in 0..BLOCK_WIDTH {
                        total[i] += (color[i] + t[i] * self.background[c]) * v[i];
                    }
                    put(self.v_tile, c, at, v);
                }
                if let Some(v_depth) = self.v_out.depth {
                    let (v, depth) = (run_of(&v_depth[from..], left), run_at(self.state, 3, at));
                    for i in 0..BLOCK_WIDTH {
                        total[i] += depth[i] * v[i];
                    }
                    put(self.v_tile, 3, at, v);
                }
                if let Gather::Error(error) = self.v_out.gather {
                    put(self.v_tile, 4, at, run_of(&error[from..], left));
                }
                if let Some(v_alpha) = self.v_out.alpha {
                    let v = run_of(&v_alpha[from..], left);
                    for i in 0..BLOCK_WIDTH {
                        total[i] -= t[i] * v[i];
                    }
                }
                self.rest[at..at + BLOCK_WIDTH].copy_from_slice(&total);
            }
        }
    }
}

#[inline(always)]
fn run_at(tile: &[f32; CHANNELS * TILE_PIXELS], channel: usize, at: usize) -> &[f32; BLOCK_WIDTH] {
    tile[channel * TILE_PIXELS + at..].first_chunk().expect("a run")
}

#[inline(always)]
fn put(tile: &mut [f32; CHANNELS * TILE_PIXELS], channel: usize, at: usize, run: [f32; BLOCK_WIDTH]) {
    tile[channel * TILE_PIXELS + at..][..BLOCK_WIDTH].copy_from_slice(&run);
}

/// The first eight of `values`, with zeros from index `len` on.
#[inline(always)]
fn run_of(values: &[f32], len: usize) -> [f32; BLOCK_WIDTH] {
    match values.first_chunk() {
        Some(whole) if len >= BLOCK_WIDTH => *whole,
        _ => {
            let mut run = [0.0; BLOCK_WIDTH];
            let len = len.min(BLOCK_WIDTH);
            run[..len].copy_from_slice(&values[..len]);
            run
        }
    }
}

/// Index of pixel (x, y) of a tile in its block-wise order.
#[inline(always)]
fn pixel_in_tile(x: usize, y: usize) -> usize {
    let block = (x / BLOCK_WIDTH) * BAND_BLOCKS + y / BLOCK_HEIGHT;
    block * BLOCK + (y % BLOCK_HEIGHT) * BLOCK_WIDTH + x % BLOCK_WIDTH
}
