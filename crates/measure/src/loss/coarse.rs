//! The squared error of low-pass filtered images, for the coarse phase of a curriculum.
//!
//! Render x and truth y are averaged over cells of `factor x factor` pixels (those at the far border may be smaller),
//! weighted by the mask m in \[0, 1\]. With M the sum of m over a cell and D that of `m (x - y)`,
//!
//! ```text
//! loss = sum over cells and channels of M (D / M)^2 / (3 sum of M)        d loss / d x = 2 m D / (M 3 sum of M)
//! ```
//!
//! so that cells are weighted by the mask they cover; without a mask it is the mean squared error of the two downscaled images.
//! The gradient is that of the downscaled image, distributed evenly over each cell.

use super::Target;
use super::job::{Gains, Job};
use super::rows::Rows;
use irradia_compute::simd::{Kernel, Lanes, Level, Scalar, Simd};
use rayon::prelude::*;
use std::sync::Mutex;

/// Computes the loss and its gradient; reuses its working memory.
pub struct CoarseLoss {
    level: Level,
    memory: Memory<f32>,
}

impl Default for CoarseLoss {
    fn default() -> Self {
        Self::with_level(Level::detect())
    }
}

impl CoarseLoss {
    /// Runs at SIMD `level`.
    pub fn with_level(level: Level) -> Self {
        Self {
            level,
            memory: Memory::default(),
        }
    }

    /// The loss of `render [3, stride]`, `stride >= H * W`, in cells of `factor x factor` pixels; `weight` times its
    /// gradient is added to `v_render`, of the same shape. A factor of 1 is the mean squared error.
    ///
    /// # Panics
    /// When a length does not match the target's size, or `factor` is 0: a bug in the caller.
    pub fn evaluate(
        &mut self,
        render: &[f32],
        target: &Target,
        factor: usize,
        weight: f32,
        v_render: &mut [f32],
    ) -> f64 {
        let level = self.level;
        let weight = f64::from(weight);
        self.memory
            .evaluate(render, target, factor, weight, v_render, |cells, rows, v_rows| {
                level.run(CellsKernel { cells, rows, v_rows })
            })
    }
}

struct Memory<T> {
    rows: Mutex<Vec<Rows<T>>>,
    sums: Vec<f64>,
    shades: [T; 256],
}

impl<T: Scalar> Default for Memory<T> {
    fn default() -> Self {
        Self {
            rows: Mutex::default(),
            sums: Vec::new(),
            shades: std::array::from_fn(|i| T::from_f64(i as f64 / 255.0)),
        }
    }
}

/// One row of cells of one channel.
struct Cells<'a, T> {
    job: Job<'a, T>,
    factor: usize,
    /// Factor of the gradient: `2 weight / (3 sum of M)`.
    gain: f64,
}

impl<T: Scalar> Memory<T> {
    fn evaluate(
        &mut self,
        render: &[T],
        target: &Target<T>,
        factor: usize,
        weight: f64,
        v_render: &mut [T],
        run: impl Fn(&Cells<T>, &mut Rows<T>, &mut [T]) -> f64 + Sync,
    ) -> f64 {
        assert!(factor > 0, "the factor is positive");
        target.assert_lengths(render.len(), v_render.len());
        let (width, height) = (target.width, target.height);
        let (pixels, stride) = (width * height, render.len() / 3);
        let count = 3.0 * target.weight();
        if count == 0.0 {
            return 0.0;
        }
        let bands = height.div_ceil(factor);
        self.sums.resize(3 * bands, 0.0);
        let (memory, shades) = (&self.rows, &self.shades);
        let channels = v_render
            .par_chunks_mut(stride)
            .zip(self.sums.par_chunks_mut(bands))
            .enumerate();
        channels.for_each(|(channel, (v_plane, sums))| {
            let each_band = v_plane[..pixels].par_chunks_mut(factor * width).zip(sums).enumerate();
            each_band.for_each(|(band, (v_rows, sum))| {
                let cells = Cells {
                    job: Job {
                        render: &render[channel * stride..channel * stride + pixels],
                        truth: target.truth,
                        channel,
                        mask: target.mask,
                        shades,
                        width,
                        height,
                        rows: band * factor..((band + 1) * factor).min(height),
                        gains: Gains::NONE,
                    },
                    factor,
                    gain: 2.0 * weight / count,
                };
                let kept = memory.lock().expect("no band panics").pop();
                let mut rows = kept.unwrap_or_default();
                rows.reshape(ROWS, width);
                *sum = run(&cells, &mut rows, v_rows);
                memory.lock().expect("no band panics").push(rows);
            });
        });
        self.sums.iter().sum::<f64>() / count
    }
}

