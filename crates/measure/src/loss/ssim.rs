//! The loss with SSIM, streamed down a band of rows.
//!
//! Symbols: x render, y truth, m weight; G the window; s = x^2 + y^2 and p = xy, whose window means are all that SSIM needs
//! besides those of x and y:
//!
//! ```text
//! SSIM = (2 mu_x mu_y + C1) (2 (G p - mu_x mu_y) + C2) / ((mu_x^2 + mu_y^2 + C1) (G s - mu_x^2 - mu_y^2 + C2))
//! ```
//!
//! The gradient of its sum is `G a + x (G b) + y (G c)`, with a, b / 2 and c the derivatives with respect to mu_x, G s and
//! G p (stored halved): with zeros beyond the border the window is its own adjoint.
//!
//! Each step loads [`ROWS_PER_STEP`] rows, finishes the maps of the rows [`RADIUS`] above them and the gradient of the rows twice that far
//! above, so that rings of 16 rows, which stay in the cache, suffice. It handles four rows at a time, since 14 loads then serve
//! 4 windows along y, whereas a single row takes 11 loads for one.

use super::job::{Job, Sums};
use super::pointwise::Differences;
use super::rows::{BLOCK, Rows};
use crate::window::{C1, C2, RADIUS, TAPS, half_window};
use irradia_compute::simd::{Lanes, Scalar, Simd};

/// Rows per step.
const ROWS_PER_STEP: usize = 4;
/// Rows covered by the windows of a step's rows.
const STEP_WINDOW_ROWS: usize = ROWS_PER_STEP + 2 * RADIUS;
/// Rows in a ring, a power of two not below `STEP_WINDOW_ROWS`.
const RING_ROWS: usize = 16;
/// Rows of a ring of moments per image row: x, y, m, s, p.
const MOMENTS: usize = 5;
const X: usize = 0;
const Y: usize = 1;
const M: usize = 2;
const S_: usize = 3;
const P: usize = 4;

/// The working memory of one band.
#[derive(Default)]
pub(super) struct Scratch<T> {
    /// Rings of x, y, m, s, p, `[RING_ROWS, MOMENTS]` rows.
    pub(super) moments: Rows<T>,
    /// Window along y of x, y, s, p, `[4, ROWS_PER_STEP]` rows.
    blurred: Rows<T>,
    /// Derivatives a, b, c of one row.
    derivatives: Rows<T>,
    /// Rings of a, b, c after the window along x, `[RING_ROWS, 3]` rows.
    adjoint: Rows<T>,
    /// Gradient of a step's rows.
    gradient: Rows<T>,
}

impl<T: Scalar> Scratch<T> {
    pub(super) fn reshape(&mut self, width: usize) {
        self.moments.reshape(RING_ROWS * MOMENTS, width);
        self.blurred.reshape(ROWS_PER_STEP * 4, width);
        self.derivatives.reshape(3, width);
        self.adjoint.reshape(RING_ROWS * 3, width);
        self.gradient.reshape(ROWS_PER_STEP, width);
    }
}

type ScalarOf<S> = <<S as Simd>::F as Lanes>::Scalar;
type Window<F> = [F; RADIUS + 1];

