//! The two kinds of layer and their VJPs, over maps with interleaved channels: the patch of a 3x3 kernel is then three
//! contiguous runs, the result of a matrix product is already the next map, and bands of rows are disjoint, hence parallel.

use crate::real::Real;
use ndarray::linalg::general_mat_mul;
use ndarray::{ArrayView2, ArrayViewMut2, Axis};
use rayon::prelude::*;
use std::ops::Range;

/// A feature map.
#[derive(Clone)]
pub(crate) struct Map<T> {
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) channels: usize,
    /// `[H, W, C]`.
    pub(crate) data: Vec<T>,
}

impl<T: Real> Map<T> {
    /// Zeros of the same shape, to accumulate a gradient.
    pub(super) fn zeros_like(&self) -> Self {
        Self {
            data: vec![T::zero(); self.data.len()],
            ..*self
        }
    }
}

/// A square convolution followed by ReLU.
pub(super) struct Convolution<T> {
    /// `[side, side, input, output]`, as the matrix that patches are multiplied by.
    kernel: Vec<T>,
    bias: Vec<T>,
    input: usize,
    side: usize,
    stride: usize,
    padding: usize,
}

/// Output pixels per matrix product: their patches stay in the L2 cache.
const PIXELS_PER_BAND: usize = 512;

impl<T: Real> Convolution<T> {
    /// From a kernel `[output, input, side, side]` and a bias `[output]`.
    pub(super) fn new(oihw: &[T], bias: Vec<T>, input: usize, side: usize, stride: usize, padding: usize) -> Self {
        let (outputs, taps) = (bias.len(), side * side);
        let mut kernel = vec![T::zero(); oihw.len()];
        for (o, filter) in oihw.chunks_exact(input * taps).enumerate() {
            for (i, plane) in filter.chunks_exact(taps).enumerate() {
                for (tap, value) in plane.iter().enumerate() {
                    kernel[(tap * input + i) * outputs + o] = *value;
                }
            }
        }
        Self {
            kernel,
            bias,
            input,
            side,
            stride,
            padding,
        }
    }

    pub(super) fn forward(&self, input: &Map<T>) -> Map<T> {
        Self::forward_side_by_side(&[self], input)
    }

    /// Convolutions whose outputs have the same size, with their channels concatenated.
    pub(super) fn forward_side_by_side(layers: &[&Self], input: &Map<T>) -> Map<T> {
        let size = |n: usize| (n + 2 * layers[0].padding - layers[0].side) / layers[0].stride + 1;
        let (height, width) = (size(input.height), size(input.width));
        let channels = layers.iter().map(|layer| layer.bias.len()).sum();
        let mut data = vec![T::zero(); height * width * channels];
        let rows_a_band = (PIXELS_PER_BAND / width).max(1);
        let bands = data.par_chunks_mut(rows_a_band * width * channels);
        bands.enumerate().for_each_init(Vec::new, |patches, (band, out)| {
            let rows = band * rows_a_band..band * rows_a_band + out.len() / (width * channels);
            let mut first = 0;
            for layer in layers {
                let columns = first..first + layer.bias.len();
                if layer.side == 1 {
                    // A patch is a pixel: the map itself is the matrix.
                    let pixels = rows.start * width * layer.input..rows.end * width * layer.input;
                    layer.multiply(&input.data[pixels], out, channels, columns.start);
                } else {
                    layer.patches(input, rows.clone(), width, patches);
                    layer.multiply(patches, out, channels, columns.start);
                }
                for pixel in out.chunks_exact_mut(channels) {
                    for (value, bias) in pixel[columns.clone()].iter_mut().zip(&layer.bias) {
                        *value = (*value + *bias).max(T::zero());
                    }
                }
                first = columns.end;
            }
        });
        Map {
            height,
            width,
            channels,
            data,
        }
    }

    /// The receptive field of each output pixel of `rows`, `[rows * width, side * side * input]`, zeros beyond the border.
    fn patches(&self, input: &Map<T>, rows: Range<usize>, width: usize, patches: &mut Vec<T>) {
        let run = self.side * self.input;
        patches.clear();
        patches.resize(rows.len() * width * self.side * run, T::zero());
        let mut runs = patches.chunks_exact_mut(run);
        for oy in rows {
            for ox in 0..width {
                for ky in 0..self.side {
                    let run = runs.next().expect("one run for every row of every patch");
                    let Some(y) = (oy * self.stride + ky)
                        .checked_sub(self.padding)
                        .filter(|y| *y < input.height)
                    else {
                        continue;
                    };
                    let (source, skipped) = self.run(y, ox, input.width);
                    run[skipped..skipped + source.len()].copy_from_slice(&input.data[source]);
                }
            }
        }
    }

