//! Which tiles a splat touches, and which of their blocks.
//!
//! A splat is tested against *bands* 8 pixels wide: within a band of x its ellipse (the set alpha >= 1/255) spans one exact
//! interval of y, which gives the tiles touched and, in each, the blocks to visit. Most splats touch few bands: their spans are
//! computed for a vector of splats at a time, those of larger ones splat by splat.

use super::bin::{BAND_BLOCKS, BLOCK_HEIGHT, BLOCK_WIDTH, TILE};
use super::blend::{Footprint2d, LOG2_ALPHA_MIN};
use irradia_compute::simd::{Lanes, Mask, Simd};

/// Margin on every side against rounding in the bounds, pixels.
const SLACK: f32 = 1e-2;
const BAND_WIDTH: f32 = BLOCK_WIDTH as f32;
/// Bands in a tile.
const TILE_BANDS: usize = TILE / BLOCK_WIDTH;
/// Spans of splats that touch more bands are not worth computing for a whole vector.
const MAX_BANDS: usize = 12;

/// First and last block from the image's top within a band; first > last if there is none.
type Span = (u32, u32);
const NO_SPAN: Span = (u32::MAX, 0);

/// The spans of a vector of splats.
pub(super) struct Spans {
    /// First and last band of each splat; first > last if it touches none.
    bands: [[f32; 16]; 2],
    /// First and last block, by band (counted from the splat's first) and lane, of splats that touch at most [`MAX_BANDS`] bands.
    blocks: [[[f32; 16]; 2]; MAX_BANDS],
}

/// The part of a splat's footprint that is needed here, one splat per lane.
#[derive(Clone, Copy)]
pub(super) struct Outline<F> {
    pub xy: [F; 2],
    pub extent: [F; 2],
    pub quadratic: [F; 3],
    pub log2_opacity: F,
}

impl Spans {
    /// The spans of the splats `visible` on an image of `tiles_x` by `tiles_y` tiles.
    #[inline(always)]
    pub fn new<F: Lanes<Scalar = f32>>(s: &Outline<F>, visible: F::Mask, tiles_x: usize, tiles_y: usize) -> Self {
        let constant = |value: f32| s.log2_opacity.simd().set(value);
        let (zero, half) = (constant(0.0), constant(0.5));
        let [x, y] = s.xy;
        let [ex, ey] = s.extent;
        let [a, b, c] = s.quadratic;
        let (per_width, slack) = (constant(1.0 / BAND_WIDTH), constant(SLACK));
        let top_band = constant((tiles_x * TILE_BANDS) as f32 - 1.0);
        // Pixel centres of band k lie at 8 k + 0.5 ..= 8 k + 7.5.
        let first = ceil((x - ex - slack - constant(BAND_WIDTH - 0.5)) * per_width).max(zero);
        let last = ((x + ex + slack - half) * per_width).floor().min(top_band);
        let mut spans = Self {
            bands: [[0.0; 16]; 2],
            blocks: [[[0.0; 16]; 2]; MAX_BANDS],
        };
        first.store(&mut spans.bands[0]);
        last.store(&mut spans.bands[1]);
        let narrow = visible.and((last - first).lt(constant(MAX_BANDS as f32)));
        // d^T conic d <= t with conic = -(a, b / 2, c).
        let t = s.log2_opacity - constant(LOG2_ALPHA_MIN as f32);
        let (inv_ex, middle_slope) = (ex.max(constant(1e-6)).recip(), constant(-0.5) * b * c.recip());
        let half_height_squared = -t * c.recip();
        // Highest and lowest point of the ellipse: dx = +- x_at_top.
        let x_at_top = constant(-0.5) * b * a.recip() * ey;
        let last_image_row = constant((tiles_y * TILE) as f32 - 1.0);
        let (one, per_height) = (constant(1.0), constant(1.0 / BLOCK_HEIGHT as f32));
        for k in 0..MAX_BANDS {
            let band = first + constant(k as f32);
            if narrow.and(band.le(last)).none() {
                break;
            }
            let edge = band * constant(BAND_WIDTH) - x;
            let left = (edge + half).max(-ex);
            let right = (edge + constant(BAND_WIDTH - 0.5)).min(ex);
            // `right < left` only within the margin: then both clamps give an end of the ellipse.
            let dx_high = x_at_top.min(right).max(left);
            let dx_low = (-x_at_top).min(right).max(left);
            let (u_high, u_low) = (dx_high * inv_ex, dx_low * inv_ex);
            let high = middle_slope * dx_high + (half_height_squared * (one - u_high * u_high).max(zero)).sqrt();
            let low = middle_slope * dx_low - (half_height_squared * (one - u_low * u_low).max(zero)).sqrt();
            // Rows whose centre r + 0.5 is in [y + low, y + high].
            let first_row = ceil(y + low - half - slack).max(zero);
            let last_row = (y + high - half + slack).floor().min(last_image_row);
            let hit = first_row.le(last_row);
            let [first_block, last_block] = &mut spans.blocks[k];
            (first_row * per_height).floor().select(hit, one).store(first_block);
            (last_row * per_height).floor().select(hit, zero).store(last_block);
        }
        spans
    }

