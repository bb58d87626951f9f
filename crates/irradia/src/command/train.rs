//! `irradia train`

use super::journal::Journal;
use super::progress::Progress;
use super::{DataArgs, file_stem, lpips, use_threads};
use crate::Usage;
use crate::run_folder::{RunConfig, RunFolder};
use anyhow::{Context, Result};
use irradia_compute::Level;
use irradia_formats::{write_png, write_splats};
use irradia_measure::Evaluation;
use irradia_scene::{Image, sh};
use irradia_train::eval::{EvaluatedView, Metrics, evaluate_views, mean};
use irradia_train::report::{Report, ViewReport, machine, peak_rss_bytes, to_html};
use irradia_train::{Recipe, RunLimits, TrainOptions, Trainer, checkpoint};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

#[derive(clap::Args)]
pub struct Args {
    /// Folder of posed photographs (COLMAP, nerfstudio, Blender, LLFF); with --resume the run knows it
    #[arg(required_unless_present = "resume")]
    pub data: Option<PathBuf>,
    /// Folder for the run
    #[arg(long, value_name = "RUN", required_unless_present = "resume")]
    pub out: Option<PathBuf>,
    /// Built-in recipe or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "classic", conflicts_with = "resume")]
    pub recipe: String,
    /// Change one key of the recipe, such as stage.grow.params.ssim_weight=0.3
    #[arg(long, value_name = "KEY=VALUE", conflicts_with = "resume")]
    pub set: Vec<String>,
    /// Fit the recipe into so many steps
    #[arg(long, conflicts_with_all = ["resume", "budget"])]
    pub steps: Option<u64>,
    /// Never more splats than this
    #[arg(long, conflicts_with = "resume")]
    pub max_splats: Option<usize>,
    /// Everything random follows from it
    #[arg(long, default_value_t = 0, conflicts_with = "resume")]
    pub seed: u64,
    /// Threads; all cores when absent. The result does not depend on it
    #[arg(long)]
    pub threads: Option<usize>,
    /// Stop when the held-out views reach this
    #[arg(long, value_name = "DB")]
    pub until_psnr: Option<f64>,
    /// Fit the recipe into a time of training, such as 90s or 5m
    #[arg(long, value_name = "TIME", value_parser = parse_seconds)]
    pub budget: Option<f64>,
    /// Go on with an interrupted run
    #[arg(long, value_name = "RUN", conflicts_with_all = ["out", "overwrite"])]
    pub resume: Option<PathBuf>,
    /// Replace the run that --out holds
    #[arg(long)]
    pub overwrite: bool,
    /// LPIPS weights (lpips_squeeze.safetensors)
    #[arg(long, value_name = "FILE")]
    pub lpips: Option<PathBuf>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// `90`, `90s`, `5m` or `1.5h` in seconds.
fn parse_seconds(text: &str) -> Result<f64, String> {
    let (number, unit) = match text.char_indices().last() {
        Some((at, 's')) => (&text[..at], 1.0),
        Some((at, 'm')) => (&text[..at], 60.0),
        Some((at, 'h')) => (&text[..at], 3600.0),
        _ => (text, 1.0),
    };
    match number.trim().parse::<f64>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok(value * unit),
        _ => Err("give a time such as 90s, 5m or 1h".into()),
    }
}

pub fn run(args: &Args) -> Result<()> {
    let started = Instant::now();
    use_threads(args.threads)?;
    let (folder, config, trainer) = match &args.resume {
        Some(run) => resume(run, args)?,
        None => begin(args)?,
    };
    finish(folder, &config, trainer, args.lpips.as_ref(), started).map(|_| ())
}

/// The recipe of `--recipe`, `--set` and `--max-splats`.
fn resolve_recipe(args: &Args) -> Result<Recipe> {
    let (origin, text) = if args.recipe.ends_with(".toml") {
        let text = std::fs::read_to_string(&args.recipe)
            .map_err(|e| Usage(format!("cannot read recipe {}: {e}", args.recipe)))?;
        (args.recipe.as_str(), text)
    } else {
        (
            args.recipe.as_str(),
            Recipe::built_in(&args.recipe)
                .map_err(|e| Usage(e.to_string()))?
                .to_owned(),
        )
    };
    let mut overrides = args.set.clone();
    overrides.extend(args.max_splats.map(|n| format!("max_splats={n}")));
    Ok(Recipe::parse(origin, &text, &overrides).map_err(|e| Usage(e.to_string()))?)
}

fn begin(args: &Args) -> Result<(RunFolder, RunConfig, Trainer)> {
    let (data, out) = (
        args.data.as_ref().expect("clap asks for it"),
        args.out.as_ref().expect("clap asks for it"),
    );
    let recipe = resolve_recipe(args)?;
    if args.steps == Some(0) {
        return Err(Usage("--steps 0: give 1 or more".into()).into());
    }
    let dataset = args.reading.read(data)?;
    let options = TrainOptions {
        seed: args.seed,
        steps: args.steps,
        ..TrainOptions::default()
    };
    let trainer = Trainer::new(Arc::new(dataset), recipe, options)?;
    let folder = RunFolder::create(out, args.overwrite)?;
    let config = RunConfig {
        data: std::path::absolute(data).unwrap_or_else(|_| data.clone()),
        format: args.reading.format.clone(),
        downscale: args.reading.downscale,
        max_side: args.reading.max_side,
        until_psnr: args.until_psnr,
        budget: args.budget,
    };
    folder.write_config(&config)?;
    folder.write("recipe.toml", trainer.recipe.to_toml().as_bytes())?;
    folder.write_cameras(&trainer.dataset)?;
    Ok((folder, config, trainer))
}