    /// The range of row `y` of the patch of output column `ox` in a map `width` wide, clipped to the map, and how many values
    /// were clipped at its front.
    fn run(&self, y: usize, ox: usize, width: usize) -> (Range<usize>, usize) {
        let x0 = ox * self.stride;
        let from = x0.max(self.padding) - self.padding;
        let to = (x0 + self.side - self.padding).min(width);
        let values = (y * width + from) * self.input..(y * width + to) * self.input;
        (values, (from + self.padding - x0) * self.input)
    }

    /// Sets columns `first..` of `out [pixels, channels]` to `patches` times the kernel.
    fn multiply(&self, patches: &[T], out: &mut [T], channels: usize, first: usize) {
        let (inner, outputs) = (self.side * self.side * self.input, self.bias.len());
        let pixels = patches.len() / inner;
        let patches = ArrayView2::from_shape((pixels, inner), patches).expect("whole patches");
        let kernel = ArrayView2::from_shape((inner, outputs), &self.kernel).expect("a whole kernel");
        let mut out = ArrayViewMut2::from_shape((pixels, channels), out).expect("whole pixels");
        let mut columns = out.slice_axis_mut(Axis(1), (first..first + outputs).into());
        general_mat_mul(T::one(), &patches, &kernel, T::zero(), &mut columns);
    }

    /// Adds the gradient through channels `first..` of `v_out` to `v_input`; [`relu_vjp`] has been applied to `v_out`.
    pub(super) fn vjp(&self, v_out: &Map<T>, first: usize, v_input: &mut Map<T>) {
        if self.side == 1 {
            let inputs = v_input.data.par_chunks_mut(PIXELS_PER_BAND * self.input);
            inputs
                .zip(v_out.data.par_chunks(PIXELS_PER_BAND * v_out.channels))
                .for_each(|(v_input, v_out_part)| {
                    self.multiply_vjp(v_out_part, v_out.channels, first, T::one(), v_input);
                });
            return;
        }
        // The gradients of all patches; each input row then sums those that contain it: rows are disjoint.
        let run = self.side * self.input;
        let mut v_patches = vec![T::zero(); v_out.height * v_out.width * self.side * run];
        let bands = v_patches.par_chunks_mut(PIXELS_PER_BAND * self.side * run);
        bands
            .zip(v_out.data.par_chunks(PIXELS_PER_BAND * v_out.channels))
            .for_each(|(v_patches, v_out_part)| {
                self.multiply_vjp(v_out_part, v_out.channels, first, T::zero(), v_patches);
            });
        let width = v_input.width;
        let rows = v_input.data.par_chunks_mut(width * self.input).enumerate();
        rows.for_each(|(y, v_row)| {
            for ky in 0..self.side {
                let Some(down) = (y + self.padding).checked_sub(ky) else {
                    continue;
                };
                let oy = down / self.stride;
                if down % self.stride != 0 || oy >= v_out.height {
                    continue;
                }
                for ox in 0..v_out.width {
                    let (target, skipped) = self.run(0, ox, width);
                    let from = ((oy * v_out.width + ox) * self.side + ky) * run + skipped;
                    let source = &v_patches[from..from + target.len()];
                    for (v, add) in v_row[target].iter_mut().zip(source) {
                        *v += *add;
                    }
                }
            }
        });
    }

    /// `v_patches = v_out[:, first..] kernel^T + keep v_patches`.
    fn multiply_vjp(&self, v_out: &[T], channels: usize, first: usize, keep: T, v_patches: &mut [T]) {
        let (inner, outputs) = (self.side * self.side * self.input, self.bias.len());
        let pixels = v_out.len() / channels;
        let v_out = ArrayView2::from_shape((pixels, channels), v_out).expect("whole pixels");
        let columns = v_out.slice_axis(Axis(1), (first..first + outputs).into());
        let kernel = ArrayView2::from_shape((inner, outputs), &self.kernel).expect("a whole kernel");
        let mut v_patches = ArrayViewMut2::from_shape((pixels, inner), v_patches).expect("whole patches");
        general_mat_mul(T::one(), &columns, &kernel.t(), keep, &mut v_patches);
    }
}

/// The VJP of ReLU: zeroes the gradient where the output `out` is 0.
pub(super) fn relu_vjp<T: Real>(out: &Map<T>, v_out: &mut Map<T>) {
    const VALUES: usize = 1 << 14;
    let parts = v_out.data.par_chunks_mut(VALUES).zip(out.data.par_chunks(VALUES));
    parts.for_each(|(v, out)| {
        for (v, out) in v.iter_mut().zip(out) {
            *v = if *out > T::zero() { *v } else { T::zero() };
        }
    });
}

