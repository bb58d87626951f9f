//! Memory layout of the activations of a field's networks.

use crate::mlp::Mlp;
use crate::net::Net;

/// Minimum number of samples over which a workgroup sums the gradients of weights; a multiple of 32.
const MIN_CHUNK: usize = 256;
/// Maximum number of chunks; each needs memory for the gradients of all weights.
pub(super) const MAX_CHUNKS: usize = 128;

/// One layer, as `Layer` in `layer.wgsl`.
#[derive(Clone, Copy, Debug)]
pub(super) struct DeviceLayer {
    pub inputs: usize,
    pub outputs: usize,
    /// Number of outputs as stored with the weights, padded to eight.
    pub padded: usize,
    weights: usize,
    bias: usize,
    from: usize,
    to: usize,
    /// Whether the outputs go through a ReLU: in all layers but the last of a network.
    relu: bool,
    /// Number of inputs whose gradient is needed, and whether they came through a ReLU.
    pub wanted: usize,
    masked: bool,
}

impl DeviceLayer {
    pub fn words(&self, samples: usize, stride: usize, parameters: usize) -> [[u32; 4]; 4] {
        let sizes = [self.inputs, self.outputs, self.padded, self.weights];
        let rows = [self.from, self.to, usize::from(self.relu), self.bias];
        let back = [self.wanted, usize::from(self.masked), 0, 0];
        [sizes, rows, [samples, stride, chunk(samples), parameters], back].map(|quad| quad.map(|n| n as u32))
    }
}

/// Number of samples per chunk.
pub(super) fn chunk(samples: usize) -> usize {
    samples.div_ceil(MAX_CHUNKS).next_multiple_of(32).max(MIN_CHUNK)
}

/// The rows of all layers. The encoded direction follows the density and the geometry features, so that the colour network reads its
/// input in place, and writes the gradients of the density network's outputs into the same rows.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// The layers of the density network, then those of the colour network.
    pub(super) layers: Vec<DeviceLayer>,
    /// Number of layers of the density network.
    pub densities: usize,
    pub density_row: usize,
    pub direction_row: usize,
    pub rgb_row: usize,
    /// Total number of rows.
    pub rows: usize,
    /// Number of parameters of both networks.
    pub parameters: usize,
}

impl Layout {
    pub fn new(net: &Net) -> Self {
        let (density, color) = net.mlps();
        let color = color.expect("a field that shows colours");
        let shape = &net.shape;
        let features = shape.encoding.features();
        let mut layers = Vec::new();
        let density_row = add(&mut layers, density, [0, features], features, 0);
        let direction_row = density_row + 1 + shape.geometry;
        let inputs = color.shape.inputs;
        let rgb_row = {
            let first = density_row + 1;
            add(
                &mut layers,
                color,
                [first, inputs],
                shape.geometry,
                density.parameters(),
            )
        };
        Self {
            densities: density.layers().len(),
            layers,
            density_row,
            direction_row,
            rgb_row,
            rows: rgb_row + 3,
            parameters: density.parameters() + color.parameters(),
        }
    }

    /// The field's shape as constants that are compiled into the shaders.
    pub fn constants(&self, net: &Net) -> String {
        let (density, _) = net.mlps();
        let levels = net.levels.len();
        let features = net.shape.encoding.features() / levels;
        [
            ("LEVELS", levels),
            ("FEATURES", features),
            ("WIDTH", net.shape.width),
            ("HIDDEN", net.shape.depth),
            ("INPUTS", density.inputs()),
            ("OUTPUTS", density.outputs()),
        ]
        .map(|(name, value)| format!("const {name}: u32 = {value}u;\n"))
        .concat()
    }
}

/// Adds the layers of `mlp`, whose `inputs` rows begin at `first` and whose parameters begin at `at`; returns the first row of its output.
fn add(layers: &mut Vec<DeviceLayer>, mlp: &Mlp, [first, inputs]: [usize; 2], wanted: usize, at: usize) -> usize {
    let last = mlp.layers().len() - 1;
    let (mut from, mut to) = (first, first + inputs);
    for (l, layer) in mlp.layers().iter().enumerate() {
        let inputs = if l == 0 { inputs } else { mlp.shape.width };
        let outputs = if l == last { mlp.shape.outputs } else { mlp.shape.width };
        layers.push(DeviceLayer {
            inputs,
            outputs,
            padded: layer.outputs,
            weights: at + layer.at,
            bias: at + layer.bias(),
            from,
            to,
            relu: l < last,
            wanted: if l == 0 { wanted } else { inputs },
            masked: l > 0,
        });
        (from, to) = (to, to + outputs);
    }
    from
}