#[inline(always)]
pub(super) fn band<S: Simd>(
    simd: S,
    job: &Job<ScalarOf<S>>,
    scratch: &mut Scratch<ScalarOf<S>>,
    v_render: &mut [ScalarOf<S>],
) -> Sums {
    let half = half_window();
    let mut window = [simd.splat(0.0); RADIUS + 1];
    for (w, value) in window.iter_mut().zip(half) {
        *w = simd.splat(value);
    }
    let mut sums = Sums::default();
    // Rows are numbered such that the first row the band reads, possibly above the image, is [`RING_ROWS`].
    let first = RING_ROWS + 2 * RADIUS;
    let last = first + job.rows.len();
    let image_row = |row: usize| {
        (job.rows.start + row)
            .checked_sub(first)
            .filter(|row| *row < job.height)
    };
    for step in (RING_ROWS..last + 2 * RADIUS).step_by(ROWS_PER_STEP) {
        for row in step..step + ROWS_PER_STEP {
            load_row(simd, job, image_row(row), &mut scratch.moments, row % RING_ROWS);
        }
        // Rows whose windows begin before the band's first row are computed but not used.
        if step + ROWS_PER_STEP >= RING_ROWS + 2 * RADIUS {
            blur_moments(simd, scratch, &window, step);
            for i in 0..ROWS_PER_STEP {
                let row = step + i - RADIUS;
                let dissimilarity = differentiate(simd, scratch, &window, i, row % RING_ROWS);
                if (first..last).contains(&row) {
                    sums.dissimilarity += dissimilarity;
                }
                blur_derivatives(simd, scratch, &window, row % RING_ROWS);
            }
        }
        if step >= first + 2 * RADIUS {
            let above = step - 2 * RADIUS;
            let rows = above..(above + ROWS_PER_STEP).min(last);
            finish(simd, job, scratch, &window, above, rows.len(), &mut sums);
            let out: [&mut [ScalarOf<S>]; ROWS_PER_STEP] = scratch.gradient.columns_mut(0);
            for (row, gradient) in rows.zip(out) {
                let at = (row - first) * job.width;
                v_render[at..at + job.width].copy_from_slice(&gradient[..job.width]);
            }
        }
    }
    sums
}

/// Loads a row of the image (zeros outside it) into slot `slot` of the ring, with its products.
#[inline(always)]
fn load_row<S: Simd>(
    simd: S,
    job: &Job<ScalarOf<S>>,
    row: Option<usize>,
    moments: &mut Rows<ScalarOf<S>>,
    slot: usize,
) {
    let rows: [&mut [ScalarOf<S>]; MOMENTS] = moments.columns_mut(slot * MOMENTS);
    let Some(row) = row else {
        rows.into_iter().for_each(|row| row.fill(Default::default()));
        return;
    };
    let [x, y, m, s, p] = rows;
    job.load_row(simd, row, [&mut *x, &mut *y, m]);
    let blocks = x.as_chunks::<BLOCK>().0.iter().zip(y.as_chunks::<BLOCK>().0);
    let out = s
        .as_chunks_mut::<BLOCK>()
        .0
        .iter_mut()
        .zip(p.as_chunks_mut::<BLOCK>().0);
    for ((x, y), (s, p)) in blocks.zip(out) {
        for at in (0..BLOCK).step_by(S::LANES) {
            let (x, y) = (simd.load(&x[at..]), simd.load(&y[at..]));
            x.mul_add(x, y * y).store(&mut s[at..]);
            (x * y).store(&mut p[at..]);
        }
    }
}

/// The window along y of the four moments, for the [`ROWS_PER_STEP`] rows whose last window ends in the step's last row.
#[inline(always)]
fn blur_moments<S: Simd>(simd: S, scratch: &mut Scratch<ScalarOf<S>>, window: &Window<S::F>, step: usize) {
    for (i, moment) in [X, Y, S_, P].into_iter().enumerate() {
        let window_rows = window_rows(&scratch.moments, step - 2 * RADIUS, MOMENTS, moment);
        let blocks = window_rows[0].len();
        let out: [&mut [ScalarOf<S>]; ROWS_PER_STEP] = scratch.blurred.columns_mut(i * ROWS_PER_STEP);
        let out = out.map(|row| &mut row.as_chunks_mut::<BLOCK>().0[..blocks]);
        for block in 0..blocks {
            for at in (0..BLOCK).step_by(S::LANES) {
                let values = along_y(simd, &window_rows, block, at, window);
                for row in 0..ROWS_PER_STEP {
                    values[row].store(&mut out[row][block][at..]);
                }
            }
        }
    }
}

