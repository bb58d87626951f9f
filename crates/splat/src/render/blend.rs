//! Front-to-back alpha blending of one tile, and its vector-Jacobian product.
//!
//! Symbols: `p = a dx^2 + b dx dy + c dy^2 + l` is log2 of alpha before the cap (conic and opacity folded in, so that a
//! fragment costs two fused operations and one exponential), `T` transmittance, `w = alpha T` weight.
//! Pixels are held block by block (8 columns, 2 rows): a block is one AVX-512 vector, two of AVX2.
//! A pixel that has terminated (a splat would have reduced T to 1e-4 or below) is stored with the sign of T flipped: every
//! later product then fails the same test, which saves a mask in the inner loop.

use super::bin::{BAND_BLOCKS, BLOCK_HEIGHT, BLOCK_WIDTH, Entry, TILE};
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};
use irradia_compute::unroll;
use std::f64::consts::LN_2;

/// Alpha never exceeds this (Inria code).
pub const ALPHA_MAX: f64 = 0.99;
/// A splat that would reduce the transmittance to this or less is not drawn and terminates the pixel (Inria code).
pub const TRANSMITTANCE_MIN: f64 = 1e-4;
/// log2 of [`super::project::ALPHA_MIN`].
pub const LOG2_ALPHA_MIN: f64 = -7.994_353_436_858_858;

/// A splat as blending reads it; one cache line.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(super) struct Footprint2d {
    /// Centre, pixels.
    pub xy: [f32; 2],
    /// `a, b, c` of `p`, negative definite.
    pub quadratic: [f32; 3],
    /// log2 of the opacity.
    pub log2_opacity: f32,
    pub color: [f32; 3],
    pub depth: f32,
    /// Half sizes of the bounding box outside which alpha < 1/255, pixels.
    pub extent: [f32; 2],
    /// First of its hits and their number, in its part.
    pub hits: [u32; 2],
}

/// Pixels of a block.
pub(super) const BLOCK: usize = BLOCK_WIDTH * BLOCK_HEIGHT;
/// Pixels of a tile.
pub(super) const TILE_PIXELS: usize = TILE * TILE;
/// Channels of a tile's forward state: red, green, blue, depth, transmittance; `[channel, block, pixel]`.
pub(super) const CHANNELS: usize = 5;
/// Sums that a splat accumulates in each tile, in this order: the moments 1, dx, dy, dx^2, dx dy, dy^2 of v_p / ln 2, then the
/// gradients of red, green, blue and depth; then the two of [`super::Gather`].
pub(super) const SUMS: usize = 12;

/// [`super::Gather`] as a const parameter of the blending loops.
pub(super) mod gather {
    /// Nothing.
    pub const NOTHING: u8 = 0;
    /// |dL/dx| and |dL/dy| of the centre, fragment by fragment.
    pub const ABSOLUTE: u8 = 1;
    /// Weight times the pixel's error, and weight.
    pub const ERROR: u8 = 2;
}

/// A splat's effect on one vector of pixels.
pub(super) struct Fragment<F: Lanes> {
    pub alpha: F,
    pub weight: F,
    /// Transmittance behind the fragment, if drawn.
    pub transmittance: F,
    /// Drawn here.
    pub drawn: F::Mask,
    /// Alpha reaches 1/255 but the pixel has terminated or terminates now.
    pub ends: F::Mask,
    /// Alpha is capped.
    pub capped: F::Mask,
}

/// One splat over one vector of pixels: `p` as above, `transmittance` in front of it.
#[inline(always)]
pub(super) fn fragment<F: Lanes>(p: F, transmittance: F) -> Fragment<F> {
    let raw = p.exp2_in_range(); // Below -126 alpha is below its threshold.
    let cap = p.splat(ALPHA_MAX);
    let alpha = raw.min(cap);
    let touched = p.splat(LOG2_ALPHA_MIN).le(p);
    let weight = alpha * transmittance;
    let behind = transmittance - weight;
    let visible = p.splat(TRANSMITTANCE_MIN).lt(behind);
    Fragment {
        alpha,
        weight,
        transmittance: behind,
        drawn: touched.and(visible),
        ends: touched.and_not(visible),
        capped: cap.lt(raw),
    }
}

