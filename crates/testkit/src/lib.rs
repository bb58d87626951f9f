//! Development only: paths to the shared data, golden files, finite differences, comparisons of arrays, and PyTorch files.
#![forbid(unsafe_code)]

mod compare;
pub mod finite_differences;
mod golden;
mod gpu;
pub mod shared;
pub mod torch;

pub use compare::{Difference, max_abs_difference, relative_difference};
pub use golden::Golden;
pub use gpu::{gpu_or_skip, validate_shader};
pub use shared::shared;
