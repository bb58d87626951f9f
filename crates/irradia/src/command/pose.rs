//! `irradia pose`, and poses for a training on bare photographs.

use super::{thread_count, use_threads, with_option_names};
use crate::Usage;
use crate::terminal::{note, print_line};
use anyhow::{Context, Result};
use clap::builder::RangedU64ValueParser;
use indicatif::{ProgressBar, ProgressStyle};
use irradia_runs::formats::{DatasetFormat, folder_of, write_atomic};
use irradia_runs::scene::Dataset;
use irradia_runs::{
    Finding, KnownDistance, MIN_POSED_FRACTION, Mapper, POSED_FOLDER, PoseInput, PoseProgress, PoseReport, TrainInput,
    group_by_reason, is_capture, photographs_in, pose,
};
use std::collections::{HashMap, HashSet};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Maximum number of findings of one kind that are printed in full.
const MAX_PRINTED_FINDINGS: usize = 5;
/// File in a dataset that lists its held-out views.
const SPLIT_FILE: &str = "test.txt";
/// Interval of plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

#[derive(clap::Args)]
pub struct Args {
    /// Folders of photographs (JPEG, PNG, WebP, TIFF, HEIC, OpenEXR; masks, if any, in their subfolders masks) and films, or film files,
    /// which need ffmpeg; panoramas of the whole sphere (equirectangular) are recognised and cut into faces
    #[arg(required = true)]
    pub photos: Vec<PathBuf>,
    /// Folder for the dataset: the photographs and their poses in COLMAP's format. Features and matches are kept there too, and reused
    #[arg(long, value_name = "DATA", required_unless_present = "into")]
    pub out: Option<PathBuf>,
    /// Add the photographs to this dataset in COLMAP's format, whose poses and cameras do not change
    #[arg(long, value_name = "DATA", conflicts_with = "out")]
    pub into: Option<PathBuf>,
    /// A known distance in metres between the camera positions of two photographs, such as a.jpg,b.jpg,1.25: scales the poses to metres.
    /// Several distances are averaged, and their agreement is reported
    #[arg(long, value_name = "A,B,METRES", value_parser = known_distance, conflicts_with = "into")]
    pub distance: Vec<KnownDistance>,
    /// Program that finds the poses: irradia, or colmap, if it is installed
    #[arg(long, value_name = "WHO", default_value = "irradia", value_enum)]
    pub poses: Poses,
    /// Maximum number of features of a photograph; when absent 8192 for up to 25 photographs, 6144 for up to 35, else 4096
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=65_536))]
    pub max_features: Option<usize>,
    /// Threads; all cores when absent. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
}

/// `a.jpg,b.jpg,1.25`
fn known_distance(text: &str) -> Result<KnownDistance, String> {
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let [a, b, metres] = parts[..] else {
        return Err("expected two photographs and a number of metres, such as a.jpg,b.jpg,1.25".to_owned());
    };
    Ok(KnownDistance {
        photos: [a.to_owned(), b.to_owned()],
        metres: metres.parse().map_err(|_| format!("{metres} is not a number"))?,
    })
}

/// The program that finds poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Poses {
    Irradia,
    Colmap,
}

impl From<Poses> for Mapper {
    fn from(poses: Poses) -> Self {
        match poses {
            Poses::Irradia => Mapper::Irradia,
            Poses::Colmap => Mapper::Colmap,
        }
    }
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let data = args.into.as_ref().or(args.out.as_ref());
    let data = data.expect("clap requires one of them");
    let mut input = PoseInput {
        photos: args.photos.clone(),
        ..PoseInput::new("", data)
    };
    input.into = args.into.is_some();
    input.distances.clone_from(&args.distance);
    input.mapper = args.poses.into();
    input.max_features = args.max_features;
    let report = pose_with_progress(&input)?;
    print_line(summary(&report))?;
    print_line(format_args!(
        "train on it with: irradia train {} --out RUN",
        data.display()
    ))
}

/// Whether `data` has photographs and no poses.
pub fn is_unposed(data: &Path) -> bool {
    DatasetFormat::recognise(data).is_none() && is_capture(data)
}

