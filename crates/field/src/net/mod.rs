//! One network of a field: maps an encoded position to density and geometry features, and the features with the direction to colour.
//!
//! A block of samples is evaluated in three steps, so that occluded samples can be dropped between them:
//! [`Net::density`], [`Block::keep`], [`Net::color`]; then [`Net::backward`].

use crate::encoding::hash_grid::{GridLevel, LevelPanels, encode_level, encode_level_point_vjp, encode_level_vjp};
use crate::encoding::{DirectionEncoding, PositionEncoding};
use crate::mlp::{Mlp, MlpShape, PANEL};
use crate::{Num, Rows};
use irradia_compute::simd::{Lanes, Scalar, Simd};
use irradia_scene::Rng;
use serde::{Deserialize, Serialize};

mod block;

pub use block::{Block, get3, sample_offset, set3};

/// Activation that turns a network's first output into a density, in inverse field units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// e^x, clamped at x = 10 (Instant-NGP).
    Exp,
    /// ln(1 + e^x) (mip-NeRF).
    Softplus,
    /// max(x, 0) (NeRF).
    Relu,
}

impl Activation {
    /// The density and its derivative.
    #[inline(always)]
    pub(crate) fn with_slope<S: Simd>(self, simd: S, x: S::F) -> [S::F; 2] {
        let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
        match self {
            Activation::Exp => {
                let y = x.min(simd.splat(10.0)).exp();
                [y, y]
            }
            Activation::Softplus => {
                let e = (-x.abs()).exp();
                let slope = one / (one + e);
                [x.max(zero) + (one + e).map(ln), slope.select(zero.le(x), one - slope)]
            }
            Activation::Relu => [x.max(zero), one.masked(zero.lt(x))],
        }
    }
}

/// The colour part of a network.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColorShape {
    /// Encoding of the viewing direction.
    pub direction: DirectionEncoding,
    /// Width of a hidden layer.
    pub width: usize,
    /// Hidden layers: 2 in Instant-NGP, 1 of half the width in NeRF.
    pub depth: usize,
    /// Length of a photograph's appearance code; 0 for none.
    #[serde(default)]
    pub appearance: usize,
}

/// The sizes of a network.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetShape {
    /// Encoding of positions.
    pub encoding: PositionEncoding,
    /// Width of a hidden layer of the density part: 64 in Instant-NGP, 256 in NeRF.
    pub width: usize,
    /// Hidden layers of the density part: 1 in Instant-NGP, 8 in NeRF.
    pub depth: usize,
    /// The hidden layer (from 0) that takes the encoded position as an additional input; NeRF: 5.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skip: Option<usize>,
    /// Features passed from density to colour: 15 in Instant-NGP, 256 in NeRF.
    pub geometry: usize,
    /// Activation of the density.
    pub activation: Activation,
    /// Added to the raw density.
    pub density_bias: f32,
    /// `None` for a proposal network, which has only densities.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color: Option<ColorShape>,
}

/// The layout of a network; its parameters are [`NetParameters`].
#[derive(Clone, Debug)]
pub struct Net {
    /// The sizes.
    pub shape: NetShape,
    /// The levels of the hash grid, empty for frequencies.
    pub levels: Vec<GridLevel>,
    density: Mlp,
    color: Option<Mlp>,
}

/// The trained parameters; gradients and moments have the same shape.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NetParameters<T> {
    /// All levels' tables, `[entries, F]`.
    pub table: Vec<T>,
    /// The density part, flat.
    pub density: Vec<T>,
    /// The colour part, flat.
    pub color: Vec<T>,
}

impl<T: Scalar> NetParameters<T> {
    /// Zeros of the same shape.
    pub fn zeros_like(&self) -> Self {
        Self {
            table: vec![T::default(); self.table.len()],
            ..self.without_table()
        }
    }

    /// Zeros for the networks, without a table.
    pub fn without_table(&self) -> Self {
        Self {
            table: Vec::new(),
            density: vec![T::default(); self.density.len()],
            color: vec![T::default(); self.color.len()],
        }
    }
}