/// The gradient of `p`, divided by ln 2, for a drawn fragment: `dL/dalpha = T g - rest / (1 - alpha)`, where `g` is the splat's
/// colour (and depth) times the pixel's gradient and `rest` the same for everything behind it, weighted, including the background.
#[inline(always)]
pub(super) fn fragment_vjp<F: Lanes>(at: &Fragment<F>, transmittance: F, g: F, rest: F) -> F {
    let one = g.splat(1.0);
    let v_alpha = (-rest).mul_add((one - at.alpha).recip(), transmittance * g);
    (v_alpha * at.alpha).masked(at.drawn.and_not(at.capped))
}

/// Blends one tile front to back into `out [CHANNELS, blocks, BLOCK]`.
pub(super) struct BlendTile<'a> {
    pub footprints: &'a [Footprint2d],
    /// The tile's splats, front to back.
    pub entries: &'a [Entry],
    /// Pixel coordinates of the tile's corner.
    pub corner: [f32; 2],
    pub with_depth: bool,
    pub out: &'a mut [f32; CHANNELS * TILE_PIXELS],
}

impl Kernel for BlendTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        if self.with_depth {
            self.blend::<S, true>(simd);
        } else {
            self.blend::<S, false>(simd);
        }
    }
}

impl BlendTile<'_> {
    #[inline(always)]
    fn blend<S: Simd, const DEPTH: bool>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let (colors, transmittances) = self.out.split_at_mut((CHANNELS - 1) * TILE_PIXELS);
        colors.fill(0.0);
        transmittances.fill(1.0);
        let (red, colors) = colors.split_at_mut(TILE_PIXELS);
        let (green, colors) = colors.split_at_mut(TILE_PIXELS);
        let (blue, depths) = colors.split_at_mut(TILE_PIXELS);
        // Bit b: some pixel of block b has not terminated.
        let mut live = u64::MAX;
        for (i, entry) in self.entries.iter().enumerate() {
            if let Some(later) = self.entries.get(i + PREFETCH_DISTANCE) {
                simd.prefetch(&self.footprints[later.splat as usize]);
            }
            let blocks = entry.blocks & live;
            if blocks == 0 {
                if live == 0 {
                    return;
                }
                continue;
            }
            let s = &self.footprints[entry.splat as usize];
            let color = unroll!(c in 3 => simd.set(s.color[c]));
            let depth = simd.set(s.depth);
            for band in 0..TILE / BLOCK_WIDTH {
                let mut todo = band_blocks(blocks, band);
                if todo == 0 {
                    continue;
                }
                let over = Parabola::<S>::new(simd, s, self.corner, band);
                while todo != 0 {
                    let block = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let mut ended = false;
                    for part in 0..BLOCK / S::LANES {
                        let at = (band * BAND_BLOCKS + block) * BLOCK + part * S::LANES;
                        let t = simd.load(&transmittances[at..]);
                        let f = fragment(over.p(part, over.dy(simd, part, block)), t);
                        let w = f.weight.masked(f.drawn);
                        w.mul_add(color[0], simd.load(&red[at..])).store(&mut red[at..]);
                        w.mul_add(color[1], simd.load(&green[at..])).store(&mut green[at..]);
                        w.mul_add(color[2], simd.load(&blue[at..])).store(&mut blue[at..]);
                        if DEPTH {
                            w.mul_add(depth, simd.load(&depths[at..])).store(&mut depths[at..]);
                        }
                        let t_next = f.transmittance.select(f.drawn, t);
                        t_next.store(&mut transmittances[at..]);
                        if !f.ends.none() {
                            (-t.abs()).select(f.ends, t_next).store(&mut transmittances[at..]);
                            ended = true;
                        }
                    }
                    if ended {
                        live &= !terminated_block(transmittances, band * BAND_BLOCKS + block);
                    }
                }
            }
        }
    }
}

/// How many entries ahead footprints are prefetched: in depth order they are far apart in memory.
const PREFETCH_DISTANCE: usize = 8;

/// The bits of `blocks` in `band`, from bit 0.
#[inline(always)]
fn band_blocks(blocks: u64, band: usize) -> u32 {
    (blocks >> (band * BAND_BLOCKS)) as u32 & ((1 << BAND_BLOCKS) - 1)
}

/// The bit of `block` if all its pixels have terminated, else 0.
#[inline(always)]
fn terminated_block(transmittances: &[f32], block: usize) -> u64 {
    let all = transmittances[block * BLOCK..][..BLOCK].iter().all(|t| *t < 0.0);
    u64::from(all) << block
}

