//! A block of samples in a network, in panels.

use crate::Rows;
use crate::mlp::{MlpTape, PANEL};
use irradia_compute::simd::Scalar;

/// Inputs, activations and gradients of a block of samples; buffers are reused. Rows are padded to eight, samples to 32.
#[derive(Clone, Debug, Default)]
pub struct Block<T> {
    /// Number of samples.
    pub len: usize,
    /// Positions in the unit cube, `[panels, 3, 32]`.
    pub points: Rows<T>,
    /// Unit viewing directions in the world, `[panels, 3, 32]`.
    pub directions: Rows<T>,
    /// Appearance codes, `[panels, appearance, 32]`.
    pub codes: Rows<T>,
    /// Encoded positions, `[panels, rows, 32]`.
    pub encoded: Rows<T>,
    /// Densities, in inverse field units, `[panels * 32]`.
    pub density: Rows<T>,
    /// Colours, `[panels, 3, 32]`.
    pub rgb: Rows<T>,
    /// Gradient of the densities.
    pub v_density: Rows<T>,
    /// Gradient of the colours.
    pub v_rgb: Rows<T>,
    /// Gradient of the encoded positions, `[panels, rows, 32]`.
    pub v_encoded: Rows<T>,
    /// Gradient of the colour part's input, `[panels, rows, 32]`.
    pub(super) v_color_in: Rows<T>,
    /// The derivative of the density with respect to the network's output.
    pub(super) slope: Rows<T>,
    pub(super) density_tape: MlpTape<T>,
    pub(super) color_in: Rows<T>,
    pub(super) color_tape: MlpTape<T>,
}

impl<T: Scalar> Block<T> {
    /// Number of panels for [`Self::len`] samples.
    pub fn panels(&self) -> usize {
        self.len.div_ceil(PANEL)
    }

    /// Makes room for `len` points, to be set with [`set3`].
    pub fn reset(&mut self, len: usize) {
        self.len = len;
        self.points.clear();
        self.points.resize(self.panels() * 3 * PANEL, T::default());
    }

    /// Gives all samples the same appearance code.
    pub(crate) fn fill_code(&mut self, code: &[T]) {
        self.codes.clear();
        self.codes.resize(self.panels() * code.len() * PANEL, T::default());
        for row in self.codes.chunks_exact_mut(code.len().max(1) * PANEL) {
            row.chunks_exact_mut(PANEL)
                .zip(code)
                .for_each(|(row, value)| row.fill(*value));
        }
    }

    /// Keeps the samples `kept` (ascending) and drops the others.
    pub fn keep(&mut self, kept: &[u32]) {
        if kept.len() == self.len {
            return;
        }
        let before = self.panels();
        self.len = kept.len();
        let after = self.panels();
        let own = [&mut self.points, &mut self.encoded, &mut self.density, &mut self.slope];
        for rows in own.into_iter().chain(self.density_tape.outputs_mut()) {
            let height = rows.len() / (before * PANEL);
            for (to, from) in kept.iter().map(|k| *k as usize).enumerate() {
                let (to, from) = (sample_offset(height, to), sample_offset(height, from));
                for row in 0..height {
                    rows[to + row * PANEL] = rows[from + row * PANEL];
                }
            }
            rows.truncate(after * height * PANEL);
        }
    }
}

/// Index of row 0 of sample `i` in panels of `rows` rows; the other rows follow at a stride of 32.
#[inline(always)]
pub fn sample_offset(rows: usize, i: usize) -> usize {
    i / PANEL * rows * PANEL + i % PANEL
}

/// Sets three rows of sample `i`.
#[inline(always)]
pub fn set3<T: Copy>(rows: &mut [T], i: usize, values: [T; 3]) {
    let at = sample_offset(3, i);
    for c in 0..3 {
        rows[at + c * PANEL] = values[c];
    }
}

/// Three rows of sample `i`.
#[inline(always)]
pub fn get3<T: Copy>(rows: &[T], i: usize) -> [T; 3] {
    let at = sample_offset(3, i);
    [rows[at], rows[at + PANEL], rows[at + 2 * PANEL]]
}