impl Net {
    /// Lays out a network.
    pub fn new(shape: NetShape) -> Self {
        let levels = match &shape.encoding {
            PositionEncoding::HashGrid(grid) => grid.level_table(),
            PositionEncoding::Frequency(_) => Vec::new(),
        };
        let density = Mlp::new(MlpShape {
            inputs: shape.encoding.features(),
            outputs: 1 + shape.color.map_or(0, |_| shape.geometry),
            width: shape.width,
            depth: shape.depth,
            skip: shape.skip,
        });
        let color = shape.color.map(|color| {
            Mlp::new(MlpShape {
                inputs: shape.geometry + color.direction.features() + color.appearance,
                outputs: 3,
                width: color.width,
                depth: color.depth,
                skip: None,
            })
        });
        Self {
            shape,
            levels,
            density,
            color,
        }
    }

    /// Random parameters: tables uniform within 1e-4 (Instant-NGP), weights from [`Mlp::init`].
    pub fn init(&self, rng: &mut Rng) -> NetParameters<f32> {
        NetParameters {
            table: (0..self.shape.encoding.parameters())
                .map(|_| rng.range(-1e-4, 1e-4))
                .collect(),
            density: self.density.init(rng),
            color: self.color.as_ref().map_or_else(Vec::new, |mlp| mlp.init(rng)),
        }
    }

    /// Zeroes the last colour layer, so that every colour starts at grey (a half).
    pub(crate) fn zero_color(&self, parameters: &mut NetParameters<f32>) {
        let (mlp, _) = self.color_parts();
        parameters.color[mlp.last_layer()].fill(0.0);
    }

    /// Number of parameters of table, density part and colour part.
    pub fn sizes(&self) -> [usize; 3] {
        [
            self.shape.encoding.parameters(),
            self.density.parameters(),
            self.color.as_ref().map_or(0, Mlp::parameters),
        ]
    }

    /// Multiplications per sample in the forward pass of the networks.
    pub fn products(&self) -> usize {
        self.density.products() + self.color.as_ref().map_or(0, Mlp::products)
    }

    /// Rows of an encoded position, padded.
    pub fn encoded_rows(&self) -> usize {
        self.density.inputs()
    }

    /// The transposed weights, for the backward pass; no table.
    pub fn transposed<T: Scalar>(&self, parameters: &NetParameters<T>) -> NetParameters<T> {
        NetParameters {
            table: Vec::new(),
            density: self.density.transposed(&parameters.density),
            color: self
                .color
                .as_ref()
                .map_or_else(Vec::new, |mlp| mlp.transposed(&parameters.color)),
        }
    }

    /// Encodes `block.points`.
    #[inline(always)]
    fn encode<S: Simd>(&self, simd: S, table: &[Num<S>], block: &mut Block<Num<S>>) {
        let rows = self.encoded_rows();
        block.encoded.clear();
        block.encoded.resize(block.panels() * rows * PANEL, Default::default());
        match &self.shape.encoding {
            PositionEncoding::HashGrid(grid) => {
                for (l, level) in self.levels.iter().enumerate() {
                    let panels = LevelPanels {
                        points: &block.points,
                        row: l * grid.features,
                        rows,
                    };
                    encode_level(simd, grid, level, table, panels, &mut block.encoded);
                }
            }
            PositionEncoding::Frequency(frequency) => {
                let mut about_zero = [Num::<S>::default(); 3 * PANEL];
                for (points, to) in block
                    .points
                    .chunks_exact(3 * PANEL)
                    .zip(block.encoded.chunks_exact_mut(rows * PANEL))
                {
                    for s in (0..3 * PANEL).step_by(S::LANES) {
                        let p = simd.load(&points[s..]);
                        (p + p - simd.splat(1.0)).store(&mut about_zero[s..]);
                    }
                    frequency.encode(simd, &about_zero, to);
                }
            }
        }
    }

    /// Computes `block.density` from `block.points`.
    #[inline(always)]
    pub fn density<S: Simd>(&self, simd: S, parameters: &NetParameters<Num<S>>, block: &mut Block<Num<S>>) {
        self.encode(simd, &parameters.table, block);
        self.density
            .forward(simd, &parameters.density, &block.encoded, &mut block.density_tape);
        let panels = block.panels();
        block.density.resize(panels * PANEL, Default::default());
        block.slope.resize(panels * PANEL, Default::default());
        let rows = self.density.outputs();
        let bias = simd.splat(f64::from(self.shape.density_bias));
        for p in 0..panels {
            for s in (0..PANEL).step_by(S::LANES) {
                let x = simd.load(&block.density_tape.output()[p * rows * PANEL + s..]) + bias;
                let [density, slope] = self.shape.activation.with_slope(simd, x);
                density.store(&mut block.density[p * PANEL + s..]);
                slope.store(&mut block.slope[p * PANEL + s..]);
            }
        }
    }

