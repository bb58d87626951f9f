//! The demo scene, made by ray tracing in our own code: a lit table-top with fine and coarse detail, a satin ball whose
//! colour depends on the viewpoint, thin parts, and a background far away. Written as a dataset it is the built-in data
//! of `irradia demo`, with the truth about depth and normals besides.
//!
//! World: z up, the middle of the table's top at the origin. Files: `shape` (solids), `texture` and `sky` (colour),
//! `scene` (what stands where), `ambient` and `trace` (the picture), `cameras` and `dataset` (the files).

mod ambient;
mod cameras;
mod dataset;
mod scene;
mod shape;
mod sky;
mod texture;
mod trace;

pub use dataset::{SynthOptions, write_dataset};
