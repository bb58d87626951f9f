//! The capture doctor on files: `doctor.json`, and `doctor.html` with thumbnails and a plan.

use super::capture::Capture;
use super::stages::{Work, to_rgb};
use super::{PoseProgress, check_photo_count, group_by_reason};
use crate::RunError;
use crate::folder::to_json;
use irradia_formats::{PhotoFolder, write_atomic, write_png};
use irradia_sfm::PairMatches;
use irradia_sfm::doctor::{Diagnosis, Evidence, diagnose, shots};
use irradia_sfm::map::{MapOptions, Model, PhotoInfo, Reconstruction, StillRegion, verify};
use irradia_sfm::matching::PairOptions;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The report, its page, and the folder of its thumbnails.
const REPORT_FILE: &str = "doctor.json";
const PAGE_FILE: &str = "doctor.html";
const THUMBNAILS_FOLDER: &str = "doctor";
/// The page, with a place for the report.
const PAGE_TEMPLATE: &str = include_str!("doctor.html");
/// Longer side of the thumbnails, px.
const THUMBNAIL_SIDE: u32 = 240;
/// Maximum number of findings with thumbnails.
const MAX_FINDINGS_WITH_THUMBNAILS: usize = 60;
/// Maximum number of points in the plan.
const MAX_PLAN_POINTS: usize = 2000;

/// A request for a diagnosis.
#[derive(Clone, Debug, PartialEq)]
pub struct DoctorInput {
    /// Folders of photographs and films, and films. Films need `out`.
    pub photos: Vec<PathBuf>,
    /// The folder for the report, features and matches; if `None`, nothing is written.
    pub out: Option<PathBuf>,
    /// Maximum number of features per photograph, at least 1; depends on the number of photographs if `None`.
    pub max_features: Option<usize>,
}

impl DoctorInput {
    /// A request with the default options; nothing is written.
    pub fn new(photos: impl Into<PathBuf>) -> Self {
        Self {
            photos: vec![photos.into()],
            out: None,
            max_features: None,
        }
    }
}

/// What is wrong with a capture; `doctor.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DoctorReport {
    /// Number of photographs found.
    pub photos: usize,
    /// The findings, the most serious first.
    pub findings: Vec<Finding>,
    /// Cameras and points seen from above, if there is a model.
    pub plan: Option<Plan>,
    /// Total seconds; set only by [`doctor`].
    pub seconds: f64,
}

/// One fault of a capture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Its kind, such as `blurred`.
    pub kind: &'static str,
    /// What is wrong and what to do, in one sentence.
    pub sentence: String,
    /// Names of the photographs at fault.
    pub photos: Vec<String>,
    /// Photographs on both sides of the fault, of which the page shows thumbnails.
    pub sides: Vec<String>,
    /// Where further photographs would fix it.
    pub shoot: Vec<Place>,
    #[serde(skip)]
    thumbnail_photos: Vec<usize>,
}

/// A camera, or a place from which to take a photograph. The coordinates are those of the model or, if it kept poses that were known,
/// those in which it is upright.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Place {
    /// The photograph's name; empty for one to be taken.
    pub name: String,
    /// Position; up is +Z, and the cameras' median distance from the origin is 1, unless the model is in metres.
    pub position: [f64; 3],
    /// Unit viewing direction.
    pub forward: [f64; 3],
}

/// A model seen from above.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// All cameras.
    pub cameras: Vec<Place>,
    /// Some of the points, x and y.
    pub points: Vec<[f32; 2]>,
}

/// Examines the pixels, features and pairs of photographs, without mapping them.
///
/// # Errors
/// When there are fewer than three photographs, or a file cannot be read or written.
pub fn doctor(input: &DoctorInput, progress: &(dyn Fn(PoseProgress) + Sync)) -> Result<DoctorReport, RunError> {
    let started = Instant::now();
    if input.max_features == Some(0) {
        return Err(RunError::setting("max_features", 0, "must be 1 or more"));
    }
    if let Some(out) = &input.out {
        fs::create_dir_all(out).map_err(RunError::io("create", out))?;
    }
    let capture = Capture::read(&input.photos, &|_| true, input.out.as_deref(), false, progress)?;
    let folder = &capture.folder;
    check_photo_count(&input.photos, folder)?;
    let mut work = Work::new(input.max_features, input.out.as_deref(), folder, progress);
    work.find_features()?;
    let pairs = work.match_pairs(&PairOptions::default())?;
    let infos = capture.infos(work.photos());
    let (cameras, verified) = verify(&infos, work.features(), &pairs, &MapOptions::default(), &mut |_| ());
    let found = Reconstruction {
        pairs: verified,
        cameras,
        ..Reconstruction::default()
    };
    let mut report = examine(&work, &infos, &pairs, &found, None, false);
    add_unreadable(&mut report, folder, &work);
    report.seconds = started.elapsed().as_secs_f64();
    if let Some(out) = &input.out {
        write(out, folder, &work, &report)?;
    }
    Ok(report)
}

