//! Structure from motion: from photographs to camera poses, intrinsics and points.
//!
//! Features ([`Features`]) are found in each photograph, matched between pairs ([`PairMatches`]), verified by two-view geometry,
//! and mapped incrementally with bundle adjustment. Geometry is `f64`; every sum and every random choice has a fixed order, so
//! neither the number of threads nor the order of the files changes a byte of the result.
#![forbid(unsafe_code)]

pub mod adjust;
mod backdrop;
mod bars;
mod connected;
pub mod doctor;
pub mod features;
pub mod geometry;
mod keypoints;
pub mod map;
pub mod matching;
mod overlay;
mod still_scene;
pub mod upright;

pub use backdrop::Backdrop;
pub use bars::bars;
pub(crate) use connected::connected_components;
pub(crate) use irradia_scene::median;
pub use keypoints::{DESCRIPTOR_BYTES, Features, Keypoint, PairMatches};
pub use overlay::OverlayDetector;
pub use still_scene::{Segmentation, StillScene};
