//! The folder of a run.

use crate::cameras::{CAMERAS, cameras_json};
use crate::edit::EDITS;
use crate::lock::FolderLock;
use crate::provenance::ViewList;
use crate::request::absolute;
use crate::scene_file::same_file;
use crate::{RunError, TrainInput};
use irradia_formats::write_atomic;
use irradia_scene::{Dataset, Similarity};
use irradia_train::checkpoint::Checkpoint;
use irradia_train::paces::Paces;
use irradia_train::{Trainer, socket};
use serde::{Deserialize, Serialize};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The splats of a run.
pub const SCENE: &str = "scene.ply";
/// The radiance field of a run.
pub const FIELD: &str = "field.safetensors";
/// The residual field of a run's splats.
pub const RESIDUAL: &str = socket::Residual::FILE;
/// The exposures of a run's photographs.
pub const EXPOSURES: &str = socket::Exposure::FILE;
/// The appearance codes of a run's photographs.
pub const APPEARANCE: &str = socket::Appearance::FILE;
/// The vignettes of a run's lenses.
pub const VIGNETTE: &str = socket::Vignette::FILE;
/// The sky behind a run's splats.
pub const SKY: &str = socket::Sky::FILE;

/// The length of a run's world unit, if it is known.
pub const UNIT: &str = "unit.json";

/// The dataset of a run whose photographs were posed for it, in the run's folder.
pub const POSED_FOLDER: &str = "posed";

/// List of the views of a run's dataset.
pub(crate) const VIEWS: &str = "views.json";
/// From the dataset's coordinates to the world in which the run trains.
const WORLD: &str = "world.json";
/// The pace of each step.
pub(crate) const PACES: &str = "pace.txt";
/// The paces that the run repeats, a copy of those of another run, which may be moved before this one is resumed.
pub(crate) const REPEATED_PACES: &str = "replay.txt";

/// The files of a run other than those of [`socket::FILES`].
const FILES: [&str; 17] = [
    "run.json",
    VIEWS,
    WORLD,
    PACES,
    REPEATED_PACES,
    "recipe.toml",
    CAMERAS,
    "events.jsonl",
    SCENE,
    FIELD,
    "report.json",
    "report.html",
    UNIT,
    EDITS,
    "scene.lod1.ply",
    "scene.lod2.ply",
    "scene.lod3.ply",
];
/// All files of a run.
fn all_files() -> impl Iterator<Item = &'static str> {
    FILES.into_iter().chain(socket::FILES)
}

/// The subfolders of a run.
const SUBFOLDERS: [&str; 2] = ["eval", "checkpoints"];

/// What the names of a run's files in its subfolders end with.
const SUFFIXES: [&str; 4] = [".truth.png", ".render.png", ".error.png", ".safetensors"];

/// The files of a run in one of its subfolders; others in it are somebody else's.
fn files_in_subfolder(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let is_ours = |file: &PathBuf| {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        SUFFIXES.iter().any(|suffix| name.ends_with(suffix))
    };
    entries.map(|entry| entry.path()).filter(is_ours).collect()
}

/// Files written before `run.json`; a run has begun once `run.json` exists.
const FILES_BEFORE_RECORD: [&str; 5] = ["recipe.toml", CAMERAS, VIEWS, WORLD, REPEATED_PACES];

/// Whether the folder `path` contains a run, or may contain one. False if it contains only files of a process that died before
/// its run had begun.
pub(crate) fn contains_run(path: &Path) -> bool {
    let is_before_record = |file| FILES_BEFORE_RECORD.contains(&file) && FolderLock::has_lock_file(path);
    all_files().any(|file| path.join(file).exists() && !is_before_record(file))
}

/// The folder of a run.
#[derive(Clone, Debug)]
pub struct RunFolder(PathBuf);

/// `run.json`: the request and the progress of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// The request.
    #[serde(flatten)]
    pub input: TrainInput,
    /// Whether the recipe was followed to its end and everything was written.
    pub complete: bool,
    /// Warnings about the dataset: what was found when it was read, and whether its poses were replaced.
    #[serde(default)]
    pub data_warnings: Vec<String>,
    /// A hash of the scene with which the run began, if it continues one: a replay needs the same.
    #[serde(default)]
    pub from_fingerprint: Option<String>,
}

