//! `irradia`: photographs in, a scene for free-viewpoint rendering out.
//!
//! This is the program. **To train or render from Rust, start with [`irradia_runs`]**: one import, and a runnable example
//! on its first page. The crates below it are `irradia_train` (recipes, schedule, the training step), `irradia_splat` and
//! `irradia_field` (what is trained), `irradia_measure`, `irradia_formats`, `irradia_synth`, `irradia_compute` and
//! `irradia_scene` (plain types and conventions).
#![forbid(unsafe_code)]

mod command;
mod interrupt;
mod terminal;

use clap::{Parser, Subcommand};
use irradia_runs::RunError;
use irradia_runs::formats::FormatError;
use std::process::ExitCode;

#[derive(Parser)]
#[command(version, about, max_term_width = 120)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Ray trace a scene, train on it, evaluate and report: no data needed
    Demo(command::demo::Args),
    /// Say what is wrong with photographs before they are posed: blur, exposure, gaps, ..
    Doctor(command::doctor::Args),
    /// Find the poses of photographs, film frames and panoramas
    Pose(command::pose::Args),
    /// Train a scene from photographs or a film
    Train(command::train::Args),
    /// Train several recipes under the same conditions and compare them
    Compare(command::compare::Args),
    /// List the recipes, show their schedules, or explain their keys
    Recipe(command::recipe::Args),
    /// Evaluate a scene against photographs: PSNR, SSIM, LPIPS
    Eval(command::eval::Args),
    /// Show which LPIPS weights are found, or import them from PyTorch files
    Lpips(command::lpips::Args),
    /// Render a scene into PNG frames
    Render(command::render::Args),
    /// View a scene, a run or a dataset in a browser
    View(command::view::Args),
    /// Write a scene as one HTML page that opens from disk in any browser
    Share(command::share::Args),
    /// Describe a scene, a run or a dataset
    Info(command::info::Args),
    /// Convert a scene to another file format, given by the extension of its name, and report the loss
    Convert(command::convert::Args),
    /// Make a scene small: fewer splats, trained to replace the others and to lose little in the file format
    Compact(command::compact::Args),
    /// Edit a scene: select, delete, move, recolour, remove floaters, merge, ..
    Edit(command::edit::Args),
    /// List the GPUs of this machine, with their names for --device
    Devices,
    /// Write a ray-traced scene as a dataset: images, depth, normals, points, cameras
    Synth(command::demo::SynthArgs),
}

/// Marks an error as a mistake in the command line: exit code 2.
#[derive(Debug)]
struct Usage(pub String);

impl std::fmt::Display for Usage {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Usage {}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Demo(args) => command::demo::run(&args),
        Command::Doctor(args) => command::doctor::run(&args),
        Command::Pose(args) => command::pose::run(&args),
        Command::Train(args) => command::train::run(&args),
        Command::Compare(args) => command::compare::run(&args),
        Command::Recipe(args) => command::recipe::run(&args),
        Command::Eval(args) => command::eval::run(&args),
        Command::Lpips(args) => command::lpips::run(&args),
        Command::Render(args) => command::render::run(&args),
        Command::View(args) => command::view::run(&args),
        Command::Share(args) => command::share::run(&args),
        Command::Info(args) => command::info::run(&args),
        Command::Convert(args) => command::convert::run(&args),
        Command::Compact(args) => command::compact::run(&args),
        Command::Edit(args) => command::edit::run(&args),
        Command::Devices => command::devices::run(),
        Command::Synth(args) => command::demo::synth(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            terminal::note(format_args!("error: {}", terminal::one_line(&error)));
            ExitCode::from(if is_usage(&error) { 2 } else { 1 })
        }
    }
}

/// Whether the error is a mistake in the command line.
fn is_usage(error: &anyhow::Error) -> bool {
    let of_a_file = matches!(
        error.downcast_ref(),
        Some(FormatError::Option(_) | FormatError::UnknownSplatFormat { .. })
    );
    error.is::<Usage>() || of_a_file || error.downcast_ref().is_some_and(RunError::is_request)
}
