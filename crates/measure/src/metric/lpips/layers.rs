//! The two kinds of layer, over maps whose channels lie together: a patch is then three runs of memory, the result of a
//! matrix product is already the next map, and bands of rows are disjoint, which makes them parallel.

use ndarray::linalg::general_mat_mul;
use ndarray::{ArrayView2, ArrayViewMut2, Axis};
use rayon::prelude::*;

/// A feature map.
pub(super) struct Map {
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) channels: usize,
    /// `[H, W, C]`.
    pub(super) data: Vec<f32>,
}

/// A square convolution followed by ReLU.
pub(super) struct Convolution {
    /// `[side, side, input, output]`, as the matrix that patches are multiplied by.
    kernel: Vec<f32>,
    bias: Vec<f32>,
    input: usize,
    side: usize,
    stride: usize,
    padding: usize,
}

/// Output pixels a matrix product: their patches stay in the second-level cache.
const PIXELS_A_BAND: usize = 512;

impl Convolution {
    /// From a kernel `[output, input, side, side]` and a bias `[output]`.
    pub(super) fn new(oihw: &[f32], bias: Vec<f32>, input: usize, side: usize, stride: usize, padding: usize) -> Self {
        let (outputs, taps) = (bias.len(), side * side);
        let mut kernel = vec![0.0; oihw.len()];
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

    pub(super) fn forward(&self, input: &Map) -> Map {
        Self::forward_side_by_side(&[self], input)
    }

    /// Convolutions whose outputs have one size, their channels concatenated.
    pub(super) fn forward_side_by_side(layers: &[&Self], input: &Map) -> Map {
        let size = |n: usize| (n + 2 * layers[0].padding - layers[0].side) / layers[0].stride + 1;
        let (height, width) = (size(input.height), size(input.width));
        let channels = layers.iter().map(|layer| layer.bias.len()).sum();
        let mut data = vec![0.0; height * width * channels];
        let rows_a_band = (PIXELS_A_BAND / width).max(1);
        let bands = data.par_chunks_mut(rows_a_band * width * channels);
        bands.enumerate().for_each_init(Vec::new, |patches, (band, out)| {
            let rows = band * rows_a_band..band * rows_a_band + out.len() / (width * channels);
            let mut first = 0;
            for layer in layers {
                let columns = first..first + layer.bias.len();
                layer.patches(input, rows.clone(), width, patches);
                layer.multiply(patches, out, channels, columns.start);
                for pixel in out.chunks_exact_mut(channels) {
                    for (value, bias) in pixel[columns.clone()].iter_mut().zip(&layer.bias) {
                        *value = (*value + bias).max(0.0);
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

    /// What each output pixel of `rows` sees, `[rows * width, side * side * input]`, zeros beyond the border.
    fn patches(&self, input: &Map, rows: std::ops::Range<usize>, width: usize, patches: &mut Vec<f32>) {
        let run = self.side * self.input;
        patches.clear();
        patches.resize(rows.len() * width * self.side * run, 0.0);
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
                    // Columns x0..x0+side of the padded row, clipped to the image.
                    let x0 = ox * self.stride;
                    let from = x0.max(self.padding) - self.padding;
                    let to = (x0 + self.side - self.padding).min(input.width);
                    let skipped = (from + self.padding - x0) * self.input;
                    let source =
                        &input.data[(y * input.width + from) * self.input..(y * input.width + to) * self.input];
                    run[skipped..skipped + source.len()].copy_from_slice(source);
                }
            }
        }
    }

    /// Columns `first..` of `out [pixels, channels]` become `patches` times the kernel.
    fn multiply(&self, patches: &[f32], out: &mut [f32], channels: usize, first: usize) {
        let (inner, outputs) = (self.side * self.side * self.input, self.bias.len());
        let pixels = patches.len() / inner;
        let patches = ArrayView2::from_shape((pixels, inner), patches).expect("whole patches");
        let kernel = ArrayView2::from_shape((inner, outputs), &self.kernel).expect("a whole kernel");
        let mut out = ArrayViewMut2::from_shape((pixels, channels), out).expect("whole pixels");
        let mut columns = out.slice_axis_mut(Axis(1), (first..first + outputs).into());
        general_mat_mul(1.0, &patches, &kernel, 0.0, &mut columns);
    }
}

/// The largest of each 3x3 window, two pixels apart; windows that reach beyond the border are kept and take what is there
/// ("ceil mode", as the network was trained).
pub(super) fn max_pool(input: &Map) -> Map {
    let size = |n: usize| n.saturating_sub(3).div_ceil(2) + 1;
    let (height, width, channels) = (size(input.height), size(input.width), input.channels);
    let mut data = vec![f32::NEG_INFINITY; height * width * channels];
    data.par_chunks_mut(width * channels).enumerate().for_each(|(oy, row)| {
        for y in 2 * oy..(2 * oy + 3).min(input.height) {
            for (ox, out) in row.chunks_exact_mut(channels).enumerate() {
                for x in 2 * ox..(2 * ox + 3).min(input.width) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_convolution_counts_its_neighbours_and_stops_at_the_border() {
        // All ones: each output is the number of pixels under the window, less the bias of 5, and not below 0.
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
    fn pooling_keeps_the_windows_that_reach_beyond_the_border() {
        let input = Map {
            height: 4,
            width: 3,
            channels: 1,
            data: (0..12).map(|v| v as f32 - 20.0).collect(),
        };
        let out = max_pool(&input);
        assert_eq!((out.height, out.width, out.data), (2, 1, vec![-12.0, -9.0]));
    }
}
