//! `irradia compare`
//!
//! Every training is a process of its own, this same program's `train`: memory is measured by itself, and what goes wrong in
//! one run stays there.

use super::train::parse_seconds;
use super::{DataArgs, by_option, thread_count};
use crate::Usage;
use crate::interrupt::stop_flag;
use crate::terminal::{note, one_line, say};
use anyhow::{Context, Result, bail};
use clap::builder::RangedU64ValueParser;
use image::codecs::jpeg::JpegEncoder;
use irradia_runs::formats::write_atomic;
use irradia_runs::train::compare::{
    Comparison, Figures, PictureRow, Render, Run, Scene, overall, picture, to_html, to_markdown, to_text,
};
use irradia_runs::train::report::{Report, ViewReport, machine};
use irradia_runs::{
    Background, RunFolder, data_fingerprint, distinct, file_stem, logged_errors, program_fingerprint, read_recipe,
};
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[derive(clap::Args)]
pub struct Args {
    /// Folders of posed photographs
    #[arg(required = true)]
    pub data: Vec<PathBuf>,
    /// Recipes to compare, separated by commas: built-in or .toml files, each with changes behind colons, such as
    /// classic,fast:max_splats=50000
    #[arg(long, value_name = "NAME[:KEY=VALUE]..", value_delimiter = ',', required = true)]
    pub recipes: Vec<String>,
    /// Trainings of each recipe on each dataset, with the seeds 0, 1, ..
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub seeds: u64,
    /// Fit the recipes into so many steps
    #[arg(long, value_name = "N", conflicts_with = "budget", value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Fit the recipes into a time of training, such as 90s or 5m
    #[arg(long, value_name = "TIME", value_parser = parse_seconds)]
    pub budget: Option<f64>,
    /// Never more splats than this
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    pub max_splats: Option<usize>,
    /// Steps between looks at the held-out views, which are not counted as training; a fortieth of --steps, or 100, when
    /// absent
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub look_every: Option<u64>,
    /// Folder for the runs and the outcome; finished runs that it holds are read and not repeated
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Repeat the runs in DIR that were made under other conditions
    #[arg(long)]
    pub overwrite: bool,
    /// Threads of each training; all cores when absent
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
    /// LPIPS weights: a file, or a folder of them; see irradia lpips
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    /// white, black or random (trained over random colours, scored over white): what photographs with alpha are laid over;
    /// white for Blender scenes and the recipe's own for others when absent
    #[arg(long, value_name = "COLOR")]
    pub background: Option<Background>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// A recipe as it takes part.
struct Way {
    /// As the user wrote it.
    text: String,
    /// Name or file.
    recipe: String,
    /// `key=value`.
    changes: Vec<String>,
    /// Of the resolved recipe.
    hash: String,
    /// Name of its folder.
    folder: String,
}

/// What a run was asked for, kept in its folder: a finished run is read again only if nothing of it changed.
#[derive(PartialEq, Serialize, Deserialize)]
struct Request {
    /// Of `irradia`, without `--out`.
    arguments: Vec<String>,
    recipe_hash: String,
    /// Of this program's file; empty where an earlier version wrote it.
    #[serde(default)]
    program: String,
    /// Of the dataset; empty where it could not be read, or an earlier version wrote it.
    #[serde(default)]
    data: String,
}

impl Request {
    /// Why a run that was made for `self` cannot stand for one that is made for `wanted`.
    fn misfit(&self, wanted: &Self) -> Option<&'static str> {
        let same = (&self.arguments, &self.recipe_hash) == (&wanted.arguments, &wanted.recipe_hash);
        match (same, self.program == wanted.program, self.data == wanted.data) {
            (false, ..) => Some("under other conditions"),
            (true, _, false) => Some("on data that changed since"),
            (true, false, true) => Some("by another build of this program"),
            (true, true, true) => None,
        }
    }
}

/// A dataset as it takes part.
struct Source {
    /// As the user wrote it.
    data: PathBuf,
    /// Name of its folder.
    name: String,
    /// Of what it holds; empty where it cannot be read, which its runs then say.
    fingerprint: String,
}

const REQUEST: &str = "request.json";

/// A run with all that is known of it.
struct Trained {
    run: Run,
    report: Option<Report>,
}

enum Outcome {
    Done(Box<Report>),
    Failed(String),
    Stopped,
}

