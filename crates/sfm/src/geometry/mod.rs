//! Two-view and three-point geometry: minimal solvers, least-squares solvers, robust estimation.

pub mod align;
pub mod camera;
pub mod correspondences;
pub mod essential;
pub mod fundamental;
pub mod homography;
pub mod linear;
pub mod pose;
pub mod ransac;
pub mod resection;
#[cfg(test)]
mod testing;
pub mod triangulate;