/// Diagnoses a capture after verification, or after mapping if there is a model; `masked` is what stood still before it was masked. The
/// world of `is_known` poses may have any origin, unit and up.
pub(super) fn examine(
    work: &Work,
    infos: &[PhotoInfo],
    matches: &[PairMatches],
    found: &Reconstruction,
    masked: Option<&StillRegion>,
    is_known: bool,
) -> DoctorReport {
    let upright = found.models.first().filter(|_| is_known);
    let upright = upright.map(|model| model.clone().upright(infos));
    let model = upright.as_ref().or(found.models.first());
    let evidence = Evidence {
        photos: infos,
        appearances: work.appearances(),
        features: work.features(),
        colors: work.colors(),
        matches,
        masked,
        pairs: &found.pairs,
        cameras: &found.cameras,
        models: &found.models,
        zooms: &found.zooms,
        own_focals: found.own_focals,
        missing: &found.missing,
        split_models: found.split_models,
        left_out: &found.left_out,
    };
    let names: Vec<String> = infos.iter().map(|info| info.name.clone()).collect();
    let findings = diagnose(&evidence)
        .iter()
        .map(|diagnosis| finding(diagnosis, &names, model))
        .collect();
    DoctorReport {
        photos: infos.len(),
        findings,
        plan: model.map(|model| plan(model, infos)),
        seconds: 0.0,
    }
}

fn finding(diagnosis: &Diagnosis, names: &[String], model: Option<&Model>) -> Finding {
    let (first, second) = diagnosis.sides();
    let thumbnail_photos: Vec<usize> = std::iter::once(first).chain(second).collect();
    let shoot = model.map_or(Vec::new(), |model| shots(diagnosis, model));
    Finding {
        kind: diagnosis.kind().name(),
        sentence: diagnosis.sentence(names).to_string(),
        photos: diagnosis.photos().into_iter().map(|p| names[p].clone()).collect(),
        sides: thumbnail_photos.iter().map(|p| names[*p].clone()).collect(),
        shoot: shoot
            .into_iter()
            .map(|shot| Place {
                name: String::new(),
                position: shot.position.to_array(),
                forward: shot.forward.to_array(),
            })
            .collect(),
        thumbnail_photos,
    }
}

/// Adds findings about photographs that are left out before any examination; those with the same reason are one finding.
pub(super) fn add_unreadable(report: &mut DoctorReport, folder: &PhotoFolder, work: &Work) {
    report.photos += folder.left_out.len();
    let unused = folder.unused().chain(work.undecodable());
    let unused = unused.map(|(name, reason)| (name.as_str(), reason.as_str()));
    report
        .findings
        .extend(group_by_reason(unused).into_iter().map(|(reason, names)| {
            let who = match &names[..] {
                [one] => format!("{one} is"),
                [first, others @ ..] => format!("{first} and {} more are", others.len()),
                [] => unreachable!("a reason has a name"),
            };
            Finding {
                kind: irradia_sfm::doctor::Kind::LeftOut.name(),
                sentence: format!("{who} left out: {reason}"),
                photos: names.into_iter().map(str::to_owned).collect(),
                sides: Vec::new(),
                shoot: Vec::new(),
                thumbnail_photos: Vec::new(),
            }
        }));
}

fn plan(model: &Model, infos: &[PhotoInfo]) -> Plan {
    let cameras = infos
        .iter()
        .zip(&model.poses)
        .filter_map(|(info, pose)| {
            let pose = pose.as_ref()?;
            Some(Place {
                name: info.name.clone(),
                position: pose.position.to_array(),
                forward: (pose.rotation * glam::DVec3::Z).to_array(),
            })
        })
        .collect();
    let step = model.points.len().div_ceil(MAX_PLAN_POINTS).max(1);
    let points = model
        .points
        .iter()
        .step_by(step)
        .map(|p| [p.position.x as f32, p.position.y as f32]);
    Plan {
        cameras,
        points: points.collect(),
    }
}

/// Writes the report, its page and its thumbnails.
pub(super) fn write(out: &Path, folder: &PhotoFolder, work: &Work, report: &DoctorReport) -> Result<(), RunError> {
    let pictures = out.join(THUMBNAILS_FOLDER);
    if pictures.exists() && out.join("doctor.json").exists() {
        // The thumbnails of an earlier call.
        fs::remove_dir_all(&pictures).map_err(RunError::io("clear", &pictures))?;
    }
    let shown: BTreeMap<&str, usize> = report
        .findings
        .iter()
        .take(MAX_FINDINGS_WITH_THUMBNAILS)
        .flat_map(|finding| {
            finding
                .sides
                .iter()
                .map(String::as_str)
                .zip(finding.thumbnail_photos.iter().copied())
        })
        .collect();
    for (name, photo) in shown {
        let (size, rgb) = thumbnail(&folder.photos[work.photos()[photo]])?;
        write_png(&pictures.join(format!("{name}.png")), size[0], size[1], 3, &rgb)?;
    }
    let json = to_json(report);
    // Within a script element only `<` can end the data; JSON strings may escape any character.
    let data = String::from_utf8_lossy(&json).replace('<', "\\u003c");
    let page = PAGE_TEMPLATE.replace("/*DATA*/", &data);
    write_atomic(&out.join(REPORT_FILE), |file| file.write_all(&json))?;
    write_atomic(&out.join(PAGE_FILE), |file| file.write_all(page.as_bytes()))?;
    Ok(())
}

/// A photograph, reduced by an integer factor to about [`THUMBNAIL_SIDE`]: its size and RGB.
fn thumbnail(photo: &irradia_formats::PhotoEntry) -> Result<([u32; 2], Vec<u8>), RunError> {
    let pixels = photo.read(THUMBNAIL_SIDE)?;
    let size = [pixels.width, pixels.height];
    let factor = size[0].max(size[1]).div_ceil(THUMBNAIL_SIDE).max(1);
    let to = size.map(|side| (side / factor).max(1));
    Ok((to, to_rgb(&pixels, to)))
}
