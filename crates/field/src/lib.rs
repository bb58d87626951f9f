//! Radiance fields: NeRF (Mildenhall et al. 2020) and the hash grid (Mueller et al. 2022) as two configurations
//! of one [`Field`], with the proposal sampling and contraction of mip-NeRF 360 (Barron et al. 2022).
//!
//! To train: [`Space::around`] or [`Space::ndc`] from the cameras, [`Field::new`], [`FieldState::new`], then [`train_views`]
//! once per step. [`render_view`] renders, [`to_points`] extracts surfaces, and [`FieldState::tensors`] with the step and the
//! number of rays forms a checkpoint from which training resumes bit for bit. [`FieldEngine`] trains on a GPU if it supports the
//! field.
#![forbid(unsafe_code)]

mod background;
mod batch;
mod config;
pub mod contraction;
pub mod encoding;
mod engine;
mod facing;
mod field;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod mlp;
pub mod net;
mod optimise;
mod pass;
mod query;
pub mod render;
mod rows;
pub mod sample;
#[cfg(feature = "gpu")]
mod shaders;
mod space;
mod state;
mod tensors;
mod to_points;
mod train;
mod walk;

pub use background::{background_color, background_vjp};
pub use batch::{Background, Draw, KnownDepth, RayBatch, TrainView};
pub use config::{FieldConfig, Occupancy, Sampler};
pub use engine::FieldEngine;
pub use facing::{FORWARD_CONE, Facing};
pub use field::{Field, FieldError};
pub use query::{color_at, density_at, update_occupancy};
pub use render::view::{FieldView, RenderOptions, camera_ray, render_view};
pub use rows::Rows;
pub use space::{Frustum, Measure, Outside, Ray, Space};
pub use state::FieldState;
pub use tensors::Tensors;
pub use to_points::{PointsOptions, to_points};
pub use train::{ResidualQuery, StepLoss, StepOptions, residual_at, train_residual, train_step, train_views};

/// The scalar type of `S`.
pub(crate) type Num<S> = <<S as irradia_compute::simd::Simd>::F as irradia_compute::simd::Lanes>::Scalar;
