//! What is shown: a finished scene, or the state of a training.

use crate::ViewerError;
use crate::editing::{Editing, file_state};
use crate::levels::Levels;
use crate::live::{Live, Watcher};
use crate::views::Views;
use irradia_edit::Transform;
use irradia_runs::formats::Lenses;
use irradia_runs::{
    Reading, ReadingOptions, Run, RunFolder, Scene, Snapshot, camera_names, is_moved, moved_from_run, read_levels,
    read_lights, scene_path,
};
use irradia_scene::Dataset;
use irradia_splat::Splats;
use irradia_splat::init::{InitOptions, from_points};
use irradia_train::lights::Lights;
use irradia_train::model::{Model, RenderOptions};
use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// A version of the scene.
#[derive(Clone)]
pub(crate) struct Edition {
    /// Counts up from 1.
    pub version: u64,
    /// The first version with these splats: a selection changes `version` alone.
    pub splats_version: u64,
    /// Whether each splat is selected; `None` if none is.
    pub selected: Option<Arc<Vec<bool>>>,
    /// How edits have moved the scene, and with it everything in it, such as the cameras of views.
    pub placement: Transform,
    /// From the coordinates of the photographs to the world of the scene before the edits.
    opened: Transform,
    /// Levels of detail of these splats, if there are any: an edit drops them.
    pub levels: Levels,
    /// The light of each view, if it is known.
    pub lights: Option<Arc<Lights>>,
    source: SceneSource,
}

#[derive(Clone)]
enum SceneSource {
    Scene(Arc<Scene>),
    Snapshot(Arc<Snapshot>),
}

impl Edition {
    /// A finished scene, which was `moved` away from its photographs.
    fn of_scene(scene: Scene, moved: &Transform, levels: Levels, lights: Option<Lights>) -> Self {
        Self {
            version: 1,
            splats_version: 1,
            selected: None,
            placement: Transform::IDENTITY,
            opened: moved.then(&Transform::to_world(&scene.world_from_dataset)),
            levels,
            lights: lights.map(Arc::new),
            source: SceneSource::Scene(Arc::new(scene)),
        }
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        match &self.source {
            SceneSource::Scene(scene) => scene,
            SceneSource::Snapshot(snapshot) => &snapshot.scene,
        }
    }

    /// From the coordinates of the photographs, in which camera paths are saved, to the world. If a scene without cameras is moved and
    /// saved, nothing tells how: its paths are in its own coordinates.
    pub fn world_from_photographs(&self) -> Transform {
        let scene = self.scene();
        match &scene.cameras {
            Some(_) => self.opened.then(&self.placement),
            None => Transform::to_world(&scene.world_from_dataset),
        }
    }

    /// Number of training steps, if this is a state of a training.
    pub fn step(&self) -> Option<u64> {
        match &self.source {
            SceneSource::Scene(_) => None,
            SceneSource::Snapshot(snapshot) => Some(snapshot.step),
        }
    }
}

/// What a [`Viewer`](crate::Viewer) shows.
pub struct Subject {
    pub(crate) title: String,
    pub(crate) views: Views,
    pub(crate) live: Option<Arc<Live>>,
    /// The run in which the length of the unit is saved.
    pub(crate) folder: Option<RunFolder>,
    /// The recipe as TOML, if known.
    pub(crate) recipe: Option<String>,
    edition: Mutex<Option<Edition>>,
    /// Omissions, one line each.
    pub warnings: Vec<String>,
    /// The editing session, or why there is none.
    pub(crate) editing: Result<Editing, &'static str>,
}

impl Subject {
    /// Reads the run, the scene or the dataset at `path`. Photographs come from `data`, else from the dataset of the run; a dataset
    /// itself is shown by its points. What `reading` leaves out follows from the run, if its dataset is read, or is the default.
    ///
    /// # Errors
    /// When there is nothing to show, or it cannot be read.
    pub fn open(path: &Path, data: Option<&Path>, reading: &ReadingOptions) -> Result<Self, ViewerError> {
        let folder = RunFolder::containing(path);
        let file = scene_path(path);
        if file.is_dir() {
            if folder.is_some() {
                return Err(ViewerError::Unfinished { path: path.to_owned() });
            }
            let dataset = reading.with_fallback(Reading::default()).read(path)?;
            return Ok(Self::of_dataset(path, dataset));
        }
        let recipe = folder
            .as_ref()
            .and_then(|folder| std::fs::read_to_string(folder.file("recipe.toml")).ok());
        // A scene that was moved away from its photographs has another unit as well.
        let folder = folder.filter(|_| !is_moved(&file));
        // Before the scene is read: if the file is replaced meanwhile, it does not count as the one that is shown.
        let opened = file_state(&file);
        let mut scene = Scene::read(&file)?;
        let mut warnings = std::mem::take(&mut scene.notes);
        // The viewer draws pinhole pictures, which are compared with undistorted photographs.
        let reading = ReadingOptions {
            lenses: reading.lenses.or(Some(Lenses::Undistorted)),
            ..reading.clone()
        };
        let dataset = match (data, &folder) {
            (Some(data), _) => Some(reading.read_for(&scene, &file, data)?),
            // A run's photographs may have been moved: its scene can be viewed without them.
            (None, Some(folder)) => RunFolder::open(folder.path())
                .and_then(|(_, record)| reading.read_for(&scene, &file, &record.input.data))
                .map_err(|error| warnings.push(format!("no photographs: {error}")))
                .ok(),
            (None, None) => None,
        };
        let cameras = scene.cameras.as_deref().unwrap_or_default();
        let views = match dataset {
            Some(dataset) => {
                warnings.extend(dataset.warnings.iter().cloned());
                let names = camera_names(&file).unwrap_or_default();
                let poses = cameras.iter().map(|camera| camera.pose);
                Views::of_dataset(&dataset, &names.into_iter().zip(poses).collect())
            }
            None => Views::of_cameras(cameras),
        };
        // Lights are numbered by the views of the run's own dataset.
        let lights = if data.is_none() { read_lights(&file) } else { Ok(None) };
        let lights = lights.unwrap_or_else(|error| {
            warnings.push(format!("no light of photographs: {error}"));
            None
        });
        let lights = lights.filter(|lights| lights.views() == views.0.len());
        let levels = match &scene.model {
            Model::Splats { splats, residual: None } => read_levels(&file, splats.len()),
            _ => Ok(Vec::new()),
        };
        let levels = levels.unwrap_or_else(|error| {
            warnings.push(format!("no levels of detail: {error}"));
            Vec::new()
        });
        let moved = moved_from_run(&file);
        let editing = match &scene.model {
            Model::Splats { splats, residual: None } => Ok(Editing::new(file, opened, splats.len())),
            Model::Splats { .. } => {
                Err("Splats with a residual field cannot be edited: their colours are in the field.")
            }
            Model::Field(_) => Err("A radiance field has no splats to edit."),
        };
        Ok(Self {
            title: title(path),
            views,
            editing,
            live: None,
            folder,
            recipe,
            edition: Mutex::new(Some(Edition::of_scene(scene, &moved, Levels::new(levels), lights))),
            warnings,
        })
    }

