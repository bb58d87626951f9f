//! Splats on any GPU: the stages of [`crate::render`] and of an update as compute shaders.
//!
//! Visible splats are sorted by depth, then their tiles by number, stably. Each splat's gradients in a tile are summed by one thread,
//! in the order of pixels, and its tiles in their order: the same bytes from run to run on the same device. Drivers may round
//! differently from the CPU; what differs is rounding alone.

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