fn resume(run: &Path, args: &Args) -> Result<(RunFolder, RunConfig, Trainer)> {
    let (folder, mut config) = RunFolder::open(run)?;
    if let Some(data) = &args.data {
        config.data = std::path::absolute(data).unwrap_or_else(|_| data.clone());
    }
    config.until_psnr = args.until_psnr.or(config.until_psnr);
    config.budget = args.budget.or(config.budget);
    let reading = DataArgs {
        downscale: config.downscale,
        max_side: config.max_side,
        format: config.format.clone(),
    };
    let dataset = reading.read(&config.data)?;
    let path = folder.newest_checkpoint()?;
    let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let trainer = checkpoint::from_bytes(&bytes, Arc::new(dataset), TrainOptions::default())
        .with_context(|| path.display().to_string())?;
    eprintln!("resuming at step {}", trainer.clock.step);
    Ok((folder, config, trainer))
}

/// Trains, writes the scene, evaluates and reports.
pub fn finish(
    folder: RunFolder,
    config: &RunConfig,
    mut trainer: Trainer,
    lpips_file: Option<&PathBuf>,
    started: Instant,
) -> Result<Report> {
    let lpips = lpips(lpips_file)?;
    let stop = Arc::new(AtomicBool::new(false));
    let asked = stop.clone();
    // The second Ctrl-C does not wait. A handler that is already set (by a test, say) is no reason not to train.
    let _ = ctrlc::set_handler(move || {
        if asked.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    });
    let mut progress = Progress::new(stop.clone());
    let mut journal = Journal::open(&folder, trainer.clock.step)?;
    journal.warnings.extend(trainer.dataset.warnings.iter().cloned());
    let limits = RunLimits {
        until_psnr: config.until_psnr,
        budget: config.budget,
    };
    irradia_train::run(&mut trainer, &limits, &mut [&mut progress, &mut journal])?;
    if !trainer.finished() {
        irradia_train::event::Observer::save(&mut journal, &trainer).map_err(anyhow::Error::msg)?;
    }
    journal.finish();

    let mut cloud = trainer.state.splats.to_cloud();
    cloud.antialiased = trainer.recipe.render.antialias;
    write_splats(&folder.file("scene.ply"), &cloud)?;

    let mut views = Vec::new();
    let mut metrics: Vec<Evaluation> = Vec::new();
    let options = trainer.render_options(sh::MAX_DEGREE);
    let mut outcome = Ok(());
    evaluate_views(
        &trainer.state.splats,
        &trainer.dataset,
        &trainer.dataset.test,
        &options,
        Metrics::All(lpips.as_ref()),
        |view| {
            let report = write_view(&folder, &view);
            match report {
                Ok(report) => views.push(report),
                Err(error) => outcome = Err(error),
            }
            metrics.push(view.metrics);
        },
    )?;
    outcome?;
    let mean = mean(&metrics);
    let report = Report {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        device: format!(
            "CPU, {} threads, {}",
            rayon::current_num_threads(),
            Level::detect().name()
        ),
        dataset: config.data.display().to_string(),
        recipe: trainer.recipe.name.clone(),
        recipe_hash: trainer.recipe.hash(),
        recipe_toml: trainer.recipe.to_toml(),
        seed: trainer.options.seed,
        steps: trainer.clock.step,
        seconds: trainer.seconds,
        cpu_seconds: trainer.cpu_seconds,
        total_seconds: started.elapsed().as_secs_f64(),
        splats: trainer.state.len() as u64,
        peak_rss_bytes: peak_rss_bytes(),
        psnr: mean.psnr,
        ssim: mean.ssim,
        lpips: mean.lpips,
        views,
        stages: journal.stages,
        curve: journal.curve,
        machine: machine(),
        warnings: journal.warnings,
    };
    folder.write("report.json", &serde_json::to_vec_pretty(&report)?)?;
    folder.write("report.html", to_html(&report).as_bytes())?;
    println!(
        "held-out PSNR {:.2} dB, SSIM {:.4}{}; {} splats, {:.1} s of training",
        report.psnr,
        report.ssim,
        report.lpips.map_or(String::new(), |l| format!(", LPIPS {l:.4}")),
        report.splats,
        report.seconds
    );
    println!("look at {}", folder.file("report.html").display());
    Ok(report)
}

/// Writes truth, render and error of a held-out view under `eval/`.
fn write_view(folder: &RunFolder, view: &EvaluatedView) -> Result<ViewReport> {
    let stem = file_stem(&view.name);
    let path = |what: &str| format!("eval/{stem}.{what}.png");
    let write = |what: &str, image: &Image| -> Result<String> {
        write_png(&folder.file(&path(what)), image.width, image.height, 3, &image.to_u8())?;
        Ok(path(what))
    };
    Ok(ViewReport {
        name: view.name.clone(),
        psnr: view.metrics.psnr,
        ssim: view.metrics.ssim,
        lpips: view.metrics.lpips,
        truth: write("truth", &view.truth)?,
        render: write("render", &view.render)?,
        error: write("error", &error_image(&view.truth, &view.render))?,
    })
}

/// Absolute difference, four times enlarged so that a difference of a quarter is white.
fn error_image(truth: &Image, render: &Image) -> Image {
    let data = truth
        .data
        .iter()
        .zip(&render.data)
        .map(|(t, r)| 4.0 * (t - r).abs())
        .collect();
    Image::new(truth.width, truth.height, 3, data)
}
