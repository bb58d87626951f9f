//! A scene that can be rendered: read from a file or a run, or taken from a training.

use crate::cameras::cameras_beside;
use crate::folder::{APPEARANCE, EXPOSURES, FIELD, RESIDUAL, SCENE, SKY, VIGNETTE, world_beside};
use crate::levels::level_files;
use crate::orbit::{OrbitGeometry, orbit, orbit_geometry};
use crate::{RunError, RunFolder};
use irradia_edit::Draft;
use irradia_field::{Field, Sampler};
use irradia_formats::{SplatFormat, folder_of, is_sog_folder, read_splat_file};
use irradia_scene::{Camera, Dataset, Similarity};
use irradia_splat::{RenderOptions, Renderer, Splats};
use irradia_train::lights::Lights;
use irradia_train::model::{Frame, Model};
use irradia_train::recipe::RenderSettings;
use irradia_train::socket::{Vignette, background_of_sky};
use irradia_train::{Recipe, TrainError, field_file};
use std::borrow::Cow;
use std::fs;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

/// Splats, with or without a residual field, or a radiance field, with render options and the training cameras.
///
/// ```
/// # use irradia_runs::scene::GaussianCloud;
/// # let folder = tempfile::tempdir()?;
/// # let ply = folder.path().join("scene.ply");
/// # let cloud = GaussianCloud {
/// #     means: vec![[-1.0, 0.0, 0.0], [0.0; 3], [1.0, 0.0, 0.0]], quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
/// #     log_scales: vec![[-1.0; 3]; 3], opacity_logits: vec![4.0; 3], sh: vec![1.0; 9], sh_degree: 0, ..Default::default()
/// # };
/// # irradia_runs::formats::write_splats(&ply, &cloud)?;
/// use irradia_runs::prelude::*;
///
/// let scene = Scene::read(&ply)?;
/// let camera = scene.orbit(8, Some((64, 48)))[0];
/// let frame = scene.render(&camera);
/// write_image(folder.path().join("frame.png"), &frame.color)?;
/// # assert!(frame.alpha.iter().any(|alpha| *alpha > 0.5));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Scene {
    /// What is rendered: splats or a field.
    pub model: Model<'static>,
    /// Background, antialiasing and SH degree.
    pub options: RenderOptions,
    /// The training views' cameras, if known.
    pub cameras: Option<Arc<[Camera]>>,
    /// From the coordinates of the dataset to those of `model` and `cameras`.
    pub world_from_dataset: Similarity,
    /// What was left out when the scene was read, a line each.
    pub notes: Vec<String>,
}

impl Scene {
    /// Reads a splat file, a field, or the scene in a run's folder. Background and antialiasing are those of the run that contains
    /// the file; if the run has a sky, its mean colour is the background. A residual field beside a run's splats is part of the scene.
    ///
    /// # Errors
    /// When it cannot be read, or is a residual field without its splats.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, RunError> {
        let path = &scene_path(path.as_ref());
        let (model, antialiased, world_from_dataset, notes) = read_model(path)?;
        let settings = render_settings_beside(path);
        Ok(Self {
            model,
            options: RenderOptions {
                background: sky_beside(path)?.unwrap_or(settings.background),
                antialias: settings.antialias || antialiased,
                ..RenderOptions::default()
            },
            cameras: cameras_beside(path, &world_from_dataset).map(Into::into),
            world_from_dataset,
            notes,
        })
    }

    /// The visible part of a scene that is being edited.
    pub fn of_draft(draft: &Draft, options: RenderOptions) -> Self {
        Self {
            model: Model::of_splats(Splats::from_cloud(&draft.visible_cloud())),
            options,
            cameras: (!draft.cameras.is_empty()).then(|| draft.cameras.clone().into()),
            world_from_dataset: draft.cloud.world_from_dataset,
            notes: Vec::new(),
        }
    }

    /// Brings `dataset`, whose files use the same coordinates as the scene's dataset, into the world of this scene.
    pub fn place(&self, dataset: Dataset) -> Dataset {
        dataset.in_world(self.world_from_dataset)
    }

    /// Renders the view of `camera`, in the world of this scene. For many frames, [`Model::render`] with one [`Renderer`] reuses memory.
    pub fn render(&self, camera: &Camera) -> Frame {
        self.model.render(&mut Renderer::new(), camera, &self.options)
    }

    /// `frames` cameras on a circle around the focus of the training cameras, at their mean distance and height. If a quarter of the circle
    /// or more has no training cameras, the path goes back and forth on the remaining arc. Without training cameras, the circle is around
    /// the centre of the splats. `size` is width and height in pixels; if `None`, that of the training images, or 1280 x 720.
    pub fn orbit(&self, frames: u32, size: Option<(u32, u32)>) -> Vec<Camera> {
        orbit(self.model.splats(), self.cameras.as_deref(), frames, size)
    }

    /// Where the scene is viewed from: its centre, up axis and extent.
    pub fn orbit_geometry(&self) -> OrbitGeometry {
        orbit_geometry(self.model.splats(), self.cameras.as_deref())
    }
}

