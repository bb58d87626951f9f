//! Edits of a scene on disk: read, replay a list, write.

use crate::folder::{cameras_beside, cameras_moved};
use crate::scene_file::is_field;
use crate::{RunError, RunFolder, SCENE, Scene, scene_of, write_image};
use irradia_edit::{Applied, Draft, Edit, EditList, Operation, Transform, apply, select};
use irradia_formats::{SplatFormat, WriteOptions, read_splat_file, write_splats_with};
use irradia_scene::GaussianCloud;
use irradia_splat::{RenderOptions, Splats};
use irradia_train::model::Model;
use std::borrow::Cow;
use std::fs;
use std::path::{Path, PathBuf};

/// The list of edits beside an edited scene.
pub const EDITS: &str = "edits.toml";

/// A scene in memory with its edits, from a splat file or a run.
pub struct Editing {
    /// The file of the scene.
    path: PathBuf,
    draft: Draft,
    list: EditList,
    made: Vec<Made>,
    /// How the whole scene was moved, in the dataset's coordinates.
    moved: Transform,
    splits: Vec<(String, GaussianCloud)>,
    /// What was left out when the scene was read, a line each.
    pub notes: Vec<String>,
}

/// An edit that was made.
#[derive(Clone, Debug, PartialEq)]
pub struct Made {
    /// The edit, with everything that was found automatically written out.
    pub edit: Edit,
    /// Splats that were selected, and that there were.
    pub selected: [usize; 2],
    /// Splats after it.
    pub splats: usize,
}

impl Editing {
    /// Reads a scene; the cameras beside it are known to the edits.
    ///
    /// # Errors
    /// When it cannot be read, or is a field.
    pub fn open(input: &Path) -> Result<Self, RunError> {
        let path = scene_of(input);
        if is_field(&path) {
            let message = format!("{} is a radiance field; only splats can be edited", path.display());
            return Err(RunError::Refused(message));
        }
        let file = read_splat_file(&path)?;
        let cameras = cameras_beside(&path, &file.cloud.world_from_dataset).unwrap_or_default();
        Ok(Self {
            notes: file.warnings(),
            draft: Draft::new(file.cloud, cameras),
            path,
            list: EditList::default(),
            made: Vec::new(),
            moved: Transform::IDENTITY,
            splits: Vec::new(),
        })
    }

    /// The scene as the edits left it.
    pub fn draft(&self) -> &Draft {
        &self.draft
    }

    /// The edits made, with everything that was found automatically written out.
    pub fn list(&self) -> &EditList {
        &self.list
    }

    /// What the edits did.
    pub fn made(&self) -> &[Made] {
        &self.made
    }

    /// Makes edits in their order. Scenes to merge are found from the current folder.
    ///
    /// # Errors
    /// When one is not possible; those before it have been made.
    pub fn apply(&mut self, list: &EditList) -> Result<(), RunError> {
        list.check()?;
        for edit in &list.edits {
            let before = self.draft.len();
            let Applied {
                edit,
                selected,
                moved,
                split,
                ..
            } = apply(&mut self.draft, edit, &open_scene)?;
            if let Some(moved) = moved {
                self.moved = self.moved.then(&moved);
            }
            self.splits.extend(split);
            self.list.edits.push(edit.clone());
            self.made.push(Made {
                edit,
                selected: [selected, before],
                splats: self.draft.len(),
            });
        }
        Ok(())
    }

    /// What each edit would select, if those before it had been made. Nothing changes.
    ///
    /// # Errors
    /// Those of [`Self::apply`].
    pub fn preview(&self, edit: &Edit) -> Result<usize, RunError> {
        Ok(match &edit.select {
            Some(steps) => select(&self.draft, steps)?.count(),
            None => self.draft.len(),
        })
    }

