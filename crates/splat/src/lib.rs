//! 3D Gaussian splatting (Kerbl et al. 2023): rendering, its gradients, initialisation and density control.
#![forbid(unsafe_code)]

pub mod contribution;
pub mod densify;
mod engine;
pub mod filter;
#[cfg(feature = "gpu")]
mod gpu;
pub mod init;
pub mod levels;
mod nearest;
mod principal;
pub mod regularize;
pub mod render;
mod splats;
mod state;

pub(crate) use principal::eigen;

pub use engine::{Engine, Noise, Placement, Update};
#[cfg(feature = "gpu")]
pub use gpu::{DeviceGradient, GpuRenderer};
pub use nearest::{Nearest, Neighbour};
pub use render::{
    CameraGradient, FramePlanes, Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, ViewParams,
};
pub use splats::{COLUMN_NAMES, Splats, Surface, logit, sigmoid};
pub use state::{Optimizer, Rates, SplatState, Statistics};