    /// The points of a dataset as small opaque splats.
    fn of_dataset(path: &Path, dataset: Dataset) -> Self {
        let options = InitOptions {
            opacity: 0.9,
            scale: 0.3,
            sh_degree: 0,
        };
        let splats = match &dataset.points {
            Some(points) if !points.is_empty() => from_points(points, &options),
            _ => Splats::zeros(0, 0),
        };
        let cameras: Arc<[_]> = dataset.views.iter().map(|view| view.camera).collect();
        let scene = Scene {
            model: Model::of_splats(splats),
            options: RenderOptions::default(),
            cameras: Some(cameras),
            world_from_dataset: dataset.world_from_dataset,
            notes: Vec::new(),
        };
        let warnings = dataset.warnings.clone();
        Self {
            title: title(path),
            views: Views::of_dataset(&dataset, &HashMap::new()),
            editing: Err("A dataset has no splats to edit: these are its points."),
            live: None,
            folder: None,
            recipe: None,
            edition: Mutex::new(Some(Edition::of_scene(
                scene,
                &Transform::IDENTITY,
                Levels::default(),
                None,
            ))),
            warnings,
        }
    }

    /// A training, and the observer to give to [`Run::train`].
    pub fn of_run(run: &Run) -> (Self, Watcher) {
        let trainer = run.trainer();
        let dataset = &trainer.dataset;
        let refined = |view: &usize| (dataset.views[*view].name.clone(), trainer.camera(*view).pose);
        let live = Arc::new(Live::new(run));
        let subject = Self {
            title: title(run.folder().path()),
            views: Views::of_dataset(dataset, &dataset.train.iter().map(refined).collect()),
            editing: Err("A scene can be edited when its training has finished: open it with irradia view."),
            live: Some(live.clone()),
            folder: Some(run.folder().clone()),
            recipe: Some(trainer.recipe.to_toml()),
            edition: Mutex::default(),
            warnings: Vec::new(),
        };
        (subject, Watcher::new(live))
    }

    /// Shows another `scene`, if there is one, and which splats are selected, if any are.
    pub(crate) fn show(&self, scene: Option<Scene>, placement: Transform, selected: Option<Arc<Vec<bool>>>) {
        let mut edition = self.edition.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(edition) = edition.as_mut() else { return };
        edition.version += 1;
        edition.placement = placement;
        edition.selected = selected;
        if let Some(scene) = scene {
            edition.splats_version = edition.version;
            edition.levels = Levels::default();
            edition.source = SceneSource::Scene(Arc::new(scene));
        }
    }

    /// The newest version, if there is one: a training has none before its first step.
    pub(crate) fn edition(&self) -> Option<Edition> {
        let mut edition = self.edition.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(snapshot) = self.live.as_ref().and_then(|live| live.newest()) {
            let known = edition.as_ref().and_then(Edition::step);
            if known != Some(snapshot.step) {
                let version = edition.as_ref().map_or(1, |old| old.version + 1);
                *edition = Some(Edition {
                    version,
                    splats_version: version,
                    selected: None,
                    placement: Transform::IDENTITY,
                    opened: Transform::to_world(&snapshot.scene.world_from_dataset),
                    levels: Levels::default(),
                    lights: snapshot.lights.clone(),
                    source: SceneSource::Snapshot(snapshot),
                });
            }
        }
        edition.clone()
    }
}

fn title(path: &Path) -> String {
    let path = path.canonicalize().unwrap_or(path.to_owned());
    let parts: Vec<_> = path.iter().rev().take(2).map(|part| part.to_string_lossy()).collect();
    parts.into_iter().rev().collect::<Vec<_>>().join("/")
}
