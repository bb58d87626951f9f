//! `irradia train`

use super::lpips::{self, lpips_path, unseen_lpips_path};
use super::pose::{Poses, is_unposed, mostly_unposed, photo_folder, pose_again, pose_all, pose_first};
use super::progress::{Progress, format_size};
use super::size::memory_size;
use super::view::ListenArgs;
use super::{DataArgs, thread_count, use_threads, warn, with_option_names};
use crate::Usage;
use crate::interrupt::stop_flag;
use crate::terminal::{note, one_line, print_line};
use anyhow::{Error, Result, anyhow, ensure};
use clap::builder::RangedU64ValueParser;
use irradia_compute::DeviceChoice;
use irradia_runs::formats::{DatasetFormat, FormatError};
use irradia_runs::scene::Dataset;
use irradia_runs::{
    Background, DEFAULT_RECIPE, Finished, NOT_MEASURED, PoseCheck, PoseSource, Reading, Run, RunError, RunFolder,
    TrainInput, TrainRequest, check_poses, has_perceptual_loss, is_rendered, moved_from_dataset, pose_source,
    read_recipe, scene_path,
};
use irradia_train::event::Observer;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// Maximum number of photographs that are posed without a request if most have no poses, equal to the maximum number of frames chosen from
/// films: they take a few minutes. Of more, such as all frames of a film, the others may have been left out on purpose.
const MAX_POSED_UNREQUESTED: usize = 300;

#[derive(clap::Args)]
pub struct Args {
    /// Folder of posed photographs (COLMAP, nerfstudio, Blender, LLFF, OpenSfM, Metashape, ..), or photographs or a film without
    /// poses, which are posed first; not needed with --resume and --replay
    #[arg(required_unless_present_any = ["resume", "replay"])]
    pub data: Option<PathBuf>,
    /// Folder for the run
    #[arg(long, value_name = "RUN", required_unless_present = "resume")]
    pub out: Option<PathBuf>,
    /// Built-in recipe or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = DEFAULT_RECIPE, conflicts_with = "resume")]
    pub recipe: String,
    /// Begin with the splats of this scene, a file or the folder of a run, instead of points; its coordinates must be those of the dataset.
    /// Fewer steps than the recipe has are its last ones. If photographs were posed for that run, these poses are used again
    #[arg(long, value_name = "SCENE", conflicts_with = "resume")]
    pub from: Option<PathBuf>,
    /// Poses to use: those given with the photographs, or new ones by irradia, or by colmap, if it is installed. When absent the given
    /// ones, unless there are none, most photographs have none, or the photographs contradict them; then irradia's
    #[arg(long, value_name = "WHO", value_enum, conflicts_with_all = ["resume", "replay"])]
    pub poses: Option<PosesArg>,
    /// Where splats begin if the dataset has poses and no points: at points found by matching its photographs (matched), or at random
    /// positions (given)
    #[arg(long, value_name = "WHICH", value_enum, default_value_t = PointsArg::Matched, conflicts_with_all = ["resume", "replay"])]
    pub points: PointsArg,
    /// Train even if fewer than 80 % of the photographs could be posed, or some held-out ones could not
    #[arg(long)]
    pub anyway: bool,
    /// Override one key of the recipe, such as stage.grow.params.ssim_weight=0.3
    #[arg(long, value_name = "KEY=VALUE", conflicts_with = "resume")]
    pub set: Vec<String>,
    /// Fit the recipe into this number of steps
    #[arg(long, value_name = "N", conflicts_with_all = ["resume", "budget"], value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Maximum number of splats
    #[arg(long, value_name = "N", conflicts_with = "resume", value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    pub max_splats: Option<usize>,
    /// Memory of the process, such as 8GiB; three quarters of what is free when absent. Photographs that do not fit are read again
    /// when they are needed; splats that do not fit are not added
    #[arg(long, value_name = "SIZE", value_parser = memory_size)]
    pub memory: Option<usize>,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 0, conflicts_with = "resume")]
    pub seed: u64,
    /// Threads; all cores when absent. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
    /// Where the scene is trained: cpu, gpu, auto (a real GPU if there is one), or a part of a GPU's name; see irradia devices. cpu when
    /// absent, or with --resume the device on which the run began
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<String>,
    /// Stop at this held-out PSNR
    #[arg(long, value_name = "DB")]
    pub until_psnr: Option<f64>,
    /// Fit the recipe into a training time, such as 90s or 5m, with --resume that of the whole run. The progress depends on the speed of
    /// the machine, and so do the bytes of the scene; --replay reproduces them
    #[arg(long, value_name = "TIME", value_parser = parse_seconds)]
    pub budget: Option<f64>,
    /// Resume an interrupted run from its latest checkpoint; the result is that of an uninterrupted run. The same views are held out; a
    /// --holdout that selects others is refused
    #[arg(long, value_name = "RUN", conflicts_with_all = ["out", "overwrite", "downscale", "max_side", "full_size", "format", "lenses", "readout"])]
    pub resume: Option<PathBuf>,
    /// Repeat RUN into --out, each step at its recorded pace: the same bytes, even for a run with a --budget
    #[arg(long, value_name = "RUN", conflicts_with_all = ["resume", "recipe", "set", "steps", "max_splats", "seed", "until_psnr", "budget", "downscale", "max_side", "full_size", "holdout", "format", "lenses", "readout", "background", "from"])]
    pub replay: Option<PathBuf>,
    /// Replace an existing run in --out
    #[arg(long)]
    pub overwrite: bool,
    /// LPIPS weights: a file, or a folder of them; see irradia lpips
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    /// Background of the scene: white, black, grey, a colour such as '#c8c0b4', or random (random colours in training, white in
    /// evaluation); when absent white for transparent Blender scenes and objects cut out on white, the colour of a white or black
    /// backdrop, else that of the recipe
    #[arg(long, value_name = "COLOR", conflicts_with = "resume")]
    pub background: Option<Background>,
    /// Serve a page to watch and pause the training; see irradia view
    #[arg(long)]
    pub view: bool,
    #[command(flatten)]
    pub listen: ListenArgs,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// Which poses are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PosesArg {
    Given,
    Irradia,
    Colmap,
}