/// Max pooling with a stride of two pixels.
#[derive(Clone, Copy)]
pub(super) struct Pool {
    /// Side of a window, 2 or 3 pixels.
    pub(super) side: usize,
    /// Whether windows that extend beyond the border are kept and clipped ("ceil mode"), as in SqueezeNet.
    pub(super) ceil: bool,
}

impl Pool {
    /// Number of windows along `n` pixels.
    fn windows(self, n: usize) -> usize {
        let room = n.saturating_sub(self.side);
        1 + if self.ceil { room.div_ceil(2) } else { room / 2 }
    }
}

/// The maximum of each window.
pub(super) fn max_pool<T: Real>(input: &Map<T>, pool: Pool) -> Map<T> {
    let size = |n: usize| pool.windows(n);
    let (height, width, channels) = (size(input.height), size(input.width), input.channels);
    let mut data = vec![T::neg_infinity(); height * width * channels];
    data.par_chunks_mut(width * channels).enumerate().for_each(|(oy, row)| {
        for y in 2 * oy..(2 * oy + pool.side).min(input.height) {
            for (ox, out) in row.chunks_exact_mut(channels).enumerate() {
                for x in 2 * ox..(2 * ox + pool.side).min(input.width) {
                    let at = (y * input.width + x) * channels;
                    for (out, value) in out.iter_mut().zip(&input.data[at..at + channels]) {
                        *out = out.max(*value);
                    }
                }
            }
        }
    });
    Map {
        height,
        width,
        channels,
        data,
    }
}

