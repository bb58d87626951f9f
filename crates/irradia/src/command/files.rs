//! `irradia info` and `irradia convert`

use crate::terminal::say;
use anyhow::Result;
use irradia_runs::formats::{SplatFormat, read_splats, write_splats};
use irradia_runs::{describe, scene_of};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct InfoArgs {
    /// A splat file, a field, a run, a point cloud or a dataset folder
    pub path: PathBuf,
}

#[derive(clap::Args)]
pub struct ConvertArgs {
    /// The scene to read
    pub input: PathBuf,
    /// The file to write; its extension selects the format
    pub output: PathBuf,
}

pub fn info(args: &InfoArgs) -> Result<()> {
    say(describe(&args.path)?)
}

pub fn convert(args: &ConvertArgs) -> Result<()> {
    // Reading may take a while: an unknown output format is reported first.
    SplatFormat::of(&args.output)?;
    let cloud = read_splats(&scene_of(&args.input))?;
    write_splats(&args.output, &cloud)?;
    say(format_args!("{}: {} splats", args.output.display(), cloud.len()))
}
