//! Fully connected ReLU networks over panels of samples, and their vector-Jacobian product.
//!
//! Activations are feature-major within a panel of 32 samples, `[panel, feature, 32]`: a layer is then
//! `y[o][s] += w[i][o] x[i][s]` with the sample in the lane. Weights are packed into tiles of eight outputs: layer by layer
//! in the forward pass, and once per step for the backward pass.
//! Every width is padded to a multiple of eight; padding is zero and stays zero.

mod outer;
mod product;

use crate::{Num, Rows};
use irradia_compute::simd::{Scalar, Simd};
use irradia_scene::Rng;
use outer::outer;
use product::{Begin, Finish, pack, product};

/// Samples per panel.
pub const PANEL: usize = 32;
/// Rows of features in a tile of weights or of sums. Widths are padded to whole tiles.
pub const TILE_ROWS: usize = 8;

/// The sizes of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MlpShape {
    /// Input features.
    pub inputs: usize,
    /// Output features (linear).
    pub outputs: usize,
    /// Width of a hidden layer.
    pub width: usize,
    /// Hidden layers (ReLU).
    pub depth: usize,
    /// The hidden layer (from 0) that takes the network's input as an additional input; NeRF: 5 of 8.
    pub skip: Option<usize>,
}

/// Position of a layer in the flat list of parameters: weights `[inputs + skip_inputs, outputs]`, then the bias.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layer {
    pub inputs: usize,
    /// Rows of the network's input taken as additional input (0 or all of it).
    skip_inputs: usize,
    pub outputs: usize,
    pub at: usize,
}

impl Layer {
    fn weights(&self) -> usize {
        (self.inputs + self.skip_inputs) * self.outputs
    }
    pub fn bias(&self) -> usize {
        self.at + self.weights()
    }
    fn end(&self) -> usize {
        self.bias() + self.outputs
    }
}

/// The layout of a network; its parameters are a flat list owned by the caller.
#[derive(Clone, Debug)]
pub struct Mlp {
    /// The requested sizes.
    pub shape: MlpShape,
    layers: Vec<Layer>,
}

/// Activations and gradients of a block of samples; buffers are reused.
#[derive(Clone, Debug, Default)]
pub struct MlpTape<T> {
    /// Output of each layer, `[panels, outputs, 32]`.
    outputs: Vec<Rows<T>>,
    /// Gradient of each layer's output before the ReLU.
    gradients: Vec<Rows<T>>,
    /// One layer's weights or gradients, packed for the current product.
    packed: Rows<T>,
}

impl<T: Scalar> MlpTape<T> {
    /// Output of the network, `[panels, padded outputs, 32]`.
    pub fn output(&self) -> &[T] {
        self.outputs.last().map_or(&[], |rows| rows)
    }

    /// The gradient of [`Self::output`], to be filled before the backward pass.
    pub fn output_gradient(&mut self) -> &mut Rows<T> {
        self.gradients.last_mut().expect("forward precedes backward")
    }

    /// The outputs of all layers, to drop samples from.
    pub(crate) fn outputs_mut(&mut self) -> &mut [Rows<T>] {
        &mut self.outputs
    }
}

impl Mlp {
    /// Lays out a network.
    pub fn new(shape: MlpShape) -> Self {
        let pad = |n: usize| n.next_multiple_of(TILE_ROWS);
        let inputs = pad(shape.inputs);
        let mut layers: Vec<Layer> = Vec::new();
        for l in 0..=shape.depth {
            layers.push(Layer {
                inputs: if l == 0 { inputs } else { pad(shape.width) },
                skip_inputs: if l > 0 && l < shape.depth && shape.skip == Some(l) {
                    inputs
                } else {
                    0
                },
                outputs: pad(if l == shape.depth { shape.outputs } else { shape.width }),
                at: layers.last().map_or(0, Layer::end),
            });
        }
        Self { shape, layers }
    }

    /// The layers, from input to output.
    #[cfg(feature = "gpu")]
    pub(crate) fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Input rows, padded.
    pub fn inputs(&self) -> usize {
        self.layers[0].inputs
    }

    /// Output rows, padded.
    pub fn outputs(&self) -> usize {
        self.layers[self.layers.len() - 1].outputs
    }

    /// Length of the flat list of parameters.
    pub fn parameters(&self) -> usize {
        self.layers[self.layers.len() - 1].end()
    }

    /// Range of the last layer in the flat list: with all zeros there, the network outputs zeros and still learns.
    pub fn last_layer(&self) -> std::ops::Range<usize> {
        let last = &self.layers[self.layers.len() - 1];
        last.at..last.end()
    }

    /// Multiplications per sample in the forward pass; the backward pass takes twice as many.
    pub fn products(&self) -> usize {
        self.layers.iter().map(Layer::weights).sum()
    }

    /// Random weights (He et al. 2015, uniform), zero biases, zero padding.
    pub fn init(&self, rng: &mut Rng) -> Vec<f32> {
        let mut parameters = vec![0.0; self.parameters()];
        for (l, layer) in self.layers.iter().enumerate() {
            let width = |real: usize, padded: usize| if real == 0 { padded } else { real };
            let inputs = if l == 0 {
                self.shape.inputs
            } else {
                width(self.shape.width, layer.inputs)
            };
            let last = l == self.shape.depth;
            let outputs = if last { self.shape.outputs } else { self.shape.width };
            let skip_inputs = if layer.skip_inputs > 0 { self.shape.inputs } else { 0 };
            let bound = (if last { 3.0 } else { 6.0 } / (inputs + skip_inputs) as f32).sqrt();
            for i in (0..inputs).chain(layer.inputs..layer.inputs + skip_inputs) {
                for o in 0..outputs {
                    parameters[layer.at + i * layer.outputs + o] = rng.range(-bound, bound);
                }
            }
        }
        parameters
    }

