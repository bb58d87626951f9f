//! The kernels, put together from their parts.

use irradia_compute::gpu::{Gpu, Kernel, Shader};

const GRID: &str = irradia_compute::gpu::GRID;
const VIEW: &str = include_str!("shaders/view.wgsl");
const GEOMETRY: &str = include_str!("shaders/geometry.wgsl");
const LOAD: &str = include_str!("shaders/load.wgsl");
const HARMONICS: &str = include_str!("shaders/harmonics.wgsl");
const TILES: &str = include_str!("shaders/tiles.wgsl");
const FRAGMENT: &str = include_str!("shaders/fragment.wgsl");
const UPDATE: &str = include_str!("shaders/update.wgsl");

macro_rules! kernels {
    ($($(#[$doc:meta])* $name:ident: [$($part:expr),*],)*) => {
        /// The stages of a frame and of a training step, compiled.
        #[derive(Debug)]
        pub(super) struct Kernels {
            $($(#[$doc])* pub $name: Kernel,)*
        }

        impl Kernels {
            pub fn new(gpu: &Gpu) -> Self {
                Self { $($name: Kernel::new(gpu, &shader(stringify!($name))),)* }
            }
        }

        /// Every kernel's source.
        pub(super) const SHADERS: &[Shader] = &[$(Shader {
            name: stringify!($name),
            parts: &[$($part,)* include_str!(concat!("shaders/", stringify!($name), ".wgsl"))],
        },)*];
    };
}

kernels! {
    /// Twin: `render::project::project` and `render::touch`.
    project: [GRID, VIEW, GEOMETRY, LOAD, HARMONICS, TILES],
    /// Visible splats and their depths, ascending.
    compact: [GRID, VIEW],
    /// Tiles of each visible splat, front to back.
    count: [GRID, VIEW],
    /// Twin: `render::bin`, with `ranges` and `segments`.
    emit: [GRID, VIEW, TILES],
    /// Where the entries of each tile are.
    ranges: [GRID, VIEW],
    /// Segments of each tile.
    segments: [GRID, VIEW],
    /// Twin: `render::blend::BlendTile`.
    blend: [GRID, VIEW, FRAGMENT],
    /// Twin: `render::blend::BlendTileVjp`.
    blend_vjp: [GRID, VIEW, FRAGMENT],
    /// Twin: `render::project::project_vjp`.
    project_vjp: [GRID, VIEW, GEOMETRY, LOAD, HARMONICS],
    /// Twin: `SplatState::step`, the colours' part.
    update_harmonics: [GRID, VIEW, UPDATE, HARMONICS],
    /// Twin: `SplatState::step`, `regularize` and `mcmc::add_noise`.
    update_geometry: [GRID, VIEW, UPDATE],
}

fn shader(name: &str) -> Shader {
    let found = SHADERS.iter().find(|shader| shader.name == name);
    *found.expect("every kernel is in the table")
}