/// The rows `first..first + STEP_WINDOW_ROWS` of part `part` of a ring of `parts`, all of one length.
#[inline(always)]
fn window_rows<T: Scalar>(
    ring: &Rows<T>,
    first: usize,
    parts: usize,
    part: usize,
) -> [&[[T; BLOCK]]; STEP_WINDOW_ROWS] {
    let row = |k: usize| ring.blocks((first + k) % RING_ROWS * parts + part);
    let blocks = row(0).len();
    let mut rows: [&[[T; BLOCK]]; STEP_WINDOW_ROWS] = [&[]; STEP_WINDOW_ROWS];
    for (k, slot) in rows.iter_mut().enumerate() {
        // The compiler must see that the lengths are equal, or it checks every load.
        *slot = &row(k)[..blocks];
    }
    rows
}

/// The window along y at one vector of [`ROWS_PER_STEP`] rows.
#[inline(always)]
fn along_y<S: Simd>(
    simd: S,
    rows: &[&[[ScalarOf<S>; BLOCK]]; STEP_WINDOW_ROWS],
    block: usize,
    at: usize,
    window: &Window<S::F>,
) -> [S::F; ROWS_PER_STEP] {
    let mut values = [simd.splat(0.0); STEP_WINDOW_ROWS];
    for k in 0..STEP_WINDOW_ROWS {
        values[k] = simd.load(&rows[k][block][at..]);
    }
    let mut out = [simd.splat(0.0); ROWS_PER_STEP];
    for i in 0..ROWS_PER_STEP {
        let mut sum = values[i + RADIUS] * window[0];
        for k in 1..=RADIUS {
            sum = (values[i + RADIUS - k] + values[i + RADIUS + k]).mul_add(window[k], sum);
        }
        out[i] = sum;
    }
    out
}

/// The window along x at the vector that begins at column `column` of a padded row.
#[inline(always)]
fn along_x<S: Simd>(simd: S, padded: &[ScalarOf<S>], column: usize, window: &Window<S::F>) -> S::F {
    let from = BLOCK + column - RADIUS;
    let span = &padded[from..from + TAPS - 1 + S::LANES];
    let mut sum = simd.load(&span[RADIUS..]) * window[0];
    for k in 1..=RADIUS {
        let pair = simd.load(&span[RADIUS - k..]) + simd.load(&span[RADIUS + k..]);
        sum = pair.mul_add(window[k], sum);
    }
    sum
}

/// SSIM and its derivatives in the step's row `i`, whose weights are in slot `slot` of their ring.
/// Returns the sum of `m (1 - SSIM)`.
#[inline(always)]
fn differentiate<S: Simd>(
    simd: S,
    scratch: &mut Scratch<ScalarOf<S>>,
    window: &Window<S::F>,
    i: usize,
    slot: usize,
) -> f64 {
    let [x, y, s, p] = [0, 1, 2, 3].map(|part| scratch.blurred.padded(part * ROWS_PER_STEP + i));
    let weights = scratch.moments.blocks(slot * MOMENTS + M);
    let [a, b, c]: [&mut [ScalarOf<S>]; 3] = scratch.derivatives.columns_mut(0);
    let blocks = weights.len();
    let [a, b, c] = [a, b, c].map(|row| &mut row.as_chunks_mut::<BLOCK>().0[..blocks]);
    let (c1, c2, one, two) = (simd.splat(C1), simd.splat(C2), simd.splat(1.0), simd.splat(2.0));
    let mut dissimilarity = simd.splat(0.0);
    for block in 0..blocks {
        for at in (0..BLOCK).step_by(S::LANES) {
            let column = block * BLOCK + at;
            let mu_x = along_x(simd, x, column, window);
            let mu_y = along_x(simd, y, column, window);
            let mean_s = along_x(simd, s, column, window);
            let mean_p = along_x(simd, p, column, window);
            let m = simd.load(&weights[block][at..]);
            let product = mu_x * mu_y;
            let squares = mu_x.mul_add(mu_x, mu_y * mu_y);
            let (n1, d1) = (two.mul_add(product, c1), squares + c1);
            let n2 = two.mul_add(mean_p - product, c2);
            // A sum of variances is non-negative, but rounding may make it negative for values far above 1.
            let d2 = (mean_s - squares).max(simd.splat(0.0)) + c2;
            // Columns and rows outside the image have m = 0 and hence no derivative.
            let inverse = one / (d1 * d2);
            let scale = m * inverse;
            let ssim = n1 * n2 * scale;
            dissimilarity += m - ssim;
            // ssim / d2 and ssim / d1, without dividing.
            let (by_d2, by_d1) = (ssim * (d1 * inverse), ssim * (d2 * inverse));
            let by_means = (mu_y * scale).mul_add(n2 - n1, mu_x * (by_d2 - by_d1));
            by_means.store(&mut a[block][at..]);
            (-by_d2).store(&mut b[block][at..]);
            (n1 * scale).store(&mut c[block][at..]);
        }
    }
    dissimilarity.sum().to_f64()
}

