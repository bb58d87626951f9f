//! Photographs and films in, a posed dataset out.
//!
//! ```text
//! images/          the posed photographs: links to the originals where the file system allows, otherwise copies
//! frames/, faces/  frames of films; panoramas and their faces; images/ links to both
//! sparse/0/*.bin   cameras, poses and points with tracks, in COLMAP's format; further models in sparse/1, ..
//! pose.json        the report: numbers, times, and each photograph left out with its reason
//! doctor.html      what is wrong with the capture, and where to take further photographs; doctor.json and doctor/*.png belong to it
//! masks/           masks of the photographs, or of what stands still in them while the rest moves
//! features.bin     features and matches, reused as long as photographs do not change; features-masked.bin: those found with masks of what
//!                  stands still; features-more.bin: those of a second attempt
//! ```

mod attempt;
mod capture;
mod check;
mod colmap;
mod doctor;
mod feature_store;
mod film;
mod import;
mod known;
mod metric_scale;
mod output;
mod points;
mod stages;
mod still;
mod view_features;

use crate::RunError;
use crate::folder::to_json;
use attempt::{Attempt, Matched};
use capture::Capture;
use irradia_formats::{PhotoFolder, write_atomic};
use irradia_sfm::doctor::Kind;
use irradia_sfm::map::{MapOptions, PhotoInfo, Reconstruction};
use known::KnownPoses;
use serde::{Deserialize, Serialize};
use stages::Work;
use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;
use still::Masked;

pub use capture::{is_capture, photographs_in};
pub use check::{PoseCheck, check_poses};
pub use doctor::{DoctorInput, DoctorReport, Finding, doctor};
use film::is_film;
pub use film::is_film_name;
pub(crate) use points::{find_points, lacks_points};

/// The fraction of the photographs that should have a pose: below it, a second attempt is made, and training does not start automatically.
pub const MIN_POSED_FRACTION: f64 = 0.8;
/// Minimum number of photographs of a dataset.
const MIN_PHOTOS: usize = 3;
/// File name of the report.
const REPORT_FILE: &str = "pose.json";

/// A request for poses.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseInput {
    /// Folders of photographs and films, and films. If a folder has neither, its subfolders are searched.
    pub photos: Vec<PathBuf>,
    /// The folder of the dataset; created if missing.
    pub out: PathBuf,
    /// The files of the photographs to use, as [`photographs_in`] names them; others beside them are ignored. `None`: all.
    pub only: Option<HashSet<PathBuf>>,
    /// Whether to add the photographs to the dataset in `out`, in COLMAP's format, whose poses and cameras do not change.
    pub into: bool,
    /// Known distances between cameras, by which the poses are scaled to metres.
    pub distances: Vec<KnownDistance>,
    /// The program that finds the poses.
    pub mapper: Mapper,
    /// The executable that [`Mapper::Colmap`] runs.
    pub colmap: String,
    /// Maximum number of features per photograph, at least 1; depends on the number of photographs if `None`.
    pub max_features: Option<usize>,
    /// Options of verification and mapping.
    pub mapping: MapOptions,
}

impl PoseInput {
    /// A request with the default options.
    pub fn new(photos: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self {
            photos: vec![photos.into()],
            out: out.into(),
            only: None,
            into: false,
            distances: Vec::new(),
            mapper: Mapper::default(),
            colmap: "colmap".to_owned(),
            max_features: None,
            mapping: MapOptions::default(),
        }
    }
}

/// A distance between the places from which two photographs were taken.
#[derive(Clone, Debug, PartialEq)]
pub struct KnownDistance {
    /// Their file names.
    pub photos: [String; 2],
    /// Metres.
    pub metres: f64,
}

/// The program that finds poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mapper {
    /// This program.
    #[default]
    Irradia,
    /// COLMAP, which must be installed; it gives no reason for the photographs that it leaves out.
    Colmap,
}

/// What [`pose`] is doing.
#[derive(Clone, Debug, PartialEq)]
pub enum PoseProgress {
    /// A stage begins.
    Stage {
        /// `frames`, `features`, `matches` or `poses`.
        name: &'static str,
        /// Steps of the stage: photographs or pairs; 0 if their number is unknown, as for the frames of a film.
        of: usize,
    },
    /// This many steps of the stage are done.
    Done(usize),
    /// Something the user should know.
    Warned(String),
}

