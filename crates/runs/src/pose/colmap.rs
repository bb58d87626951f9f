//! Poses by COLMAP, if requested: works with any installed version, whose options are taken from its own help.

use super::capture::{Capture, prepare_folder};
use super::import;
use super::stages::max_features;
use super::{LeftOutPhoto, PoseInput, PoseProgress, PoseReport, PoseSource, join_paths, output};
use crate::RunError;
use irradia_formats::{PhotoEntry, PhotoFolder, read_colmap_poses};
use rayon::prelude::*;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// Maximum number of photographs of which COLMAP matches all pairs; with more, it matches successive ones.
const MAX_EXHAUSTIVE_PHOTOS: usize = 300;
/// Folder in the dataset's folder for the masks as COLMAP reads them, removed when it has found the features.
const COLMAP_MASKS_FOLDER: &str = "masks_colmap";
/// File that marks it as written by an earlier call.
const MASKS_RECORD_FILE: &str = "masks.json";

/// Runs COLMAP's feature extraction, matching and mapper on the photographs of `capture`, and puts its models into `sparse` of the dataset.
pub(super) fn run(
    input: &PoseInput,
    capture: &Capture,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<PoseReport, RunError> {
    let folder = &capture.folder;
    let colmap = Colmap::find(&input.colmap)?;
    let out = &input.out;
    let images = out.join(import::IMAGES_FOLDER);
    for photo in &folder.photos {
        import::import_photo(out, photo)?;
    }
    // Also moves files of other photographs to `unused`: COLMAP reads everything in the folder.
    import::record(out, &folder.photos.iter().collect::<Vec<_>>(), false)?;
    let (database, written) = (out.join("colmap.db"), output::begin_models(out)?);
    if database.exists() {
        // COLMAP would add to the database of an earlier call.
        fs::remove_file(&database).map_err(RunError::io("clear", &database))?;
    }
    let stage = |name| progress(PoseProgress::Stage { name, of: 0 });

    stage("features");
    let mut extract = colmap.command("feature_extractor")?;
    extract.path("database_path", &database).path("image_path", &images);
    let one_camera = folder.cameras().iter().all(|camera| *camera == 0);
    let one_size = folder
        .photos
        .iter()
        .all(|photo| photo.size() == folder.photos[0].size());
    extract.option(
        &["ImageReader.single_camera"],
        if one_camera && one_size { "1" } else { "0" },
    );
    extract.option(
        &["FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"],
        colmap.use_gpu(),
    );
    let features = max_features(input.max_features, folder.photos.len()).to_string();
    extract.option(
        &["SiftExtraction.max_num_features", "FeatureExtraction.max_num_features"],
        &features,
    );
    let masks = out.join(COLMAP_MASKS_FOLDER);
    let has_masks = folder.photos.iter().any(|photo| photo.mask.is_some());
    if has_masks {
        // COLMAP reads NAME.png only, and ignores only pixels of the value 0.
        prepare_folder(&masks, MASKS_RECORD_FILE)?;
        let write = |photo: &PhotoEntry| photo.write_mask(&masks.join(format!("{}.png", photo.name)));
        folder.photos.par_iter().try_for_each(write)?;
        extract.option(&["ImageReader.mask_path"], &masks.to_string_lossy());
    }
    let extracted = extract.run();
    if has_masks {
        fs::remove_dir_all(&masks).map_err(RunError::io("clear", &masks))?;
    }
    extracted?;

    stage("matches");
    let in_order = capture.has_films || folder.photos.len() > MAX_EXHAUSTIVE_PHOTOS;
    let mut matching = colmap.command(if in_order {
        "sequential_matcher"
    } else {
        "exhaustive_matcher"
    })?;
    matching.path("database_path", &database);
    matching.option(&["FeatureMatching.use_gpu", "SiftMatching.use_gpu"], colmap.use_gpu());
    matching.run()?;

    stage("poses");
    let mut mapper = colmap.command("mapper")?;
    mapper.path("database_path", &database).path("image_path", &images);
    let mapped = mapper.path("output_path", &written).run();
    if !written.join("0").is_dir() {
        // Some versions report this as a failure, others do not.
        let why = mapped.err().map_or(String::new(), |error| format!(" ({error})"));
        return Err(RunError::Refused(format!(
            "{}: COLMAP found no model{why}; try without --poses colmap, or see irradia doctor",
            join_paths(&input.photos)
        )));
    }
    mapped?;
    output::end_models(out, &written)?;
    report(out, folder)
}

/// The report, as far as COLMAP's files provide it.
fn report(out: &Path, folder: &PhotoFolder) -> Result<PoseReport, RunError> {
    let (_, _, images) = read_colmap_poses(out)?;
    let mut points: Vec<u64> = images.iter().flat_map(|image| image.points.iter().copied()).collect();
    points.sort_unstable();
    points.dedup();
    let reason = "COLMAP left it out of its largest model".to_owned();
    let absent = folder
        .photos
        .iter()
        .filter(|photo| !images.iter().any(|image| image.name == photo.name));
    let absent = absent.map(|photo| (photo.name.clone(), reason.clone()));
    let mut left_out: Vec<LeftOutPhoto> = folder
        .unused()
        .cloned()
        .chain(absent)
        .map(|(name, reason)| LeftOutPhoto { name, reason })
        .collect();
    left_out.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(PoseReport {
        photos: folder.photos.len() + folder.left_out.len(),
        registered: images.len(),
        left_out,
        models: vec![images.len()],
        points: points.len(),
        poses_by: PoseSource::Colmap,
        ..PoseReport::default()
    })
}

/// An installed COLMAP that runs.
struct Colmap {
    program: String,
    /// Whether it was built with CUDA.
    has_cuda: bool,
}

impl Colmap {
    fn find(program: &str) -> Result<Self, RunError> {
        let answer = Command::new(program).arg("help").stdin(Stdio::null()).output();
        let answer = answer.map_err(|error| {
            RunError::Refused(format!(
                "{program} cannot be run ({error}): install COLMAP, or leave out --poses colmap"
            ))
        })?;
        Ok(Self {
            program: program.to_owned(),
            has_cuda: String::from_utf8_lossy(&answer.stdout).contains("with CUDA"),
        })
    }

    /// Whether COLMAP uses the GPU: only with CUDA, since its other GPU path needs a display.
    fn use_gpu(&self) -> &'static str {
        if self.has_cuda { "1" } else { "0" }
    }

    /// One of COLMAP's commands, with the options that its help lists.
    fn command(&self, name: &'static str) -> Result<ColmapCommand, RunError> {
        let help = Command::new(&self.program)
            .args([name, "-h"])
            .stdin(Stdio::null())
            .output();
        let help =
            help.map_err(|error| RunError::Refused(format!("{} {name} cannot be run: {error}", self.program)))?;
        let mut command = Command::new(&self.program);
        command.arg(name).stdin(Stdio::null());
        // No version opens a window for these commands, but Qt requires a display otherwise.
        command.env("QT_QPA_PLATFORM", "offscreen");
        Ok(ColmapCommand {
            name,
            help: format!(
                "{}{}",
                String::from_utf8_lossy(&help.stdout),
                String::from_utf8_lossy(&help.stderr)
            ),
            command,
        })
    }
}

