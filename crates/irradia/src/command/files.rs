//! `irradia info` and `irradia convert`

use anyhow::Result;
use irradia_formats::{describe, read_splats, write_splats};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct InfoArgs {
    /// A splat file, a point cloud or a dataset's folder
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
    println!("{}", describe(&args.path)?);
    Ok(())
}

pub fn convert(args: &ConvertArgs) -> Result<()> {
    let cloud = read_splats(&args.input)?;
    write_splats(&args.output, &cloud)?;
    println!("{}: {} splats", args.output.display(), cloud.len());
    Ok(())
}