    /// Calls `hit(tile, blocks)` for every tile in which some pixel centre may lie inside the ellipse of the splat in `lane`, whose
    /// footprint is `s`.
    #[inline(always)]
    pub fn tiles(&self, lane: usize, s: &Footprint2d, tiles_x: usize, tiles_y: usize, hit: impl FnMut(u32, u64)) {
        let [first, last] = [self.bands[0][lane], self.bands[1][lane]];
        if last < first {
            return;
        }
        // Via i32: converting a float to usize directly takes three times the instructions.
        let [first, last] = [first as i32 as usize, last as i32 as usize];
        if last - first < MAX_BANDS {
            let span = |band: usize| {
                let [from, to] = &self.blocks[band - first];
                (from[lane] as i32 as u32, to[lane] as i32 as u32)
            };
            tiles_of([first, last], span, tiles_x, hit);
        } else {
            tiles_of([first, last], wide_spans(s, tiles_y), tiles_x, hit);
        }
    }
}

#[inline(always)]
fn ceil<F: Lanes>(v: F) -> F {
    -(-v).floor()
}

/// The spans of one splat that touches many bands.
#[inline(always)]
fn wide_spans(s: &Footprint2d, tiles_y: usize) -> impl Fn(usize) -> Span {
    let [x, y] = s.xy;
    let [ex, ey] = s.extent;
    let [a, b, c] = s.quadratic;
    let t = s.log2_opacity - LOG2_ALPHA_MIN as f32;
    let (inv_ex, middle_slope) = (1.0 / ex.max(1e-6), -0.5 * b / c);
    let half_height_squared = -t / c;
    let x_at_top = -0.5 * b / a * ey;
    let last_image_row = (tiles_y * TILE) as f32 - 1.0;
    move |band: usize| {
        let edge = band as f32 * BAND_WIDTH - x;
        let (left, right) = ((edge + 0.5).max(-ex), (edge + BAND_WIDTH - 0.5).min(ex));
        let dx_high = x_at_top.min(right).max(left);
        let dx_low = (-x_at_top).min(right).max(left);
        let (u_high, u_low) = (dx_high * inv_ex, dx_low * inv_ex);
        let high = middle_slope * dx_high + (half_height_squared * (1.0 - u_high * u_high).max(0.0)).sqrt();
        let low = middle_slope * dx_low - (half_height_squared * (1.0 - u_low * u_low).max(0.0)).sqrt();
        let first_row = (y + low - 0.5 - SLACK).ceil().max(0.0);
        let last_row = (y + high - 0.5 + SLACK).floor().min(last_image_row);
        if first_row <= last_row {
            (
                first_row as i32 as u32 / BLOCK_HEIGHT as u32,
                last_row as i32 as u32 / BLOCK_HEIGHT as u32,
            )
        } else {
            NO_SPAN
        }
    }
}

