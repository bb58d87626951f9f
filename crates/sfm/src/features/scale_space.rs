//! Octaves of Gaussian-blurred planes.
//!
//! Symbols: sigma, the standard deviation of a level's blur in the octave's pixels. Positions are in pixels, with the first centre at
//! (0.5, 0.5), so a position in an octave times the size of its pixels is a position in the photograph, without offsets: octaves are
//! doubled and halved about corners, not centres, and a photograph turned by 90 degrees has the same features.

use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Simd};

/// Number of scales per octave.
pub(super) const SCALES: usize = 3;
/// Number of blurred planes in an octave: extrema need a difference on either side.
const LEVELS: usize = SCALES + 3;
/// The first difference that is searched for extrema, and the first level at which they are described.
pub(super) const FIRST_SCALE: usize = 1;
/// Blur of an octave's first level (Lowe 2004, 3.3).
pub(super) const BASE_SIGMA: f32 = 1.6;
/// Blur that a photograph is assumed to have, in its own pixels (Lowe 2004, 3.3).
const CAMERA_SIGMA: f32 = 0.5;
/// Minimum side of an octave in pixels: a smaller one has no room for a descriptor.
const MIN_SIDE: usize = 16;
/// Lanes of the widest vector.
const MAX_LANES: usize = 16;

/// A plane of floats. Rows are padded so that a vector can be loaded at every pixel and at its neighbours.
#[derive(Clone, Debug)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    stride: usize,
    data: Vec<f32>,
}

impl Plane {
    pub(super) fn new(width: usize, height: usize) -> Self {
        let stride = width.next_multiple_of(MAX_LANES) + MAX_LANES;
        Self {
            width,
            height,
            stride,
            data: vec![0.0; stride * height],
        }
    }

    /// Bytes `[H, W]` as values in \[0, 1\].
    pub(super) fn from_bytes(bytes: &[u8], [width, height]: [u32; 2]) -> Self {
        let mut plane = Self::new(width as usize, height as usize);
        for (row, bytes) in plane.rows_mut().zip(bytes.chunks_exact(width as usize)) {
            for (value, byte) in row.iter_mut().zip(bytes) {
                *value = f32::from(*byte) * (1.0 / 255.0);
            }
        }
        plane
    }

    /// Row `y`, with its padding.
    #[inline(always)]
    pub(super) fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.stride..(y + 1) * self.stride]
    }

    #[inline(always)]
    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.stride + x]
    }

    pub(super) fn rows_mut(&mut self) -> impl Iterator<Item = &mut [f32]> {
        self.data.chunks_exact_mut(self.stride)
    }

    /// The row nearest to `y`.
    fn row_or_border(&self, y: isize) -> &[f32] {
        self.row(y.clamp(0, self.height as isize - 1) as usize)
    }

    /// The plane at twice the size, by cubic convolution (Keys 1981), which does not blur as linear interpolation does.
    fn doubled(&self) -> Self {
        // The kernel at distances 1.75, 0.75, 0.25 and 1.25: a new pixel's centre is a quarter of a pixel from an old one's.
        const TAPS: [f32; 4] = [-0.023_437_5, 0.226_562_5, 0.867_187_5, -0.070_312_5];
        let mut to = Self::new(2 * self.width, 2 * self.height);
        let mut column = vec![0.0; self.width + 4];
        let width = self.width;
        for (y, row) in to.rows_mut().enumerate() {
            let (at, side) = ((y / 2) as isize, if y % 2 == 0 { -1 } else { 1 });
            let rows = [2 * side, side, 0, -side].map(|offset| &self.row_or_border(at + offset)[..width]);
            for (x, value) in column[2..width + 2].iter_mut().enumerate() {
                *value = TAPS[0] * rows[0][x] + TAPS[1] * rows[1][x] + TAPS[2] * rows[2][x] + TAPS[3] * rows[3][x];
            }
            let (first, last) = (column[2], column[width + 1]);
            column[..2].fill(first);
            column[width + 2..].fill(last);
            for (pair, c) in row.chunks_exact_mut(2).zip(column.windows(5)) {
                pair[0] = TAPS[0] * c[0] + TAPS[1] * c[1] + TAPS[2] * c[2] + TAPS[3] * c[3];
                pair[1] = TAPS[0] * c[4] + TAPS[1] * c[3] + TAPS[2] * c[2] + TAPS[3] * c[1];
            }
        }
        to
    }

    /// The plane at half the size: the mean of each block of 2 x 2 pixels. A last odd row or column is dropped.
    fn halved(&self) -> Self {
        let mut to = Self::new(self.width / 2, self.height / 2);
        for (y, row) in to.rows_mut().enumerate() {
            let [above, below] = [self.row(2 * y), self.row(2 * y + 1)];
            let pairs = above.as_chunks::<2>().0.iter().zip(below.as_chunks::<2>().0);
            for (value, (a, b)) in row.iter_mut().zip(pairs) {
                *value = ((a[0] + b[0]) + (a[1] + b[1])) * 0.25;
            }
        }
        to
    }
}

