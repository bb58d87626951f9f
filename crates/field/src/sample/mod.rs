//! Where along a ray a field is looked at.

pub mod aabb;
pub mod importance;
pub mod march;
pub mod occupancy;
pub mod proposal;
pub mod stratified;

pub use occupancy::OccupancyGrid;
