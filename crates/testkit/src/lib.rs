//! Development only: where the shared data lies, the golden files, finite differences, and comparisons that say what differs.
#![forbid(unsafe_code)]

mod compare;
pub mod differences;
mod golden;
pub mod shared;
pub mod torch;

pub use compare::{Difference, max_abs_difference, relative_difference};
pub use golden::Golden;
pub use shared::shared;
