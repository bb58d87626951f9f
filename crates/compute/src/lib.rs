//! Shared numerics: SIMD lanes with run-time dispatch, planar arrays, radix sort, nearest neighbours of byte vectors and Adam;
//! with the feature `gpu`, arrays, kernels, prefix sums and a radix sort on any GPU.
//!
//! All `unsafe` code is in `simd` and `nearest`, except for one call in `gpu::kernel`.

pub mod adam;
mod device;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod nearest;
pub mod planes;
pub mod shaders;
pub mod simd;
pub mod sort;

pub use device::{Device, DeviceChoice, DeviceError};
pub use planes::Planes;
pub use simd::Level;