/// The result of [`pose`]; `pose.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PoseReport {
    /// Number of photographs found.
    pub photos: usize,
    /// Number of photographs with a pose in the largest model.
    pub registered: usize,
    /// Photographs without a pose in the largest model.
    pub left_out: Vec<LeftOutPhoto>,
    /// Number of photographs of each model, largest first; each model has its own world.
    pub models: Vec<usize>,
    /// Number of points of the largest model.
    pub points: usize,
    /// Mean reprojection error of the largest model, px; 0 if COLMAP found it.
    pub mean_error_px: f64,
    /// How the largest model was scaled to metres; `None` if its unit is arbitrary.
    pub scale: Option<ScaleReport>,
    /// Cameras of the largest model.
    pub cameras: Vec<CameraReport>,
    /// The searches for poses. A second one, with frontal descriptors, is made if too few photographs have a pose or if pairs contradict
    /// the model of few photographs; [`pose`] says when it replaces the first.
    pub attempts: Vec<AttemptReport>,
    /// Number of pairs of photographs that were matched.
    pub pairs: usize,
    /// Number of pairs with a common geometry.
    pub verified_pairs: usize,
    /// Seconds per stage, in order.
    pub stages: Vec<StageReport>,
    /// Total seconds.
    pub seconds: f64,
    /// Warnings for the user.
    pub warnings: Vec<String>,
    /// What is wrong with the capture, the most serious first.
    pub findings: Vec<Finding>,
    /// The program that found the poses.
    pub poses_by: PoseSource,
}

/// The program that found the poses of a dataset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseSource {
    /// This program, which has checked them.
    #[default]
    Irradia,
    /// COLMAP, run by this program.
    Colmap,
    /// Another program; this one found the poses of photographs that were added.
    Others,
}

/// One search for poses; [`PoseReport::attempts`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AttemptReport {
    /// Maximum number of features per photograph.
    pub max_features: usize,
    /// Whether features were also matched by frontal descriptors.
    pub frontal: bool,
    /// Number of photographs with a pose in its largest model.
    pub registered: usize,
    /// Its warnings.
    pub warnings: Vec<String>,
}

impl PoseReport {
    /// The fraction of the photographs that have a pose.
    pub fn fraction(&self) -> f64 {
        self.registered as f64 / self.photos.max(1) as f64
    }
}

/// A photograph without a pose.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LeftOutPhoto {
    /// File name.
    pub name: String,
    /// Why.
    pub reason: String,
}

/// Groups the names of `named`, each a `(name, reason)`, by reason; reasons are in the order of their first occurrence.
pub fn group_by_reason<'a>(named: impl Iterator<Item = (&'a str, &'a str)>) -> Vec<(&'a str, Vec<&'a str>)> {
    let mut reasons: Vec<(&str, Vec<&str>)> = Vec::new();
    for (name, reason) in named {
        match reasons.iter_mut().find(|(other, _)| *other == reason) {
            Some((_, names)) => names.push(name),
            None => reasons.push((reason, vec![name])),
        }
    }
    reasons
}

/// A camera of the largest model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraReport {
    /// Number of its photographs.
    pub photos: usize,
    /// Width and height, px.
    pub size: [u32; 2],
    /// Focal length, mean of both axes, px.
    pub focal_px: f64,
    /// Principal point, px: the image centre, unless photographs are crops of larger ones.
    pub principal_px: [f64; 2],
    /// Whether the metadata of its photographs contain the focal length.
    pub focal_known: bool,
    /// Whether the focal length was fixed because nothing in the photographs determines it.
    pub focal_held: bool,
}

/// The scale of a model in metres, determined by the GPS positions of the photographs (+X is then east and +Y north) or by known distances.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ScaleReport {
    /// Number of known distances that determine the scale; 0 if GPS positions do.
    pub distances: usize,
    /// Number of photographs whose GPS positions agree with the model.
    pub photos: usize,
    /// Number of posed photographs that have a GPS position.
    pub with_place: usize,
    /// Root mean square residual, m: of horizontal distances between GPS positions and the model, or of known distances.
    pub residual_m: f64,
    /// Relative standard deviation of the scale. With a single distance it contains only the contribution of the poses: how well distances
    /// were measured shows only if there are several.
    pub scale_error: f64,
}

/// The time that a stage took.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageReport {
    /// `photographs` (including frames of films and faces of panoramas), `features`, `matches`, `masks`, `poses`, `doctor`, `writing` or
    /// `colmap`.
    pub name: &'static str,
    /// Wall time.
    pub seconds: f64,
}