impl RunRecord {
    /// The record of the run in `folder`, without paths that are invalid because the run or its list of held-out views was moved.
    fn parse(text: &[u8], folder: &Path) -> Result<Self, serde_json::Error> {
        let mut record: Self = serde_json::from_slice(text)?;
        let (input, posed) = (&mut record.input, folder.join(POSED_FOLDER));
        input.data = folder.join(&input.data);
        // In earlier records, the path to a dataset in the run's own folder is absolute.
        if input.data.ends_with(POSED_FOLDER) && !input.data.exists() && posed.is_dir() {
            input.data = posed;
        }
        if input.reading.is_holdout_list_missing() && folder.join(VIEWS).is_file() {
            // The run knows its held-out views by name: [`RunFolder::restore_holdout`].
            input.reading.holdout = None;
        }
        Ok(record)
    }
}

/// `world.json`: `world = scale (dataset - center)`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct WorldRecord {
    scale: f64,
    center: [f64; 3],
}

/// `unit.json`
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Unit {
    metres_per_unit: f64,
}

impl RunFolder {
    /// Checks that a new run may be created at `path`, before any work is done for it.
    ///
    /// # Errors
    /// When it already contains a run and `overwrite` is not set, is in use, or is a file.
    pub fn check_free(path: &Path, overwrite: bool) -> Result<(), RunError> {
        Self::check_replaceable(path, overwrite)?;
        // Before photographs are posed into the folder of a run that is training.
        FolderLock::acquire_existing(path).map(drop)
    }

    /// As [`Self::check_free`], whoever holds the folder.
    pub(crate) fn check_replaceable(path: &Path, overwrite: bool) -> Result<(), RunError> {
        if path.exists() && !path.is_dir() {
            return Err(RunError::Refused(format!(
                "{} is a file: name a folder with --out",
                path.display()
            )));
        }
        if !overwrite && contains_run(path) {
            let message = format!(
                "{} already holds a run: choose another --out, --overwrite to replace it, or --resume {0} to resume it",
                path.display()
            );
            return Err(RunError::Refused(message));
        }
        Ok(())
    }

    /// Creates and locks the folder of a new run; removes the files of an earlier run.
    ///
    /// # Errors
    /// When it cannot be created or cleared, is in use, or by now contains a run that must not be replaced.
    pub(crate) fn create(
        path: &Path,
        overwrite: bool,
        held: Option<FolderLock>,
    ) -> Result<(Self, FolderLock), RunError> {
        let no_folder = |source| RunError::NoFolder {
            path: path.to_owned(),
            source,
        };
        fs::create_dir_all(path).map_err(no_folder)?;
        let lock = match held {
            Some(lock) => lock,
            None => FolderLock::acquire(path)?,
        };
        Self::check_replaceable(path, overwrite)?;
        if all_files().any(|file| path.join(file).exists()) {
            let in_subfolders = SUBFOLDERS
                .iter()
                .flat_map(|folder| files_in_subfolder(&path.join(folder)));
            for file in in_subfolders.chain(all_files().map(|file| path.join(file))) {
                if file.exists() {
                    fs::remove_file(&file).map_err(RunError::io("clear", &file))?;
                }
            }
        }
        for folder in SUBFOLDERS.map(|folder| path.join(folder)) {
            fs::create_dir_all(&folder).map_err(|source| RunError::NoFolder {
                path: folder.clone(),
                source,
            })?;
        }
        let folder = Self(path.to_owned());
        folder.remove_leftovers()?;
        Ok((folder, lock))
    }

    /// Opens the folder of an earlier run.
    ///
    /// # Errors
    /// When there is no run, or its `run.json` is damaged.
    pub fn open(path: &Path) -> Result<(Self, RunRecord), RunError> {
        let file = path.join("run.json");
        let text = fs::read(&file).map_err(|source| RunError::NoRun {
            path: path.to_owned(),
            source,
        })?;
        let record = RunRecord::parse(&text, path).map_err(|error| RunError::Damaged {
            path: file,
            reason: error.to_string(),
        })?;
        Ok((Self(path.to_owned()), record))
    }

    /// A folder, whether it contains a run or not.
    pub(crate) fn at(path: &Path) -> Self {
        Self(path.to_owned())
    }

    /// The folder of the run that contains the scene `path`, a file or the folder itself, whether it is complete or not.
    pub fn containing(path: &Path) -> Option<Self> {
        let folder = if path.is_dir() { path } else { path.parent()? };
        folder.join("run.json").is_file().then(|| Self(folder.to_owned()))
    }

    /// Metres per world unit, if they have been measured.
    pub fn metres_per_unit(&self) -> Option<f64> {
        let unit: Unit = serde_json::from_slice(&fs::read(self.file(UNIT)).ok()?).ok()?;
        Some(unit.metres_per_unit).filter(|metres| metres.is_finite() && *metres > 0.0)
    }

