//! Ray-traced scenes with known cameras, depth, normals and points. The demo scene, the built-in data of `irradia demo` and ground
//! truth for tests, is a lit table-top with fine and coarse detail, a satin ball whose colour depends on the viewpoint, thin
//! parts, and a distant background. [`SceneName`] lists the others, whose layout and colours follow the seed.
//!
//! World: z up. [`Capture`] places the cameras and traces them one by one;
//! [`dataset`] traces them all in memory. `irradia-runs` writes the views as files.
//!
//! ```
//! use irradia_synth::{Capture, SynthOptions, dataset};
//!
//! let options = SynthOptions { views: 4, width: 24, height: 16, ..SynthOptions::default() };
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
mod lens;
mod scene;
mod scenes;
mod shape;
mod sky;
mod texture;
mod trace;

pub use cameras::{Path, Rig, Split};
pub use capture::{Capture, Shot, SynthError, SynthOptions, dataset};
pub use lens::{SynthLens, UnknownLens};
pub use scene::{Cluster, Hit, Light, Material, Object, SynthScene, demo_scene};
pub use scenes::{SceneName, UnknownScene};
pub use shape::{Ray, Shape};
pub use texture::Texture;
pub use trace::SynthFrame;