/// Finds the poses of photographs and writes them as a dataset. Features and matches of an earlier call are reused.
///
/// If fewer than [`MIN_POSED_FRACTION`] of the photographs have a pose at first, or any of up to 25 photographs has none, or pairs of up to
/// 25 contradict the model, a second attempt is made with frontal descriptors. Its model replaces the first one if it is larger by a
/// twentieth of the photographs and contains half of them, or if it is as large and contradicted half as often.
///
/// The result depends neither on the number of threads nor on the order of the files.
///
/// # Errors
/// When options exclude each other, there are fewer than three photographs, a film cannot be read, no three photographs can be posed
/// together, a distance is not between two posed photographs, `out` contains a dataset that was not written by this function, or no dataset
/// to which photographs could be added, or a file cannot be written.
pub fn pose(input: &PoseInput, progress: &(dyn Fn(PoseProgress) + Sync)) -> Result<PoseReport, RunError> {
    let started = Instant::now();
    check_input(input)?;
    let out = &input.out;
    let known = if input.into {
        Some(KnownPoses::read(out)?)
    } else {
        check_free(out)?;
        None
    };
    fs::create_dir_all(out).map_err(RunError::io("create", out))?;
    let mut clock = StageTimer::new();
    let capture = read_capture(input, known.as_ref(), progress)?;
    import::clear_stale(out, &capture.folder.photos)?;
    clock.end("photographs");
    let mut posing = Posing {
        input,
        capture: &capture,
        progress,
        clock,
    };
    let report = match input.mapper {
        Mapper::Irradia => posing.pose_with_irradia(known)?,
        Mapper::Colmap => posing.pose_with_colmap()?,
    };
    posing.finish_report(report, started)
}

/// Rejects options that are out of range or exclude each other, before anything is read or written.
fn check_input(input: &PoseInput) -> Result<(), RunError> {
    if input.max_features == Some(0) {
        return Err(RunError::setting("max_features", 0, "must be 1 or more"));
    }
    if input.into && !input.distances.is_empty() {
        return Err(RunError::setting(
            "into",
            input.out.display(),
            "adding photographs does not change the unit: leave out --distance",
        ));
    }
    if input.mapper == Mapper::Colmap && !input.distances.is_empty() {
        return Err(RunError::setting(
            "poses",
            "colmap",
            "COLMAP's poses are not scaled: leave out --distance or --poses colmap",
        ));
    }
    if input.mapper == Mapper::Colmap && input.into {
        return Err(RunError::setting(
            "poses",
            "colmap",
            "COLMAP cannot add photographs to a dataset: leave out --into or --poses colmap",
        ));
    }
    Ok(())
}

/// Reads the photographs to pose, and those of the dataset to which they are added, whose poses are `known`.
fn read_capture(
    input: &PoseInput,
    known: Option<&KnownPoses>,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<Capture, RunError> {
    let is_chosen = |path: &Path| input.only.as_ref().is_none_or(|only| only.contains(path));
    let mut capture = Capture::read(&input.photos, &is_chosen, Some(&input.out), input.into, progress)?;
    still::ignore_own_masks(&mut capture.folder.photos, &input.out)?;
    if let Some(known) = known {
        capture.folder = known.combined_with(capture.folder)?;
    }
    check_photo_count(&input.photos, &capture.folder)?;
    metric_scale::check_distances(&input.distances, &capture.folder)?;
    Ok(capture)
}

/// A call of [`pose`] whose photographs have been read.
struct Posing<'a> {
    input: &'a PoseInput,
    capture: &'a Capture,
    progress: &'a (dyn Fn(PoseProgress) + Sync),
    clock: StageTimer,
}