/// Poses the photographs of `input` into the folder `posed` of its run, and makes that its dataset.
pub fn pose_first(input: &mut TrainInput, poses: Poses, anyway: bool) -> Result<()> {
    note(format_args!(
        "{} has no poses: finding them first",
        input.data.display()
    ));
    let absolute = std::path::absolute(&input.data).unwrap_or_else(|_| input.data.clone());
    if let Some(dataset) = absolute
        .parent()
        .filter(|folder| DatasetFormat::recognise(folder).is_some())
    {
        let dataset = dataset.display();
        note(format_args!(
            "warning: {dataset} is a dataset with poses: name it instead to use them"
        ));
    }
    let photos = input.reading.images.clone().unwrap_or_else(|| input.data.clone());
    pose_all(input, &photos, None, poses, anyway)?;
    Ok(())
}

/// Poses the capture `photos`, or `only` some of its photographs, into the folder `posed` of the run of `input`, and makes that its dataset.
/// Fails if too few can be posed, unless `anyway`.
pub fn pose_all(
    input: &mut TrainInput,
    photos: &Path,
    only: Option<HashSet<PathBuf>>,
    poses: Poses,
    anyway: bool,
) -> Result<PoseReport> {
    let report = pose_into_run(input, photos, poses, only)?;
    let posed = &input.data;
    if report.fraction() < MIN_POSED_FRACTION && !anyway {
        let reasons: Vec<&str> = report
            .findings
            .iter()
            .filter(|f| f.kind != "left-out")
            .map(|f| f.sentence.as_str())
            .collect();
        let first = reasons.first().map_or(String::new(), |first| format!(" {first};"));
        let doctor = posed.join("doctor.html");
        let see = if doctor.exists() {
            format!(" see {};", doctor.display())
        } else {
            String::new()
        };
        // Poses by COLMAP would be compared with the photographs first.
        let given = if poses == Poses::Colmap { " --poses given" } else { "" };
        let overwrite = if input.overwrite { " --overwrite" } else { "" };
        return Err(Usage(format!(
            "only {} of {} photographs have poses:{first}{see} add photographs between them and the others, or train --anyway, or without \
             posing again: irradia train {} --out {}{given}{overwrite}",
            report.registered,
            report.photos,
            posed.display(),
            input.out.display(),
        ))
        .into());
    }
    Ok(report)
}

/// As [`pose_first`], for photographs whose poses in `dataset` are not used; the same views are held out, left out and trained on. Fails if
/// no pose is found for a held-out view, or for more than a few of the others, unless `anyway`, which trains on those with poses.
pub fn pose_again(input: &mut TrainInput, dataset: &Dataset, poses: Poses, anyway: bool) -> Result<()> {
    let names_of = |views: &[usize]| -> Vec<String> {
        let names = views.iter().map(|view| bare_name(&dataset.views[*view].name));
        names.map(str::to_owned).collect()
    };
    let (train, test) = (names_of(&dataset.train), names_of(&dataset.test));
    let mut listed = HashSet::new();
    if let Some(name) = train.iter().chain(&test).find(|name| !listed.insert(*name)) {
        return Err(Usage(format!(
            "several photographs are called {name}, but held-out ones are identified by their names: train with --poses given, or rename \
             them"
        ))
        .into());
    }
    let photos = photo_folder(input);
    let report = pose_into_run(input, &photos, poses, files_of(dataset, &photos))?;
    let left_out: HashSet<&str> = report.left_out.iter().map(|left| bare_name(&left.name)).collect();
    let is_lost = |name: &&String| left_out.contains(name.as_str());
    let held_out: Vec<&str> = test.iter().filter(|name| !is_lost(name)).map(String::as_str).collect();
    let (train, test) = (train.iter().filter(is_lost).count(), test.len() - held_out.len());
    if !anyway && (test > 0 || train as f64 > (1.0 - MIN_POSED_FRACTION) * dataset.train.len() as f64) {
        return Err(Usage(format!(
            "no new pose was found for {train} of {} training views and {test} of {} held-out ones; train with --poses given, or with --anyway on the others",
            dataset.train.len(),
            dataset.test.len()
        ))
        .into());
    }
    // By another split, other views would be held out; without any, every 8th.
    input.reading.holdout = held_out.is_empty().then(|| "0".to_owned());
    if !held_out.is_empty() {
        let list = input.data.join(SPLIT_FILE);
        let names = held_out.join("\n") + "\n";
        write_atomic(&list, |out| out.write_all(names.as_bytes()))?;
    }
    Ok(())
}

