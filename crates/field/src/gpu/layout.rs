//! Where the activations of a field's networks lie.

use crate::mlp::Mlp;
use crate::net::Net;

/// Samples over which a workgroup sums the gradients of weights, at least; a multiple of 32.
const CHUNK: usize = 256;
/// Chunks at most: memory for as many gradients of all weights.
pub(super) const CHUNKS: usize = 128;

/// One layer: `Layer` in `layer.wgsl`.
#[derive(Clone, Copy, Debug)]
pub(super) struct DeviceLayer {
    pub inputs: usize,
    pub outputs: usize,
    /// Outputs as stored with the weights.
    pub padded: usize,
    weights: usize,
    bias: usize,
    from: usize,
    to: usize,
    /// Whether it is not the last of its network.
    relu: bool,
    /// Inputs whose gradient is wanted, and whether they came through a ReLU.
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

/// Samples of a chunk.
pub(super) fn chunk(samples: usize) -> usize {
    samples.div_ceil(CHUNKS).next_multiple_of(32).max(CHUNK)
}

/// The rows of all layers. The encoded direction follows the density and its features, so that these are the input of the colour's
/// network where they are: its gradients in their rows are then those of the density network's outputs.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// Those of the density, then those of the colour.
    pub(super) layers: Vec<DeviceLayer>,
    /// Layers of the density.
    pub densities: usize,
    pub density_row: usize,
    pub direction_row: usize,
    pub rgb_row: usize,
    /// Rows in all.
    pub rows: usize,
    /// Parameters of both networks.
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

    /// What the shaders know of the field's shape when they are compiled.
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
