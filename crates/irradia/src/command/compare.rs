//! `irradia compare`
//!
//! Each run is a separate process of this program's `train`, so that memory is measured separately and a failure does not
//! affect other runs.

use super::lpips::{lpips_path, unseen_lpips_path};
use super::train::parse_seconds;
use super::{DataArgs, thread_count, with_option_names};
use crate::Usage;
use crate::interrupt::stop_flag;
use crate::terminal::{note, one_line, print_line};
use anyhow::{Context, Result, bail};
use clap::builder::RangedU64ValueParser;
use image::codecs::jpeg::JpegEncoder;
use irradia_runs::formats::write_atomic;
use irradia_runs::train::compare::{
    Comparison, Figures, PictureRow, Published, Render, Run, Scene, lpips_bias_notes, overall, picture, published,
    to_html, to_markdown, to_text,
};
use irradia_runs::train::report::{Report, ViewReport, machine};
use irradia_runs::{
    Background, Protocol, Reading, RunFolder, data_fingerprint, distinct, file_stem, logged_errors, open_device,
    program_fingerprint, read_recipe,
};
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::iter;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[derive(clap::Args)]
pub struct Args {
    /// Folders of posed photographs
    #[arg(required = true)]
    pub data: Vec<PathBuf>,
    /// Recipes to compare, separated by commas: built-in or .toml files, each with overrides after colons, such as
    /// classic,fast:max_splats=50000
    #[arg(long, value_name = "NAME[:KEY=VALUE]..", required = true)]
    pub recipes: Vec<String>,
    /// Runs of each recipe on each dataset, with the seeds 0, 1, ..
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub seeds: u64,
    /// Fit the recipes into this number of steps
    #[arg(long, value_name = "N", conflicts_with = "budget", value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Fit the recipes into a training time, such as 90s or 5m
    #[arg(long, value_name = "TIME", value_parser = parse_seconds)]
    pub budget: Option<f64>,
    /// Maximum number of splats
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    pub max_splats: Option<usize>,
    /// Steps between evaluations of the held-out views, which are not counted as training; when absent a fortieth of --steps,
    /// or 100
    #[arg(long, alias = "look-every", value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub eval_every: Option<u64>,
    /// Folder for the runs and the results; finished runs in it are read and not repeated
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Repeat the runs in DIR that were made under other conditions
    #[arg(long)]
    pub overwrite: bool,
    /// Threads of each run; all cores when absent
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
    /// Where recipes are trained: cpu, gpu, auto (a real GPU if there is one), or a part of a GPU's name; see irradia devices. cpu when
    /// absent
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<String>,
    /// LPIPS weights: a file, or a folder of them; see irradia lpips
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    /// Background of the scene: white, black, grey, a colour such as '#c8c0b4', or random (random colours in training, white in
    /// evaluation); when absent white for transparent Blender scenes and objects cut out on white, the colour of a white or black
    /// backdrop, else that of the recipe
    #[arg(long, value_name = "COLOR")]
    pub background: Option<Background>,
    /// Read and score the datasets as the papers do, and show their figures: blender, llff, mipnerf360 or tandt; the folder of a dataset
    /// must have the name of the benchmark's scene, such as .../nerf_synthetic/chair
    #[arg(long, value_name = "NAME", conflicts_with_all = ["downscale", "max_side", "full_size", "holdout", "background"])]
    pub protocol: Option<Protocol>,
    #[command(flatten)]
    pub reading: DataArgs,
}

impl Args {
    fn background(&self) -> Option<Background> {
        self.background.or_else(|| self.protocol?.background())
    }
}

/// A recipe with overrides.
struct Variant {
    /// As the user wrote it.
    text: String,
    /// Name or file.
    recipe: String,
    /// Overrides, each `key=value`.
    overrides: Vec<String>,
    /// Hash of the resolved recipe.
    hash: String,
    /// Name of its folder.
    folder: String,
}

/// The request of a run, stored in its folder: a finished run is reused only if its request is unchanged.
#[derive(PartialEq, Serialize, Deserialize)]
struct Request {
    /// Arguments of `irradia`, without `--out`.
    arguments: Vec<String>,
    recipe_hash: String,
    /// Hash of this program's file; empty if an earlier version wrote it.
    #[serde(default)]
    program: String,
    /// Hash of the data; empty if an earlier version wrote it.
    #[serde(default)]
    data: String,
    /// The LPIPS weights found: those of the loss and of the scores, and those that only score.
    #[serde(default)]
    lpips: [Option<PathBuf>; 2],
}