impl Posing<'_> {
    /// Has COLMAP find the poses and write them; returns the report without times.
    fn pose_with_colmap(&mut self) -> Result<PoseReport, RunError> {
        let report = colmap::run(self.input, self.capture, self.progress)?;
        self.clock.end("colmap");
        Ok(report)
    }

    /// Finds the poses, or those of photographs that are not `known`, and writes them; returns the report without times.
    fn pose_with_irradia(&mut self, known: Option<KnownPoses>) -> Result<PoseReport, RunError> {
        let (input, capture, progress) = (self.input, self.capture, self.progress);
        let out = &input.out;
        let known_model = known.as_ref().map(|known| known.model.clone());
        let poses_by = match known {
            Some(_) => pose_source(out).unwrap_or(PoseSource::Others),
            None => PoseSource::Irradia,
        };
        let is_new = known.is_none();
        let may_mask = is_new && !capture.has_panoramas();
        let work = Work::new(input.max_features, Some(out), &capture.folder, progress);
        let mut matched = Matched::find(work, capture, false, &mut self.clock)?;
        let masked = if may_mask {
            still::mask(&matched, &capture.folder, out, progress)?
        } else {
            None
        };
        if let Some(masked) = &masked {
            self.clock.end("masks");
            let work = matched.work.masked(&masked.folder, out);
            matched = Matched::find(work, capture, true, &mut self.clock)?;
        }
        let mut attempt = matched.map(&input.mapping, known, &mut self.clock, progress)?;
        let mut attempts = vec![attempt.report()];
        if is_new && let Some(second) = self.second_attempt(&attempt, masked.is_some())? {
            attempts.push(second.report());
            if second.replaces(&attempt) {
                attempt = second;
            }
        }
        let mask_message = match &masked {
            Some(masked) => Some(masked.message.clone()),
            None if may_mask => self.mask_after_posing(&attempt)?,
            None => None,
        };
        let mut report = self.write(attempt, masked.as_ref(), known_model.as_deref())?;
        report.poses_by = poses_by;
        report.attempts = attempts;
        report.warnings.extend(mask_message);
        Ok(report)
    }

    /// The second attempt, if the `first` one gives a reason for it; `masked` as in [`Matched::find`].
    fn second_attempt<'b>(&mut self, first: &Attempt<'b>, masked: bool) -> Result<Option<Attempt<'b>>, RunError> {
        let Some(reason) = first.retry_reason() else {
            return Ok(None);
        };
        let work = first.retry(self.input.max_features, &self.input.out);
        let max_features = work.sift().max_features;
        let guided = if attempt::can_be_guided(self.capture.folder.photos.len()) {
            " and along epipolar lines"
        } else {
            ""
        };
        (self.progress)(PoseProgress::Warned(format!(
            "{reason}: trying again with up to {max_features} features per photograph, matched by frontal \
             descriptors{guided}",
        )));
        let matched = Matched::find(work, self.capture, masked, &mut self.clock)?;
        let second = matched.map(&self.input.mapping, None, &mut self.clock, self.progress)?;
        Ok(Some(second))
    }

    /// Masks what the poses do not need masked: the backdrop of a turntable, otherwise bars and text. Returns the message for the user.
    fn mask_after_posing(&mut self, attempt: &Attempt) -> Result<Option<String>, RunError> {
        let (folder, out) = (&self.capture.folder, &self.input.out);
        let mut message = still::mask_backdrop(attempt, folder, out, self.progress)?;
        if message.is_none() {
            message = still::mask_bars_and_text(attempt, folder, out, self.progress)?;
        }
        if message.is_some() {
            self.clock.end("masks");
        }
        Ok(message)
    }

    /// Scales the model to metres, and writes it and what the doctor finds; `known_model` is the folder of the model to which photographs
    /// were added. Returns the report without times, attempts and the program that found the poses.
    fn write(
        &mut self,
        attempt: Attempt,
        masked: Option<&Masked>,
        known_model: Option<&Path>,
    ) -> Result<PoseReport, RunError> {
        let (input, out) = (self.input, &self.input.out);
        let folder = masked.map_or(&self.capture.folder, |masked| &masked.folder);
        let Attempt {
            matched:
                Matched {
                    mut work,
                    mut infos,
                    pairs,
                    ..
                },
            mut reconstruction,
        } = attempt;
        reconstruction.regroup(&mut infos);
        let scale = match reconstruction.models.first_mut() {
            // Known poses keep their unit.
            Some(model) if known_model.is_none() => {
                let gps_scale = metric_scale::scale_by_gps(folder, &mut work, model);
                metric_scale::scale_by_distances(&input.distances, &infos, &mut work, model)?.or(gps_scale)
            }
            _ => None,
        };
        self.clock.end("poses");
        let still_region = masked.map(|masked| &masked.still);
        let mut examined = doctor::examine(
            &work,
            &infos,
            &pairs,
            &reconstruction,
            still_region,
            known_model.is_some(),
        );
        doctor::add_unreadable(&mut examined, folder, &work);
        doctor::write(out, folder, &work, &examined)?;
        self.clock.end("doctor");
        if reconstruction.models.is_empty() {
            return Err(RunError::Refused(no_model_message(
                &input.photos,
                &infos,
                &reconstruction,
                &examined,
            )));
        }
        output::write(out, folder, &work, &infos, &reconstruction, known_model)?;
        self.clock.end("writing");
        Ok(PoseReport {
            findings: examined.findings,
            scale,
            pairs: pairs.len(),
            warnings: work.warnings().to_vec(),
            ..output::report(folder, &work, &infos, &reconstruction)
        })
    }

    /// Completes the report with its times, and writes it.
    fn finish_report(self, mut report: PoseReport, started: Instant) -> Result<PoseReport, RunError> {
        report.stages = self.clock.stages;
        report.seconds = started.elapsed().as_secs_f64();
        let file = self.input.out.join(REPORT_FILE);
        write_atomic(&file, |file| file.write_all(&to_json(&report)))?;
        Ok(report)
    }
}

