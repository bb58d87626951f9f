//! `irradia train`

use super::journal::Journal;
use super::lpips::{HOW, lpips, lpips_path};
use super::progress::{Progress, size_in_words};
use super::{DataArgs, file_stem, thread_count, use_threads};
use crate::Usage;
use crate::run_folder::{FIELD, RESIDUAL, RunConfig, RunFolder, SCENE};
use crate::terminal::{note, one_line, say};
use anyhow::{Context, Result, anyhow};
use clap::builder::RangedU64ValueParser;
use irradia_compute::Level;
use irradia_formats::{write_png, write_splats};
use irradia_measure::{Evaluation, Lpips, LpipsNet};
use irradia_scene::{Image, sh};
use irradia_train::eval::{EvaluatedView, Metrics, evaluate_views, mean};
use irradia_train::event::Observer;
use irradia_train::model::Model;
use irradia_train::recipe::Param;
use irradia_train::report::{Report, ViewReport, machine, peak_rss_bytes, schedule, to_html};
use irradia_train::schedule::{Moment, outline};
use irradia_train::{Recipe, RunLimits, TrainOptions, Trainer, checkpoint, field_file};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// What is trained by when nothing is said: the best for its time on all six scenes of RESULTS.md.
pub const DEFAULT_RECIPE: &str = "fast";

