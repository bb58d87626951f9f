//! `irradia demo` and `irradia synth`

use super::lpips::{lpips_path, unseen_lpips_path};
use super::render::parse_size;
use super::{thread_count, train, use_threads};
use crate::Usage;
use crate::terminal::{note, print_line};
use anyhow::Result;
use irradia_runs::synth::{SceneName, SynthLens, SynthOptions};
use irradia_runs::{RunFolder, TrainInput, same_file, write_synth_dataset};
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(clap::Args)]
pub struct Args {
    /// Folder for the data and the run
    #[arg(long, default_value = "demo")]
    pub out: PathBuf,
    /// Training views; one in eight more is held out
    #[arg(long, value_name = "N", default_value_t = SynthOptions::default().views)]
    pub views: u32,
    /// Size of the images
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    pub size: (u32, u32),
    /// Training steps
    #[arg(long, default_value_t = 1500, value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: u64,
    /// Threads; all cores when absent
    #[arg(long, value_parser = thread_count())]
    pub threads: Option<usize>,
}

#[derive(clap::Args)]
pub struct SynthArgs {
    /// Folder for the dataset; files of the same names are replaced
    pub out: PathBuf,
    /// Training views; one in eight more is held out
    #[arg(long, default_value_t = SynthOptions::default().views)]
    pub views: u32,
    /// Size of the images
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    pub size: (u32, u32),
    /// Random seed: cameras and noise, and layout and colours of all scenes but the demo
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Scene: demo, room, shelf, outdoor or thin
    #[arg(long, value_name = "NAME", default_value_t = SceneName::Demo)]
    pub scene: SceneName,
    /// Lens of the photographs to train on: pinhole, fisheye or equirectangular; held-out views are always of a pinhole
    #[arg(long, value_name = "NAME", default_value_t = SynthLens::Pinhole)]
    pub lens: SynthLens,
    /// Angle by which the camera turns while each photograph to train on is read out from top to bottom (rolling shutter)
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0)]
    pub turn: f32,
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let (data, out) = (args.out.join("data"), args.out.join("run"));
    check_replaceable(&data, &out)?;
    let start = Instant::now();
    note("ray tracing the demo scene ..");
    let options = SynthOptions {
        views: args.views,
        width: args.size.0,
        height: args.size.1,
        ..SynthOptions::default()
    };
    let summary = write_synth_dataset(&data, &options)?;
    note(format_args!(
        "{summary}, in {:.1} s: {}",
        start.elapsed().as_secs_f64(),
        data.display()
    ));
    let lpips = lpips_path(None)?;
    let input = TrainInput {
        steps: Some(args.steps),
        unseen_lpips: unseen_lpips_path(None, lpips.as_ref()),
        lpips,
        overwrite: true,
        ..TrainInput::new(data, out.clone())
    };
    train::begin(input, None)?;
    print_line(format_args!(
        "the scene is {}; render an orbit of it with: irradia render {} --orbit 60 --out frames",
        out.join("scene.ply").display(),
        out.display()
    ))
}

/// Rejects data and a run that no earlier demo wrote.
fn check_replaceable(data: &Path, run: &Path) -> Result<()> {
    let is_empty = data.read_dir().map_or(true, |mut entries| entries.next().is_none());
    let is_traced = ["transforms_train.json", "points.ply", "normal"]
        .iter()
        .all(|name| data.join(name).exists());
    let record = RunFolder::record_containing(run)?;
    let foreign = if !is_empty && !is_traced {
        data
    } else if record.is_some_and(|record| !same_file(&record.input.data, data)) {
        run
    } else {
        return Ok(());
    };
    let foreign = foreign.display();
    Err(Usage(format!(
        "{foreign} exists and was not written by a demo: choose another --out"
    ))
    .into())
}

pub fn synth(args: &SynthArgs) -> Result<()> {
    let options = SynthOptions {
        scene: args.scene,
        views: args.views,
        width: args.size.0,
        height: args.size.1,
        seed: args.seed,
        lens: args.lens,
        turn: args.turn.to_radians(),
    };
    let summary = write_synth_dataset(&args.out, &options)?;
    print_line(format_args!("{}: {summary}", args.out.display()))
}
