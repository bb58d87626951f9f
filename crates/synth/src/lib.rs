//! A ray-traced scene with known cameras, depth, normals and points: a lit table-top with fine and coarse detail, a satin
//! ball whose colour depends on the viewpoint, thin parts, and a distant background. It is the built-in data of
//! `irradia demo`, and ground truth for tests.
//!
//! World: z up, the centre of the table top at the origin. [`Capture`] places the cameras and traces them one by one;
//! [`dataset`] traces them all in memory. `irradia-runs` writes the views as files.
//!
//! ```
//! use irradia_synth::{Capture, SynthOptions, dataset};
//!
//! let options = SynthOptions { views: 4, width: 24, height: 16, seed: 0 };
//! let dataset = dataset(&options)?;
//! assert_eq!((dataset.train.len(), dataset.test.len()), (4, 2));
//!
//! // With true depth, view by view:
//! let capture = Capture::new(&options)?;
//! let frame = capture.trace(&capture.shots()[0]);
//! assert!(frame.depth.data.iter().all(|depth| *depth > 0.5));
//! # Ok::<(), irradia_synth::SynthError>(())
//! ```
#![forbid(unsafe_code)]

mod ambient;
mod cameras;
mod capture;
mod scene;
mod shape;
mod sky;
mod texture;
mod trace;

pub use cameras::{FOV_X, Part};
pub use capture::{Capture, Shot, SynthError, SynthOptions, dataset};
pub use scene::{Cluster, Hit, Material, Object, SynthScene, demo_scene};
pub use shape::{Ray, Shape};
pub use texture::Texture;
pub use trace::SynthFrame;