/// One of COLMAP's commands with its options.
struct ColmapCommand {
    name: &'static str,
    /// The command's help text.
    help: String,
    command: Command,
}

impl ColmapCommand {
    fn path(&mut self, option: &str, path: &Path) -> &mut Self {
        self.command.arg(format!("--{option}")).arg(path);
        self
    }

    /// Sets an option whose name differs between versions: the first of `names` that this version knows, if any.
    fn option(&mut self, names: &[&str], value: &str) {
        let is_known = |name: &&&str| {
            self.help
                .split_whitespace()
                .any(|word| word.strip_prefix("--") == Some(**name))
        };
        if let Some(name) = names.iter().find(is_known) {
            self.command.arg(format!("--{name}")).arg(value);
        }
    }

    fn run(&mut self) -> Result<(), RunError> {
        let name = self.name;
        let output = self
            .command
            .output()
            .map_err(|error| RunError::Refused(format!("colmap {name} cannot be run: {error}")))?;
        if output.status.success() {
            return Ok(());
        }
        let stderr = String::from_utf8_lossy(&output.stderr);
        let last = stderr
            .lines()
            .rev()
            .find(|line| !line.trim().is_empty())
            .unwrap_or("no error message");
        Err(RunError::Refused(format!(
            "colmap {name} failed ({}): {}",
            output.status,
            last.trim()
        )))
    }
}
