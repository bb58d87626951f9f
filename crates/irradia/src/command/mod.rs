//! One file a command, and what several of them ask of the command line.

pub mod compare;
pub mod demo;
mod describe_field;
pub mod eval;
pub mod files;
mod journal;
pub mod lpips;
mod progress;
pub mod recipe;
pub mod render;
pub mod train;

use crate::Usage;
use crate::terminal::note;
use anyhow::{Context, Result};
use clap::builder::RangedU64ValueParser;
use irradia_formats::{DatasetFormat, DatasetOptions, read_dataset};
use irradia_scene::Dataset;
use std::path::Path;

/// Which part of a dataset.
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

/// How a dataset is read.
#[derive(Clone, Debug, clap::Args)]
pub struct DataArgs {
    /// Divide the images' sides by this
    #[arg(long, value_name = "F", default_value_t = 1.0)]
    pub downscale: f32,
    /// Shrink images until the longer side has at most so many pixels
    #[arg(long, value_name = "PX", conflicts_with = "downscale", value_parser = clap::value_parser!(u32).range(1..))]
    pub max_side: Option<u32>,
    /// colmap, nerfstudio, blender or llff; recognised from the folder when absent
    #[arg(long)]
    pub format: Option<String>,
}

impl DataArgs {
    /// Reads the dataset; its warnings go to standard error, one line each.
    pub fn read(&self, path: &Path) -> Result<Dataset> {
        let format: Option<DatasetFormat> = match &self.format {
            Some(name) => Some(name.parse().map_err(|e| Usage(format!("--format {name}: {e}")))?),
            None => None,
        };
        if !self.downscale.is_finite() || self.downscale < 1.0 {
            return Err(Usage(format!("--downscale {}: give 1 or more", self.downscale)).into());
        }
        let options = DatasetOptions {
            format,
            downscale: self.downscale,
            max_side: self.max_side,
        };
        let dataset = read_dataset(path, &options)?;
        for warning in &dataset.warnings {
            note(format_args!("warning: {warning}"));
        }
        Ok(dataset)
    }
}

/// What `--threads` takes.
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

/// A view's name as a file name without extension: folders become underscores.
pub fn file_stem(name: &str) -> String {
    let stem = name.rsplit_once('.').map_or(
        name,
        |(stem, extension)| if extension.contains('/') { name } else { stem },
    );
    stem.chars()
        .map(|c| {
            if c.is_alphanumeric() || "-_.".contains(c) {
                c
            } else {
                '_'
            }
        })
        .collect()
}
