//! 3D Gaussian splatting (Kerbl et al. 2023): rendering, its gradients, initialisation and density control.
#![forbid(unsafe_code)]

pub mod render;
mod splats;

pub use render::{OutputGradient, RenderOptions, Renderer, SplatGradients, ViewParams};
pub use splats::{COLUMN_NAMES, Splats, logit, sigmoid};
