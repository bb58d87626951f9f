//! Fully connected ReLU networks over panels of samples, and their vector-Jacobian product.
//!
//! Activations are feature-major within a panel of 32 samples, `[panel, feature, 32]`: a layer is then
//! `y[o][s] += w[i][o] x[i][s]` with the sample in the lane, so nothing is ever transposed but the weights, once a step.
//! A panel of a layer of 64 is 8 KiB: it goes through the whole network without leaving the first cache.
//! Every width is padded to a multiple of eight; what is padding is zero and stays zero.

use crate::{Num, Rows};
use irradia_compute::each;
use irradia_compute::simd::{Lanes, Scalar, Simd};
use irradia_scene::Rng;

/// Samples of a panel.
pub const PANEL: usize = 32;
/// Widths are padded to this.
pub const ROWS: usize = 8;

/// The sizes of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MlpShape {
    /// Input features.
    pub inputs: usize,
    /// Output features (linear).
    pub outputs: usize,
    /// Features of a hidden layer.
    pub width: usize,
    /// Hidden layers (ReLU).
    pub depth: usize,
    /// The hidden layer (from 0) that sees the input again; NeRF: 5 of 8.
    pub skip: Option<usize>,
}

/// Where one layer's numbers lie in the flat list of parameters: weights `[inputs + again, outputs]`, then the bias.
#[derive(Clone, Copy, Debug)]
struct Layer {
    inputs: usize,
    /// Rows of the network's input that come in again (0 or all of it).
    again: usize,
    outputs: usize,
    at: usize,
}

impl Layer {
    fn weights(&self) -> usize {
        (self.inputs + self.again) * self.outputs
    }
    fn bias(&self) -> usize {
        self.at + self.weights()
    }
    fn end(&self) -> usize {
        self.bias() + self.outputs
    }
}

/// A network: its sizes and where its parameters lie. The parameters themselves are a flat list that others hold.
#[derive(Clone, Debug)]
pub struct Mlp {
    /// The sizes asked for.
    pub shape: MlpShape,
    layers: Vec<Layer>,
}

/// Activations and gradients of a block of samples; buffers are reused.
#[derive(Clone, Debug, Default)]
pub struct MlpTape<T> {
    /// What each layer gives out, `[panels, outputs, 32]`.
    outputs: Vec<Rows<T>>,
    /// The gradient of the same before the ReLU.
    gradients: Vec<Rows<T>>,
}

impl<T: Scalar> MlpTape<T> {
    /// What the network gives out, `[panels, padded outputs, 32]`.
    pub fn output(&self) -> &[T] {
        self.outputs.last().map_or(&[], |rows| rows)
    }

    /// To be filled with the gradient of [`Self::output`] before going back.
    pub fn output_gradient(&mut self) -> &mut Rows<T> {
        self.gradients.last_mut().expect("forward came first")
    }

    /// Everything kept a sample, layer by layer, with its number of rows: for throwing samples away.
    pub(crate) fn outputs_mut(&mut self) -> &mut [Rows<T>] {
        &mut self.outputs
    }
}

