//! Shared numerics: SIMD lanes with run-time dispatch, planar arrays, radix sort, nearest neighbours of byte vectors and Adam.
//!
//! All `unsafe` code is in `simd::x86` and `nearest::x86`.

pub mod adam;
pub mod nearest;
pub mod planes;
pub mod simd;
pub mod sort;

pub use planes::Planes;
pub use simd::Level;
