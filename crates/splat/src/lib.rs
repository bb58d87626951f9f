//! 3D Gaussian splatting (Kerbl et al. 2023): rendering, its gradients, initialisation and density control.
#![forbid(unsafe_code)]

pub mod densify;
pub mod filter;
pub mod init;
mod nearest;
pub mod regularize;
pub mod render;
mod splats;
mod state;

pub use render::{CameraGradient, Gather, OutputGradient, RenderOptions, Renderer, Shade, SplatGradients, ViewParams};
pub use splats::{COLUMN_NAMES, Splats, logit, sigmoid};
pub use state::{Rates, SplatState, Statistics};