#[derive(clap::Args)]
pub struct Args {
    /// Folder of posed photographs (COLMAP, nerfstudio, Blender, LLFF); with --resume the run knows it
    #[arg(required_unless_present = "resume")]
    pub data: Option<PathBuf>,
    /// Folder for the run
    #[arg(long, value_name = "RUN", required_unless_present = "resume")]
    pub out: Option<PathBuf>,
    /// Built-in recipe or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = DEFAULT_RECIPE, conflicts_with = "resume")]
    pub recipe: String,
    /// Change one key of the recipe, such as stage.grow.params.ssim_weight=0.3
    #[arg(long, value_name = "KEY=VALUE", conflicts_with = "resume")]
    pub set: Vec<String>,
    /// Fit the recipe into so many steps
    #[arg(long, value_name = "N", conflicts_with_all = ["resume", "budget"], value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Never more splats than this
    #[arg(long, value_name = "N", conflicts_with = "resume", value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    pub max_splats: Option<usize>,
    /// Everything random follows from it
    #[arg(long, value_name = "N", default_value_t = 0, conflicts_with = "resume")]
    pub seed: u64,
    /// Threads; all cores when absent. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
    /// Stop when the held-out views reach this
    #[arg(long, value_name = "DB")]
    pub until_psnr: Option<f64>,
    /// Fit the recipe into a time of training, such as 90s or 5m
    #[arg(long, value_name = "TIME", value_parser = parse_seconds)]
    pub budget: Option<f64>,
    /// Go on with an interrupted run, from its newest checkpoint; the result is that of an unbroken run
    #[arg(long, value_name = "RUN", conflicts_with_all = ["out", "overwrite", "downscale", "max_side", "format"])]
    pub resume: Option<PathBuf>,
    /// Replace the run that --out holds
    #[arg(long)]
    pub overwrite: bool,
    /// LPIPS weights: a file, or a folder of them; see irradia lpips
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// `90`, `90s`, `5m` or `1.5h` in seconds.
pub fn parse_seconds(text: &str) -> Result<f64, String> {
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
    use_threads(args.threads)?;
    train(args)
}

/// Trains on the threads that there are.
pub fn train(args: &Args) -> Result<()> {
    let started = Instant::now();
    let weights = |given: Option<&PathBuf>| anyhow::Ok(lpips(given, None)?.map(Arc::new));
    let (folder, config, trainer) = match &args.resume {
        Some(run) => {
            let (folder, mut config) = RunFolder::open(run)?;
            if config.complete {
                return say(format_args!(
                    "{} is complete: look at {}",
                    run.display(),
                    folder.file("report.html").display()
                ));
            }
            // Those it began with, where they still lie: a perceptual loss without them would train another scene.
            let kept = config.lpips.take().filter(|path| path.exists());
            config.lpips = lpips_path(args.lpips.as_ref().or(kept.as_ref()));
            let lpips = weights(config.lpips.as_ref())?;
            resume(folder, config, args, lpips)?
        }
        None => begin(args, weights(args.lpips.as_ref())?)?,
    };
    let hint = format!(
        "; when that is put right, go on with: irradia train --resume {}",
        folder.path().display()
    );
    finish(folder, config, trainer, started).map_err(|error| anyhow!("{}{hint}", one_line(&error)))
}

/// The recipe of `--recipe`, `--set` and `--max-splats`.
fn resolve_recipe(args: &Args) -> Result<Recipe> {
    let mut overrides = args.set.clone();
    overrides.extend(args.max_splats.map(|n| format!("max_splats={n}")));
    read_recipe(&args.recipe, &overrides)
}

/// The built-in recipe or file `name`, changed by `overrides`.
pub fn read_recipe(name: &str, overrides: &[String]) -> Result<Recipe> {
    let text = if name.ends_with(".toml") {
        std::fs::read_to_string(name).map_err(|e| Usage(format!("cannot read recipe {name}: {e}")))?
    } else {
        Recipe::built_in(name).map_err(|e| Usage(e.to_string()))?.to_owned()
    };
    Ok(Recipe::parse(name, &text, overrides).map_err(|e| Usage(e.to_string()))?)
}

fn begin(args: &Args, lpips: Option<Arc<Lpips>>) -> Result<(RunFolder, RunConfig, Trainer)> {
    let (data, out) = (
        args.data.as_ref().expect("clap asks for it"),
        args.out.as_ref().expect("clap asks for it"),
    );
    let recipe = resolve_recipe(args)?;
    RunFolder::check_free(out, args.overwrite)?;
    let dataset = args.reading.read(data)?;
    let options = TrainOptions {
        seed: args.seed,
        steps: args.steps,
        lpips,
        ..TrainOptions::default()
    };
    let trainer = Trainer::new(Arc::new(dataset), recipe, options)?;
    let folder = RunFolder::create(out)?;
    let config = RunConfig {
        data: std::path::absolute(data).unwrap_or_else(|_| data.clone()),
        format: args.reading.format.clone(),
        downscale: args.reading.downscale,
        max_side: args.reading.max_side,
        until_psnr: args.until_psnr,
        budget: args.budget,
        seed: args.seed,
        steps: args.steps,
        lpips: lpips_path(args.lpips.as_ref()),
        complete: false,
    };
    folder.write_config(&config)?;
    folder.write("recipe.toml", trainer.recipe.to_toml().as_bytes())?;
    folder.write_cameras(&trainer.dataset)?;
    Ok((folder, config, trainer))
}

fn resume(
    folder: RunFolder,
    mut config: RunConfig,
    args: &Args,
    lpips: Option<Arc<Lpips>>,
) -> Result<(RunFolder, RunConfig, Trainer)> {
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
    let dataset = Arc::new(dataset);
    let read = |path: &Path| std::fs::read(path).with_context(|| format!("cannot read {}", path.display()));
    let options = TrainOptions {
        seed: config.seed,
        steps: config.steps,
        lpips,
        ..TrainOptions::default()
    };
    let trainer = match folder.newest_checkpoint()? {
        Some(path) => {
            checkpoint::from_bytes(&read(&path)?, dataset, options).with_context(|| path.display().to_string())
        }
        None => {
            // Interrupted before its first checkpoint.
            let path = folder.file("recipe.toml");
            let text = String::from_utf8_lossy(&read(&path)?).into_owned();
            let recipe = Recipe::parse(&path.display().to_string(), &text, &[])?;
            Trainer::new(dataset, recipe, options).map_err(Into::into)
        }
    }?;
    note(format_args!("resuming at step {}", trainer.clock.step));
    Ok((folder, config, trainer))
}

/// Trains, writes the scene, evaluates and reports.
fn finish(folder: RunFolder, mut config: RunConfig, mut trainer: Trainer, started: Instant) -> Result<()> {
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
    if let Some(warning) = missing_weights(&trainer) {
        note(format_args!("warning: {warning}"));
        journal.warnings.push(warning);
    }
    let limits = RunLimits {
        until_psnr: config.until_psnr,
        budget: config.budget,
    };
    let ran = irradia_train::run(&mut trainer, &limits, &mut [&mut progress, &mut journal]);
    // Whatever ended it early, the steps made are kept; a first error is not hidden by a second.
    let saved = if trainer.finished() || trainer.clock.step == 0 {
        Ok(None)
    } else {
        journal.save(&trainer)
    };
    ran?;
    journal.finish();

    match trainer.scene() {
        Model::Splats { splats, residual } => {
            let mut cloud = splats.to_cloud();
            cloud.antialiased = trainer.recipe.render.antialias;
            write_splats(&folder.file(SCENE), &cloud)?;
            if let Some(field) = residual {
                folder.write(RESIDUAL, &field_file::to_bytes(&field))?;
            }
        }
        Model::Field(field) => folder.write(FIELD, &field_file::to_bytes(&field))?,
    }
    saved.map_err(anyhow::Error::msg)?;

    let lpips = trainer.options.lpips.clone();
    let lpips_net = lpips.as_ref().map(|lpips| lpips.net());
    let mut views = Vec::new();
    let mut metrics: Vec<Evaluation> = Vec::new();
    let options = trainer.render_options(sh::MAX_DEGREE);
    let mut outcome = Ok(());
    evaluate_views(
        &trainer.scene(),
        &trainer.dataset,
        &trainer.dataset.test,
        &options,
        Metrics::All(lpips.as_deref()),
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
        parameters: trainer.parameters().map(|n| n as u64),
        peak_rss_bytes: peak_rss_bytes(),
        psnr: mean.psnr,
        ssim: mean.ssim,
        lpips: mean.lpips,
        lpips_net: lpips_net.map(|net| net.name().to_owned()),
        views,
        schedule: schedule(
            &trainer.recipe,
            &journal.stages,
            &trainer.clock,
            config.steps,
            config.budget.is_some(),
        ),
        stages: journal.stages,
        curve: journal.curve,
        machine: machine(),
        warnings: journal.warnings,
    };
    folder.write("report.json", &serde_json::to_vec_pretty(&report)?)?;
    folder.write("report.html", to_html(&report).as_bytes())?;
    config.complete = trainer.finished();
    folder.write_config(&config)?;
    say(format_args!(
        "held-out PSNR {:.2} dB, SSIM {:.4}{}; {}, {:.1} s of training",
        report.psnr,
        report.ssim,
        in_words(report.lpips, lpips_net),
        size_in_words(report.splats, report.parameters),
        report.seconds
    ))?;
    if !config.complete {
        say(format_args!(
            "go on with: irradia train --resume {}",
            folder.path().display()
        ))?;
    }
    say(format_args!("look at {}", folder.file("report.html").display()))
}

/// `, LPIPS (alex) 0.1234`, where it was measured.
fn in_words(lpips: Option<f64>, net: Option<LpipsNet>) -> String {
    let pair = lpips.zip(net);
    pair.map_or(String::new(), |(lpips, net)| format!(", LPIPS ({net}) {lpips:.4}"))
}

/// What is left out of the recipe because LPIPS has no weights.
fn missing_weights(trainer: &Trainer) -> Option<String> {
    let weighs = |moment: &Moment| moment.values[Param::PerceptualWeight as usize] > 0.0;
    let missing = trainer.options.lpips.is_none() && outline(&trainer.recipe, 1000).iter().any(weighs);
    missing.then(|| {
        format!(
            "recipe {} is trained without its perceptual loss, since no weights of LPIPS were found: {HOW}",
            trainer.recipe.name
        )
    })
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
        error: write("error", &error_image(view))?,
    })
}

/// Absolute difference, four times enlarged so that a difference of a quarter is white; black where a mask says that the
/// pixel does not count.
fn error_image(view: &EvaluatedView) -> Image {
    let (truth, render) = (&view.truth, &view.render);
    let counts = |pixel: usize| view.mask.as_ref().is_none_or(|mask| mask[pixel] != 0);
    let error = |(i, (t, r)): (usize, (&f32, &f32))| if counts(i / 3) { 4.0 * (t - r).abs() } else { 0.0 };
    let data = truth.data.iter().zip(&render.data).enumerate().map(error).collect();
    Image::new(truth.width, truth.height, 3, data)
}