/// The window along x of the derivatives, into slot `slot` of their ring.
#[inline(always)]
fn blur_derivatives<S: Simd>(simd: S, scratch: &mut Scratch<ScalarOf<S>>, window: &Window<S::F>, slot: usize) {
    let to: [&mut [ScalarOf<S>]; 3] = scratch.adjoint.columns_mut(slot * 3);
    for (part, to) in to.into_iter().enumerate() {
        let from = scratch.derivatives.padded(part);
        for at in (0..to.len()).step_by(S::LANES) {
            along_x(simd, from, at, window).store(&mut to[at..]);
        }
    }
}

/// The gradient of the `count` rows starting at `above`: the derivatives' window along y, and the pointwise parts.
#[inline(always)]
fn finish<S: Simd>(
    simd: S,
    job: &Job<ScalarOf<S>>,
    scratch: &mut Scratch<ScalarOf<S>>,
    window: &Window<S::F>,
    above: usize,
    count: usize,
    sums: &mut Sums,
) {
    let [gain_l1, gain_ssim, gain_mse] =
        [job.gains.l1, 2.0 * job.gains.ssim, job.gains.mse].map(|gain| simd.splat(gain));
    let blocks = scratch.adjoint.blocks(0).len();
    let derivatives = [0, 1, 2].map(|part| window_rows(&scratch.adjoint, above - RADIUS, 3, part));
    let out: [&mut [ScalarOf<S>]; ROWS_PER_STEP] = scratch.gradient.columns_mut(0);
    let out = out.map(|row| &mut row.as_chunks_mut::<BLOCK>().0[..blocks]);
    let mut pixel_rows = [[derivatives[0][0]; 3]; ROWS_PER_STEP];
    for (i, rows) in pixel_rows.iter_mut().enumerate() {
        let slot = (above + i) % RING_ROWS * MOMENTS;
        *rows = [X, Y, M].map(|moment| &scratch.moments.blocks(slot + moment)[..blocks]);
    }
    let mut differences = [Differences::zero(simd); ROWS_PER_STEP];
    for block in 0..blocks {
        for at in (0..BLOCK).step_by(S::LANES) {
            let a = along_y(simd, &derivatives[0], block, at, window);
            let b = along_y(simd, &derivatives[1], block, at, window);
            let c = along_y(simd, &derivatives[2], block, at, window);
            for i in 0..ROWS_PER_STEP {
                // Not `map`: the compiler does not inline it into code for wider instructions.
                let [x, y, m] = &pixel_rows[i];
                let (x, y) = (simd.load(&x[block][at..]), simd.load(&y[block][at..]));
                let m = simd.load(&m[block][at..]);
                let v_ssim = b[i].mul_add(x, c[i].mul_add(y, a[i]));
                let v = differences[i].add(x, y, gain_l1, gain_mse);
                (m * v_ssim.mul_add(gain_ssim, v)).store(&mut out[i][block][at..]);
            }
        }
    }
    for rows in differences.into_iter().take(count) {
        rows.add_to(sums);
    }
}