    /// Computes `block.rgb` from `block.directions` (and codes) and the output of [`Net::density`].
    ///
    /// # Panics
    /// When the network has no colour part.
    #[inline(always)]
    pub fn color<S: Simd>(&self, simd: S, parameters: &NetParameters<Num<S>>, block: &mut Block<Num<S>>) {
        let (mlp, shape) = self.color_parts();
        let panels = block.panels();
        let (rows, from_rows) = (mlp.inputs(), self.density.outputs());
        let geometry = self.shape.geometry;
        block.color_in.clear();
        block.color_in.resize(panels * rows * PANEL, Default::default());
        for (p, to) in block.color_in.chunks_exact_mut(rows * PANEL).enumerate() {
            let from = &block.density_tape.output()[p * from_rows * PANEL..];
            to[..geometry * PANEL].copy_from_slice(&from[PANEL..][..geometry * PANEL]);
            let directions = &block.directions[p * 3 * PANEL..][..3 * PANEL];
            shape.direction.encode(simd, directions, &mut to[geometry * PANEL..]);
            if shape.appearance > 0 {
                let at = (geometry + shape.direction.features()) * PANEL;
                let length = shape.appearance * PANEL;
                to[at..][..length].copy_from_slice(&block.codes[p * length..][..length]);
            }
        }
        mlp.forward(simd, &parameters.color, &block.color_in, &mut block.color_tape);
        block.rgb.resize(panels * 3 * PANEL, Default::default());
        let out_rows = mlp.outputs();
        let one = simd.splat(1.0);
        for p in 0..panels {
            for s in (0..3 * PANEL).step_by(S::LANES) {
                let x = simd.load(&block.color_tape.output()[p * out_rows * PANEL + s..]);
                // exp(-|x|) does not overflow; negative values follow by symmetry.
                let e = (-x.abs()).exp();
                let right = one / (one + e);
                let y = right.select(simd.splat(0.0).le(x), one - right);
                y.store(&mut block.rgb[p * 3 * PANEL + s..]);
            }
        }
    }

    /// The networks of density and colour.
    #[cfg(feature = "gpu")]
    pub(crate) fn mlps(&self) -> (&Mlp, Option<&Mlp>) {
        (&self.density, self.color.as_ref())
    }

    fn color_parts(&self) -> (&Mlp, &ColorShape) {
        match (&self.color, &self.shape.color) {
            (Some(mlp), Some(shape)) => (mlp, shape),
            _ => panic!("this network has no colour part"),
        }
    }