/// Converts the spans of the bands `first_band..=last_band` to tiles and blocks.
#[inline(always)]
fn tiles_of(
    [first_band, last_band]: [usize; 2],
    span: impl Fn(usize) -> Span,
    tiles_x: usize,
    mut hit: impl FnMut(u32, u64),
) {
    for column in first_band / TILE_BANDS..=last_band / TILE_BANDS {
        let mut spans = [NO_SPAN; TILE_BANDS];
        let (mut first, mut last) = NO_SPAN;
        for band in first_band.max(TILE_BANDS * column)..=last_band.min(TILE_BANDS * column + TILE_BANDS - 1) {
            let s = span(band);
            spans[band % TILE_BANDS] = s;
            if s.0 <= s.1 {
                first = first.min(s.0);
                last = last.max(s.1);
            }
        }
        if first > last {
            continue;
        }
        let blocks_of_row = BAND_BLOCKS as u32;
        for tile_row in first / blocks_of_row..=last / blocks_of_row {
            let top = tile_row * blocks_of_row;
            let mut blocks = 0u64;
            for (band, (first, last)) in spans.iter().enumerate() {
                let (first, last) = ((*first).max(top), (*last).min(top + blocks_of_row - 1));
                if first <= last {
                    blocks |= ((2u64 << (last - top)) - (1 << (first - top))) << (band * BAND_BLOCKS);
                }
            }
            if blocks != 0 {
                hit(tile_row * tiles_x as u32 + column as u32, blocks);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_compute::simd::{Kernel, Level};
    use irradia_scene::Rng;
    use std::collections::HashMap;

    /// The tiles of one splat in the first lane.
    struct One<'a>(&'a Footprint2d, usize, usize);

    impl Kernel for One<'_> {
        type Output = HashMap<u32, u64>;

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> HashMap<u32, u64>
        where
            S::F: Lanes<Scalar = f32>,
        {
            let Self(s, tiles_x, tiles_y) = self;
            let outline = Outline {
                xy: s.xy.map(|v| simd.set(v)),
                extent: s.extent.map(|v| simd.set(v)),
                quadratic: s.quadratic.map(|v| simd.set(v)),
                log2_opacity: simd.set(s.log2_opacity),
            };
            let visible = simd.splat(0.0).le(simd.splat(0.0));
            let mut blocks = HashMap::new();
            Spans::new(&outline, visible, tiles_x, tiles_y).tiles(0, s, tiles_x, tiles_y, |tile, b| {
                assert!(blocks.insert(tile, b).is_none(), "a tile is listed once");
            });
            blocks
        }
    }

    /// Every pixel that the formula touches is in a listed tile and block; few blocks are listed unnecessarily.
    #[test]
    fn no_touched_pixel_is_missed_and_blocks_are_tight() {
        for level in Level::all() {
            let mut rng = Rng::new(3, 1);
            let (tiles_x, tiles_y) = (4, 2);
            let (mut listed_blocks, mut needed_blocks) = (0usize, 0usize);
            for _ in 0..300 {
                let (sx, sy) = ((rng.range(-1.0, 4.5)).exp(), (rng.range(-1.0, 3.0)).exp());
                let angle = rng.range(0.0, 3.15);
                let (sin, cos) = angle.sin_cos();
                let covariance = [
                    cos * cos * sx * sx + sin * sin * sy * sy + 0.3,
                    sin * cos * (sx * sx - sy * sy),
                    sin * sin * sx * sx + cos * cos * sy * sy + 0.3,
                ];
                let det = covariance[0] * covariance[2] - covariance[1] * covariance[1];
                let opacity = rng.range(0.01, 1.0);
                let k = -0.5 * std::f32::consts::LOG2_E / det;
                let reach = 2.0 * (255.0 * opacity).ln();
                let s = Footprint2d {
                    xy: [rng.range(-30.0, 140.0), rng.range(-30.0, 94.0)],
                    quadratic: [k * covariance[2], -2.0 * k * covariance[1], k * covariance[0]],
                    log2_opacity: opacity.log2(),
                    extent: [(reach * covariance[0]).sqrt(), (reach * covariance[2]).sqrt()],
                    ..Default::default()
                };
                let blocks = level.run(One(&s, tiles_x, tiles_y));
                for tile in 0..(tiles_x * tiles_y) as u32 {
                    let corner = [(tile as usize % tiles_x) * TILE, (tile as usize / tiles_x) * TILE];
                    for block in 0..64 {
                        let needed = (0..16).any(|i| {
                            let column = block / BAND_BLOCKS * BLOCK_WIDTH + i % BLOCK_WIDTH;
                            let row = block % BAND_BLOCKS * BLOCK_HEIGHT + i / BLOCK_WIDTH;
                            let d = [
                                (corner[0] + column) as f32 + 0.5 - s.xy[0],
                                (corner[1] + row) as f32 + 0.5 - s.xy[1],
                            ];
                            let [a, b, c] = s.quadratic;
                            a * d[0] * d[0] + b * d[0] * d[1] + c * d[1] * d[1] + s.log2_opacity
                                >= LOG2_ALPHA_MIN as f32
                        });
                        let listed = blocks.get(&tile).is_some_and(|blocks| blocks >> block & 1 == 1);
                        assert!(listed || !needed, "tile {tile} block {block} of {s:?}");
                        listed_blocks += usize::from(listed);
                        needed_blocks += usize::from(needed);
                    }
                }
            }
            // A thin ellipse may pass between pixel centres; otherwise no block is listed unnecessarily.
            assert!(
                listed_blocks < needed_blocks + needed_blocks / 20,
                "{listed_blocks} listed, {needed_blocks} needed"
            );
        }
    }
}
