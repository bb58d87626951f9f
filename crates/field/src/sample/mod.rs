//! Sampling along rays.

pub mod aabb;
pub mod importance;
pub mod march;
pub mod occupancy;
pub mod proposal;
pub mod stratified;

pub use occupancy::OccupancyGrid;