/// Which points splats begin from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PointsArg {
    Matched,
    Given,
}

impl PosesArg {
    /// The program that finds new poses; `None` for the given ones.
    fn mapper(self) -> Option<Poses> {
        match self {
            Self::Given => None,
            Self::Irradia => Some(Poses::Irradia),
            Self::Colmap => Some(Poses::Colmap),
        }
    }
}

impl Args {
    /// Where to serve a viewer, if one is requested.
    fn viewer(&self) -> Option<&ListenArgs> {
        (self.view || self.listen.open).then_some(&self.listen)
    }
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
        _ => Err("expected a time such as 90s, 5m or 1h".into()),
    }
}

pub fn run(args: &Args) -> Result<()> {
    if args.viewer().is_none() && args.listen.names_an_address() {
        let message = "--host and --port are those of the page that --view serves: add --view, or omit them";
        return Err(Usage(message.into()).into());
    }
    use_threads(args.threads)?;
    match (&args.resume, &args.replay) {
        (Some(run), _) => resume(run, args),
        (None, Some(run)) => begin(replay(run, args)?, args.viewer()),
        (None, None) => {
            let mut input = input(args)?;
            refuse_run(&input.data)?;
            if let Some(from) = &args.from {
                let (request, dataset) = with_poses_of(from, input, args.poses)?;
                RunFolder::check_free(&request.input().out, request.input().overwrite)?;
                return begin_on(request, dataset, args.viewer());
            }
            if finds_poses(&input) {
                // Posing takes a while: mistakes are reported first.
                let request = input.clone().check().map_err(with_option_names)?;
                RunFolder::check_free(&input.out, input.overwrite)?;
                request.check_resources().map_err(with_option_names)?;
                let Some(mapper) = args.poses.map_or(Some(Poses::Irradia), PosesArg::mapper) else {
                    let message = format!("{} has no poses: omit --poses given", input.data.display());
                    return Err(Usage(message).into());
                };
                pose_first(&mut input, mapper, args.anyway)?;
                return begin(input, args.viewer());
            }
            let (request, dataset) = with_poses(input, args.poses, args.anyway)?;
            begin_on(request, dataset, args.viewer())
        }
    }
}