    /// Writes the scene without hidden splats: to a file, whose name selects the format, or to a folder, which gets `scene.ply`, the
    /// cameras, the recipe, by which it is rendered, and `edits.toml`. Scenes that were split off are written beside it. Returns what the reader should
    /// know, a line each.
    ///
    /// # Errors
    /// When the format is unknown, the output is a run or would replace the input, or a file cannot be written.
    pub fn write(&self, output: &Path, options: &WriteOptions) -> Result<Vec<String>, RunError> {
        let is_file = SplatFormat::of(output).is_ok();
        if !is_file && output.extension().is_some() && !output.is_dir() {
            // The known endings.
            SplatFormat::of(output)?;
        }
        let file = match is_file {
            true => output.to_owned(),
            false => output.join(SCENE),
        };
        if same_file(&file, &self.path) {
            let message = format!("{} would be replaced: name another output", self.path.display());
            return Err(RunError::Refused(message));
        }
        if !is_file && output.join("run.json").exists() {
            let message = format!("{} holds a run: name another folder", output.display());
            return Err(RunError::Refused(message));
        }
        let mut notes = Vec::new();
        for (name, cloud) in &self.splits {
            let path = self.beside(&file, name)?;
            notes.extend(write_splats_with(&path, cloud, options)?);
            notes.push(format!("{}: {} splats split off", path.display(), cloud.len()));
        }
        if !is_file {
            fs::create_dir_all(output).map_err(RunError::io("create", output))?;
            let folder = RunFolder::at(output);
            if let Some(cameras) = cameras_moved(&self.path, &self.moved) {
                folder.write("cameras.json", &cameras)?;
            }
            if let Ok(recipe) = fs::read(self.path.with_file_name("recipe.toml")) {
                folder.write("recipe.toml", &recipe)?;
            }
            folder.write(EDITS, self.list.to_toml().as_bytes())?;
            if self.path.with_file_name(crate::RESIDUAL).is_file() {
                notes.push(format!(
                    "{} is left out: it belongs to the scene as it was",
                    crate::RESIDUAL
                ));
            }
        }
        notes.extend(write_splats_with(&file, &self.draft.shown(), options)?);
        match self.draft.hidden.count() {
            0 => {}
            hidden => notes.push(format!("{hidden} hidden splats left out")),
        }
        Ok(notes)
    }

    /// The file for a scene that is split off, beside `file`.
    fn beside(&self, file: &Path, name: &str) -> Result<PathBuf, RunError> {
        let mut path = file.with_file_name(name);
        if SplatFormat::of(&path).is_err() {
            path = file.with_file_name(format!("{name}.ply"));
        }
        let is_taken = same_file(&path, file) || same_file(&path, &self.path);
        match is_taken {
            true => Err(RunError::Refused(format!(
                "split {name}: {} is the scene itself; choose another name",
                path.display()
            ))),
            false => Ok(path),
        }
    }

    /// Writes `before.png` and `after.png` to a folder: the scene around which a camera looks, as it was and as it is.
    ///
    /// # Errors
    /// When the scene cannot be read again or a picture cannot be written.
    pub fn write_pictures(&self, folder: &Path) -> Result<(), RunError> {
        fs::create_dir_all(folder).map_err(RunError::io("create", folder))?;
        let before = Scene::read(&self.path)?;
        let options = before.options;
        let size = {
            let k = before.outlook().intrinsics;
            let factor = (800.0 / k.width.max(k.height) as f32).min(1.0);
            let k = k.scaled(factor);
            (k.width, k.height)
        };
        let camera = before.orbit(1, Some(size))[0];
        write_image(folder.join("before.png"), &before.render(&camera).color)?;
        let after = self.scene(options);
        let camera = match self.moved.is_identity() {
            true => camera,
            // The camera that moved along.
            false => after.orbit(1, Some(size))[0],
        };
        write_image(folder.join("after.png"), &after.render(&camera).color)
    }

    /// The scene as it is drawn.
    fn scene(&self, options: RenderOptions) -> Scene {
        Scene {
            model: Model::Splats {
                splats: Cow::Owned(Splats::from_cloud(&self.draft.shown())),
                residual: None,
            },
            options,
            cameras: (!self.draft.cameras.is_empty()).then(|| self.draft.cameras.clone().into()),
            world_from_dataset: self.draft.cloud.world_from_dataset,
        }
    }
}

/// Whether the edits of a list leave the splats where the photographs saw them.
pub fn keeps_place(list: &EditList) -> bool {
    list.edits.iter().all(|edit| match edit.op {
        Operation::Move { .. } | Operation::Rotate { .. } | Operation::Scale { .. } => edit.select.is_some(),
        Operation::Upright { .. } | Operation::SetLength { .. } => false,
        _ => true,
    })
}

fn open_scene(file: &str) -> Result<GaussianCloud, String> {
    let path = scene_of(Path::new(file));
    Ok(read_splat_file(&path).map_err(|error| error.to_string())?.cloud)
}

fn same_file(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        _ => false,
    }
}