/// The scene's file if `path` is a run's folder or a folder of SOG images, otherwise `path` itself.
pub fn scene_path(path: &Path) -> PathBuf {
    let files = [SCENE, FIELD].map(|name| path.join(name));
    let meta = is_sog_folder(path).then(|| path.join(SplatFormat::SogFolder.suffix()));
    let found = files.into_iter().find(|file| file.is_file());
    found.or(meta).unwrap_or(path.to_owned())
}

/// Rejects an output that would replace the input scene.
///
/// # Errors
/// When `output` is `scene`, or the scene's file in that folder, or `scene` is a level of detail of `output`.
pub fn check_not_overwritten(scene: &Path, output: &Path) -> Result<(), RunError> {
    let scene = scene_path(scene);
    // A folder of SOG images is written as its list.
    let list = output.join(SplatFormat::SogFolder.suffix());
    if [output.to_owned(), list]
        .into_iter()
        .chain(level_files(output))
        .any(|file| same_file(&file, &scene))
    {
        Err(RunError::Refused(format!(
            "{} would be replaced: name another output",
            scene.display()
        )))
    } else {
        Ok(())
    }
}

/// Whether both paths lead to the same file or folder, which may not exist yet.
pub fn same_file(a: &Path, b: &Path) -> bool {
    resolved(a) == resolved(b)
}

/// `path` without links, `.` and `..`; folders that do not exist yet have no links.
fn resolved(path: &Path) -> PathBuf {
    if let Ok(resolved) = path.canonicalize() {
        return resolved;
    }
    let mut folder = match folder_of(path) {
        Some(folder) => resolved(folder),
        None => Path::new(".").canonicalize().unwrap_or_default(),
    };
    match path.components().next_back() {
        Some(Component::Normal(name)) => folder.push(name),
        Some(Component::ParentDir) => {
            folder.pop();
        }
        _ => {}
    }
    folder
}

/// The field in a file.
pub(crate) fn read_field(path: &Path) -> Result<Field, RunError> {
    let bytes = fs::read(path).map_err(RunError::io("read", path))?;
    field_file::from_bytes(&bytes).map_err(|source| RunError::File {
        path: path.to_owned(),
        source,
    })
}

/// Whether `path` has the extension of a field's file.
pub(crate) fn is_field(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "safetensors")
}

/// Returns the model in a file (a field if the extension says so, otherwise splats), whether its opacities require antialiasing, its
/// world, and what was left out.
fn read_model(path: &Path) -> Result<(Model<'static>, bool, Similarity, Vec<String>), RunError> {
    if is_field(path) {
        let field = read_field(path)?;
        if matches!(field.config.sampler, Sampler::Given { .. }) {
            return Err(RunError::Residual(path.to_owned()));
        }
        return Ok((Model::Field(Cow::Owned(field)), false, world_beside(path)?, Vec::new()));
    }
    let file = read_splat_file(path)?;
    let (notes, cloud) = (file.warnings(), file.cloud);
    let splats = Cow::Owned(Splats::from_cloud(&cloud));
    let residual = residual_beside(path)?.map(Box::new);
    let model = Model::Splats { splats, residual };
    Ok((model, cloud.antialiased, cloud.world_from_dataset, notes))
}

