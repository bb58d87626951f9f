//! The folder of a run, and what is read back from it.

use crate::Usage;
use anyhow::{Context, Result, bail};
use glam::{Quat, Vec3};
use irradia_field::{Field, Sampler};
use irradia_formats::{read_splats, write_atomic};
use irradia_scene::{Camera, Dataset, Intrinsics, Pose};
use irradia_splat::Splats;
use irradia_train::field_file;
use irradia_train::model::Model;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fs;
use std::path::{Path, PathBuf};

/// The splats of a run.
pub const SCENE: &str = "scene.ply";
/// The radiance field of a run.
pub const FIELD: &str = "field.safetensors";
/// What adds to the colours of a run's splats.
pub const RESIDUAL: &str = "residual.safetensors";

/// What a run may leave in its folder.
const FILES: [&str; 11] = [
    "run.json",
    "recipe.toml",
    "cameras.json",
    "events.jsonl",
    SCENE,
    FIELD,
    RESIDUAL,
    "poses.safetensors",
    "exposure.safetensors",
    "report.json",
    "report.html",
];
/// The folders in it.
const FOLDERS: [&str; 2] = ["eval", "checkpoints"];

/// A run's place on disk.
#[derive(Clone, Debug)]
pub struct RunFolder(PathBuf);

/// What a resumed run needs to be the same run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunConfig {
    /// The dataset, absolute.
    pub data: PathBuf,
    /// `--format`.
    pub format: Option<String>,
    /// `--downscale`.
    pub downscale: f32,
    /// `--max-side`.
    pub max_side: Option<u32>,
    /// `--until-psnr`.
    pub until_psnr: Option<f64>,
    /// `--budget`, seconds.
    pub budget: Option<f64>,
    /// `--seed`.
    pub seed: u64,
    /// `--steps`.
    pub steps: Option<u64>,
    /// Weights of LPIPS, absolute, where there were any.
    #[serde(default)]
    pub lpips: Option<PathBuf>,
    /// Whether the recipe was followed to its end and everything was written.
    pub complete: bool,
}

/// A camera as `cameras.json` holds it: enough to orbit the scene later without its photographs.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct CameraRecord {
    name: String,
    width: u32,
    height: u32,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    /// World, camera centre.
    position: [f32; 3],
    /// World from camera (x right, y down, z forward): w, x, y, z.
    rotation: [f32; 4],
}

impl RunFolder {
    /// Whether a new run may be made at `path`; asked before any work is done for it.
    ///
    /// # Errors
    /// When it already holds a run and `overwrite` is not set, or is a file.
    pub fn check_free(path: &Path, overwrite: bool) -> Result<()> {
        if path.exists() && !path.is_dir() {
            return Err(Usage(format!("{} is a file: --out takes a folder", path.display())).into());
        }
        if !overwrite && FILES.iter().any(|file| path.join(file).exists()) {
            let message = format!(
                "{} already holds a run: give another --out, --overwrite to replace it, or --resume {0} to go on with it",
                path.display()
            );
            return Err(Usage(message).into());
        }
        Ok(())
    }

    /// Makes the folder for a new run; what an earlier run left there is removed.
    ///
    /// # Errors
    /// When it cannot be made or cleared.
    pub fn create(path: &Path) -> Result<Self> {
        if FILES.iter().any(|file| path.join(file).exists()) {
            for folder in FOLDERS.map(|folder| path.join(folder)) {
                if folder.exists() {
                    fs::remove_dir_all(&folder).with_context(|| format!("cannot clear {}", folder.display()))?;
                }
            }
            for file in FILES.map(|file| path.join(file)) {
                if file.exists() {
                    fs::remove_file(&file).with_context(|| format!("cannot clear {}", file.display()))?;
                }
            }
        }
        for folder in FOLDERS.map(|folder| path.join(folder)) {
            fs::create_dir_all(&folder)
                .with_context(|| format!("cannot make {}; give another --out", folder.display()))?;
        }
        Ok(Self(path.to_owned()))
    }

    /// Opens the folder of an earlier run.
    ///
    /// # Errors
    /// When there is none.
    pub fn open(path: &Path) -> Result<(Self, RunConfig)> {
        let file = path.join("run.json");
        let text = fs::read_to_string(&file).with_context(|| {
            format!(
                "{} holds no run to resume: cannot read {}",
                path.display(),
                file.display()
            )
        })?;
        let config = serde_json::from_str(&text).with_context(|| format!("{} is damaged", file.display()))?;
        let run = Self(path.to_owned());
        run.remove_leftovers()?;
        Ok((run, config))
    }

