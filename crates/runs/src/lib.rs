//! Irradia as a library: photographs in, a renderable scene out. **Start here**; one import suffices:
//!
//! ```
//! # let folder = tempfile::tempdir().unwrap();
//! # let here = |name: &str| folder.path().join(name);
//! use irradia_runs::prelude::*;
//!
//! // A small dataset to try; any folder of posed photographs works.
//! write_synth_dataset(here("photos"), &SynthOptions { views: 4, width: 24, height: 16, ..Default::default() })?;
//!
//! // Train ..
//! let mut run = Run::begin(TrainInput { steps: Some(5), ..TrainInput::new(here("photos"), here("run")) }.check()?)?;
//! run.train(&mut [])?;
//! println!("held-out PSNR {:.2} dB", run.finish()?.report.psnr);
//!
//! // .. and render, this run or any splat PLY.
//! let scene = Scene::read(here("run"))?;
//! write_image(here("frame.png"), &scene.render(&scene.orbit(60, None)[0]).color)?;
//! # Ok::<(), RunError>(())
//! ```
//!
//! | to | start with |
//! |---|---|
//! | train on a folder | [`TrainInput`], which becomes a validated [`TrainRequest`]; [`Run::begin`] |
//! | find the poses of photographs | [`PoseInput`], [`pose`] |
//! | train on a dataset in memory | [`Run::begin_on`] |
//! | resume an interrupted run | [`TrainInput::of_run`], [`Run::resume`] |
//! | show progress, pause, save or stop | an [`Observer`](train::event::Observer) given to [`Run::train`] |
//! | view a training run from another thread | [`Run::snapshots`] |
//! | read and render a scene | [`Scene`] |
//! | evaluate a scene against photographs | [`evaluate`] |
//! | convert a scene to another format | [`convert`], [`write_levels`] |
//! | make a scene small | [`CompactInput`], [`compact`] |
//! | edit a scene | [`Editing`] |
//! | describe a file or folder | [`describe`] |
//!
//! Nothing here prints: warnings are returned, or passed to observers. Random numbers come from the request's seed alone, and
//! the number of threads (rayon's global pool) does not change a byte of a scene.
//!
//! The lower crates are re-exported by their short names. [`train`] has the recipes, the schedule and the training step,
//! [`scene`] the plain types and their conventions.
#![forbid(unsafe_code)]

mod background;
mod cameras;
mod compact;
mod convert;
mod describe;
mod edit;
mod error;
mod evaluate;
mod folder;
mod journal;
mod levels;
mod lock;
mod orbit;
mod path;
mod photographs;
mod pose;
mod protocol;
mod provenance;
mod reading;
mod request;
mod results;
mod run;
mod saver;
mod scene_file;
mod snapshot;
mod synth_files;

pub use background::{Background, is_rendered};
pub use cameras::{camera_names, is_moved, moved_from_dataset, moved_from_run, write_own_cameras};
pub use compact::{CompactEvent, CompactInput, CompactTarget, Compacted, compact};
pub use convert::{COMPARED_VIEWS, Conversion, convert};
pub use describe::describe;
pub use edit::{AppliedEdit, EDITS, Editing, merge_notes};
pub use error::RunError;
pub use evaluate::{
    NOT_MEASURED, distinct, evaluate, file_stem, file_stems, leave_out_unreadable, psnr_8_bits, unmeasured,
};
pub use folder::{FIELD, POSED_FOLDER, RESIDUAL, RunFolder, RunRecord, SCENE};
pub use irradia_formats as formats;
pub use irradia_scene as scene;
pub use irradia_synth as synth;
pub use irradia_train as train;
pub use journal::logged_errors;
pub use levels::{LEVELS, Level, level_file, read_levels, write_levels};
pub use orbit::OrbitGeometry;
pub use path::{CameraPath, FRAME_SIDE, Film, PathKey};
pub use photographs::photographs_of;
pub use pose::{
    AttemptReport, CameraReport, DoctorInput, DoctorReport, Finding, KnownDistance, LeftOutPhoto, MIN_POSED_FRACTION,
    Mapper, PoseCheck, PoseInput, PoseProgress, PoseReport, PoseSource, ScaleReport, StageReport, check_poses, doctor,
    group_by_reason, is_capture, is_film_name, photographs_in, pose, pose_source,
};
pub use protocol::Protocol;
pub use provenance::{data_fingerprint, program_fingerprint};
pub use reading::{Reading, ReadingOptions};
pub use request::{DEFAULT_RECIPE, HOW_TO_GET_LPIPS, TrainInput, TrainRequest, has_perceptual_loss, read_recipe};
pub use results::write_image;
pub use run::{Finished, Run, open_device};
pub use scene_file::{
    Scene, check_not_overwritten, read_lights, read_vignette, residual_left_out, same_file, scene_path,
};
pub use snapshot::{Snapshot, Snapshots};
pub use synth_files::{SynthSummary, write_synth_dataset};

/// The names that a program needs to train or render.
pub mod prelude {
    pub use crate::scene::{Camera, Dataset, Image, Intrinsics, Pose};
    pub use crate::synth::SynthOptions;
    pub use crate::train::event::{Event, Observer, Signal};
    pub use crate::train::{Recipe, Trainer};
    pub use crate::{
        Background, Finished, Reading, ReadingOptions, Run, RunError, RunFolder, Scene, Snapshot, Snapshots,
        TrainInput, TrainRequest, describe, evaluate, write_image, write_synth_dataset,
    };
}
