//! Splats on any GPU: the stages of [`crate::render`] and of an update as compute shaders.
//!
//! Visible splats are sorted by depth, then their tiles by number, stably. Each splat's gradients are summed in a fixed order in each
//! tile, then over its tiles in their order, so that results have the same bytes from run to run on the same device. They differ from
//! the CPU's by rounding, and MCMC's noise by its random numbers.

mod frame;
mod moves;
mod training;

pub use frame::GpuRenderer;
pub use training::DeviceGradient;
pub(crate) use training::GpuTraining;

#[cfg(test)]
mod bisect;
#[cfg(test)]
mod tests;
