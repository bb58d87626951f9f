//! What numeric code shares: SIMD lanes with run-time dispatch, planar arrays, and the kernels sort and Adam.
//!
//! `unsafe` lives in `simd::x86` alone.

pub mod adam;
pub mod planes;
pub mod simd;
pub mod sort;

pub use planes::Planes;
pub use simd::Level;