/// Refuses the folder of a run as data, unless it holds a dataset or photographs as well.
fn refuse_run(data: &Path) -> Result<()> {
    if !data.join("run.json").is_file() || DatasetFormat::recognise(data).is_some() || is_unposed(data) {
        return Ok(());
    }
    let run = data.display();
    let message = format!("{run} is a run: resume it with irradia train --resume {run}, or name the data to train on");
    Err(Usage(message).into())
}

/// Whether poses are found first, since the data are photographs or films without any. A requested layout says that there are some.
fn finds_poses(input: &TrainInput) -> bool {
    input.reading.format.is_none() && is_unposed(&input.data)
}

/// The input that repeats `run`.
fn replay(run: &Path, args: &Args) -> Result<TrainInput> {
    let out = args.out.clone().expect("required by clap");
    let mut input = with_local_settings(args, TrainInput::replay_of(run, out)?)?;
    input.overwrite = args.overwrite;
    Ok(input)
}

/// The input of a run, with the settings that may differ by now or on another machine: its files, memory and device.
fn with_local_settings(args: &Args, mut input: TrainInput) -> Result<TrainInput> {
    if let Some(data) = &args.data {
        input.data.clone_from(data);
    }
    input.reading.images = args.reading.images.clone().or(input.reading.images);
    input.memory = args.memory.or(input.memory);
    input.device = args.device.clone().unwrap_or(input.device);
    input.lpips = resolve_lpips(&input, args)?;
    input.unseen_lpips = input.unseen_lpips.filter(|path| path.exists());
    Ok(input)
}

/// The given weights, else those with which the run of `input` began. Weights that only measure may be others by now, but a perceptual loss
/// must not begin with the next step, or change its network.
fn resolve_lpips(input: &TrainInput, args: &Args) -> Result<Option<PathBuf>> {
    let kept = input.lpips.as_ref().filter(|path| path.exists());
    let given = args.lpips.as_ref().or(kept);
    if given.is_none() && has_perceptual_loss(&read_recipe(&input.recipe, &[])?) {
        if let Some(gone) = &input.lpips {
            let gone = gone.display();
            warn(&[format!(
                "{gone}, the LPIPS weights of the run's loss, are gone: name their new place with --lpips"
            )]);
        }
        return Ok(None);
    }
    lpips_path(given)
}

/// The input of a new run.
fn input(args: &Args) -> Result<TrainInput> {
    let given = |path: &Option<PathBuf>| path.clone().expect("required by clap");
    let lpips = lpips_path(args.lpips.as_ref())?;
    Ok(TrainInput {
        unseen_lpips: unseen_lpips_path(args.lpips.as_ref(), lpips.as_ref()),
        recipe: args.recipe.clone(),
        set: args.set.clone(),
        max_splats: args.max_splats,
        steps: args.steps,
        budget: args.budget,
        until_psnr: args.until_psnr,
        memory: args.memory,
        seed: args.seed,
        lpips,
        reading: args.reading.training(args.device.as_deref()),
        background: args.background,
        from: args.from.clone(),
        match_points: args.points == PointsArg::Matched,
        device: args
            .device
            .clone()
            .unwrap_or_else(|| DeviceChoice::default().to_string()),
        overwrite: args.overwrite,
        ..TrainInput::new(given(&args.data), given(&args.out))
    })
}