    /// Stores the metres per world unit beside the scene.
    ///
    /// # Errors
    /// When the file cannot be written, or `metres` is not a positive number.
    pub fn set_metres_per_unit(&self, metres: f64) -> Result<(), RunError> {
        if !(metres.is_finite() && metres > 0.0) {
            return Err(RunError::setting("unit", metres, "must be a positive number of metres"));
        }
        self.write(
            UNIT,
            &to_json(&Unit {
                metres_per_unit: metres,
            }),
        )
    }

    /// `run.json` of the run that contains the scene `path`, a file or a run's folder; `None` if there is none.
    ///
    /// # Errors
    /// When it cannot be read or is damaged.
    pub fn record_containing(path: &Path) -> Result<Option<RunRecord>, RunError> {
        let folder = Self::containing(path);
        folder.map(|folder| Ok(Self::open(folder.path())?.1)).transpose()
    }

    /// The dataset of the run that contains the scene `path`, if its photographs were posed for it.
    pub fn posed_dataset(path: &Path) -> Option<PathBuf> {
        let data = Self::record_containing(path).ok()??.input.data;
        (data.exists() && same_file(&data, &Self::containing(path)?.file(POSED_FOLDER))).then_some(data)
    }

    /// Writes the list of training and held-out views.
    pub(crate) fn write_views(&self, views: &ViewList) -> Result<(), RunError> {
        self.write(VIEWS, &to_json(views))
    }

    /// The views with which the run began; `None` if the run has no list.
    ///
    /// # Errors
    /// When the list cannot be read or is damaged.
    fn views(&self) -> Result<Option<ViewList>, RunError> {
        let Some(bytes) = self.read_existing(VIEWS)? else {
            return Ok(None);
        };
        let views = serde_json::from_slice(&bytes).map_err(|error| RunError::Damaged {
            path: self.file(VIEWS),
            reason: error.to_string(),
        })?;
        Ok(Some(views))
    }