/// The file `name` in the folder of a run, for any scene in it: what lenses do, and what is behind the scene, survive edits.
fn run_file(scene: &Path, name: &str) -> Option<PathBuf> {
    let path = scene.with_file_name(name);
    (RunFolder::containing(scene).is_some() || scene.file_name().is_some_and(|name| name == SCENE))
        .then_some(path)
        .filter(|path| path.is_file())
}

/// The file `name` beside the scene of a run, if there is one.
fn file_beside(scene: &Path, name: &str) -> Option<PathBuf> {
    let path = scene.with_file_name(name);
    (scene.file_name().is_some_and(|name| name == SCENE) && path.is_file()).then_some(path)
}

/// The bytes of a file, if there is one.
fn read_optional(file: Option<PathBuf>) -> Result<Option<Vec<u8>>, RunError> {
    let read = |path: PathBuf| fs::read(&path).map_err(RunError::io("read", &path));
    file.map(read).transpose()
}

/// The file `name` in the folder of a run, if there is one, parsed by `parse`.
fn parse_run_file<T>(
    scene: &Path,
    name: &str,
    parse: impl FnOnce(&[u8]) -> Result<T, String>,
) -> Result<Option<T>, RunError> {
    let parsed = read_optional(run_file(scene, name))?
        .map(|bytes| parse(&bytes))
        .transpose();
    parsed.map_err(|why| RunError::File {
        path: scene.with_file_name(name),
        source: TrainError::Checkpoint(why),
    })
}

/// The residual field beside `scene`, if there is one.
pub(crate) fn residual_beside(scene: &Path) -> Result<Option<Field>, RunError> {
    file_beside(scene, RESIDUAL).as_deref().map(read_field).transpose()
}

/// A note if the scene `scene` has a residual field, which is left out for the reason `why`.
pub fn residual_left_out(scene: &Path, why: &str) -> Option<String> {
    file_beside(scene, RESIDUAL).map(|_| format!("{RESIDUAL} is left out: {why}"))
}

/// The light of each photograph of the run whose scene is the file `scene`, if the run has learned it. The scene itself is shown in
/// the mean light.
///
/// # Errors
/// When one of their files cannot be read, or the files do not belong together.
pub fn read_lights(scene: &Path) -> Result<Option<Lights>, RunError> {
    let [exposures, appearance] = [
        read_optional(file_beside(scene, EXPOSURES))?,
        read_optional(file_beside(scene, APPEARANCE))?,
    ];
    Lights::from_files(exposures.as_deref(), appearance.as_deref()).map_err(|source| RunError::File {
        path: scene.to_owned(),
        source,
    })
}

/// The vignette of the lenses of the run whose scene is the file `scene`, if the run has learned it.
///
/// # Errors
/// When its file cannot be read.
pub fn read_vignette(scene: &Path) -> Result<Option<Vignette>, RunError> {
    parse_run_file(scene, VIGNETTE, Vignette::from_file)
}

/// The mean colour of the sky beside `scene`, if there is one.
fn sky_beside(scene: &Path) -> Result<Option<[f32; 3]>, RunError> {
    parse_run_file(scene, SKY, background_of_sky)
}

/// Background and antialiasing of the run that contains `scene`; the defaults if there is no run.
pub(crate) fn render_settings_beside(scene: &Path) -> RenderSettings {
    let fallback = RenderSettings {
        background: [0.0; 3],
        antialias: false,
        smoothing_filter: false,
    };
    let Some(folder) = scene.parent() else { return fallback };
    fs::read_to_string(folder.join("recipe.toml"))
        .ok()
        .and_then(|text| Recipe::parse("beside the scene", &text, &[]).ok())
        .map_or(fallback, |recipe| recipe.render)
}
