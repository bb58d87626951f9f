//! The data model: cameras, images, points, Gaussians and datasets as plain types.
//!
//! Nothing here reads a file or runs a kernel. Every other crate follows these conventions:
//!
//! - World: right-handed, in the dataset's own coordinates unless [`Dataset::world_from_dataset`] moves and scales them. Cameras: OpenCV
//!   axes, +X right, +Y down, +Z forward.
//! - Transforms are named target-from-source: [`Pose::world_from_camera`].
//! - The centre of pixel (0, 0) is at (0.5, 0.5). Colour is sRGB-encoded float in \[0, 1\]. Angles in radians.
//! - Quaternions are `w, x, y, z`, normalised when used. Scales are stored as ln, opacities as logit.
#![forbid(unsafe_code)]

pub mod base64;
mod camera;
mod cloud;
mod dataset;
mod digits;
mod extra;
pub mod half;
mod image;
mod lens;
mod median;
mod points;
mod pose;
mod resize;
pub mod rng;
pub mod sh;
mod shutter;
mod similarity;
mod srgb;
mod survey;

pub use camera::{Camera, Intrinsics};
pub use cloud::GaussianCloud;
pub use dataset::{
    Dataset, DepthGrid, Grid, GridSource, Kept, LoadError, NormalGrid, Photo, PhotoSource, View, every_eighth,
};
pub use digits::with_f32_digits;
pub use extra::{ExtraColumn, Scalar};
pub use image::Image;
pub use lens::Lens;
pub use median::median;
pub use points::PointCloud;
pub use pose::Pose;
pub use resize::{Part, resize_area, resize_part};
pub use rng::Rng;
pub use shutter::{FirstSide, RollingShutter};
pub use similarity::Similarity;
pub use srgb::{srgb_from_linear, srgb_slope};
pub use survey::{Survey, survey};