    /// The content of a file; `None` if it does not exist.
    fn read_existing(&self, name: &str) -> Result<Option<Vec<u8>>, RunError> {
        let path = self.file(name);
        match fs::read(&path) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(RunError::io("read", &path)(error)),
        }
    }

    /// Differences between the views `now` and those with which the run began; empty if the run has no list.
    pub(crate) fn changed_views(&self, now: &ViewList) -> Result<Vec<String>, RunError> {
        let then = self.views()?;
        Ok(then.map_or_else(Vec::new, |then| then.differences(now)))
    }

    /// Holds out those views of `dataset` that the run held out, by their names, even if the dataset has gained or lost photographs since:
    /// every N-th view would be another one. A dataset of other photographs keeps its own split.
    ///
    /// # Errors
    /// When the run's list of views is damaged.
    pub fn restore_holdout(&self, dataset: &mut Dataset) -> Result<(), RunError> {
        if let Some(missing) = self
            .views()?
            .and_then(|views| views.split(dataset))
            .filter(|missing| *missing > 0)
        {
            dataset
                .warnings
                .push(format!("{missing} views that the run held out are not in the dataset"));
        }
        Ok(())
    }

    /// Adds a warning to `dataset` if the run was trained on views that it holds out.
    ///
    /// # Errors
    /// When the run's list of views is damaged.
    pub(crate) fn warn_of_trained_views(&self, dataset: &mut Dataset) -> Result<(), RunError> {
        let trained = self.views()?.map_or(0, |views| views.trained_on(dataset));
        if trained > 0 {
            dataset.warnings.push(format!(
                "{} was trained on {trained} of the {} held-out views, whose figures are therefore too good: omit --holdout to hold out its own",
                self.0.display(),
                dataset.test.len()
            ));
        }
        Ok(())
    }

    /// The recorded paces of the run's steps.
    ///
    /// # Errors
    /// When the run has no recorded paces, or the file is damaged.
    pub(crate) fn paces(&self) -> Result<Paces, RunError> {
        read_paces(self.file(PACES))
    }

    /// The paces that the run repeats, if it has begun with a copy of them.
    ///
    /// # Errors
    /// When the file is damaged.
    pub(crate) fn repeated_paces(&self) -> Result<Option<Paces>, RunError> {
        let path = self.file(REPEATED_PACES);
        path.is_file().then(|| read_paces(path)).transpose()
    }

    /// Removes the temporary files that a killed process left; requires the folder's lock.
    pub(crate) fn remove_leftovers(&self) -> Result<(), RunError> {
        for folder in SUBFOLDERS.map(|folder| self.file(folder)).iter().chain([&self.0]) {
            let entries = fs::read_dir(folder).map_err(RunError::io("read", folder))?;
            for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                if name.starts_with('.') && name.ends_with(".tmp") {
                    fs::remove_file(&path).map_err(RunError::io("remove", &path))?;
                }
            }
        }
        Ok(())
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The path of a file in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes `bytes` to `name`, atomically.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), RunError> {
        write_atomic(&self.file(name), |out| out.write_all(bytes))?;
        Ok(())
    }

    /// Removes the file `name`, if it exists.
    ///
    /// # Errors
    /// When it cannot be removed.
    pub fn remove(&self, name: &str) -> Result<(), RunError> {
        let path = self.file(name);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(RunError::io("remove", &path)(error)),
            _ => Ok(()),
        }
    }

    /// Writes `run.json`. A dataset in the folder itself is recorded relative to it, since the run may be moved.
    pub(crate) fn write_record(&self, record: &RunRecord) -> Result<(), RunError> {
        let mut record = record.clone();
        if let Ok(inside) = record.input.data.strip_prefix(absolute(self.0.clone()))
            && inside != Path::new("")
        {
            record.input.data = inside.to_owned();
        }
        let bytes = serde_json::to_vec_pretty(&record)
            .map_err(|e| RunError::Refused(format!("the request cannot be written to run.json: {e}")))?;
        self.write("run.json", &bytes)
    }

    /// Writes `cameras.json`: the training views' cameras, with refined poses.
    pub(crate) fn write_cameras(&self, trainer: &Trainer) -> Result<(), RunError> {
        self.write(CAMERAS, &cameras_json(trainer))
    }

    /// Writes `world.json`.
    pub(crate) fn write_world(&self, world_from_dataset: &Similarity) -> Result<(), RunError> {
        let record = WorldRecord {
            scale: world_from_dataset.scale,
            center: world_from_dataset.center.to_array(),
        };
        self.write(WORLD, &to_json(&record))
    }

    /// The world in which the run trains: the dataset's own coordinates if the run is older than `world.json`.
    ///
    /// # Errors
    /// When the file is damaged.
    pub(crate) fn world_from_dataset(&self) -> Result<Similarity, RunError> {
        let Some(bytes) = self.read_existing(WORLD)? else {
            return Ok(Similarity::IDENTITY);
        };
        let damaged = |reason: String| RunError::Damaged {
            path: self.file(WORLD),
            reason,
        };
        let record: WorldRecord = serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
        let world = Similarity {
            scale: record.scale,
            center: record.center.into(),
        };
        if world.is_valid() {
            Ok(world)
        } else {
            Err(damaged("the scale must be positive".into()))
        }
    }

    /// The latest checkpoint, if there is one.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub(crate) fn newest_checkpoint(&self) -> Result<Option<PathBuf>, RunError> {
        Ok(self.checkpoints()?.pop().map(|(_, path)| path))
    }

    /// Steps and paths of the checkpoints, oldest first.
    fn checkpoints(&self) -> Result<Vec<(u64, PathBuf)>, RunError> {
        let folder = self.file("checkpoints");
        let entries = match fs::read_dir(&folder) {
            // A finished run whose checkpoints were deleted.
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries.map_err(RunError::io("read", &folder))?,
        };
        let mut found: Vec<(u64, PathBuf)> = entries
            .filter_map(|entry| {
                let path = entry.ok()?.path();
                let step = path
                    .file_name()?
                    .to_str()?
                    .strip_prefix("step_")?
                    .strip_suffix(".safetensors")?
                    .parse()
                    .ok()?;
                Some((step, path))
            })
            .collect();
        found.sort();
        Ok(found)
    }

    /// Writes a checkpoint and removes older ones; returns its path relative to the run.
    pub(crate) fn write_checkpoint(&self, checkpoint: &Checkpoint) -> Result<String, RunError> {
        let step = checkpoint.step;
        let name = format!("checkpoints/step_{step}.safetensors");
        write_atomic(&self.file(&name), |out| checkpoint.write(out))?;
        for (_, old) in self.checkpoints()?.into_iter().filter(|(s, _)| *s < step) {
            fs::remove_file(&old).map_err(RunError::io("remove", &old))?;
        }
        Ok(name)
    }
}

/// The paces in a file.
fn read_paces(path: PathBuf) -> Result<Paces, RunError> {
    let text = fs::read_to_string(&path).map_err(RunError::io("read", &path))?;
    Paces::parse(&text).map_err(|reason| RunError::Damaged { path, reason })
}

/// Serialisable data as indented JSON.
pub(crate) fn to_json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec_pretty(value).expect("plain data")
}

/// The world of the run that contains the file `scene`; the dataset's own coordinates if there is no run.
pub(crate) fn world_beside(scene: &Path) -> Result<Similarity, RunError> {
    RunFolder(scene.parent().unwrap_or(Path::new("")).to_owned()).world_from_dataset()
}