impl Request {
    /// Why a run made for `self` cannot be reused for `wanted`.
    fn mismatch(&self, wanted: &Self) -> Option<&'static str> {
        let same = (&self.arguments, &self.recipe_hash, &self.lpips)
            == (&wanted.arguments, &wanted.recipe_hash, &wanted.lpips);
        match (same, self.program == wanted.program, self.data == wanted.data) {
            (false, ..) => Some("under other conditions"),
            (true, _, false) => Some("on data that has changed since"),
            (true, false, true) => Some("by another build of this program"),
            (true, true, true) => None,
        }
    }
}

/// A dataset of the comparison.
struct Source {
    /// As the user wrote it.
    data: PathBuf,
    /// Name of its folder.
    name: String,
    /// Hash of its content.
    fingerprint: String,
    /// How it is read.
    reading: Reading,
    /// Published figures under the protocol.
    published: Vec<Published>,
    /// How it differs from the protocol's scene, one line each.
    notes: Vec<String>,
}

const REQUEST_FILE: &str = "request.json";

/// A run with its report.
struct TrainedRun {
    run: Run,
    report: Option<Report>,
}

enum Outcome {
    Done(Box<Report>),
    Failed(String),
    Stopped,
}

pub fn run(args: &Args) -> Result<()> {
    let variants = variants(args)?;
    if let Some(data) = args.data.iter().find(|data| !data.exists()) {
        return Err(Usage(format!("{} does not exist; name a dataset folder", data.display())).into());
    }
    if let Some(device) = &args.device {
        open_device(device).map_err(with_option_names)?;
    }
    let sources = sources(args)?;
    let program = program_fingerprint().context("cannot read this program's file")?;
    lpips_path(args.lpips.as_ref())?;
    if !args.overwrite {
        check_earlier(args, &program, &variants, &sources)?;
    }
    fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create {}; choose another --out", args.out.display()))?;
    let stop = stop_flag();

    let total = args.data.len() * variants.len() * args.seeds as usize;
    let (mut scenes, mut number) = (Vec::new(), 0);
    let (mut device, mut done) = (String::new(), 0);
    for source in &sources {
        let name = &source.name;
        let mut trained: Vec<Vec<TrainedRun>> = variants.iter().map(|_| Vec::new()).collect();
        // Seeds in the outer loop, so that other load on the machine affects all recipes alike.
        for seed in 0..args.seeds {
            for (variant, trained) in variants.iter().zip(&mut trained) {
                number += 1;
                let what = format!("[{number}/{total}] {name}, {}, seed {seed}", variant.text);
                let folder = format!("{name}/{}/seed_{seed}", variant.folder);
                let request = request(args, &program, source, variant, seed);
                let outcome = one_run(request, &args.out.join(&folder), &what, &stop)?;
                let (error, report) = match outcome {
                    Outcome::Stopped => break,
                    Outcome::Failed(error) => {
                        note(format_args!("{what}: failed: {error}"));
                        (Some(error), None)
                    }
                    Outcome::Done(report) => {
                        note(format_args!(
                            "{what}: {:.2} dB after {:.1} s",
                            report.psnr, report.training_seconds
                        ));
                        (None, Some(*report))
                    }
                };
                if let Some(report) = &report {
                    device = report.device.clone();
                    done += 1;
                }
                let errors = logged_errors(&args.out.join(&folder));
                let figures = report.as_ref().map(|report| Figures::of(report, &errors));
                let run = Run {
                    seed,
                    folder,
                    error,
                    figures,
                };
                trained.push(TrainedRun { run, report });
            }
            if stop.load(Ordering::Relaxed) {
                break;
            }
        }
        if trained.iter().any(|runs| !runs.is_empty()) {
            let view = held_out_view(&args.out, &trained);
            let texts = variants.iter().map(|variant| variant.text.clone());
            let runs = texts.zip(
                trained
                    .into_iter()
                    .map(|runs| runs.into_iter().map(|t| t.run).collect()),
            );
            scenes.push(Scene::new(
                name.clone(),
                source.data.display().to_string(),
                runs.collect(),
                view,
            ));
        }
        if stop.load(Ordering::Relaxed) {
            break;
        }
    }
    let mut notes: Vec<String> = sources.iter().flat_map(|source| source.notes.clone()).collect();
    notes.extend(lpips_bias_notes(&scenes));
    let comparison = Comparison {
        notes,
        published: sources.into_iter().flat_map(|source| source.published).collect(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        conditions: conditions(args),
        device,
        machine: machine(),
        overall: overall(&scenes),
        scenes,
    };
    write(args, &comparison)?;
    if stop.load(Ordering::Relaxed) {
        print_line("stopped; run the same command to continue after the finished runs")?;
    } else if done == 0 {
        bail!("no run was completed; see the .log files in {}", args.out.display());
    }
    Ok(())
}

/// The datasets of the command line; those that can be read must have held-out views.
fn sources(args: &Args) -> Result<Vec<Source>> {
    let names = distinct(args.data.iter().map(|data| folder_name(data)));
    let source = |(data, name): (&PathBuf, String)| {
        // The scene of the benchmark, before the name is made distinct.
        let scene = folder_name(data).to_lowercase();
        let reading = match args.protocol {
            Some(protocol) => Reading {
                format: args.reading.format.clone(),
                images: args.reading.images.clone(),
                lenses: args.reading.training(args.device.as_deref()).lenses,
                readout: args.reading.readout.clone(),
                ..protocol.reading(&scene)
            },
            None => args.reading.training(args.device.as_deref()),
        };
        reading.check().map_err(with_option_names)?;
        let dataset = reading.read(data).ok();
        if dataset.as_ref().is_some_and(|dataset| dataset.test.is_empty()) {
            let message = format!(
                "{}: no view is held out, so the recipes cannot be compared",
                data.display()
            );
            return Err(Usage(message).into());
        }
        let (mut published_rows, mut notes) = (Vec::new(), Vec::new());
        if let Some(protocol) = args.protocol {
            published_rows = published(protocol.name(), &scene, &name);
            if published_rows.is_empty() {
                notes.push(format!(
                    "{name}: no published figures of a scene of this name under protocol {protocol}"
                ));
            } else if let Some(dataset) = &dataset {
                let differences = protocol.differences(&scene, dataset);
                notes.extend(
                    differences
                        .into_iter()
                        .map(|line| format!("{name}: not comparable with the published figures: {line}")),
                );
            }
            notes.iter().for_each(note);
        }
        // The file of a dataset, as of nerfstudio, is beside its photographs.
        let root = std::path::absolute(data)?;
        let beside = root.parent().filter(|_| dataset.is_some() && root.is_file());
        let folders: Vec<&Path> = iter::once(beside.unwrap_or(&root))
            .chain(reading.images.as_deref())
            .collect();
        let fingerprint = data_fingerprint(dataset.as_ref(), &folders);
        Ok(Source {
            published: published_rows,
            notes,
            reading,
            data: data.clone(),
            name,
            fingerprint,
        })
    };
    args.data.iter().zip(names).map(source).collect()
}

/// The recipes of the command line, all read first, so that a mistake in the last one is found at once.
fn variants(args: &Args) -> Result<Vec<Variant>> {
    let eval_every = args.eval_every.or(args.steps.map(|steps| (steps / 40).max(1)));
    let eval_every = eval_every.unwrap_or(100);
    let mut variants = Vec::new();
    for text in args.recipes.iter().flat_map(|list| split_plain(list, ',')) {
        let (recipe, rest) = text.split_once(':').unwrap_or((text, ""));
        let mut overrides = vec![format!("eval_every={eval_every}")];
        let changes = split_plain(rest, ':').into_iter().filter(|change| !change.is_empty());
        overrides.extend(changes.map(str::to_owned));
        let resolved = read_recipe(recipe, &overrides)?;
        variants.push(Variant {
            text: text.to_owned(),
            recipe: recipe.to_owned(),
            overrides,
            hash: resolved.hash(),
            folder: folder_name(Path::new(text)),
        });
    }
    let folders = distinct(variants.iter().map(|variant| variant.folder.clone()));
    for (variant, folder) in variants.iter_mut().zip(folders) {
        variant.folder = folder;
    }
    Ok(variants)
}

/// The parts of `text` between separators outside of brackets, braces and quotes.
fn split_plain(text: &str, separator: char) -> Vec<&str> {
    let (mut depth, mut quote, mut start) = (0i32, None, 0);
    let mut parts = Vec::new();
    for (at, c) in text.char_indices() {
        match (c, quote) {
            (_, Some(opened)) if c == opened => quote = None,
            (_, Some(_)) => {}
            ('"' | '\'', None) => quote = Some(c),
            ('[' | '{', None) => depth += 1,
            (']' | '}', None) => depth -= 1,
            (_, None) if c == separator && depth <= 0 => {
                parts.push(&text[start..at]);
                start = at + c.len_utf8();
            }
            _ => {}
        }
    }
    parts.push(&text[start..]);
    parts
}

/// The last part of a path as the name of a folder, without characters that file systems may reject.
fn folder_name(path: &Path) -> String {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let name = absolute.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name = name.replace(".toml", "");
    // `file_stem` would treat the part after a dot in an override as an extension.
    let name = file_stem(&format!("{name}.x"));
    if name.is_empty() { "scene".into() } else { name }
}

fn request(args: &Args, program: &str, source: &Source, variant: &Variant, seed: u64) -> Request {
    let data = std::path::absolute(&source.data).unwrap_or_else(|_| source.data.clone());
    let mut arguments = vec!["train".to_owned(), data.display().to_string()];
    let mut option = |name: &str, value: Option<String>| {
        if let Some(value) = value {
            arguments.extend([name.to_owned(), value]);
        }
    };
    option("--recipe", Some(variant.recipe.clone()));
    for change in &variant.overrides {
        option("--set", Some(change.clone()));
    }
    option("--seed", Some(seed.to_string()));
    option("--steps", args.steps.map(|n| n.to_string()));
    option("--budget", args.budget.map(|s| format!("{s}s")));
    option("--max-splats", args.max_splats.map(|n| n.to_string()));
    option("--threads", args.threads.map(|n| n.to_string()));
    option("--device", args.device.clone());
    option("--lpips", args.lpips.as_ref().map(|path| path.display().to_string()));
    option("--format", args.reading.format.clone());
    let reading = &source.reading;
    match reading.max_side {
        Some(side) => option("--max-side", Some(side.to_string())),
        None => option("--downscale", Some(reading.downscale.to_string())),
    }
    option("--lenses", Some(reading.lenses.name().to_owned()));
    option("--readout", reading.readout.clone());
    option("--holdout", reading.holdout.clone());
    let images = reading.images.as_ref().map(std::path::absolute);
    option(
        "--images",
        images.and_then(Result::ok).map(|path| path.display().to_string()),
    );
    option("--background", args.background().map(|b| b.to_string()));
    // Published figures were measured with the given poses.
    option("--poses", args.protocol.map(|_| "given".to_owned()));
    // A folder without weights has been reported before.
    let lpips = lpips_path(args.lpips.as_ref()).ok().flatten();
    let unseen_lpips = unseen_lpips_path(args.lpips.as_ref(), lpips.as_ref());
    Request {
        lpips: [lpips, unseen_lpips],
        arguments,
        recipe_hash: variant.hash.clone(),
        program: program.to_owned(),
        data: source.fingerprint.clone(),
    }
}

/// The report of the finished run in `folder`, with its request.
fn finished(folder: &Path) -> Option<(Report, Option<Request>)> {
    let (run, record) = RunFolder::open(folder).ok()?;
    let read = |name: &str| fs::read_to_string(run.file(name)).ok();
    let report = serde_json::from_str(&read("report.json")?).ok()?;
    let request = read(REQUEST_FILE).and_then(|text| serde_json::from_str(&text).ok());
    record.complete.then_some((report, request))
}

/// Rejects finished runs with a different request, before any training.
fn check_earlier(args: &Args, program: &str, variants: &[Variant], sources: &[Source]) -> Result<()> {
    for source in sources {
        for variant in variants {
            for seed in 0..args.seeds {
                let folder = args.out.join(format!("{}/{}/seed_{seed}", source.name, variant.folder));
                let Some((_, earlier)) = finished(&folder) else {
                    continue;
                };
                let wanted = request(args, program, source, variant, seed);
                let mismatch = earlier.map_or(Some("under other conditions"), |earlier| earlier.mismatch(&wanted));
                if let Some(how) = mismatch {
                    let message = format!(
                        "{} holds a run made {how}; choose another --out, or --overwrite to repeat such runs",
                        folder.display()
                    );
                    return Err(Usage(message).into());
                }
            }
        }
    }
    Ok(())
}

/// Reads the run in `folder` if its request matches, otherwise makes it.
fn one_run(request: Request, folder: &Path, what: &str, stop: &AtomicBool) -> Result<Outcome> {
    if let Some((report, earlier)) = finished(folder)
        && earlier.as_ref() == Some(&request)
    {
        return Ok(Outcome::Done(Box::new(report)));
    }
    if stop.load(Ordering::Relaxed) {
        return Ok(Outcome::Stopped);
    }
    note(format_args!("{what} .."));
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    // If the run ends early, what an earlier one left does not pass for its result.
    if let Some(earlier) = RunFolder::containing(folder) {
        earlier.remove("run.json")?;
    }
    let bytes = serde_json::to_vec_pretty(&request)?;
    write_atomic(&folder.join(REQUEST_FILE), |out| out.write_all(&bytes))?;
    let log = folder.with_extension("log");
    let output = File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    let mut child = Command::new(program)
        .args(&request.arguments)
        .args(["--overwrite".as_ref(), "--out".as_ref(), folder.as_os_str()])
        .stdin(Stdio::null())
        .stdout(output.try_clone()?)
        .stderr(output)
        .spawn()
        .context("cannot start a run")?;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if stop.load(Ordering::Relaxed) {
            // A partial run is useless here: its time would not be that of an uninterrupted one.
            let _ = child.kill();
            child.wait()?;
            return Ok(Outcome::Stopped);
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    if status.success()
        && let Some((report, _)) = finished(folder)
    {
        return Ok(Outcome::Done(Box::new(report)));
    }
    // Ctrl-C reaches the child process, too, perhaps before this process has noticed it.
    std::thread::sleep(Duration::from_millis(200));
    if stop.load(Ordering::Relaxed) {
        return Ok(Outcome::Stopped);
    }
    let log_text = fs::read_to_string(&log).unwrap_or_default();
    let error = log_text.lines().rev().find_map(|line| line.strip_prefix("error: "));
    Ok(Outcome::Failed(error.map_or_else(
        || format!("the run ended early ({status}); see {}", log.display()),
        str::to_owned,
    )))
}

/// The held-out view of median PSNR in the first finished run, with the renderings of the first finished run of each recipe.
fn held_out_view(out: &Path, trained: &[Vec<TrainedRun>]) -> Option<PictureRow> {
    let first = |runs: &'_ Vec<TrainedRun>| runs.iter().position(|t| t.report.is_some());
    let firsts: Vec<Option<(&Run, &Report)>> = trained
        .iter()
        .map(|runs| first(runs).and_then(|i| Some((&runs[i].run, runs[i].report.as_ref()?))))
        .collect();
    let (run, report) = firsts.iter().flatten().next()?;
    let measured = |view: &&ViewReport| !view.truth.is_empty() && !view.psnr.is_nan();
    let mut views: Vec<_> = report.views.iter().filter(measured).collect();
    views.sort_by(|a, b| a.psnr.total_cmp(&b.psnr));
    let view = views.get(views.len() / 2)?;
    let embedded = |run: &Run, file: &str| {
        embed(&out.join(&run.folder).join(file)).map_err(|error| note(format_args!("warning: {}", one_line(&error))))
    };
    let render = |(run, report): &(&Run, &Report)| {
        let shown = report.views.iter().find(|shown| shown.name == view.name)?;
        Some(Render {
            seed: run.seed,
            psnr: shown.psnr,
            picture: embedded(run, &shown.render).ok()?,
        })
    };
    Some(PictureRow {
        name: view.name.clone(),
        truth: embedded(run, &view.truth).ok()?,
        renders: firsts.iter().map(|found| found.as_ref().and_then(render)).collect(),
    })
}

/// An image file as a `data:` URL: a JPEG of good quality, no larger than the page shows it.
fn embed(path: &Path) -> Result<String> {
    const MAX_SIDE: u32 = 1200;
    let mut shown = image::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    if shown.width().max(shown.height()) > MAX_SIDE {
        shown = shown.resize(MAX_SIDE, MAX_SIDE, image::imageops::FilterType::Triangle);
    }
    let mut bytes = Vec::new();
    shown
        .to_rgb8()
        .write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, 92))?;
    Ok(picture(&bytes))
}