/// The dataset of `input` with poses that the splats of the scene `from` fit: new ones would be in a world of their own. If the photographs
/// of the run that contains `from` were posed for it, they replace photographs without poses or with others.
fn with_poses_of(from: &Path, mut input: TrainInput, poses: Option<PosesArg>) -> Result<(TrainRequest, Dataset)> {
    let (scene, data) = (from.display(), input.data.display().to_string());
    if poses.and_then(PosesArg::mapper).is_some() {
        let message = format!("--poses: new poses do not fit the splats of {scene}: omit it, or omit --from");
        return Err(Usage(message).into());
    }
    let given = (!finds_poses(&input)).then(|| read(input.clone())).transpose()?;
    let fits = |dataset: &Dataset| moved_from_dataset(&scene_path(from), dataset).is_some();
    match (given, RunFolder::posed_dataset(from)) {
        (Some(given), _) if fits(&given.1) => Ok(given),
        (_, Some(posed)) => {
            note(format_args!(
                "the splats of {scene} fit the poses in {}, which replace {data}",
                posed.display()
            ));
            input.data = posed;
            (input.reading.format, input.reading.images) = (None, None);
            read(input)
        }
        // Other poses are refused when the run begins.
        (Some(given), None) => Ok(given),
        (None, None) => {
            let message = format!(
                "{data} has no poses, and new ones do not fit the splats of {scene}: name the dataset on which it was trained"
            );
            Err(Usage(message).into())
        }
    }
}

/// The dataset of `input`, whose photographs have poses: with the given poses, or with new ones if they are requested, the photographs
/// contradict the given ones, or most photographs have none.
fn with_poses(input: TrainInput, poses: Option<PosesArg>, anyway: bool) -> Result<(TrainRequest, Dataset)> {
    let mut given = read(input.clone()).map_err(|error| naming_photographs(error, &input))?;
    RunFolder::check_free(&input.out, input.overwrite)?;
    // Rendered scenes are exact, and our own poses have been checked.
    let is_sure = || is_rendered(&given.1) || pose_source(&input.data) == Some(PoseSource::Irradia);
    let mapper = match poses.map(PosesArg::mapper) {
        Some(None) => return Ok(given),
        None if is_sure() => return Ok(given),
        mapper => mapper.flatten(),
    };
    // What follows takes a while.
    given.0.check_resources().map_err(with_option_names)?;
    if let Some(mapper) = mapper {
        let mut again = input;
        match mostly_unposed(&again, &given.1) {
            Some(files) => {
                let photos = photo_folder(&again);
                pose_all(&mut again, &photos, Some(files), mapper, anyway)?;
            }
            None => pose_again(&mut again, &given.1, mapper, anyway)?,
        }
        return read(again);
    }
    if let Some(files) = mostly_unposed(&input, &given.1)
        && let Some(found) = pose_others(input.clone(), &mut given.1, files)
    {
        return Ok(found);
    }
    let found = check(&input)?;
    if !found.is_broken() {
        let agree = found.pairs - found.contradicting.len();
        note(format_args!(
            "{agree} of {} pairs of photographs agree with the given poses",
            found.pairs
        ));
        if let Some([a, b]) = found.absent.first() {
            let n = found.absent.len();
            given.1.warnings.push(format!(
                "according to the given poses {n} pairs of photographs, such as {a} and {b}, are from nearly the same place, but they share \
                 nothing: parts that look alike may be taken for one; check whether --poses irradia --anyway separates them"
            ));
        }
        return Ok(given);
    }
    let [a, b] = &found.contradicting[0];
    let (wrong, of) = (found.contradicting.len(), found.pairs);
    let line = format!("{wrong} of {of} pairs of photographs contradict the given poses, such as {a} and {b}");
    note(format_args!(
        "{line}: finding new ones; --poses given keeps the given ones"
    ));
    match find_better_poses(input, &given.1, found.share()) {
        Ok((request, mut dataset)) => {
            let line = format!("{line}: new ones are used, in a world of their own");
            dataset.warnings.push(line);
            Ok((request, dataset))
        }
        Err(error) => {
            note(format_args!("the given poses are used after all: {}", one_line(&error)));
            Ok(given)
        }
    }
}

/// `error` of reading the dataset of `input`, with what to do if it has photographs but no usable poses.
fn naming_photographs(error: Error, input: &TrainInput) -> Error {
    let photographs = photo_folder(input).join("images");
    let has_no_poses = matches!(
        error.downcast_ref(),
        Some(RunError::Format(
            FormatError::TooFewViews { .. } | FormatError::Malformed { .. }
        ))
    );
    if !(has_no_poses && is_unposed(&photographs)) {
        return error;
    }
    let message = format!(
        "{error}; for new poses of its photographs: irradia train {} --out {}",
        photographs.display(),
        input.out.display()
    );
    anyhow!(message)
}

