//! The kernels of a field, assembled from their parts.

use irradia_compute::shaders::{ADAM, GRID, HARMONICS};

const RAY: &str = include_str!("gpu/shaders/ray.wgsl");
const TASK: &str = include_str!("gpu/shaders/task.wgsl");
const CORNERS: &str = include_str!("gpu/shaders/corners.wgsl");
const SAMPLE_LEVEL: &str = include_str!("gpu/shaders/sample_level.wgsl");
const LAYER: &str = include_str!("gpu/shaders/layer.wgsl");
const SAMPLE: &str = include_str!("gpu/shaders/ray_sample.wgsl");
const RATES: &str = include_str!("gpu/shaders/rates.wgsl");

irradia_compute::kernels! {
    /// Twin: `walk::Walks::march`.
    march: [GRID, RAY, TASK, CORNERS],
    /// Stores the samples of all rays contiguously, with `DirectionEncoding::encode`.
    gather: [GRID, RAY, TASK, HARMONICS],
    /// Twin: `encoding::hash_grid::encode_level`.
    encode: [GRID, TASK, CORNERS, SAMPLE_LEVEL],
    /// Twin: one layer of `Mlp::forward`.
    dense: [GRID, LAYER],
    /// Twin: `Worker::backward`, up to the networks.
    composite: [GRID, RAY, TASK, HARMONICS, SAMPLE],
    /// Twin: `render::view::pixel`.
    pixels: [GRID, RAY, TASK, HARMONICS, SAMPLE],
    /// Sums of the losses.
    totals: [TASK],
    /// Twin: one layer of `Mlp::pull_back`.
    dense_vjp: [GRID, LAYER],
    /// Twin: `mlp::outer`.
    weights_vjp: [GRID, LAYER],
    /// Twin: `encoding::hash_grid::encode_level_vjp`.
    scatter: [GRID, TASK, CORNERS, SAMPLE_LEVEL],
    /// Twin: `optimise::Adam`, dense.
    update_nets: [GRID, ADAM, RATES],
    /// Twin: `optimise::Adam`, sparse.
    update_table: [GRID, ADAM, RATES],
    /// Twin: `background_vjp` and `optimise::Adam`.
    update_background: [RAY, ADAM, RATES, HARMONICS],
}