/// The VJP of [`max_pool`], which returned `out`: each window's gradient goes to the first of its maxima.
pub(super) fn max_pool_vjp<T: Real>(input: &Map<T>, out: &Map<T>, v_out: &Map<T>, pool: Pool) -> Map<T> {
    let mut v_input = input.zeros_like();
    let (width, channels) = (input.width, input.channels);
    // Two input rows at a time: they belong to the windows that begin in them and to those that begin two rows above.
    let bands = v_input.data.par_chunks_mut(2 * width * channels).enumerate();
    bands.for_each_init(Vec::new, |left, (band, v_rows)| {
        let mine = 2 * band..2 * band + v_rows.len() / (width * channels);
        for oy in band.saturating_sub(1)..(band + 1).min(out.height) {
            for ox in 0..out.width {
                let at = (oy * out.width + ox) * channels;
                let largest = &out.data[at..at + channels];
                // The part of the window's gradient not yet assigned.
                left.clear();
                left.extend_from_slice(&v_out.data[at..at + channels]);
                for y in 2 * oy..(2 * oy + pool.side).min(mine.end) {
                    for x in 2 * ox..(2 * ox + pool.side).min(width) {
                        let at = (y * width + x) * channels;
                        let values = &input.data[at..at + channels];
                        if y < mine.start {
                            for ((left, value), largest) in left.iter_mut().zip(values).zip(largest) {
                                *left = if value == largest { T::zero() } else { *left };
                            }
                            continue;
                        }
                        let to = at - mine.start * width * channels;
                        let v = v_rows[to..to + channels].iter_mut().zip(left.iter_mut());
                        for ((v, left), (value, largest)) in v.zip(values.iter().zip(largest)) {
                            let wins = value == largest;
                            *v += if wins { *left } else { T::zero() };
                            *left = if wins { T::zero() } else { *left };
                        }
                    }
                }
            }
        }
    });
    v_input
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;
    use irradia_testkit::finite_differences::check_directional;

    const CEIL: Pool = Pool { side: 3, ceil: true };

    fn random(height: usize, width: usize, channels: usize, rng: &mut Rng) -> Map<f64> {
        let data = (0..height * width * channels)
            .map(|_| f64::from(rng.normal()))
            .collect();
        Map {
            height,
            width,
            channels,
            data,
        }
    }

    fn dot(a: &Map<f64>, b: &Map<f64>) -> f64 {
        a.data.iter().zip(&b.data).map(|(a, b)| a * b).sum()
    }

    /// `vjp(input, out, v_out)` is the gradient of `v_out . forward(input)`.
    fn check(
        forward: impl Fn(&Map<f64>) -> Map<f64>,
        vjp: impl Fn(&Map<f64>, &Map<f64>, Map<f64>) -> Map<f64>,
        input: &Map<f64>,
        rng: &mut Rng,
    ) {
        let out = forward(input);
        let v_out = random(out.height, out.width, out.channels, rng);
        let v_input = vjp(input, &out, v_out.clone());
        let value = |data: &[f64]| {
            let data = data.to_vec();
            dot(&v_out, &forward(&Map { data, ..*input }))
        };
        // Piecewise linear: only rounding error, unless a kink lies within a step (none for these seeds).
        check_directional(&input.data, &v_input.data, value, 1e-6, 1e-7);
    }

    #[test]
    fn convolution_gradients_match_finite_differences() {
        let mut rng = Rng::new(3, 0);
        for (height, width) in [(7, 9), (8, 5), (3, 3)] {
            for (side, stride, padding) in [(1, 1, 0), (3, 1, 1), (3, 2, 0), (5, 1, 2), (7, 4, 2)] {
                let (inputs, outputs) = (3, 4);
                let mut values = |n: usize| (0..n).map(|_| 0.5 * f64::from(rng.normal())).collect::<Vec<_>>();
                let (kernel, bias) = (values(outputs * inputs * side * side), values(outputs));
                let layer = Convolution::new(&kernel, bias, inputs, side, stride, padding);
                let input = random(height, width, inputs, &mut rng);
                let vjp = |input: &Map<f64>, out: &Map<f64>, mut v_out: Map<f64>| {
                    relu_vjp(out, &mut v_out);
                    let mut v_input = input.zeros_like();
                    layer.vjp(&v_out, 0, &mut v_input);
                    v_input
                };
                check(|input| layer.forward(input), vjp, &input, &mut rng);
            }
        }
    }

    #[test]
    fn pooling_gradients_match_finite_differences() {
        let mut rng = Rng::new(4, 0);
        for (height, width) in [(7, 9), (8, 6), (3, 3), (4, 3)] {
            for (side, ceil) in [(3, true), (3, false), (2, false)] {
                let pool = Pool { side, ceil };
                let input = random(height, width, 2, &mut rng);
                check(
                    |input| max_pool(input, pool),
                    |input, out, v_out| max_pool_vjp(input, out, &v_out, pool),
                    &input,
                    &mut rng,
                );
            }
        }
    }

    #[test]
    fn ties_in_pooling_give_the_gradient_to_the_first_value() {
        let flat = Map {
            height: 4,
            width: 3,
            channels: 1,
            data: vec![0.5; 12],
        };
        let out = max_pool(&flat, CEIL);
        let v_out = Map {
            data: vec![1.0, 2.0],
            ..out.zeros_like()
        };
        let v_input = max_pool_vjp(&flat, &out, &v_out, CEIL);
        assert_eq!(v_input.data, [1., 0., 0., 0., 0., 0., 2., 0., 0., 0., 0., 0.]);
    }

    #[test]
    fn a_convolution_of_ones_counts_neighbours_and_pads_with_zeros() {
        // All ones: each output is the number of pixels under the window, less 5 by the bias, and at least 0.
        let ones = Map {
            height: 3,
            width: 4,
            channels: 1,
            data: vec![1.0; 12],
        };
        let layer = Convolution::new(&[1.0; 9], vec![-5.0], 1, 3, 1, 1);
        let out = layer.forward(&ones);
        assert_eq!((out.height, out.width, out.channels), (3, 4, 1));
        assert_eq!(out.data, [0., 1., 1., 0., 1., 4., 4., 1., 0., 1., 1., 0.]);
        let strided = Convolution::new(&[1.0; 9], vec![0.0], 1, 3, 2, 0).forward(&ones);
        assert_eq!((strided.height, strided.width, strided.data), (1, 1, vec![9.0]));
    }

    #[test]
    fn kernels_are_not_transposed_or_mirrored() {
        // Two channels in, two out; only output 1, input 0, row 0, column 2 is set: out(y, x) = in(y - 1, x + 1).
        let mut kernel = vec![0.0; 2 * 2 * 9];
        kernel[2 * 9 + 2] = 1.0;
        let data: Vec<f32> = (0..2 * 2 * 2).map(|v| v as f32 + 1.0).collect();
        let input = Map {
            height: 2,
            width: 2,
            channels: 2,
            data,
        };
        let out = Convolution::new(&kernel, vec![0.0; 2], 2, 3, 1, 1).forward(&input);
        assert_eq!(out.data, [0., 0., 0., 0., 0., 3., 0., 0.]);
    }

    #[test]
    fn ceil_mode_pooling_keeps_windows_beyond_the_border() {
        let input = Map {
            height: 4,
            width: 3,
            channels: 1,
            data: (0..12).map(|v| v as f32 - 20.0).collect(),
        };
        let out = max_pool(&input, CEIL);
        assert_eq!((out.height, out.width, out.data), (2, 1, vec![-12.0, -9.0]));
        let floor = max_pool(&input, Pool { side: 2, ceil: false });
        assert_eq!((floor.height, floor.width, floor.data), (2, 1, vec![-16.0, -10.0]));
    }
}