/// The folder that contains the photographs of a dataset.
pub fn photo_folder(input: &TrainInput) -> PathBuf {
    match &input.reading.images {
        Some(images) => images.clone(),
        // A file that describes the dataset; the folder of a bare name is the current one.
        None if input.data.is_file() => folder_of(&input.data).unwrap_or(Path::new(".")).to_owned(),
        None => input.data.clone(),
    }
}

/// All photographs in the folders of those of `dataset`, if it has poses of fewer than half of them: a program that could not connect
/// photographs may have kept a model of three. Rendered scenes name the views of each split, and may name few.
pub fn mostly_unposed(input: &TrainInput, dataset: &Dataset) -> Option<HashSet<PathBuf>> {
    let folder = photo_folder(input);
    let posed = files_of(dataset, &folder).filter(|_| dataset.kind != "Blender")?;
    let folders: HashSet<&Path> = posed.iter().filter_map(|file| file.parent()).collect();
    let mut all = photographs_in(&folder);
    all.retain(|file| file.parent().is_some_and(|folder| folders.contains(folder)));
    (2 * posed.len() < all.len()).then(|| all.into_iter().collect())
}

/// The files below `folder` of the photographs that `dataset` trains on or holds out; `None` if that of a view cannot be told.
fn files_of(dataset: &Dataset, folder: &Path) -> Option<HashSet<PathBuf>> {
    let mut by_name: HashMap<String, Vec<PathBuf>> = HashMap::new();
    for file in photographs_in(folder) {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        by_name.entry(bare_name(&name).to_owned()).or_default().push(file);
    }
    let file_of = |name: &str| {
        let files = by_name.get(bare_name(name))?;
        // Other folders may have photographs of the same name.
        let is_exact = |file: &&PathBuf| file.with_extension("").ends_with(Path::new(name).with_extension(""));
        let exact = files.iter().find(is_exact);
        exact.or(files.first().filter(|_| files.len() == 1)).cloned()
    };
    let used = dataset.train.iter().chain(&dataset.test);
    used.map(|view| file_of(&dataset.views[*view].name)).collect()
}

/// The last part of a view's name, without extension: a dataset may name photographs with the extension that they had before a conversion.
fn bare_name(name: &str) -> &str {
    let last = name.rsplit('/').next().unwrap_or(name);
    last.rsplit_once('.').map_or(last, |(bare, _)| bare)
}

/// Poses the capture `photos`, or `only` some of its photographs, into the folder `posed` of the run of `input`, and makes that its dataset.
fn pose_into_run(
    input: &mut TrainInput,
    photos: &Path,
    poses: Poses,
    only: Option<HashSet<PathBuf>>,
) -> Result<PoseReport> {
    let posed = input.out.join(POSED_FOLDER);
    note(format_args!("finding poses, which are written to {}", posed.display()));
    input.data.clone_from(&posed);
    (input.reading.format, input.reading.images) = (None, None);
    let request = PoseInput {
        mapper: poses.into(),
        only,
        ..PoseInput::new(photos, &posed)
    };
    let report = pose_with_progress(&request)?;
    note(summary(&report));
    let list = posed.join(SPLIT_FILE);
    if list.exists() {
        // Of an earlier run.
        std::fs::remove_file(&list).with_context(|| format!("cannot remove {}", list.display()))?;
    }
    Ok(report)
}

fn pose_with_progress(input: &PoseInput) -> Result<PoseReport> {
    let report = with_progress(|progress| pose(input, progress)).map_err(with_option_names)?;
    let unread = |name: &str| {
        !report
            .findings
            .iter()
            .any(|f| f.kind == "left-out" && f.photos == [name])
    };
    // One line per reason.
    let unreported = report.left_out.iter().filter(|left| unread(&left.name));
    for (reason, names) in group_by_reason(unreported.map(|left| (&left.name[..], &left.reason[..]))) {
        let first = names[0];
        match names.len() - 1 {
            0 => note(format_args!("left out: {first}: {reason}")),
            1 => note(format_args!("left out: {first} and 1 other: {reason}")),
            others => note(format_args!("left out: {first} and {others} others: {reason}")),
        }
    }
    print_findings(&report.findings, |line| {
        note(line);
        Ok(())
    })?;
    Ok(report)
}