/// The conditions common to all runs.
fn conditions(args: &Args) -> Vec<String> {
    let length = match (args.steps, args.budget) {
        (Some(steps), _) => format!("{steps} steps"),
        (None, Some(seconds)) => format!("{seconds} s of training"),
        (None, None) => "whole recipes".into(),
    };
    let seeds = format!("{} seed{}", args.seeds, if args.seeds == 1 { "" } else { "s" });
    let splats = args.max_splats.map(|n| format!("at most {n} splats"));
    let how = match args.protocol {
        Some(protocol) => [Some(format!("protocol {protocol}")), None, None],
        None => {
            let reading = args.reading.reading();
            let size = match reading.max_side {
                Some(side) => Some(format!("images of at most {side} px")),
                None if reading.downscale > 1.0 => Some(format!("images downscaled by {}", reading.downscale)),
                None => None,
            };
            let background = args.background.map(|b| format!("background {b}"));
            let holdout = reading.holdout.map(|holdout| format!("held out: {holdout}"));
            [size, holdout, background]
        }
    };
    let conditions = iter::once(Some(length)).chain(how).chain([splats, Some(seeds)]);
    conditions.flatten().collect()
}

fn write(args: &Args, comparison: &Comparison) -> Result<()> {
    let files = [
        ("compare.json", serde_json::to_vec_pretty(comparison)?),
        ("compare.html", to_html(comparison).into_bytes()),
        ("compare.md", to_markdown(comparison).into_bytes()),
    ];
    for (name, bytes) in &files {
        write_atomic(&args.out.join(name), |out| out.write_all(bytes))?;
    }
    print_line(to_text(comparison).trim_end())?;
    print_line(format_args!("see {}", args.out.join("compare.html").display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn recipes_are_separated_outside_of_values() {
        for (list, parts) in [
            (
                "classic,fast:max_splats=50000",
                &["classic", "fast:max_splats=50000"][..],
            ),
            (
                "fast:render.background=[1,0,0],mcmc",
                &["fast:render.background=[1,0,0]", "mcmc"],
            ),
            (
                "fast:render={background=[1,0,0],antialias=true}",
                &["fast:render={background=[1,0,0],antialias=true}"],
            ),
            ("fast:name='a, b',\"it's\",x", &["fast:name='a, b'", "\"it's\"", "x"]),
            ("fast]},mcmc,", &["fast]}", "mcmc", ""]),
        ] {
            assert_eq!(split_plain(list, ','), parts);
        }
        let line = "compare chair --out x --recipes fast:render.background=[1,0,0]:name='a:b',classic";
        let variants = variants(&Cli::parse_from(line.split(' ')).args).expect("recipes");
        let changes = ["eval_every=100", "render.background=[1,0,0]", "name='a:b'"];
        assert_eq!(
            (variants.len(), &variants[0].overrides[..]),
            (2, &changes.map(str::to_owned)[..])
        );
    }

    #[test]
    fn a_limit_of_splats_is_among_the_conditions_under_a_protocol_too() {
        let of = |line: &str| conditions(&Cli::parse_from(line.split(' ')).args).join(", ");
        let line = "compare chair --recipes fast --out x --seeds 1 --steps 9 --max-splats 500";
        let protocol = of(&format!("{line} --protocol blender"));
        assert_eq!(protocol, "9 steps, protocol blender, at most 500 splats, 1 seed");
        let free = of(&format!("{line} --max-side 64 --holdout 5 --background white"));
        assert_eq!(
            free,
            "9 steps, images of at most 64 px, held out: 5, background white, at most 500 splats, 1 seed"
        );
    }

    #[test]
    fn folder_names_are_safe_and_distinct() {
        let names = [
            "a/room",
            "b/room/",
            "curriculum:params.coarse=0",
            "my/own.toml:a.b=1",
            "/",
        ];
        let names = distinct(names.iter().map(|name| folder_name(Path::new(name))));
        assert_eq!(
            names,
            ["room", "room_2", "curriculum_params.coarse_0", "own_a.b_1", "scene"]
        );
        assert_eq!(
            distinct(["a", "a_2", "a"].map(str::to_owned).into_iter()),
            ["a", "a_2", "a_3"]
        );
    }
}