/// `p` over a band of a tile, with everything independent of the row precomputed.
struct Parabola<S: Simd> {
    c: S::F,
    /// For each part of a block: dx, dy in the topmost block, b dx, and a dx^2 + l.
    dx: [S::F; 4],
    dy: [S::F; 4],
    slope: [S::F; 4],
    level: [S::F; 4],
}

impl<S: Simd> Parabola<S>
where
    S::F: Lanes<Scalar = f32>,
{
    #[inline(always)]
    fn new(simd: S, s: &Footprint2d, corner: [f32; 2], band: usize) -> Self {
        let zero = simd.splat(0.0);
        let [a, b, c] = unroll!(i in 3 => simd.set(s.quadratic[i]));
        let l = simd.set(s.log2_opacity);
        let mut over = Self {
            c,
            dx: [zero; 4],
            dy: [zero; 4],
            slope: [zero; 4],
            level: [zero; 4],
        };
        let x = simd.set(s.xy[0] - corner[0] - (band * BLOCK_WIDTH) as f32);
        let y = simd.set(s.xy[1] - corner[1]);
        for part in 0..BLOCK / S::LANES {
            let dx = simd.load(&PIXEL_X[part * S::LANES..]) - x;
            over.dx[part] = dx;
            over.dy[part] = simd.load(&PIXEL_Y[part * S::LANES..]) - y;
            over.slope[part] = b * dx;
            over.level[part] = (a * dx).mul_add(dx, l);
        }
        over
    }

    #[inline(always)]
    fn dy(&self, simd: S, part: usize, block: usize) -> S::F {
        self.dy[part] + simd.set(BLOCK_TOP[block])
    }

    #[inline(always)]
    fn p(&self, part: usize, dy: S::F) -> S::F {
        self.c.mul_add(dy, self.slope[part]).mul_add(dy, self.level[part])
    }
}

/// Centres of a block's pixels relative to its left edge.
const PIXEL_X: [f32; BLOCK] = [
    0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5,
];
/// Centres of a block's pixels relative to its top edge.
const PIXEL_Y: [f32; BLOCK] = [
    0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5,
];
/// Top edges of a band's blocks.
const BLOCK_TOP: [f32; BAND_BLOCKS] = [
    0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 22.0, 24.0, 26.0, 28.0, 30.0,
];

/// Walks one tile front to back again and writes every entry's [`SUMS`].
///
/// Front to back, as in the forward pass: every test then has exactly the same operands. The light from behind a splat follows
/// from the pixel's total: `rest` starts at the total and loses each splat's contribution.
pub(super) struct BlendTileVjp<'a> {
    pub footprints: &'a [Footprint2d],
    pub entries: &'a [Entry],
    pub corner: [f32; 2],
    /// Gradients of red, green, blue and depth over the tile, then its error, `[CHANNELS, blocks, BLOCK]`; zero outside the
    /// image.
    pub v_out: &'a [f32; CHANNELS * TILE_PIXELS],
    /// `color . v_color + depth v_depth - T v_alpha`, background included, `[blocks, BLOCK]`; overwritten.
    pub rest: &'a mut [f32; TILE_PIXELS],
    pub with_depth: bool,
    /// One of the constants of [`gather`].
    pub gather: u8,
    /// The entries' sums, in the order of the entries.
    pub sums: &'a mut [[f32; SUMS]],
}

impl Kernel for BlendTileVjp<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        match (self.with_depth, self.gather) {
            (false, gather::ABSOLUTE) => self.backward::<S, false, { gather::ABSOLUTE }>(simd),
            (false, gather::ERROR) => self.backward::<S, false, { gather::ERROR }>(simd),
            (false, _) => self.backward::<S, false, { gather::NOTHING }>(simd),
            (true, gather::ABSOLUTE) => self.backward::<S, true, { gather::ABSOLUTE }>(simd),
            (true, gather::ERROR) => self.backward::<S, true, { gather::ERROR }>(simd),
            (true, _) => self.backward::<S, true, { gather::NOTHING }>(simd),
        }
    }
}

