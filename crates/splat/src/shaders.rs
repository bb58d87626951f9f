//! The kernels, assembled from their parts: as text for anything that runs WGSL, such as a browser, and compiled for the GPU.

use irradia_compute::shaders::{ADAM, GRID, HARMONICS, SCAN, SORT, Shader};

const VIEW: &str = include_str!("gpu/shaders/view.wgsl");
const GEOMETRY: &str = include_str!("gpu/shaders/geometry.wgsl");
const LOAD: &str = include_str!("gpu/shaders/load.wgsl");
const DIRECTION: &str = include_str!("gpu/shaders/direction.wgsl");
const TILES: &str = include_str!("gpu/shaders/tiles.wgsl");
const FRAGMENT: &str = include_str!("gpu/shaders/fragment.wgsl");
const UPDATE: &str = include_str!("gpu/shaders/update.wgsl");

irradia_compute::kernels! {
    /// Twin: `render::project::project` and `render::touch`.
    project: [GRID, VIEW, GEOMETRY, LOAD, HARMONICS, DIRECTION, TILES],
    /// Visible splats and their depths, ascending.
    compact: [GRID, VIEW],
    /// Numbers of visible splats and entries, if there is room for them.
    admit: [VIEW],
    /// Tiles of each visible splat, front to back.
    count: [GRID, VIEW],
    /// Twin: `render::bin`, with `ranges` and `segments`.
    emit: [GRID, VIEW, TILES],
    /// The range of each tile's entries.
    ranges: [GRID, VIEW],
    /// Number of segments of each tile.
    segments: [GRID, VIEW],
    /// Twin: `render::blend::BlendTile`.
    blend: [GRID, VIEW, FRAGMENT],
    /// Twin: `render::blend::BlendTileVjp`.
    blend_vjp: [GRID, VIEW, FRAGMENT],
    /// Twin: `render::project::project_vjp`.
    project_vjp: [GRID, VIEW, GEOMETRY, LOAD, HARMONICS, DIRECTION],
    /// Sums of the camera's gradient over groups of splats; the CPU accumulates it splat by splat.
    sum_camera: [GRID, VIEW],
    /// Twin: `SplatState::step`, the colours' part.
    update_harmonics: [GRID, VIEW, UPDATE, ADAM, HARMONICS, DIRECTION],
    /// Twin: `SplatState::step`, `regularize` and `mcmc::add_noise`.
    update_geometry: [GRID, VIEW, UPDATE, ADAM],
    /// Twin: `Planes::rearrange`.
    move_rows: [GRID],
}

/// A stage of a training step, which is one function or a few on the CPU.
#[derive(Clone, Copy, Debug)]
pub struct Stage {
    /// Its name.
    pub name: &'static str,
    /// Its own kernels, in order; prefix sums and sorts come between them.
    pub kernels: &'static [&'static str],
    /// The functions of this crate that do the same on the CPU.
    pub twin: &'static str,
}

/// The stages in order. Tests run the GPU from each stage on, with the twin's results as its input, so that an error is located at its
/// stage (`gpu/bisect.rs`).
pub const STAGES: [Stage; 6] = [
    Stage {
        name: "project",
        kernels: &["project"],
        twin: "render::project, render::harmonics, render::touch",
    },
    Stage {
        name: "bin",
        kernels: &["compact", "admit", "count", "emit", "ranges", "segments"],
        twin: "render::bin",
    },
    Stage {
        name: "blend",
        kernels: &["blend"],
        twin: "render::blend::BlendTile, render::untile",
    },
    Stage {
        name: "blend_vjp",
        kernels: &["blend_vjp"],
        twin: "render::blend::BlendTileVjp",
    },
    Stage {
        name: "project_vjp",
        kernels: &["project_vjp", "sum_camera"],
        twin: "render::chunk::ProjectChunkVjp",
    },
    Stage {
        name: "update",
        kernels: &["update_harmonics", "update_geometry"],
        twin: "SplatState::gather_statistics, regularize, SplatState::step, mcmc::add_noise",
    },
];

/// Kernels of [`SHADERS`] that render a frame.
const FRAME: [&str; 7] = ["project", "compact", "count", "emit", "ranges", "segments", "blend"];

/// The source of every kernel of a frame, with those of prefix sums and of the sort.
pub fn frame_shaders() -> impl Iterator<Item = &'static Shader> {
    let own = SHADERS.iter().filter(|shader| FRAME.contains(&shader.name));
    own.chain(&SCAN).chain(&SORT)
}