/// The program that found the poses in `data`, if [`pose`] wrote the model there or added to it.
pub fn pose_source(data: &Path) -> Option<PoseSource> {
    #[derive(Deserialize)]
    struct StoredReport {
        // Missing in reports of earlier versions.
        #[serde(default)]
        poses_by: PoseSource,
    }
    let report = fs::read(data.join(REPORT_FILE)).ok()?;
    Some(serde_json::from_slice::<StoredReport>(&report).map_or(PoseSource::Irradia, |known| known.poses_by))
}

/// Rejects an output folder with a model that [`pose`] did not write.
fn check_free(out: &Path) -> Result<(), RunError> {
    let foreign = ["sparse", "transforms.json", "transforms_train.json", "poses_bounds.npy"]
        .into_iter()
        .find(|name| out.join(name).exists() && matches!(pose_source(out), None | Some(PoseSource::Others)));
    match foreign {
        Some(name) => Err(RunError::Refused(format!(
            "{} already contains {name} from another source: choose another --out",
            out.display()
        ))),
        None => Ok(()),
    }
}

fn check_photo_count(paths: &[PathBuf], folder: &PhotoFolder) -> Result<(), RunError> {
    if folder.photos.len() >= MIN_PHOTOS {
        return Ok(());
    }
    let reasons: String = folder
        .unused()
        .take(3)
        .map(|(name, reason)| format!("; {name}: {reason}"))
        .collect();
    Err(RunError::Refused(format!(
        "{}: {} readable photographs, at least {MIN_PHOTOS} of different views are needed{reasons}",
        join_paths(paths),
        folder.photos.len()
    )))
}

/// Paths as text for a message.
fn join_paths(paths: &[PathBuf]) -> String {
    let paths: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
    paths.join(", ")
}

/// Why nothing could be posed, and what to do: masks or too little texture if these affect more than half of the photographs, otherwise the
/// doctor's first finding other than a left-out photograph, otherwise the first photograph's reason.
fn no_model_message(
    paths: &[PathBuf],
    photos: &[PhotoInfo],
    found: &Reconstruction,
    examined: &DoctorReport,
) -> String {
    let count = |kind: Kind| {
        examined
            .findings
            .iter()
            .filter(|finding| finding.kind == kind.name())
            .count()
    };
    let (smooth, hidden) = (count(Kind::FewFeatures), count(Kind::Hidden));
    let of_all = examined
        .findings
        .iter()
        .find(|finding| finding.kind != Kind::LeftOut.name());
    let overlap = "take more photographs that overlap by two thirds, from different places";
    let reason = match (of_all, found.left_out.first()) {
        _ if 2 * hidden > photos.len() => {
            format!(
                "{hidden} are masked or transparent nearly everywhere; white parts of a mask count, black ones are hidden"
            )
        }
        _ if 2 * smooth > photos.len() => format!(
            "{smooth} show little texture, or are out of focus; put something textured, such as a newspaper, under or around the subject, \
             or move closer"
        ),
        (Some(finding), _) => format!("{}; {overlap}", finding.sentence),
        (None, Some(left)) => format!("{}: {}; {overlap}", photos[left.photo].name, left.reason),
        (None, None) => overlap.to_owned(),
    };
    format!(
        "{}: no three of {} photographs could be posed together; {reason}",
        join_paths(paths),
        photos.len()
    )
}

/// Measures the time of each stage.
struct StageTimer {
    last: Instant,
    stages: Vec<StageReport>,
}

impl StageTimer {
    fn new() -> Self {
        Self {
            last: Instant::now(),
            stages: Vec::new(),
        }
    }

    /// Adds the time since the end of the last stage to stage `name`.
    fn end(&mut self, name: &'static str) {
        let seconds = self.last.elapsed().as_secs_f64();
        match self.stages.iter_mut().find(|stage| stage.name == name) {
            Some(stage) => stage.seconds += seconds,
            None => self.stages.push(StageReport { name, seconds }),
        }
        self.last = Instant::now();
    }
}