impl BlendTileVjp<'_> {
    #[inline(always)]
    fn backward<S: Simd, const DEPTH: bool, const GATHER: u8>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let mut transmittances = [1.0f32; TILE_PIXELS];
        let [v_red, v_green, v_blue, v_depth, error] =
            std::array::from_fn(|c| &self.v_out[c * TILE_PIXELS..][..TILE_PIXELS]);
        let zero = simd.splat(0.0);
        let mut live = u64::MAX;
        for (i, (entry, out)) in self.entries.iter().zip(self.sums).enumerate() {
            if let Some(later) = self.entries.get(i + PREFETCH_DISTANCE) {
                simd.prefetch(&self.footprints[later.splat as usize]);
            }
            let blocks = entry.blocks & live;
            if blocks == 0 {
                *out = [0.0; SUMS];
                continue;
            }
            let s = &self.footprints[entry.splat as usize];
            let color = unroll!(c in 3 => simd.set(s.color[c]));
            let depth = simd.set(s.depth);
            let mut sums = [zero; 6];
            let mut v_color = [zero; 4];
            let mut gathered = [zero; 2];
            let [a, b, c] = unroll!(i in 3 => simd.set(s.quadratic[i]));
            for band in 0..TILE / BLOCK_WIDTH {
                let mut todo = band_blocks(blocks, band);
                if todo == 0 {
                    continue;
                }
                let over = Parabola::<S>::new(simd, s, self.corner, band);
                // Moments 1, dy, dy^2 of v_p in each column; dx is applied at the end, since it is the same in all blocks of a band.
                let mut moments = [[zero; 3]; 4];
                while todo != 0 {
                    let block = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let mut ended = false;
                    for part in 0..BLOCK / S::LANES {
                        let at = (band * BAND_BLOCKS + block) * BLOCK + part * S::LANES;
                        let t = simd.load(&transmittances[at..]);
                        let dy = over.dy(simd, part, block);
                        let f = fragment(over.p(part, dy), t);
                        let w = f.weight.masked(f.drawn);
                        let v = [
                            simd.load(&v_red[at..]),
                            simd.load(&v_green[at..]),
                            simd.load(&v_blue[at..]),
                        ];
                        let mut g = color[0].mul_add(v[0], color[1].mul_add(v[1], color[2] * v[2]));
                        if DEPTH {
                            let v = simd.load(&v_depth[at..]);
                            g = depth.mul_add(v, g);
                            v_color[3] = w.mul_add(v, v_color[3]);
                        }
                        for c in 0..3 {
                            v_color[c] = w.mul_add(v[c], v_color[c]);
                        }
                        let rest = (-w).mul_add(g, simd.load(&self.rest[at..]));
                        rest.store(&mut self.rest[at..]);
                        let v_p = fragment_vjp(&f, t, g, rest);
                        if GATHER == gather::ABSOLUTE {
                            // dp/dx = 2 a dx + b dy, dp/dy = b dx + 2 c dy.
                            let dx = over.dx[part];
                            let (ax, cy) = (a * dx, c * dy);
                            let slope = [b.mul_add(dy, ax + ax), b.mul_add(dx, cy + cy)];
                            let magnitude = v_p.abs();
                            gathered[0] = magnitude.mul_add(slope[0].abs(), gathered[0]);
                            gathered[1] = magnitude.mul_add(slope[1].abs(), gathered[1]);
                        }
                        if GATHER == gather::ERROR {
                            gathered[0] = w.mul_add(simd.load(&error[at..]), gathered[0]);
                            gathered[1] += w;
                        }
                        let m = &mut moments[part];
                        m[0] += v_p;
                        let v_dy = v_p * dy;
                        m[1] += v_dy;
                        m[2] = v_dy.mul_add(dy, m[2]);
                        let t_next = f.transmittance.select(f.drawn, t);
                        t_next.store(&mut transmittances[at..]);
                        if !f.ends.none() {
                            (-t.abs()).select(f.ends, t_next).store(&mut transmittances[at..]);
                            ended = true;
                        }
                    }
                    if ended {
                        live &= !terminated_block(&transmittances, band * BAND_BLOCKS + block);
                    }
                }
                for part in 0..BLOCK / S::LANES {
                    let (dx, [m0, m1, m2]) = (over.dx[part], moments[part]);
                    let m0_dx = m0 * dx;
                    sums[0] += m0;
                    sums[1] += m0_dx;
                    sums[2] += m1;
                    sums[3] = m0_dx.mul_add(dx, sums[3]);
                    sums[4] = m1.mul_add(dx, sums[4]);
                    sums[5] += m2;
                }
            }
            let [s0, s1, s2, s3, s4, s5] = sums;
            let [c0, c1, c2, c3] = v_color;
            if GATHER == gather::ABSOLUTE {
                gathered = unroll!(i in 2 => gathered[i] * simd.splat(LN_2));
            }
            let [g0, g1] = gathered;
            S::F::sums(&[s0, s1, s2, s3, s4, s5, c0, c1, c2, c3, g0, g1], out);
        }
    }
}