pub fn run(args: &Args) -> Result<()> {
    let ways = ways(args)?;
    if let Some(data) = args.data.iter().find(|data| !data.exists()) {
        return Err(Usage(format!("{} does not exist: give a dataset's folder", data.display())).into());
    }
    let sources = sources(args)?;
    let program = program_fingerprint().context("cannot read this program's file")?;
    if !args.overwrite {
        check_earlier(args, &program, &ways, &sources)?;
    }
    fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}; give another --out", args.out.display()))?;
    let stop = stop_flag();

    let total = args.data.len() * ways.len() * args.seeds as usize;
    let (mut scenes, mut number) = (Vec::new(), 0);
    let (mut device, mut done) = (String::new(), 0);
    for source in &sources {
        let name = &source.name;
        let mut trained: Vec<Vec<Trained>> = ways.iter().map(|_| Vec::new()).collect();
        // Recipes within seeds: what else the machine does meanwhile falls on all of them alike.
        for seed in 0..args.seeds {
            for (way, trained) in ways.iter().zip(&mut trained) {
                number += 1;
                let what = format!("[{number}/{total}] {name}, {}, seed {seed}", way.text);
                let folder = format!("{name}/{}/seed_{seed}", way.folder);
                let request = request(args, &program, source, way, seed);
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
                trained.push(Trained { run, report });
            }
            if stop.load(Ordering::Relaxed) {
                break;
            }
        }
        if trained.iter().any(|runs| !runs.is_empty()) {
            let view = held_out_view(&args.out, &trained);
            let texts = ways.iter().map(|way| way.text.clone());
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
    let comparison = Comparison {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        conditions: conditions(args),
        device,
        machine: machine(),
        overall: overall(&scenes),
        scenes,
    };
    write(args, &comparison)?;
    if stop.load(Ordering::Relaxed) {
        say("stopped: the same command goes on behind the runs that are finished")?;
    } else if done == 0 {
        bail!(
            "no run came to an end; look at the .log files in {}",
            args.out.display()
        );
    }
    Ok(())
}

/// The datasets of the command line; those that can be read must have views that score the runs.
fn sources(args: &Args) -> Result<Vec<Source>> {
    let reading = args.reading.reading();
    reading.check().map_err(by_option)?;
    let names = distinct(args.data.iter().map(|data| folder_name(data)));
    let source = |(data, name): (&PathBuf, String)| {
        let dataset = reading.read(data).ok();
        if dataset.as_ref().is_some_and(|dataset| dataset.test.is_empty()) {
            let message = format!(
                "{}: no view is held out, so that nothing can be compared",
                data.display()
            );
            return Err(Usage(message).into());
        }
        Ok(Source {
            data: data.clone(),
            name,
            fingerprint: dataset.map_or(String::new(), |dataset| data_fingerprint(&dataset, data)),
        })
    };
    args.data.iter().zip(names).map(source).collect()
}

/// The recipes of the command line, each read, so that a mistake in the last one is not found after hours.
fn ways(args: &Args) -> Result<Vec<Way>> {
    let looks = args.look_every.or(args.steps.map(|steps| (steps / 40).max(1)));
    let looks = looks.unwrap_or(100);
    let mut ways = Vec::new();
    for text in &args.recipes {
        let (recipe, rest) = text.split_once(':').unwrap_or((text, ""));
        let mut changes = vec![format!("eval_every={looks}")];
        changes.extend(rest.split(':').filter(|change| !change.is_empty()).map(str::to_owned));
        let resolved = read_recipe(recipe, &changes)?;
        ways.push(Way {
            text: text.clone(),
            recipe: recipe.to_owned(),
            changes,
            hash: resolved.hash(),
            folder: folder_name(Path::new(text)),
        });
    }
    let folders = distinct(ways.iter().map(|way| way.folder.clone()));
    for (way, folder) in ways.iter_mut().zip(folders) {
        way.folder = folder;
    }
    Ok(ways)
}

/// The last part of a path as the name of a folder, without what a file system may not like.
fn folder_name(path: &Path) -> String {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let name = absolute.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name = name.replace(".toml", "");
    // `file_stem` would take what stands behind a dot in a change for an extension.
    let name = file_stem(&format!("{name}.x"));
    if name.is_empty() { "scene".into() } else { name }
}

fn request(args: &Args, program: &str, source: &Source, way: &Way, seed: u64) -> Request {
    let data = std::path::absolute(&source.data).unwrap_or_else(|_| source.data.clone());
    let mut arguments = vec!["train".to_owned(), data.display().to_string()];
    let mut option = |name: &str, value: Option<String>| {
        if let Some(value) = value {
            arguments.extend([name.to_owned(), value]);
        }
    };
    option("--recipe", Some(way.recipe.clone()));
    for change in &way.changes {
        option("--set", Some(change.clone()));
    }
    option("--seed", Some(seed.to_string()));
    option("--steps", args.steps.map(|n| n.to_string()));
    option("--budget", args.budget.map(|s| format!("{s}s")));
    option("--max-splats", args.max_splats.map(|n| n.to_string()));
    option("--threads", args.threads.map(|n| n.to_string()));
    option("--lpips", args.lpips.as_ref().map(|path| path.display().to_string()));
    option("--format", args.reading.format.clone());
    let reading = args.reading.reading();
    match reading.max_side {
        Some(side) => option("--max-side", Some(side.to_string())),
        None => option("--downscale", Some(reading.downscale.to_string())),
    }
    option("--holdout", reading.holdout);
    option("--background", args.background.map(|b| b.name().to_owned()));
    Request {
        arguments,
        recipe_hash: way.hash.clone(),
        program: program.to_owned(),
        data: source.fingerprint.clone(),
    }
}

/// The report of the finished run in `folder`; with what it was asked for.
fn finished(folder: &Path) -> Option<(Report, Option<Request>)> {
    let (run, record) = RunFolder::open(folder).ok()?;
    let read = |name: &str| fs::read_to_string(run.file(name)).ok();
    let report = serde_json::from_str(&read("report.json")?).ok()?;
    let request = read(REQUEST).and_then(|text| serde_json::from_str(&text).ok());
    record.complete.then_some((report, request))
}

/// Refuses, before anything is trained, finished runs that were asked for something else.
fn check_earlier(args: &Args, program: &str, ways: &[Way], sources: &[Source]) -> Result<()> {
    for source in sources {
        for way in ways {
            for seed in 0..args.seeds {
                let folder = args.out.join(format!("{}/{}/seed_{seed}", source.name, way.folder));
                let Some((_, earlier)) = finished(&folder) else {
                    continue;
                };
                let wanted = request(args, program, source, way, seed);
                let misfit = earlier.map_or(Some("under other conditions"), |earlier| earlier.misfit(&wanted));
                if let Some(how) = misfit {
                    let message = format!(
                        "{} holds a run made {how}: give another --out, or --overwrite to repeat such runs",
                        folder.display()
                    );
                    return Err(Usage(message).into());
                }
            }
        }
    }
    Ok(())
}

/// Reads the run in `folder` if it is what is asked for, makes it otherwise.
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
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let bytes = serde_json::to_vec_pretty(&request)?;
    write_atomic(&folder.join(REQUEST), |out| out.write_all(&bytes))?;
    let log = folder.with_extension("log");
    let output = File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
    let program = std::env::current_exe().context("cannot find this program to run it again")?;
    let mut child = Command::new(program)
        .args(&request.arguments)
        .args(["--overwrite".as_ref(), "--out".as_ref(), folder.as_os_str()])
        .stdin(Stdio::null())
        .stdout(output.try_clone()?)
        .stderr(output)
        .spawn()
        .context("cannot start a training")?;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if stop.load(Ordering::Relaxed) {
            // Half a run is of no use here: its time would not be that of an unbroken one.
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
    // Ctrl-C reaches the training too, and perhaps before this process has taken note.
    std::thread::sleep(Duration::from_millis(200));
    if stop.load(Ordering::Relaxed) {
        return Ok(Outcome::Stopped);
    }
    let said = fs::read_to_string(&log).unwrap_or_default();
    let error = said.lines().rev().find_map(|line| line.strip_prefix("error: "));
    Ok(Outcome::Failed(error.map_or_else(
        || format!("the training ended early ({status}); see {}", log.display()),
        str::to_owned,
    )))
}

/// The held-out view of median PSNR in the first finished run, as the first finished run of each recipe shows it.
fn held_out_view(out: &Path, trained: &[Vec<Trained>]) -> Option<PictureRow> {
    let first = |runs: &'_ Vec<Trained>| runs.iter().position(|t| t.report.is_some());
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

/// A picture as an address that holds it: a JPEG of good quality, no larger than a page shows.
fn embed(path: &Path) -> Result<String> {
    const LARGEST: u32 = 1200;
    let mut shown = image::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    if shown.width().max(shown.height()) > LARGEST {
        shown = shown.resize(LARGEST, LARGEST, image::imageops::FilterType::Triangle);
    }
    let mut bytes = Vec::new();
    shown
        .to_rgb8()
        .write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, 92))?;
    Ok(picture(&bytes))
}

/// What was the same for all runs.
fn conditions(args: &Args) -> Vec<String> {
    let length = match (args.steps, args.budget) {
        (Some(steps), _) => format!("{steps} steps"),
        (None, Some(seconds)) => format!("{seconds} s of training"),
        (None, None) => "whole recipes".into(),
    };
    let reading = args.reading.reading();
    let size = match reading.max_side {
        Some(side) => Some(format!("images of at most {side} px")),
        None if reading.downscale > 1.0 => Some(format!("images downscaled by {}", reading.downscale)),
        None => None,
    };
    let background = args.background.map(|b| format!("background {}", b.name()));
    let holdout = reading.holdout.map(|holdout| format!("held out: {holdout}"));
    let seeds = format!("{} seed{}", args.seeds, if args.seeds == 1 { "" } else { "s" });
    let splats = args.max_splats.map(|n| format!("at most {n} splats"));
    [Some(length), size, holdout, background, splats, Some(seeds)]
        .into_iter()
        .flatten()
        .collect()
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
    say(to_text(comparison).trim_end())?;
    say(format_args!("look at {}", args.out.join("compare.html").display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_folders_are_tame_and_distinct() {
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