/// The dataset of `input` with new poses of the photographs `files`, of which `given` has poses of a minority, if at least twice as many are
/// found; `None`, with a warning in `given`, if those are used after all.
fn pose_others(mut input: TrainInput, given: &mut Dataset, files: HashSet<PathBuf>) -> Option<(TrainRequest, Dataset)> {
    let posed = given.views.len();
    let line = format!("only {posed} of {} photographs have poses", files.len());
    if files.len() > MAX_POSED_UNREQUESTED {
        let line = format!("{line}: --poses irradia finds new ones for all");
        given.warnings.push(line);
        return None;
    }
    note(format_args!(
        "{line}: finding new ones; --poses given keeps the given ones"
    ));
    let photos = photo_folder(&input);
    let found = pose_all(&mut input, &photos, Some(files), Poses::Irradia, true).and_then(|report| {
        let n = report.registered;
        ensure!(n >= 2 * posed, "new ones were found for {n} only");
        read(input)
    });
    match found {
        Ok((request, mut dataset)) => {
            let line = format!("{line}: new ones are used, in a world of their own");
            dataset.warnings.push(line);
            Some((request, dataset))
        }
        Err(error) => {
            let line = format!("{line}, and they are used after all: {}", one_line(&error));
            given.warnings.push(line);
            None
        }
    }
}

/// The dataset of `input` with new poses, if the share of pairs that contradict them is less than half of `contradicted`, that of the poses
/// of `given`.
fn find_better_poses(mut input: TrainInput, given: &Dataset, contradicted: f64) -> Result<(TrainRequest, Dataset)> {
    pose_again(&mut input, given, Poses::Irradia, false)?;
    let share = check(&input)?.share();
    ensure!(
        2.0 * share < contradicted,
        "the photographs contradict the new ones as well"
    );
    let (request, dataset) = read(input)?;
    // Views cut from a photograph as faces do not have its name.
    ensure!(dataset.test.len() == given.test.len(), "other views would be held out");
    Ok((request, dataset))
}

fn read(input: TrainInput) -> Result<(TrainRequest, Dataset)> {
    let request = input.check().map_err(with_option_names)?;
    let dataset = request.read_dataset()?;
    Ok((request, dataset))
}

/// Compares the poses of the dataset of `input` with its photographs, undistorted and at a size that does not depend on that of the
/// training.
fn check(input: &TrainInput) -> Result<PoseCheck> {
    let mut input = input.clone();
    (input.reading.downscale, input.reading.max_side) = (1.0, Reading::default().max_side);
    input.reading.lenses = irradia_runs::formats::Lenses::Undistorted;
    Ok(check_poses(&read(input)?.1))
}

/// Begins a new run on the current threads, and finishes it; `viewer` shows it while it trains.
pub fn begin(input: TrainInput, viewer: Option<&ListenArgs>) -> Result<()> {
    let request = input.check().map_err(with_option_names)?;
    RunFolder::check_free(&request.input().out, request.input().overwrite)?;
    let dataset = request.read_dataset()?;
    begin_on(request, dataset, viewer)
}

fn begin_on(request: TrainRequest, dataset: Dataset, viewer: Option<&ListenArgs>) -> Result<()> {
    warn(&dataset.warnings);
    warn(&request.warnings());
    if request.should_match_points(&dataset) {
        note("the dataset has no points: matching its photographs");
    }
    let known = dataset.warnings.len();
    let run = Run::begin_on(request, dataset).map_err(with_option_names)?;
    warn(&run.trainer().dataset.warnings[known..]);
    note(format_args!("background: {}", run.background()));
    finish(run, viewer)
}

fn resume(folder: &Path, args: &Args) -> Result<()> {
    let (opened, record) = RunFolder::open(folder)?;
    if record.complete {
        let report = opened.file("report.html");
        return print_line(format_args!(
            "{} is complete: see {}",
            folder.display(),
            report.display()
        ));
    }
    let mut input = with_local_settings(args, TrainInput::of_run(folder)?)?;
    if args.budget.is_some() {
        (input.budget, input.steps) = (args.budget, None);
    }
    input.until_psnr = args.until_psnr.or(input.until_psnr);
    input.reading.holdout = args.reading.holdout.clone().or(input.reading.holdout);
    let request = input.check().map_err(with_option_names)?;
    let dataset = request.read_dataset()?;
    warn(&dataset.warnings);
    warn(&request.warnings());
    let known = dataset.warnings.len();
    let run = Run::resume_on(request, dataset).map_err(with_option_names)?;
    warn(&run.trainer().dataset.warnings[known..]);
    note(format_args!("resuming at step {}", run.trainer().clock.step));
    finish(run, args.viewer())
}

