//! The kernels of a field, put together from their parts.

use irradia_compute::shaders::{ADAM, GRID, HARMONICS, Shader};

const RAY: &str = include_str!("gpu/shaders/ray.wgsl");
const TASK: &str = include_str!("gpu/shaders/task.wgsl");
const CORNERS: &str = include_str!("gpu/shaders/corners.wgsl");
const LAYER: &str = include_str!("gpu/shaders/layer.wgsl");
const SAMPLE: &str = include_str!("gpu/shaders/ray_sample.wgsl");
const RATES: &str = include_str!("gpu/shaders/rates.wgsl");

macro_rules! kernels {
    ($($(#[$doc:meta])* $name:ident: [$($part:expr),*],)*) => {
        /// The stages of a field, compiled.
        #[derive(Debug)]
        pub(crate) struct Kernels {
            $($(#[$doc])* pub $name: irradia_compute::gpu::Kernel,)*
        }

        impl Kernels {
            /// `constants` are those of the field: see [`crate::gpu::Layout::constants`].
            pub fn new(gpu: &irradia_compute::gpu::Gpu, constants: &str) -> Self {
                Self { $($name: irradia_compute::gpu::Kernel::with_constants(gpu, &$name(), constants),)* }
            }
        }

        $(fn $name() -> Shader {
            Shader {
                name: stringify!($name),
                parts: &[$($part,)* include_str!(concat!("gpu/shaders/", stringify!($name), ".wgsl"))],
            }
        })*

        /// Every kernel's source, without its constants.
        #[cfg(test)]
        pub(crate) fn all() -> Vec<Shader> {
            vec![$($name(),)*]
        }
    };
}

kernels! {
    /// Twin: `walk::Walks::march`.
    march: [GRID, RAY, TASK, CORNERS],
    /// Samples of all rays side by side, with `DirectionEncoding::encode`.
    gather: [GRID, RAY, TASK, HARMONICS],
    /// Twin: `encoding::hash_grid::encode_level`.
    encode: [GRID, TASK, CORNERS],
    /// Twin: `Mlp::forward`, a layer.
    dense: [GRID, LAYER],
    /// Twin: `Worker::backward`, up to the networks.
    composite: [GRID, RAY, TASK, HARMONICS, SAMPLE],
    /// Twin: `render::view::pixel`.
    pixels: [GRID, RAY, TASK, HARMONICS, SAMPLE],
    /// Sums of the losses.
    totals: [TASK],
    /// Twin: `Mlp::pull_back`, a layer.
    dense_vjp: [GRID, LAYER],
    /// Twin: `mlp::outer`.
    weights_vjp: [GRID, LAYER],
    /// Twin: `encoding::hash_grid::encode_level_vjp`.
    scatter: [GRID, TASK, CORNERS],
    /// Twin: `optimise::Adam`, dense.
    update_nets: [GRID, RATES, ADAM],
    /// Twin: `optimise::Adam`, sparse.
    update_table: [GRID, RATES, ADAM],
    /// Twin: `background_vjp` and `optimise::Adam`.
    update_background: [RAY, RATES, ADAM, HARMONICS],
}
