//! One file per command, and arguments common to several commands.

pub mod compact;
pub mod compare;
pub mod convert;
pub mod demo;
mod depths;
pub mod devices;
pub mod doctor;
pub mod edit;
pub mod eval;
mod film;
pub mod info;
pub mod lpips;
pub mod pose;
mod progress;
pub mod recipe;
mod recipe_keys;
pub mod render;
pub mod share;
mod size;
pub mod train;
pub mod view;

use crate::Usage;
use crate::terminal::note;
use anyhow::{Context, Result};
use clap::builder::RangedU64ValueParser;
use irradia_compute::{Device, DeviceChoice};
use irradia_runs::formats::{Lenses, SplatFormat};
use irradia_runs::scene::Dataset;
use irradia_runs::{Reading, ReadingOptions, RunError, RunFolder, open_device};
use std::path::{Path, PathBuf};

/// A part of a dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Split {
    /// Held-out views.
    Test,
    /// Training views.
    Train,
    /// All views.
    All,
}

impl Split {
    /// Indices of the views.
    pub fn of(self, dataset: &Dataset) -> Vec<usize> {
        match self {
            Split::Test => dataset.test.clone(),
            Split::Train => dataset.train.clone(),
            Split::All => (0..dataset.views.len()).collect(),
        }
    }
}

/// Options for reading a dataset.
#[derive(Clone, Debug, clap::Args)]
pub struct DataArgs {
    /// Divide the images' sides by this factor
    #[arg(long, value_name = "F")]
    pub downscale: Option<f32>,
    /// Downscale images whose longer side has more pixels than this; 1600 when no size is requested
    #[arg(long, value_name = "PX", conflicts_with = "downscale", value_parser = clap::value_parser!(u32).range(1..))]
    pub max_side: Option<u32>,
    /// Use images at full size
    #[arg(long, conflicts_with_all = ["downscale", "max_side"])]
    pub full_size: bool,
    /// Hold out every N-th view by name, none (0), or those listed in FILE; when absent the dataset's own split, or every 8th
    #[arg(long, value_name = "N|0|FILE")]
    pub holdout: Option<String>,
    /// Folder of the photographs, if it is not where the layout of the dataset expects it
    #[arg(long, value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// How distorted photographs are read: undistorted, and cut into faces if one image would show too little (undistorted); kept distorted
    /// instead of cut into faces (whole: the default for training on the CPU); or always kept distorted (distorted)
    #[arg(long, value_name = "undistorted|whole|distorted", hide_possible_values = true)]
    pub lenses: Option<Lenses>,
    /// The photographs are frames of a film whose rows are exposed one after another (rolling shutter), during this fraction of a frame:
    /// 0.5, or 0.5:left if the left side is exposed first. The camera's motion is taken from the poses of neighbouring frames, found by the
    /// numbers in their names. Training runs on the CPU
    #[arg(long, value_name = "FRAMES[:SIDE]")]
    pub readout: Option<String>,
    /// colmap, nerfstudio, blender, llff, nerfies, opensfm, openmvg, meshroom, metashape, realitycapture, polycam, record3d, nvm or
    /// bundler; detected from the folder when absent
    #[arg(long)]
    pub format: Option<String>,
}

impl DataArgs {
    /// The library's form of these options.
    pub fn options(&self) -> ReadingOptions {
        ReadingOptions {
            format: self.format.clone(),
            downscale: self.downscale,
            max_side: self.max_side,
            full_size: self.full_size,
            holdout: self.holdout.clone(),
            images: self.images.clone(),
            lenses: self.lenses,
            readout: self.readout.clone(),
        }
    }

    /// These options, and the defaults of those that are absent.
    pub fn reading(&self) -> Reading {
        self.options().with_fallback(Reading::default())
    }

    /// As [`DataArgs::reading`], for training on `device`: the GPU kernels for splats support pinhole cameras only.
    pub fn training(&self, device: Option<&str>) -> Reading {
        let on_cpu = device.is_none_or(|device| device.parse() == Ok(DeviceChoice::Cpu));
        let lenses = if on_cpu { Lenses::Whole } else { Lenses::Undistorted };
        self.options().with_fallback(Reading {
            lenses,
            ..Reading::default()
        })
    }
}

/// The dataset `given` with `--data`, else that of the run that contains `scene`.
pub fn data_for(given: Option<&Path>, scene: &Path) -> Result<PathBuf> {
    if let Some(given) = given {
        return Ok(given.to_owned());
    }
    // A scene that is not there is in no run either.
    std::fs::metadata(scene).with_context(|| format!("cannot read {}", scene.display()))?;
    let of_run = RunFolder::record_containing(scene)?.map(|record| record.input.data);
    of_run.ok_or_else(|| {
        let scene = scene.display();
        Usage(format!(
            "{scene}: no run contains it, so that its photographs are not known: add --data"
        ))
        .into()
    })
}

/// The device that `--device` names for rendering; prints its name if it is a GPU.
pub fn rendering_device(name: &str) -> Result<Device> {
    let device = open_device(name).map_err(with_option_names)?;
    if !device.is_cpu() {
        note(format_args!("rendering on {device}"));
    }
    Ok(device)
}

/// Rewrites an error of a request with the option names of the command line.
pub fn with_option_names(error: RunError) -> anyhow::Error {
    match error {
        RunError::Setting { name, value, message } => {
            Usage(format!("--{} {value}: {message}", name.replace('_', "-"))).into()
        }
        error => error.into(),
    }
}

/// Prints warnings on standard error, one line each.
pub fn warn(warnings: &[String]) {
    for warning in warnings {
        note(format_args!("warning: {warning}"));
    }
}

/// The line of a summary that shows how the file size changed; `bytes` and `formats` before and after.
pub fn size_line(bytes: [u64; 2], formats: [SplatFormat; 2]) -> String {
    let [before, after] = bytes.map(|bytes| bytes as f64 / 1e6);
    let [from, to] = formats;
    let percent = 100.0 * after / before.max(1e-9);
    format!("\n  size           {before:.3} MB {from} -> {after:.3} MB {to} ({percent:.1} %)")
}

/// Notes at the end of a summary, one line each.
pub fn note_lines(notes: &[String]) -> String {
    notes.iter().map(|note| format!("\n  note: {note}")).collect()
}

/// Parser of `--threads`.
pub fn thread_count() -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(1..=1024)
}

/// Uses `threads` threads, all cores when `None`.
pub fn use_threads(threads: Option<usize>) -> Result<()> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads.unwrap_or(0))
        .build_global()
        .context("cannot start threads")
}