    /// The transposed weights, at the same offsets, so that the backward pass can use the forward pass's product kernel.
    ///
    /// Each layer is packed into tiles `[(inputs + skip_inputs) / 8, outputs, 8]`.
    pub fn transposed<T: Scalar>(&self, parameters: &[T]) -> Vec<T> {
        let mut transposed = vec![T::default(); parameters.len()];
        for layer in &self.layers {
            let weights = &parameters[layer.at..layer.bias()];
            let tiles = transposed[layer.at..layer.bias()].as_chunks_mut::<TILE_ROWS>().0;
            for (i, row) in weights.chunks_exact(layer.outputs).enumerate() {
                for (o, w) in row.iter().enumerate() {
                    tiles[i / TILE_ROWS * layer.outputs + o][i % TILE_ROWS] = *w;
                }
            }
        }
        transposed
    }

    /// Computes `tape.output()` from `x [panels, inputs, 32]`.
    #[inline(always)]
    pub fn forward<S: Simd>(&self, simd: S, parameters: &[Num<S>], x: &[Num<S>], tape: &mut MlpTape<Num<S>>) {
        let panels = x.len() / (self.inputs() * PANEL);
        tape.outputs.resize_with(self.layers.len(), Rows::default);
        tape.gradients.resize_with(self.layers.len(), Rows::default);
        // Layer by layer, so that a layer's weights stay in the cache for all panels.
        for (l, layer) in self.layers.iter().enumerate() {
            pack(&parameters[layer.at..layer.bias()], layer.outputs, &mut tape.packed);
            let (before, after) = tape.outputs.split_at_mut(l);
            let from = before.last().map_or(x, |hidden| hidden);
            after[0].resize(panels * layer.outputs * PANEL, Default::default());
            let bias = Begin::Bias(&parameters[layer.bias()..layer.end()]);
            let finish = if l + 1 == self.layers.len() {
                Finish::Keep
            } else {
                Finish::Relu
            };
            for (p, to) in after[0].chunks_exact_mut(layer.outputs * PANEL).enumerate() {
                let from = [panel(from, layer.inputs, p), panel(x, layer.skip_inputs, p)];
                product(simd, &tape.packed, from, bias, finish, to);
            }
        }
    }

    /// The VJP: adds to `grads` (flat, like the parameters) and writes the input's gradient to `v_x`, if requested.
    ///
    /// `transposed` is [`Self::transposed`]; `x` and `tape` are those of [`Self::forward`], with
    /// [`MlpTape::output_gradient`] filled, zero in the padding rows.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &self,
        simd: S,
        transposed: &[Num<S>],
        x: &[Num<S>],
        tape: &mut MlpTape<Num<S>>,
        grads: &mut [Num<S>],
        v_x: Option<&mut Rows<Num<S>>>,
    ) {
        self.pull_back(simd, transposed, tape, v_x);
        for (l, layer) in self.layers.iter().enumerate() {
            let from = if l == 0 { x } else { &tape.outputs[l - 1] };
            let from = [(from, layer.inputs), (x, layer.skip_inputs)];
            let v = (&tape.gradients[l][..], layer.outputs);
            outer(simd, from, v, &mut tape.packed, &mut grads[layer.at..layer.end()]);
        }
    }

    /// The part of [`Self::backward`] without parameter gradients: the gradients of all activations and of the input.
    #[inline(always)]
    pub fn pull_back<S: Simd>(
        &self,
        simd: S,
        transposed: &[Num<S>],
        tape: &mut MlpTape<Num<S>>,
        mut v_x: Option<&mut Rows<Num<S>>>,
    ) {
        let panels = tape.output().len() / (self.outputs() * PANEL);
        if let Some(v_x) = &mut v_x {
            v_x.resize(panels * self.inputs() * PANEL, Default::default());
        }
        let mut begin = Begin::Zero;
        for (l, layer) in self.layers.iter().enumerate().rev() {
            let (before, after) = tape.gradients.split_at_mut(l);
            let v = |p| [panel(&after[0], layer.outputs, p), &[]];
            let transposed = &transposed[layer.at..layer.bias()];
            let (to_hidden, to_input) = transposed.split_at(if l == 0 { 0 } else { layer.inputs * layer.outputs });
            if let Some(v_hidden) = before.last_mut() {
                let hidden = &tape.outputs[l - 1];
                v_hidden.resize(hidden.len(), Default::default());
                for (p, to) in v_hidden.chunks_exact_mut(layer.inputs * PANEL).enumerate() {
                    let mask = Finish::Mask(panel(hidden, layer.inputs, p));
                    product(simd, to_hidden, v(p), Begin::Zero, mask, to);
                }
            }
            if let (false, Some(v_x)) = (to_input.is_empty(), &mut v_x) {
                for (p, to) in v_x.chunks_exact_mut(self.inputs() * PANEL).enumerate() {
                    product(simd, to_input, v(p), begin, Finish::Keep, to);
                }
                begin = Begin::Add;
            }
        }
    }
}

/// Panel `p` of `rows [panels, count, 32]`.
#[inline(always)]
fn panel<T>(rows: &[T], count: usize, p: usize) -> &[T] {
    &rows[p * count * PANEL..(p + 1) * count * PANEL]
}