impl Mlp {
    /// Lays a network out.
    pub fn new(shape: MlpShape) -> Self {
        let pad = |n: usize| n.next_multiple_of(ROWS);
        let inputs = pad(shape.inputs);
        let mut layers: Vec<Layer> = Vec::new();
        for l in 0..=shape.depth {
            layers.push(Layer {
                inputs: if l == 0 { inputs } else { pad(shape.width) },
                again: if l > 0 && l < shape.depth && shape.skip == Some(l) {
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

    /// Rows of the input, padded.
    pub fn inputs(&self) -> usize {
        self.layers[0].inputs
    }

    /// Rows of the output, padded.
    pub fn outputs(&self) -> usize {
        self.layers[self.layers.len() - 1].outputs
    }

    /// Numbers in the flat list.
    pub fn parameters(&self) -> usize {
        self.layers[self.layers.len() - 1].end()
    }

    /// Where the last layer's numbers lie in the flat list: all zero, the network gives out zeros and still learns.
    pub fn last_layer(&self) -> std::ops::Range<usize> {
        let last = &self.layers[self.layers.len() - 1];
        last.at..last.end()
    }

    /// Multiplications of one sample forward; going back takes twice as many.
    pub fn products(&self) -> usize {
        self.layers.iter().map(Layer::weights).sum()
    }

    /// Random weights (He et al. 2015, uniform), zero biases, zeros where there is padding.
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
            let again = if layer.again > 0 { self.shape.inputs } else { 0 };
            let bound = (if last { 3.0 } else { 6.0 } / (inputs + again) as f32).sqrt();
            for i in (0..inputs).chain(layer.inputs..layer.inputs + again) {
                for o in 0..outputs {
                    parameters[layer.at + i * layer.outputs + o] = rng.range(-bound, bound);
                }
            }
        }
        parameters
    }

    /// The weights turned over, `[outputs, inputs + again]` at the same places: going back is then going forward.
    pub fn transposed<T: Scalar>(&self, parameters: &[T]) -> Vec<T> {
        let mut turned = vec![T::default(); parameters.len()];
        for layer in &self.layers {
            let rows = layer.inputs + layer.again;
            let weights = &parameters[layer.at..layer.bias()];
            for (i, row) in weights.chunks_exact(layer.outputs).enumerate() {
                for (o, w) in row.iter().enumerate() {
                    turned[layer.at + o * rows + i] = *w;
                }
            }
        }
        turned
    }

    /// `tape.output()` of `x [panels, inputs, 32]`.
    #[inline(always)]
    pub fn forward<S: Simd>(&self, simd: S, parameters: &[Num<S>], x: &[Num<S>], tape: &mut MlpTape<Num<S>>) {
        let panels = x.len() / (self.inputs() * PANEL);
        tape.outputs.resize_with(self.layers.len(), Rows::default);
        tape.gradients.resize_with(self.layers.len(), Rows::default);
        for (layer, to) in self.layers.iter().zip(&mut tape.outputs) {
            to.resize(panels * layer.outputs * PANEL, Default::default());
        }
        for (p, x) in x.chunks_exact(self.inputs() * PANEL).enumerate() {
            for (l, layer) in self.layers.iter().enumerate() {
                let (before, after) = tape.outputs.split_at_mut(l);
                let from = match before.last() {
                    Some(hidden) => &hidden[p * layer.inputs * PANEL..][..layer.inputs * PANEL],
                    None => x,
                };
                let to = &mut after[0][p * layer.outputs * PANEL..][..layer.outputs * PANEL];
                let weights = &parameters[layer.at..layer.bias()];
                let bias = &parameters[layer.bias()..layer.end()];
                let finish = if l + 1 == self.layers.len() {
                    Finish::Keep
                } else {
                    Finish::Relu
                };
                let (first, second) = weights.split_at(layer.inputs * layer.outputs);
                if layer.again == 0 {
                    product(simd, first, layer.outputs, from, Begin::Bias(bias), finish, to);
                } else {
                    product(simd, first, layer.outputs, from, Begin::Bias(bias), Finish::Keep, to);
                    product(simd, second, layer.outputs, x, Begin::Add, finish, to);
                }
            }
        }
    }

    /// Goes back: adds to `grads` (flat, as the parameters) and writes the input's gradient to `v_x`, where it is wanted.
    ///
    /// `turned` is [`Self::transposed`]; `x` and `tape` are those of [`Self::forward`], with
    /// [`MlpTape::output_gradient`] filled, zero in the padding rows.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &self,
        simd: S,
        turned: &[Num<S>],
        x: &[Num<S>],
        tape: &mut MlpTape<Num<S>>,
        grads: &mut [Num<S>],
        v_x: Option<&mut Rows<Num<S>>>,
    ) {
        self.pull_back(simd, turned, tape, v_x);
        for (l, layer) in self.layers.iter().enumerate() {
            let v = &tape.gradients[l];
            let (weights, bias) = grads[layer.at..layer.end()].split_at_mut(layer.weights());
            let (first, second) = weights.split_at_mut(layer.inputs * layer.outputs);
            let from: &[Num<S>] = if l == 0 { x } else { &tape.outputs[l - 1] };
            outer(simd, from, layer.inputs, v, layer.outputs, first);
            if layer.again > 0 {
                outer(simd, x, layer.again, v, layer.outputs, second);
            }
            add_rows(simd, v, bias);
        }
    }

    /// The half of [`Self::backward`] that needs no parameters' gradients: the gradients of all activations, and of the input.
    #[inline(always)]
    pub fn pull_back<S: Simd>(
        &self,
        simd: S,
        turned: &[Num<S>],
        tape: &mut MlpTape<Num<S>>,
        mut v_x: Option<&mut Rows<Num<S>>>,
    ) {
        let inputs = self.inputs() * PANEL;
        let panels = tape.output().len() / (self.outputs() * PANEL);
        if let Some(v_x) = &mut v_x {
            v_x.clear();
            v_x.resize(panels * inputs, Default::default());
        }
        for (layer, to) in self.layers.iter().zip(&mut tape.gradients).rev().skip(1) {
            to.resize(panels * layer.outputs * PANEL, Default::default());
        }
        for p in 0..panels {
            for (l, layer) in self.layers.iter().enumerate().rev() {
                let (before, after) = tape.gradients.split_at_mut(l);
                let v = &after[0][p * layer.outputs * PANEL..][..layer.outputs * PANEL];
                let rows = layer.inputs + layer.again;
                let turned = &turned[layer.at..layer.bias()];
                if let Some(v_hidden) = before.last_mut() {
                    let place = p * layer.inputs * PANEL..(p + 1) * layer.inputs * PANEL;
                    let mask = Finish::Mask(&tape.outputs[l - 1][place.clone()]);
                    product(simd, turned, rows, v, Begin::Zero, mask, &mut v_hidden[place]);
                }
                let comes_in = l == 0 || layer.again > 0;
                if let (true, Some(v_x)) = (comes_in, &mut v_x) {
                    let skip = if l == 0 { 0 } else { layer.inputs };
                    let to = &mut v_x[p * inputs..(p + 1) * inputs];
                    product(simd, &turned[skip..], rows, v, Begin::Add, Finish::Keep, to);
                }
            }
        }
    }
}

/// What a sum starts with.
#[derive(Clone, Copy)]
enum Begin<'a, T> {
    Zero,
    Bias(&'a [T]),
    /// What is there already.
    Add,
}

/// What happens to a sum at the end.
#[derive(Clone, Copy)]
enum Finish<'a, T> {
    Keep,
    Relu,
    /// Zero where this is not positive: the ReLU's VJP.
    Mask(&'a [T]),
}

/// `to[o][s] = begin + sum over i of w[i][o] x[i][s]` for one panel; `w` has rows `stride` apart.
#[inline(always)]
fn product<S: Simd>(
    simd: S,
    w: &[Num<S>],
    stride: usize,
    x: &[Num<S>],
    begin: Begin<Num<S>>,
    finish: Finish<Num<S>>,
    to: &mut [Num<S>],
) {
    // As many accumulators as hide the latency of two multipliers and leave registers for the operands.
    match S::LANES {
        16 => tiles::<S, 8, 2>(simd, w, stride, x, begin, finish, to),
        4 | 8 => tiles::<S, 4, 2>(simd, w, stride, x, begin, finish, to),
        _ => tiles::<S, 4, 1>(simd, w, stride, x, begin, finish, to),
    }
}

#[inline(always)]
fn tiles<S: Simd, const O: usize, const V: usize>(
    simd: S,
    w: &[Num<S>],
    stride: usize,
    x: &[Num<S>],
    begin: Begin<Num<S>>,
    finish: Finish<Num<S>>,
    to: &mut [Num<S>],
) {
    let (x, to) = (x.as_chunks::<PANEL>().0, to.as_chunks_mut::<PANEL>().0);
    let zero = simd.splat(0.0);
    for o in (0..to.len()).step_by(O) {
        for s in (0..PANEL).step_by(V * S::LANES) {
            let mut sums = [[zero; V]; O];
            match begin {
                Begin::Zero => {}
                Begin::Bias(bias) => {
                    for k in 0..O {
                        sums[k] = [simd.set(bias[o + k]); V];
                    }
                }
                Begin::Add => {
                    for k in 0..O {
                        for v in 0..V {
                            sums[k][v] = simd.load(&to[o + k][s + v * S::LANES..]);
                        }
                    }
                }
            }
            let mut at = o;
            for x in x {
                let w: &[Num<S>; O] = w[at..].first_chunk().expect("a tile of weights");
                at += stride;
                let mut xs = [zero; V];
                for v in 0..V {
                    xs[v] = simd.load(&x[s + v * S::LANES..]);
                }
                for k in 0..O {
                    let w = simd.set(w[k]);
                    for v in 0..V {
                        sums[k][v] = w.mul_add(xs[v], sums[k][v]);
                    }
                }
            }
            for k in 0..O {
                for v in 0..V {
                    let at = s + v * S::LANES;
                    let sum = match finish {
                        Finish::Keep => sums[k][v],
                        Finish::Relu => sums[k][v].max(zero),
                        Finish::Mask(mask) => {
                            let mask = simd.load(&mask[(o + k) * PANEL + at..]);
                            sums[k][v].zero_where_not(zero.lt(mask))
                        }
                    };
                    sum.store(&mut to[o + k][at..]);
                }
            }
        }
    }
}

/// `to[i][o] += sum over samples of x[i][s] v[o][s]`, over all panels.
#[inline(always)]
fn outer<S: Simd>(simd: S, x: &[Num<S>], inputs: usize, v: &[Num<S>], outputs: usize, to: &mut [Num<S>]) {
    if S::LANES == 16 {
        outer_tiles::<S, 4>(simd, x, inputs, v, outputs, to);
    } else {
        outer_tiles::<S, 2>(simd, x, inputs, v, outputs, to);
    }
}

#[inline(always)]
fn outer_tiles<S: Simd, const I: usize>(
    simd: S,
    x: &[Num<S>],
    inputs: usize,
    v: &[Num<S>],
    outputs: usize,
    to: &mut [Num<S>],
) {
    let zero = simd.splat(0.0);
    let (xs, vs) = (x.as_chunks::<PANEL>().0, v.as_chunks::<PANEL>().0);
    // Counted by hand: iterators over panels cost a division and a call a tile.
    for o in (0..outputs).step_by(4) {
        for i in (0..inputs).step_by(I) {
            let mut sums = [[zero; 4]; I];
            let (mut x_row, mut v_row) = (i, o);
            while x_row < xs.len() {
                let x: &[[Num<S>; PANEL]; I] = xs[x_row..].first_chunk().expect("a tile");
                let v: &[[Num<S>; PANEL]; 4] = vs[v_row..].first_chunk().expect("a tile");
                (x_row, v_row) = (x_row + inputs, v_row + outputs);
                let mut s = 0;
                while s < PANEL {
                    let four = each!(k in 4 => simd.load(&v[k][s..]));
                    for j in 0..I {
                        let x = simd.load(&x[j][s..]);
                        for k in 0..4 {
                            sums[j][k] = x.mul_add(four[k], sums[j][k]);
                        }
                    }
                    s += S::LANES;
                }
            }
            for j in 0..I {
                let mut four = [Num::<S>::default(); 4];
                S::F::sums(&sums[j], &mut four);
                let to = &mut to[(i + j) * outputs + o..][..4];
                for k in 0..4 {
                    to[k] = to[k] + four[k];
                }
            }
        }
    }
}

/// `to[o] += sum over samples of v[o][s]`.
#[inline(always)]
fn add_rows<S: Simd>(simd: S, v: &[Num<S>], to: &mut [Num<S>]) {
    for v in v.chunks_exact(to.len() * PANEL) {
        for (row, to) in v.as_chunks::<PANEL>().0.iter().zip(to.iter_mut()) {
            let mut sum = simd.splat(0.0);
            for s in (0..PANEL).step_by(S::LANES) {
                sum += simd.load(&row[s..]);
            }
            *to = *to + sum.sum();
        }
    }
}