/// Blur of a level, in its octave's pixels.
pub(super) fn sigma_of(level: usize) -> f32 {
    BASE_SIGMA * 2f32.powf(level as f32 / SCALES as f32)
}

/// One octave of the scale space.
pub(super) struct Octave {
    /// `[LEVELS]`, from the least blurred.
    pub levels: Vec<Plane>,
    /// Size of a pixel, in pixels of the photograph.
    pub pixel: f32,
}

impl Octave {
    /// The octave at twice the size of `photo`; `None` if that is too small.
    pub(super) fn first(level: Level, photo: &Plane) -> Option<Self> {
        let doubled = photo.doubled();
        let sigma = 2.0 * CAMERA_SIGMA;
        if doubled.width.min(doubled.height) < MIN_SIDE {
            return None;
        }
        let base = blurred(level, &doubled, (BASE_SIGMA * BASE_SIGMA - sigma * sigma).sqrt());
        Some(Self::from_base(level, base, BASE_SIGMA * BASE_SIGMA, 0.5))
    }

    /// The octave that starts from `base`, whose blur has the variance `variance`.
    fn from_base(level: Level, base: Plane, mut variance: f32, pixel: f32) -> Self {
        let mut levels = vec![base];
        for i in 1..LEVELS {
            let sigma = sigma_of(i);
            let next = blurred(level, &levels[i - 1], (sigma * sigma - variance).sqrt());
            variance = sigma * sigma;
            levels.push(next);
        }
        Self { levels, pixel }
    }

    /// The levels at which features of this octave are described, and the next octave unless it would be too small.
    pub(super) fn halved(mut self, level: Level) -> (Vec<Plane>, Option<Self>) {
        let source = &self.levels[SCALES];
        let next = (source.width.min(source.height) / 2 >= MIN_SIDE).then(|| {
            // In the smaller pixels of the source, the mean of 2 x 2 pixels adds a variance of 1/4 to the level's 4 sigma^2.
            let variance = BASE_SIGMA * BASE_SIGMA + 1.0 / 16.0;
            Self::from_base(level, source.halved(), variance, 2.0 * self.pixel)
        });
        (self.levels.drain(FIRST_SCALE..FIRST_SCALE + SCALES).collect(), next)
    }
}

/// `plane` blurred by a Gaussian of `sigma` pixels, truncated at 4 sigma as in VLFeat; pixels outside repeat the border.
fn blurred(level: Level, plane: &Plane, sigma: f32) -> Plane {
    let taps = gaussian(sigma, 4.0);
    level.run(Blur { plane, taps: &taps })
}

/// Weights of a Gaussian of `sigma` pixels, from its centre outwards, truncated at `reach` sigmas.
pub(super) fn gaussian(sigma: f32, reach: f32) -> Vec<f32> {
    let radius = (reach * sigma).ceil() as usize;
    let weights: Vec<f64> = (0..=radius)
        .map(|i| (-0.5 * (i as f64 / f64::from(sigma)).powi(2)).exp())
        .collect();
    let sum = weights[0] + 2.0 * weights[1..].iter().sum::<f64>();
    weights.iter().map(|weight| (weight / sum) as f32).collect()
}

struct Blur<'a> {
    plane: &'a Plane,
    /// From the centre outwards.
    taps: &'a [f32],
}

impl Kernel for Blur<'_> {
    type Output = Plane;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Plane
    where
        S::F: Lanes<Scalar = f32>,
    {
        let Self { plane, taps } = self;
        let radius = taps.len() - 1;
        let (width, stride) = (plane.width, plane.stride);
        let mut to = Plane::new(width, plane.height);
        let mut column = vec![0.0f32; stride + 2 * radius];
        let mut rows: Vec<[&[f32]; 2]> = Vec::with_capacity(radius);
        for (y, out) in to.data.chunks_exact_mut(stride).enumerate() {
            let y = y as isize;
            rows.clear();
            rows.extend((1..=radius as isize).map(|i| [y - i, y + i].map(|y| plane.row_or_border(y))));
            let centre = plane.row(y as usize);
            for x in (0..stride).step_by(S::LANES) {
                let mut sum = simd.load(&centre[x..]) * simd.set(taps[0]);
                for (row, tap) in rows.iter().zip(&taps[1..]) {
                    sum += (simd.load(&row[0][x..]) + simd.load(&row[1][x..])) * simd.set(*tap);
                }
                sum.store(&mut column[radius + x..]);
            }
            let (first, last) = (column[radius], column[radius + width - 1]);
            column[..radius].fill(first);
            column[radius + width..].fill(last);
            for x in (0..stride).step_by(S::LANES) {
                let at = x + radius;
                let mut sum = simd.load(&column[at..]) * simd.set(taps[0]);
                for (i, tap) in taps.iter().enumerate().skip(1) {
                    sum += (simd.load(&column[at - i..]) + simd.load(&column[at + i..])) * simd.set(*tap);
                }
                sum.store(&mut out[x..]);
            }
        }
        to
    }
}