struct CellsKernel<'a, 'b> {
    cells: &'a Cells<'b, f32>,
    rows: &'a mut Rows<f32>,
    v_rows: &'a mut [f32],
}

impl Kernel for CellsKernel<'_, '_> {
    type Output = f64;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f64
    where
        S::F: Lanes<Scalar = f32>,
    {
        row_of_cells(simd, self.cells, self.rows, self.v_rows)
    }
}

/// Rows of x, y, m, and per column D, M and the gradient.
const ROWS: usize = 6;

/// Adds the gradient of a row of cells to `v_rows` and returns the sum of `D^2 / M`.
#[inline(always)]
fn row_of_cells<S: Simd>(
    simd: S,
    cells: &Cells<<S::F as Lanes>::Scalar>,
    rows: &mut Rows<<S::F as Lanes>::Scalar>,
    v_rows: &mut [<S::F as Lanes>::Scalar],
) -> f64 {
    let width = cells.job.width;
    let [x, y, m, differences, weights, gains] = rows.columns_mut(0);
    differences.fill(Default::default());
    weights.fill(Default::default());
    for row in cells.job.rows.clone() {
        cells.job.load_row(simd, row, [&mut *x, &mut *y, &mut *m]);
        for at in (0..x.len()).step_by(S::LANES) {
            // x has already been replaced by y + m (x - y).
            let d = simd.load(&differences[at..]) + (simd.load(&x[at..]) - simd.load(&y[at..]));
            d.store(&mut differences[at..]);
            (simd.load(&weights[at..]) + simd.load(&m[at..])).store(&mut weights[at..]);
        }
    }
    let mut sum = 0.0;
    for first in (0..width).step_by(cells.factor) {
        let columns = first..(first + cells.factor).min(width);
        let (mut d, mut m) = (0.0, 0.0);
        for column in columns.clone() {
            d += differences[column].to_f64();
            m += weights[column].to_f64();
        }
        // In a cell of weight 0 the difference is 0, too.
        let mean = if m > 0.0 { d / m } else { 0.0 };
        sum += d * mean;
        gains[columns].fill(Scalar::from_f64(cells.gain * mean));
    }
    for (row, v_row) in cells.job.rows.clone().zip(v_rows.chunks_exact_mut(width)) {
        match cells.job.mask {
            None => {
                for (v, gain) in v_row.iter_mut().zip(gains.iter()) {
                    *v = *v + *gain;
                }
            }
            Some(mask) => {
                let mask = &mask[row * width..(row + 1) * width];
                for (value, m) in m.iter_mut().zip(mask) {
                    *value = cells.job.shades[usize::from(*m)];
                }
                x[..width].copy_from_slice(v_row);
                for at in (0..x.len()).step_by(S::LANES) {
                    let (m, gain) = (simd.load(&m[at..]), simd.load(&gains[at..]));
                    m.mul_add(gain, simd.load(&x[at..])).store(&mut x[at..]);
                }
                v_row.copy_from_slice(&x[..width]);
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::super::picture::Picture;
    use super::super::{LossWeights, PhotometricLoss, Truth};
    use super::*;
    use irradia_compute::simd::Double;
    use irradia_testkit::finite_differences::{FiniteDifferences, sample_indices};

    fn in_double(picture: &Picture, render: &[f64], factor: usize) -> (f64, Vec<f64>) {
        let mut v = vec![0.0; render.len()];
        let run = |cells: &Cells<f64>, rows: &mut Rows<f64>, v: &mut [f64]| row_of_cells(Double, cells, rows, v);
        let loss = Memory::<f64>::default().evaluate(render, &picture.target(), factor, 1.0, &mut v, run);
        (loss, v)
    }

    const SIZES: [(usize, usize); 4] = [(1, 1), (23, 17), (16, 9), (7, 30)];

    #[test]
    fn the_loss_is_the_squared_error_of_downscaled_images() {
        for (width, height) in SIZES {
            for factor in [1, 2, 3, 8, 100] {
                let picture = Picture::random(width, height, false, 3);
                let mut want = 0.0;
                for c in 0..3 {
                    for cy in (0..height).step_by(factor) {
                        for cx in (0..width).step_by(factor) {
                            let (mut d, mut n) = (0.0, 0.0);
                            for y in cy..(cy + factor).min(height) {
                                for x in cx..(cx + factor).min(width) {
                                    let i = (c * height + y) * width + x;
                                    d += picture.render[i] - picture.truth[i];
                                    n += 1.0;
                                }
                            }
                            want += n * (d / n) * (d / n) / (3 * width * height) as f64;
                        }
                    }
                }
                let got = in_double(&picture, &picture.render, factor).0;
                assert!((got - want).abs() < 1e-12, "{width}x{height} by {factor}: {got} {want}");
            }
        }
    }

    #[test]
    fn gradients_match_finite_differences() {
        for (width, height) in SIZES {
            for (factor, masked) in [(1, false), (2, true), (4, false), (5, true), (64, true)] {
                let picture = Picture::random(width, height, masked, 11);
                let (_, v) = in_double(&picture, &picture.render, factor);
                // Quadratic: central differences are exact up to rounding.
                let value = |render: &[f64]| in_double(&picture, render, factor).0;
                FiniteDifferences::relative_to_max(1e-4, 1e-7).check(
                    "coarse",
                    &picture.render,
                    &v,
                    sample_indices(v.len()),
                    value,
                );
            }
        }
    }

    #[test]
    fn every_level_agrees_accumulates_and_ignores_masked_pixels() {
        for level in Level::all() {
            let mut loss = CoarseLoss::with_level(level);
            for (masked, factor) in [(false, 4), (true, 3), (true, 1)] {
                let picture = Picture::random(45, 31, masked, 2);
                let (want, v_want) = in_double(&picture, &picture.render, factor);
                let single = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
                let (mut render, truth) = (single(&picture.render), single(&picture.truth));
                if let Some(mask) = &picture.mask {
                    for (i, x) in render.iter_mut().enumerate() {
                        *x = if mask[i % mask.len()] == 0 { f32::NAN } else { *x };
                    }
                }
                let target = Target {
                    width: 45,
                    height: 31,
                    truth: Truth::Planar(&truth),
                    mask: picture.mask.as_deref(),
                };
                let mut v = vec![0.25; truth.len()];
                let got = loss.evaluate(&render, &target, factor, 2.0, &mut v);
                // Sums of up to 16 single-precision values.
                assert!(
                    (got - want).abs() < 1e-6 * want.max(1e-3),
                    "{} {got} {want}",
                    level.name()
                );
                for (v, want) in v.iter().zip(&v_want) {
                    assert!((f64::from(*v) - 0.25 - 2.0 * want).abs() < 1e-7);
                }
            }
        }
    }

    #[test]
    fn cells_of_one_pixel_match_the_photometric_squared_error() {
        let picture = Picture::random(20, 14, false, 8);
        let bytes: Vec<u8> = picture.image(&picture.truth).to_u8();
        let render: Vec<f32> = picture.render.iter().map(|v| *v as f32).collect();
        let target = Target {
            width: 20,
            height: 14,
            truth: Truth::Rgb8(&bytes),
            mask: None,
        };
        let weights = LossWeights {
            l1: 0.0,
            ssim: 0.0,
            mse: 1.0,
        };
        let (mut v, mut v_want) = (vec![0.0; render.len()], vec![0.0; render.len()]);
        let want = PhotometricLoss::new().evaluate(&render, &target, &weights, &mut v_want);
        let got = CoarseLoss::default().evaluate(&render, &target, 1, 1.0, &mut v);
        assert!((got - want.total).abs() < 1e-7, "{got} {want:?}");
        assert!(v.iter().zip(&v_want).all(|(a, b)| (a - b).abs() < 1e-8));
        let nothing = Target {
            mask: Some(&[0; 280]),
            ..target
        };
        assert_eq!(CoarseLoss::default().evaluate(&render, &nothing, 4, 1.0, &mut v), 0.0);
    }
}
