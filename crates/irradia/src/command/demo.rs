//! `irradia demo` and `irradia synth`

use super::render::parse_size;
use super::{DataArgs, train};
use crate::synth::{SynthOptions, write_dataset};
use anyhow::Result;
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
pub struct Args {
    /// Folder for the data and the run
    #[arg(long, default_value = "demo")]
    pub out: PathBuf,
    /// Steps of training
    #[arg(long, default_value_t = 2000)]
    pub steps: u64,
    /// Threads; all cores when absent
    #[arg(long)]
    pub threads: Option<usize>,
}

#[derive(clap::Args)]
pub struct SynthArgs {
    /// Folder for the dataset
    pub out: PathBuf,
    /// Training views; one more in eight is held out
    #[arg(long, default_value_t = SynthOptions::default().views)]
    pub views: u32,
    /// Size of the images
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    pub size: (u32, u32),
    /// Everything random follows from it
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
}

pub fn run(args: &Args) -> Result<()> {
    let (data, out) = (args.out.join("data"), args.out.join("run"));
    let start = Instant::now();
    eprintln!("ray tracing the demo scene ..");
    let summary = write_dataset(&data, &SynthOptions::default())?;
    eprintln!(
        "{summary}, in {:.1} s: {}",
        start.elapsed().as_secs_f64(),
        data.display()
    );
    train::run(&train::Args {
        data: Some(data),
        out: Some(out.clone()),
        recipe: "classic".into(),
        set: Vec::new(),
        steps: Some(args.steps),
        max_splats: None,
        seed: 0,
        threads: args.threads,
        until_psnr: None,
        budget: None,
        resume: None,
        overwrite: true,
        lpips: None,
        reading: DataArgs {
            downscale: 1.0,
            max_side: None,
            format: None,
        },
    })?;
    println!(
        "the scene is {}; go round it with: irradia render {0} --orbit 60 --out frames",
        out.join("scene.ply").display()
    );
    Ok(())
}

pub fn synth(args: &SynthArgs) -> Result<()> {
    let options = SynthOptions {
        views: args.views,
        width: args.size.0,
        height: args.size.1,
        seed: args.seed,
    };
    let summary = write_dataset(&args.out, &options)?;
    println!("{}: {summary}", args.out.display());
    Ok(())
}
