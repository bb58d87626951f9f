//! `irradia info`

use crate::terminal::print_line;
use anyhow::Result;
use irradia_runs::describe;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Args {
    /// A splat file, a field, a run, a point cloud or a dataset folder
    pub path: PathBuf,
}

pub fn run(args: &Args) -> Result<()> {
    print_line(describe(&args.path)?)
}
