//! `irradia info`

use super::{DataArgs, with_option_names};
use crate::terminal::print_line;
use anyhow::Result;
use irradia_runs::describe;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Args {
    /// A splat file, a field, a run, a point cloud or a dataset folder
    pub path: PathBuf,
    #[command(flatten)]
    pub reading: DataArgs,
}

pub fn run(args: &Args) -> Result<()> {
    let description = describe(&args.path, &args.reading.options());
    print_line(description.map_err(with_option_names)?)
}
