//! Training: recipes, the schedule, the loop, checkpoints and reports. Start at [`Trainer::step`].
#![forbid(unsafe_code)]

mod audit;
pub mod checkpoint;
pub mod compare;
mod conditions;
mod depth_maps;
mod device;
mod edges;
pub mod eval;
pub mod event;
mod exposure_probe;
pub mod field_file;
mod field_space;
mod field_step;
mod first_splats;
mod forecast;
mod free_space;
pub mod half_fit;
pub mod lights;
pub mod memory;
mod misfits;
pub mod model;
mod normal_maps;
mod objective;
pub mod paces;
pub mod painter;
mod photos;
mod pixel_size;
pub mod recipe;
pub mod report;
mod robust;
mod run;
pub mod schedule;
pub mod socket;
mod spacing;
mod splat_step;
mod stream;
mod surroundings;
pub mod tensor_file;
pub mod times;
mod trainer;
mod transients;

pub use recipe::{Recipe, RecipeError};
pub use run::{EndReason, RunLimits, run};
pub use trainer::{TrainError, TrainOptions, Trainer};
