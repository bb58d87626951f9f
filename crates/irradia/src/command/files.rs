//! `irradia info` and `irradia convert`

use super::describe_field::describe_field;
use crate::run_folder::{RESIDUAL, is_field, read_field, residual_beside, scene_of};
use crate::terminal::say;
use anyhow::Result;
use irradia_formats::{SplatFormat, describe, read_splats, write_splats};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct InfoArgs {
    /// A splat file, a field, a run, a point cloud or a dataset's folder
    pub path: PathBuf,
}

#[derive(clap::Args)]
pub struct ConvertArgs {
    /// The scene to read
    pub input: PathBuf,
    /// The file to write; its extension says which format
    pub output: PathBuf,
}

pub fn info(args: &InfoArgs) -> Result<()> {
    let scene = scene_of(&args.path);
    if is_field(&scene) {
        let bytes = std::fs::metadata(&scene).map_or(0, |file| file.len());
        return say(describe_field(&read_field(&scene)?, bytes));
    }
    let mut description = describe(&scene)?;
    if let Some(field) = residual_beside(&scene)? {
        let adds = format!("{RESIDUAL}, {} parameters", field.len());
        description.facts.push(("reflections", adds));
    }
    say(description)
}

pub fn convert(args: &ConvertArgs) -> Result<()> {
    // Reading may take a while: what cannot be written is said first.
    SplatFormat::of(&args.output)?;
    let cloud = read_splats(&scene_of(&args.input))?;
    write_splats(&args.output, &cloud)?;
    say(format_args!("{}: {} splats", args.output.display(), cloud.len()))
}
