//! How datasets are read: settings, and those of a run over which a user's own take precedence.

use crate::request::absolute;
use crate::scene_file::same_file;
use crate::{RunError, RunFolder, Scene, cameras, moved_from_dataset, scene_path};
use irradia_formats::{DEFAULT_MAX_SIDE, DatasetFormat, DatasetOptions, Holdout, Lenses, Readout, read_dataset};
use irradia_scene::Dataset;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// How to read a dataset, not validated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reading {
    /// The name of a [`DatasetFormat`], such as `colmap`; detected from the folder if `None`.
    #[serde(default)]
    pub format: Option<String>,
    /// The images' sides are divided by this; 1 or more.
    pub downscale: f32,
    /// Maximum number of pixels of an image's longer side; at least 1, and not together with `downscale`, which replaces the
    /// default limit. `None`: full size.
    #[serde(default)]
    pub max_side: Option<u32>,
    /// Views to hold out: every N-th in the order of names (`8`), none (`0`), or those listed in a file, one per line.
    /// `None`: those that the dataset itself holds out, every 8th if it does not define any.
    #[serde(default)]
    pub holdout: Option<String>,
    /// The folder of the photographs, if it is not where the layout expects it.
    #[serde(default)]
    pub images: Option<PathBuf>,
    /// How distorted photographs are handled.
    #[serde(default)]
    pub lenses: Lenses,
    /// The readout of the film whose frames the photographs are, in the form of [`Readout`].
    #[serde(default)]
    pub readout: Option<String>,
}

impl Default for Reading {
    /// Any format, the dataset's own split, at most [`DEFAULT_MAX_SIDE`] pixels per side.
    fn default() -> Self {
        Self {
            format: None,
            downscale: 1.0,
            max_side: Some(DEFAULT_MAX_SIDE),
            holdout: None,
            images: None,
            lenses: Lenses::default(),
            readout: None,
        }
    }
}

impl Reading {
    /// The validated options.
    ///
    /// # Errors
    /// [`RunError::Setting`] for a value out of range.
    pub fn check(&self) -> Result<DatasetOptions, RunError> {
        let format: Option<DatasetFormat> = match &self.format {
            Some(name) => Some(
                name.parse()
                    .map_err(|e| RunError::setting("format", name, format!("{e}")))?,
            ),
            None => None,
        };
        let readout: Option<Readout> = match &self.readout {
            Some(text) => Some(text.parse().map_err(|e| RunError::setting("readout", text, e))?),
            None => None,
        };
        if !self.downscale.is_finite() || self.downscale < 1.0 {
            return Err(RunError::setting("downscale", self.downscale, "must be 1 or more"));
        }
        if self.max_side == Some(0) {
            return Err(RunError::setting("max_side", 0, "must be 1 or more"));
        }
        // An explicit downscale replaces the default limit.
        let max_side = self
            .max_side
            .filter(|side| self.downscale == 1.0 || *side != DEFAULT_MAX_SIDE);
        if let Some(side) = max_side.filter(|_| self.downscale != 1.0) {
            return Err(RunError::setting("max_side", side, "cannot be combined with downscale"));
        }
        Ok(DatasetOptions {
            format,
            downscale: self.downscale,
            max_side,
            holdout: self.holdout()?,
            images: self.images.clone(),
            lenses: self.lenses,
            readout,
        })
    }

    fn holdout(&self) -> Result<Holdout, RunError> {
        let Some(text) = &self.holdout else {
            return Ok(Holdout::AsDeclared);
        };
        let wrong = |message: &str| Err(RunError::setting("holdout", text, message));
        match text.parse::<usize>() {
            Ok(0) => Ok(Holdout::Nothing),
            Ok(1) => wrong("every view would be held out; must be 2 or more, or 0 to train on all"),
            Ok(n) => Ok(Holdout::Every(n)),
            Err(_) if Path::new(text).is_file() => Ok(Holdout::Listed(text.into())),
            Err(_) => wrong("expected a number, 0 to train on all views, or a file that lists the views to hold out"),
        }
    }

    /// Whether `holdout` is a list that is not there any more.
    pub(crate) fn is_holdout_list_missing(&self) -> bool {
        // Settings of a run are valid but for what has become of their files.
        self.holdout().is_err()
    }