    /// The VJP from `block.v_density` and, if `with_color`, `block.v_rgb`: adds to the networks' `grads` and writes
    /// `block.v_encoded`, the source of the gradients of tables and positions.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &self,
        simd: S,
        transposed: &NetParameters<Num<S>>,
        block: &mut Block<Num<S>>,
        grads: &mut NetParameters<Num<S>>,
        with_color: bool,
    ) {
        let panels = block.panels();
        let rows = self.density.outputs();
        let v_out = block.density_tape.output_gradient();
        v_out.clear();
        v_out.resize(panels * rows * PANEL, Default::default());
        if with_color {
            let (mlp, _) = self.color_parts();
            let out_rows = mlp.outputs();
            let v = block.color_tape.output_gradient();
            v.clear();
            v.resize(panels * out_rows * PANEL, Default::default());
            let one = simd.splat(1.0);
            for p in 0..panels {
                for s in (0..3 * PANEL).step_by(S::LANES) {
                    let y = simd.load(&block.rgb[p * 3 * PANEL + s..]);
                    let v_y = simd.load(&block.v_rgb[p * 3 * PANEL + s..]);
                    (v_y * y * (one - y)).store(&mut v[p * out_rows * PANEL + s..]);
                }
            }
            let v_in = Some(&mut block.v_color_in);
            mlp.backward(
                simd,
                &transposed.color,
                &block.color_in,
                &mut block.color_tape,
                &mut grads.color,
                v_in,
            );
            let v_out = block.density_tape.output_gradient();
            let length = self.shape.geometry * PANEL;
            for p in 0..panels {
                let from = &block.v_color_in[p * mlp.inputs() * PANEL..][..length];
                v_out[(p * rows + 1) * PANEL..][..length].copy_from_slice(from);
            }
        }
        let v_out = block.density_tape.output_gradient();
        for p in 0..panels {
            for s in (0..PANEL).step_by(S::LANES) {
                let at = p * PANEL + s;
                let v = simd.load(&block.v_density[at..]) * simd.load(&block.slope[at..]);
                v.store(&mut v_out[p * rows * PANEL + s..]);
            }
        }
        self.density.backward(
            simd,
            &transposed.density,
            &block.encoded,
            &mut block.density_tape,
            &mut grads.density,
            Some(&mut block.v_encoded),
        );
    }

    /// The gradient of component `k` of sample `i`'s appearance code, after [`Net::backward`].
    pub fn code_gradient<T: Copy>(&self, block: &Block<T>, i: usize, k: usize) -> T {
        let (mlp, shape) = self.color_parts();
        let row = self.shape.geometry + shape.direction.features() + k;
        block.v_color_in[sample_offset(mlp.inputs(), i) + row * PANEL]
    }

    /// Adds the tables' gradient from `points` and `v_encoded` of a block to `grads`, in sample order.
    #[inline(always)]
    pub fn table_gradient<S: Simd>(&self, simd: S, points: &[Num<S>], v_encoded: &[Num<S>], grads: &mut [Num<S>]) {
        let PositionEncoding::HashGrid(grid) = &self.shape.encoding else {
            return;
        };
        for (l, level) in self.levels.iter().enumerate() {
            let grads = &mut grads[level.first * grid.features..];
            let panels = LevelPanels {
                points,
                row: l * grid.features,
                rows: self.encoded_rows(),
            };
            encode_level_vjp(simd, grid, level, panels, v_encoded, grads);
        }
    }

    /// Writes the derivative of each sample's density with respect to its point, `[panels, 3, 32]`, after [`Net::density`].
    #[inline(always)]
    pub fn density_slope<S: Simd>(
        &self,
        simd: S,
        parameters: &NetParameters<Num<S>>,
        transposed: &NetParameters<Num<S>>,
        block: &mut Block<Num<S>>,
        slope: &mut Rows<Num<S>>,
    ) {
        let (panels, rows) = (block.panels(), self.density.outputs());
        let v_out = block.density_tape.output_gradient();
        v_out.clear();
        v_out.resize(panels * rows * PANEL, Default::default());
        for p in 0..panels {
            v_out[p * rows * PANEL..][..PANEL].copy_from_slice(&block.slope[p * PANEL..][..PANEL]);
        }
        let v_encoded = Some(&mut block.v_encoded);
        self.density
            .pull_back(simd, &transposed.density, &mut block.density_tape, v_encoded);
        self.point_gradient(simd, &parameters.table, block, slope);
    }

    /// Writes the gradient of `block.points` from `block.v_encoded`, `[panels, 3, 32]`.
    #[inline(always)]
    pub fn point_gradient<S: Simd>(
        &self,
        simd: S,
        table: &[Num<S>],
        block: &Block<Num<S>>,
        v_points: &mut Rows<Num<S>>,
    ) {
        v_points.clear();
        v_points.resize(block.panels() * 3 * PANEL, Default::default());
        let rows = self.encoded_rows();
        match &self.shape.encoding {
            PositionEncoding::HashGrid(grid) => {
                for (l, level) in self.levels.iter().enumerate() {
                    let panels = LevelPanels {
                        points: &block.points,
                        row: l * grid.features,
                        rows,
                    };
                    encode_level_point_vjp(simd, grid, level, table, panels, &block.v_encoded, v_points);
                }
            }
            PositionEncoding::Frequency(frequency) => {
                let panels = block.encoded.chunks_exact(rows * PANEL);
                let panels = panels.zip(block.v_encoded.chunks_exact(rows * PANEL));
                for ((encoded, v), v_points) in panels.zip(v_points.chunks_exact_mut(3 * PANEL)) {
                    frequency.encode_vjp(simd, encoded, v, v_points);
                    for s in (0..3 * PANEL).step_by(S::LANES) {
                        let v = simd.load(&v_points[s..]);
                        (v + v).store(&mut v_points[s..]);
                    }
                }
            }
        }
    }
}

fn ln<T: Scalar>(x: T) -> T {
    T::from_f64(x.to_f64().ln())
}
