//! The folder of a run, and what is read back from it.

use crate::Usage;
use anyhow::{Context, Result};
use glam::{Quat, Vec3};
use irradia_formats::write_atomic;
use irradia_scene::{Camera, Dataset, Intrinsics, Pose};
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::{Path, PathBuf};

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
    /// Makes the folder for a new run.
    ///
    /// # Errors
    /// When it already holds a run and `overwrite` is not set, or cannot be made.
    pub fn create(path: &Path, overwrite: bool) -> Result<Self> {
        let run = Self(path.to_owned());
        let holds_a_run = ["events.jsonl", "recipe.toml", "report.json", "scene.ply"]
            .iter()
            .any(|f| path.join(f).exists());
        if holds_a_run && !overwrite {
            let message = format!(
                "{} already holds a run: give another --out, --overwrite to replace it, or --resume {0} to go on with it",
                path.display()
            );
            return Err(Usage(message).into());
        }
        if path.exists() && !path.is_dir() {
            return Err(Usage(format!("{} is a file: --out takes a folder", path.display())).into());
        }
        if holds_a_run {
            for folder in ["eval", "checkpoints"] {
                if path.join(folder).exists() {
                    fs::remove_dir_all(path.join(folder))
                        .with_context(|| format!("cannot clear {}", path.join(folder).display()))?;
                }
            }
            for file in [
                "events.jsonl",
                "report.json",
                "report.html",
                "scene.ply",
                "run.json",
                "cameras.json",
            ] {
                if path.join(file).exists() {
                    fs::remove_file(path.join(file))
                        .with_context(|| format!("cannot clear {}", path.join(file).display()))?;
                }
            }
        }
        for folder in ["eval", "checkpoints"] {
            fs::create_dir_all(path.join(folder))
                .with_context(|| format!("cannot make {}", path.join(folder).display()))?;
        }
        Ok(run)
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
        Ok((Self(path.to_owned()), config))
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

    /// Writes `cameras.json`, the training views.
    pub fn write_cameras(&self, dataset: &Dataset) -> Result<()> {
        let records: Vec<CameraRecord> = dataset
            .train
            .iter()
            .map(|i| {
                let view = &dataset.views[*i];
                let (k, pose) = (&view.camera.intrinsics, &view.camera.pose);
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

    /// The newest checkpoint.
    ///
    /// # Errors
    /// When there is none, or the folder cannot be read.
    pub fn newest_checkpoint(&self) -> Result<PathBuf> {
        let folder = self.file("checkpoints");
        self.checkpoints()?
            .pop()
            .map(|(_, path)| path)
            .with_context(|| format!("{} holds no checkpoint: start anew with --overwrite", folder.display()))
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
    };
    let Some(folder) = scene.parent() else { return fallback };
    fs::read_to_string(folder.join("recipe.toml"))
        .ok()
        .and_then(|text| irradia_train::Recipe::parse("beside the scene", &text, &[]).ok())
        .map_or(fallback, |recipe| recipe.render)
}