    /// Removes the temporary files that a killed process could not remove.
    fn remove_leftovers(&self) -> Result<()> {
        for folder in FOLDERS.map(|folder| self.file(folder)).iter().chain([&self.0]) {
            let entries = fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
            for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                if name.starts_with('.') && name.ends_with(".tmp") {
                    fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
                }
            }
        }
        Ok(())
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// A file in it.
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes `bytes` to `name`, whole or not at all.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        write_atomic(&self.file(name), |out| out.write_all(bytes))?;
        Ok(())
    }

    /// Writes `run.json`.
    pub fn write_config(&self, config: &RunConfig) -> Result<()> {
        self.write("run.json", &serde_json::to_vec_pretty(config)?)
    }

    /// Writes `cameras.json`, the training views; `camera` knows those of the dataset's views.
    pub fn write_cameras(&self, dataset: &Dataset, camera: impl Fn(usize) -> Camera) -> Result<()> {
        let records: Vec<CameraRecord> = dataset
            .train
            .iter()
            .map(|i| {
                let view = &dataset.views[*i];
                let Camera {
                    intrinsics: k, pose, ..
                } = camera(*i);
                let q = pose.rotation;
                CameraRecord {
                    name: view.name.clone(),
                    width: k.width,
                    height: k.height,
                    fx: k.fx,
                    fy: k.fy,
                    cx: k.cx,
                    cy: k.cy,
                    position: pose.position.to_array(),
                    rotation: [q.w, q.x, q.y, q.z],
                }
            })
            .collect();
        self.write("cameras.json", &serde_json::to_vec_pretty(&records)?)
    }

    /// The newest checkpoint, if there is one.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn newest_checkpoint(&self) -> Result<Option<PathBuf>> {
        Ok(self.checkpoints()?.pop().map(|(_, path)| path))
    }

    /// Steps and paths of the checkpoints, oldest first.
    fn checkpoints(&self) -> Result<Vec<(u64, PathBuf)>> {
        let folder = self.file("checkpoints");
        let entries = fs::read_dir(&folder).with_context(|| format!("cannot read {}", folder.display()))?;
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

    /// Writes the checkpoint of `step` and removes older ones; its name relative to the run.
    pub fn write_checkpoint(&self, step: u64, bytes: &[u8]) -> Result<String> {
        let name = format!("checkpoints/step_{step}.safetensors");
        self.write(&name, bytes)?;
        for (_, old) in self.checkpoints()?.into_iter().filter(|(s, _)| *s < step) {
            fs::remove_file(&old).with_context(|| format!("cannot remove {}", old.display()))?;
        }
        Ok(name)
    }
}

/// The scene's file where `path` is a run, `path` itself elsewhere.
pub fn scene_of(path: &Path) -> PathBuf {
    let files = [SCENE, FIELD].map(|name| path.join(name));
    files.into_iter().find(|file| file.is_file()).unwrap_or(path.to_owned())
}

/// The field in a file.
///
/// # Errors
/// When it cannot be read.
pub fn read_field(path: &Path) -> Result<Field> {
    let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    field_file::from_bytes(&bytes).with_context(|| path.display().to_string())
}

/// Whether `path` is named as the file of a field is.
pub fn is_field(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "safetensors")
}

/// The scene in a file: a field's where its name ends so, splats elsewhere; and whether it wants its opacities scaled.
///
/// # Errors
/// When it cannot be read.
pub fn read_scene(path: &Path) -> Result<(Model<'static>, bool)> {
    if is_field(path) {
        let field = read_field(path)?;
        if matches!(field.config.sampler, Sampler::Given { .. }) {
            bail!(
                "{} only adds to splats: name the {SCENE} that it lies beside",
                path.display()
            );
        }
        return Ok((Model::Field(Cow::Owned(field)), false));
    }
    let cloud = read_splats(path)?;
    let splats = Cow::Owned(Splats::from_cloud(&cloud));
    let residual = residual_beside(path)?.map(Box::new);
    Ok((Model::Splats { splats, residual }, cloud.antialiased))
}

/// What adds to the colours of a run's `scene`, if anything does.
///
/// # Errors
/// When it cannot be read.
pub fn residual_beside(scene: &Path) -> Result<Option<Field>> {
    let beside = scene.with_file_name(RESIDUAL);
    let is_there = scene.file_name().is_some_and(|name| name == SCENE) && beside.is_file();
    is_there.then(|| read_field(&beside)).transpose()
}

/// The cameras of the run that `scene` lies in, if it lies in one.
pub fn cameras_beside(scene: &Path) -> Option<Vec<Camera>> {
    let text = fs::read_to_string(scene.parent()?.join("cameras.json")).ok()?;
    let records: Vec<CameraRecord> = serde_json::from_str(&text).ok()?;
    let camera = |r: &CameraRecord| {
        let [w, x, y, z] = r.rotation;
        let mut k = Intrinsics::from_fov_x(r.width, r.height, 1.0);
        (k.fx, k.fy, k.cx, k.cy) = (r.fx, r.fy, r.cx, r.cy);
        Camera::new(
            Pose {
                rotation: Quat::from_xyzw(x, y, z, w),
                position: Vec3::from_array(r.position),
            },
            k,
        )
    };
    Some(records.iter().map(camera).collect())
}

/// Background and antialiasing of the run that `scene` lies in; the defaults elsewhere.
pub fn render_knobs_beside(scene: &Path) -> irradia_train::recipe::RenderKnobs {
    let fallback = irradia_train::recipe::RenderKnobs {
        background: [0.0; 3],
        antialias: false,
        smoothing_filter: false,
    };
    let Some(folder) = scene.parent() else { return fallback };
    fs::read_to_string(folder.join("recipe.toml"))
        .ok()
        .and_then(|text| irradia_train::Recipe::parse("beside the scene", &text, &[]).ok())
        .map_or(fallback, |recipe| recipe.render)
}