    /// Makes the paths in `holdout` and `images` absolute.
    pub(crate) fn with_absolute_paths(mut self) -> Self {
        self.images = self.images.map(absolute);
        if let Ok(Holdout::Listed(file)) = self.holdout() {
            self.holdout = Some(absolute(file).display().to_string());
        }
        self
    }

    /// Reads the dataset at `path`; the caller shows its `warnings`.
    ///
    /// # Errors
    /// When a value is out of range, or `path` contains no dataset.
    pub fn read(&self, path: &Path) -> Result<Dataset, RunError> {
        Ok(read_dataset(path, &self.check()?)?)
    }
}

/// The settings of [`Reading`] that a user gives; those that are absent follow from a run, or are the defaults.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadingOptions {
    /// [`Reading::format`].
    pub format: Option<String>,
    /// [`Reading::downscale`].
    pub downscale: Option<f32>,
    /// [`Reading::max_side`].
    pub max_side: Option<u32>,
    /// Whether the size is that of the files.
    pub full_size: bool,
    /// [`Reading::holdout`](field@Reading::holdout).
    pub holdout: Option<String>,
    /// [`Reading::images`].
    pub images: Option<PathBuf>,
    /// [`Reading::lenses`].
    pub lenses: Option<Lenses>,
    /// [`Reading::readout`].
    pub readout: Option<String>,
}

impl ReadingOptions {
    /// These settings, and those of `reading` where they are absent. Any of the three that set the size replaces the size of `reading`.
    pub fn with_fallback(&self, reading: Reading) -> Reading {
        let is_sized = self.downscale.is_some() || self.max_side.is_some() || self.full_size;
        let (downscale, max_side) = if is_sized {
            (self.downscale.unwrap_or(1.0), self.max_side)
        } else {
            (reading.downscale, reading.max_side)
        };
        Reading {
            format: self.format.clone().or(reading.format),
            downscale,
            max_side,
            holdout: self.holdout.clone().or(reading.holdout),
            images: self.images.clone().or(reading.images),
            lenses: self.lenses.unwrap_or(reading.lenses),
            readout: self.readout.clone().or(reading.readout),
        }
    }

    /// Reads the dataset at `data` for `scene`, which was read from `path`, a file or a run's folder, and brings it into the world of the
    /// scene. Absent settings are those of the run that contains the scene, and so are, by their names, the held-out views. If the whole
    /// scene was moved away from the photographs, their cameras follow. The caller shows the `warnings` of the dataset.
    ///
    /// # Errors
    /// Those of [`Reading::read`]; when the run's list of views is damaged, or its dataset has other poses by now.
    pub fn read_for(&self, scene: &Scene, path: &Path, data: &Path) -> Result<Dataset, RunError> {
        let (mut reading, mut is_own) = (Reading::default(), false);
        if let Some(record) = RunFolder::record_containing(path)? {
            reading = record.input.reading;
            is_own = same_file(data, &record.input.data);
            if !is_own {
                // Another dataset has a layout of its own.
                (reading.format, reading.images) = (None, None);
            }
        }
        let mut dataset = self.with_fallback(reading).read(data)?;
        match RunFolder::containing(path) {
            // The run was trained on all others.
            Some(run) if self.holdout.is_none() => run.restore_holdout(&mut dataset)?,
            Some(run) => run.warn_of_trained_views(&mut dataset)?,
            None => {}
        }
        let (shown_path, shown_data) = (path.display(), data.display());
        match moved_from_dataset(&scene_path(path), &dataset) {
            Some(moved) if moved.is_identity() => {}
            Some(moved) => dataset = cameras::moved(dataset, &moved),
            None if is_own => {
                return Err(RunError::Refused(format!(
                    "{shown_data} has other poses than those with which {shown_path} was trained: restore them, or train again"
                )));
            }
            None => dataset.warnings.push(format!(
                "views of {shown_data} have the names of views on which {shown_path} was trained, and other poses: unless both have the same \
                 coordinates, they do not fit"
            )),
        }
        Ok(scene.place(dataset))
    }
}
