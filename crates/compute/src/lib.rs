//! Shared numerics: SIMD lanes with run-time dispatch, planar arrays, radix sort and Adam.
//!
//! All `unsafe` code is in `simd::x86`.

pub mod adam;
pub mod planes;
pub mod simd;
pub mod sort;

pub use planes::Planes;
pub use simd::Level;