/// Trains, writes all results, and prints a summary.
fn finish(mut run: Run, viewer: Option<&ListenArgs>) -> Result<()> {
    let folder = run.folder().path().to_owned();
    if let (Some(lpips), Some(path)) = (&run.trainer().options.lpips, &run.request().input().lpips) {
        lpips::print_network(lpips, path);
    }
    note(&run.trainer().memory);
    let stop = stop_flag();
    let mut watched = viewer.map(|listen| listen.watch(&run)).transpose()?;
    let mut progress = Progress::new(stop.clone());
    let mut observers: Vec<&mut dyn Observer> = vec![&mut progress];
    if let Some((_, watcher)) = &mut watched {
        observers.extend(watcher.observers());
    }
    let trained = run.train(&mut observers);
    // If Ctrl-C ended the steps, a second one ends the evaluation.
    let stopped = stop.load(Ordering::Relaxed);
    let requested = stop.clone();
    let stop = || !stopped && stop.load(Ordering::Relaxed);
    let finished = trained.and_then(|_| run.finish_unless(&stop));
    if matches!(finished, Err(RunError::EvaluationStopped)) {
        return print_line(format_args!(
            "{}; evaluate it with: irradia train --resume {}",
            RunError::EvaluationStopped,
            folder.display()
        ));
    }
    let finished = finished.map_err(|error| {
        anyhow!(
            "{}; once that is fixed, resume with: irradia train --resume {}",
            one_line(&error.into()),
            folder.display()
        )
    })?;
    print_summary(&finished)?;
    if let Some((viewer, _)) = watched.filter(|(viewer, _)| viewer.is_watched() && !stopped) {
        note("the pages are served until they are closed; Ctrl-C ends the program");
        viewer.wait_while_watched(&|| requested.load(Ordering::Relaxed));
    }
    Ok(())
}

fn print_summary(finished: &Finished) -> Result<()> {
    let (report, folder) = (&finished.report, &finished.folder);
    let figures = if report.psnr.is_nan() {
        "nothing was evaluated: there is no held-out view with pixels to measure".to_owned()
    } else {
        format!(
            "held-out PSNR {:.2} dB ({:.2} colour-corrected), SSIM {:.4}{}{}{}{}",
            report.psnr,
            report.psnr_corrected,
            report.ssim,
            format_lpips(report.lpips, report.lpips_net.as_deref()),
            format_lpips(report.unseen_lpips, report.unseen_lpips_net.as_deref()),
            report.half_fit_psnr.map_or(String::new(), |psnr| format!(
                ", {psnr:.2} dB on right halves after a fit on left halves"
            )),
            report.corner_brightness.map_or(String::new(), |corner| format!(
                ", corners with {corner:.2} of the middle's brightness, which the scene is without"
            )),
        )
    };
    warn(
        &report
            .warnings
            .iter()
            .filter(|line| line.contains(NOT_MEASURED))
            .cloned()
            .collect::<Vec<_>>(),
    );
    print_line(format_args!(
        "{figures}; {}, {:.1} s of training",
        format_size(report.splats, report.parameters),
        report.training_seconds
    ))?;
    if !finished.complete {
        print_line(format_args!(
            "resume with: irradia train --resume {}",
            folder.path().display()
        ))?;
    }
    print_line(format_args!("see {}", folder.file("report.html").display()))
}

/// `, LPIPS (alex) 0.1234`, if measured.
fn format_lpips(lpips: Option<f64>, net: Option<&str>) -> String {
    let pair = lpips.zip(net);
    pair.map_or(String::new(), |(lpips, net)| format!(", LPIPS ({net}) {lpips:.4}"))
}