/// Runs `work` with its progress on display.
pub fn with_progress<T>(work: impl FnOnce(&(dyn Fn(PoseProgress) + Sync)) -> T) -> T {
    let display = Mutex::new(Display::new());
    let result = work(&|event| {
        // A thread that panicked while it held the display ends everything anyway.
        if let Ok(mut display) = display.lock() {
            display.show(event);
        }
    });
    if let Ok(display) = display.into_inner() {
        display.clear();
    }
    result
}

/// One line per finding, at most [`MAX_PRINTED_FINDINGS`] of each kind.
pub fn print_findings(findings: &[Finding], mut print: impl FnMut(&str) -> Result<()>) -> Result<()> {
    for (i, finding) in findings.iter().enumerate() {
        let same = |other: &&Finding| other.kind == finding.kind;
        match findings[..i].iter().filter(same).count() {
            before if before < MAX_PRINTED_FINDINGS => print(&format!("{}: {}", finding.kind, finding.sentence))?,
            MAX_PRINTED_FINDINGS => {
                let more = findings[i..].iter().filter(same).count();
                print(&format!("{}: {more} more such findings", finding.kind))?;
            }
            _ => {}
        }
    }
    Ok(())
}

/// `48 of 50 photographs posed, ..; features 3.1 s, ..`
fn summary(report: &PoseReport) -> String {
    let stages: Vec<String> = report
        .stages
        .iter()
        .map(|stage| format!("{} {:.1} s", stage.name, stage.seconds))
        .collect();
    let unit = report.scale.as_ref().map_or(String::new(), |scale| {
        let by = match scale.distances {
            0 => format!("the recorded positions of {} photographs", scale.photos),
            1 => "a known distance".to_owned(),
            several => format!("{several} known distances"),
        };
        format!("; in metres by {by}, to {:.1} %", 100.0 * scale.scale_error)
    });
    // COLMAP's error is not read.
    let error = match report.mean_error_px {
        0.0 => String::new(),
        pixels => format!(", mean error {pixels:.2} px"),
    };
    format!(
        "{} of {} photographs posed, {} points{error}{unit}; {}; {:.1} s in all",
        report.registered,
        report.photos,
        report.points,
        stages.join(", "),
        report.seconds
    )
}

/// Progress of the stages: a bar, or plain lines without a terminal.
struct Display {
    bar: Option<ProgressBar>,
    stage: &'static str,
    of: usize,
    last_line: Instant,
}

impl Display {
    fn new() -> Self {
        Self {
            bar: std::io::stderr().is_terminal().then(|| {
                let style = "{bar:16} {pos}/{len} {msg} {elapsed} eta {eta}";
                ProgressBar::new(0).with_style(ProgressStyle::with_template(style).expect("a valid template"))
            }),
            stage: "",
            of: 0,
            last_line: Instant::now(),
        }
    }

    fn show(&mut self, event: PoseProgress) {
        match (event, &self.bar) {
            (PoseProgress::Stage { name, of }, bar) => {
                (self.stage, self.of) = (name, of);
                if let Some(bar) = bar {
                    bar.reset();
                    bar.set_length(of as u64);
                    bar.set_message(name);
                }
            }
            (PoseProgress::Done(done), Some(bar)) => bar.set_position(done as u64),
            (PoseProgress::Done(done), None) if self.last_line.elapsed() >= LINE_INTERVAL => {
                match self.of {
                    0 => note(format_args!("{} {done}", self.stage)),
                    of => note(format_args!("{} {done}/{of}", self.stage)),
                }
                self.last_line = Instant::now();
            }
            (PoseProgress::Done(_), None) => {}
            (PoseProgress::Warned(line), Some(bar)) => bar.suspend(|| note(format_args!("warning: {line}"))),
            (PoseProgress::Warned(line), None) => note(format_args!("warning: {line}")),
        }
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
