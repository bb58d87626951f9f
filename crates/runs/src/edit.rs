//! Edits of a scene on disk: read the scene, apply a list of edits, write the result.

use crate::cameras::{CAMERAS, cameras_beside, moved_cameras_json, write_own_cameras};
use crate::folder::{SKY, VIGNETTE};
use crate::levels::{remove_levels, write_scene};
use crate::lock::FolderLock;
use crate::photographs::photographs_of;
use crate::scene_file::{check_not_overwritten, is_field, same_file};
use crate::{RunError, RunFolder, SCENE, Scene, residual_left_out, scene_path, write_image};
use irradia_edit::{Applied, Draft, Edit, EditList, Provenance, Transform, apply};
use irradia_formats::{
    SplatFile, SplatFormat, StagedFile, WriteOptions, encode_splats, read_splat_file, write_splats, write_splats_with,
};
use irradia_scene::{ExtraColumn, GaussianCloud};
use irradia_splat::Splats;
use irradia_train::checkpoint::{splats_of, with_splats};
use std::cell::RefCell;
use std::fs;
use std::io::ErrorKind;
use std::iter;
use std::path::{Path, PathBuf};

/// The list of edits beside an edited scene.
pub const EDITS: &str = "edits.toml";
/// Files beside a scene that are needed to render it.
const RENDERING: [&str; 3] = ["recipe.toml", SKY, VIGNETTE];

/// A scene in memory with its edits, from a splat file or a run.
pub struct Editing {
    /// The file of the scene.
    path: PathBuf,
    /// The files of merged scenes.
    merged: Vec<PathBuf>,
    draft: Draft,
    list: EditList,
    applied: Vec<AppliedEdit>,
    /// How the whole scene was moved, in the dataset's coordinates.
    moved: Transform,
    splits: Vec<(String, GaussianCloud)>,
    /// What was left out when the scene and those merged into it were read, and merged scenes that look different in it, a line each.
    pub notes: Vec<String>,
}

/// An edit that was made.
#[derive(Clone, Debug, PartialEq)]
pub struct AppliedEdit {
    /// The edit, with all automatically determined values written out.
    pub edit: Edit,
    /// Number of selected splats, and of all splats before the edit.
    pub selected: [usize; 2],
    /// Number of splats after the edit.
    pub splats: usize,
}

impl Editing {
    /// Reads a scene; edits may use the cameras beside it.
    ///
    /// # Errors
    /// When it cannot be read, or is a field.
    pub fn open(input: &Path) -> Result<Self, RunError> {
        let path = scene_path(input);
        if is_field(&path) {
            let message = format!("{} is a radiance field; only splats can be edited", path.display());
            return Err(RunError::Refused(message));
        }
        let file = read_splat_file(&path)?;
        let cameras = cameras_beside(&path, &file.cloud.world_from_dataset).unwrap_or_default();
        let notes = file.warnings();
        let mut draft = Draft::new(file.cloud, cameras);
        draft.photographs = photographs_of(&path);
        Ok(Self {
            notes,
            draft,
            path,
            merged: Vec::new(),
            list: EditList::default(),
            applied: Vec::new(),
            moved: Transform::IDENTITY,
            splits: Vec::new(),
        })
    }

    /// The scene as the edits left it.
    pub fn draft(&self) -> &Draft {
        &self.draft
    }

    /// The edits made, with all automatically determined values written out.
    pub fn list(&self) -> &EditList {
        &self.list
    }

    /// What the edits did.
    pub fn applied(&self) -> &[AppliedEdit] {
        &self.applied
    }

    /// Applies edits in order. Scenes to merge are looked up in the current folder, then beside this scene.
    ///
    /// # Errors
    /// When an edit is not possible; the edits before it have been applied.
    pub fn apply(&mut self, list: &EditList) -> Result<(), RunError> {
        list.check()?;
        for edit in &list.edits {
            let before = self.draft.len();
            let antialiased = self.draft.cloud.antialiased;
            let columns: Vec<ExtraColumn> = self.draft.cloud.extra.iter().map(|column| column.zeros(0)).collect();
            let (notes, merged) = (RefCell::new(Vec::new()), RefCell::new(Vec::new()));
            let open = |file: &str| {
                let (path, other) = open_scene(file, &self.path)?;
                notes
                    .borrow_mut()
                    .extend(merge_notes(file, &other, antialiased, &columns));
                merged.borrow_mut().push(path);
                Ok(other.cloud)
            };
            let Applied {
                edit,
                selected,
                moved,
                split,
                ..
            } = apply(&mut self.draft, edit, &open)?;
            self.notes.extend(notes.into_inner());
            self.merged.extend(merged.into_inner());
            if let Some(moved) = moved {
                self.moved = self.moved.then(&moved);
            }
            self.splits.extend(split);
            self.list.edits.push(edit.clone());
            self.applied.push(AppliedEdit {
                edit,
                selected: [selected, before],
                splats: self.draft.len(),
            });
        }
        Ok(())
    }

    /// Writes the scene without hidden splats: to a file, whose name selects the format, or to a folder, which gets `scene.ply`, the
    /// cameras, the recipe (for rendering) and `edits.toml`. Scenes that were split off are written beside it. Returns notes for the user,
    /// a line each.
    ///
    /// # Errors
    /// When the format is unknown, the output is a run or would replace the input, or a file cannot be written.
    pub fn write(&self, output: &Path, options: &WriteOptions) -> Result<Vec<String>, RunError> {
        let is_file = SplatFormat::of(output).is_ok();
        if !is_file && output.extension().is_some() && !output.is_dir() {
            // The error lists the known extensions.
            SplatFormat::of(output)?;
        }
        let file = if is_file { output.to_owned() } else { output.join(SCENE) };
        self.check_output(&file)?;
        if !is_file {
            check_folder(output)?;
        }
        let splits = self.split_files(&file)?;
        let mut notes = Vec::new();
        if !is_file {
            fs::create_dir_all(output).map_err(RunError::io("create", output))?;
            let folder = RunFolder::at(output);
            let cameras = (CAMERAS, moved_cameras_json(&self.path, &self.moved));
            // Rendering needs these.
            let others = RENDERING.map(|name| (name, fs::read(self.path.with_file_name(name)).ok()));
            for (name, content) in iter::once(cameras).chain(others) {
                match content {
                    Some(content) => folder.write(name, &content)?,
                    // Of the scene before.
                    None => folder.remove(name)?,
                }
            }
            folder.write(EDITS, self.list.to_toml().as_bytes())?;
        }
        notes.extend(residual_left_out(&self.path, "it belongs to the scene before the edit"));
        for (path, cloud) in &splits {
            notes.extend(write_splats_with(path, cloud, options)?);
            notes.push(format!("{}: {} splats split off", path.display(), cloud.len()));
        }
        notes.extend(write_scene(&file, &self.draft.visible_cloud(), options)?);
        if is_file {
            write_own_cameras(&self.path, &file, &self.moved)?;
        }
        match self.draft.hidden.count() {
            0 => {}
            hidden => notes.push(format!("{hidden} hidden splats left out")),
        }
        Ok(notes)
    }

    /// Rejects an output that would replace the scene or one that was merged into it.
    ///
    /// # Errors
    /// When it would.
    pub fn check_output(&self, output: &Path) -> Result<(), RunError> {
        iter::once(&self.path)
            .chain(&self.merged)
            .try_for_each(|input| check_not_overwritten(input, output))
    }

    /// Overwrites the scene of its run with the edited one, and appends the edits to the run's `edits.toml`. The latest checkpoint is
    /// edited in the same way: unchanged splats keep their moments, and the run resumes with the edited splats. None of them is replaced
    /// before all of them are written under temporary names. Returns notes for the user, a line each.
    ///
    /// # Errors
    /// When the scene is not a run's, the whole scene was moved away from its photographs, the run is training, the file of a split already
    /// exists, or a file cannot be written.
    pub fn write_in_place(&self) -> Result<Vec<String>, RunError> {
        let refused = |message: String| Err(RunError::Refused(message));
        let folder = match RunFolder::containing(&self.path) {
            Some(folder) if self.path == folder.file(SCENE) => folder,
            _ => return refused(format!("{} is not a run: name an output with -o", self.path.display())),
        };
        if !self.moved.is_identity() {
            return refused(
                "the whole scene would be moved away from its photographs: name another folder with -o".to_owned(),
            );
        }
        let scene = self.draft.visible_cloud();
        if scene.is_empty() {
            return refused("nothing would be left of the run: name an output with -o".to_owned());
        }
        let _lock = FolderLock::acquire(folder.path())?;
        let path = folder.file(EDITS);
        let mut list = match fs::read_to_string(&path) {
            Ok(text) => EditList::parse(&text).map_err(|error| RunError::Damaged {
                path,
                reason: error.to_string(),
            })?,
            Err(error) if error.kind() == ErrorKind::NotFound => EditList::default(),
            // Otherwise the list of all earlier edits would be replaced.
            Err(error) => return Err(RunError::io("read", &path)(error)),
        };
        list.edits.extend(self.list.edits.iter().cloned());
        let splits = self.split_files(&self.path)?;
        // An existing file may be the only copy of what an earlier edit split off.
        if let Some((path, _)) = splits.iter().find(|(path, _)| path.exists()) {
            return refused(format!("split: {} exists already; choose another name", path.display()));
        }
        let mut notes = Vec::new();
        let mut staged = Vec::new();
        if let Some(path) = folder.newest_checkpoint()? {
            let (bytes, kept) = self.edited_checkpoint(&path)?;
            staged.push(StagedFile::write(&path, |out| out.write_all(&bytes))?);
            notes.push(format!("{}: {kept} splats keep their optimiser state", path.display()));
        }
        staged.push(StagedFile::write(&self.path, |out| {
            out.write_all(&encode_splats(SplatFormat::Ply, &scene, &WriteOptions::default())?)
        })?);
        staged.push(StagedFile::write(&folder.file(EDITS), |out| {
            out.write_all(list.to_toml().as_bytes())
        })?);
        for (path, cloud) in &splits {
            write_splats(path, cloud)?;
            notes.push(format!("{}: {} splats split off", path.display(), cloud.len()));
        }
        staged.into_iter().try_for_each(StagedFile::put_in_place)?;
        remove_levels(&self.path)?;
        notes.push("the run's figures are from before the edit: run irradia eval to measure again".to_owned());
        Ok(notes)
    }

    /// A checkpoint with the edits applied, and the number of splats that keep their moments.
    fn edited_checkpoint(&self, path: &Path) -> Result<(Vec<u8>, usize), RunError> {
        let failed = |source| RunError::File {
            path: path.to_owned(),
            source,
        };
        let bytes = fs::read(path).map_err(RunError::io("read", path))?;
        let mut cloud = splats_of(&bytes).map_err(failed)?.to_cloud();
        let degree = cloud.sh_degree;
        cloud.antialiased = self.draft.cloud.antialiased;
        cloud.world_from_dataset = self.draft.cloud.world_from_dataset;
        let mut draft = Draft::new(cloud, self.draft.cameras.clone());
        // Edits that depend on photographs decide as they did on the scene.
        draft.photographs = self.draft.photographs.clone();
        let mut total = Provenance::identity(draft.len());
        for edit in &self.list.edits {
            let open = |file: &str| Ok(open_scene(file, &self.path)?.1.cloud);
            total = total.then(&apply(&mut draft, edit, &open)?.provenance);
        }
        draft.cloud.set_degree(degree);
        let source = |i: usize| total.source(i).filter(|_| !total.changed.contains(i));
        let shown = (0..draft.len()).filter(|i| !draft.hidden.contains(*i));
        let sources: Vec<Option<u32>> = shown.map(source).collect();
        let splats = Splats::from_cloud(&draft.visible_cloud());
        let bytes = with_splats(&bytes, &splats, &sources).map_err(failed)?;
        Ok((bytes, sources.iter().flatten().count()))
    }

    /// The scenes that were split off and their files, beside `file`.
    ///
    /// # Errors
    /// When two of them, or one and the scene itself, would have the same file, or one would replace a merged scene.
    fn split_files(&self, file: &Path) -> Result<Vec<(PathBuf, &GaussianCloud)>, RunError> {
        let mut files: Vec<(PathBuf, &GaussianCloud)> = Vec::new();
        for (name, cloud) in &self.splits {
            let mut path = file.with_file_name(name);
            if SplatFormat::of(&path).is_err() {
                path = file.with_file_name(format!("{name}.ply"));
            }
            let is_scene = path == file || same_file(&path, &self.path);
            if is_scene || files.iter().any(|(other, _)| *other == path) {
                let what = if is_scene {
                    "the scene itself"
                } else {
                    "split off before"
                };
                return Err(RunError::Refused(format!(
                    "split {name}: {} is {what}; choose another name",
                    path.display()
                )));
            }
            self.check_output(&path)?;
            files.push((path, cloud));
        }
        Ok(files)
    }

    /// Writes `before.png` and `after.png` to a folder: renders of the scene before and after the edits, by one camera of its orbit.
    ///
    /// # Errors
    /// When the scene cannot be read again or an image cannot be written.
    pub fn write_pictures(&self, folder: &Path) -> Result<(), RunError> {
        fs::create_dir_all(folder).map_err(RunError::io("create", folder))?;
        let before = Scene::read(&self.path)?;
        let options = before.options;
        let size = {
            let k = before.orbit_geometry().intrinsics;
            let factor = (800.0 / k.width.max(k.height) as f32).min(1.0);
            let k = k.scaled(factor);
            (k.width, k.height)
        };
        let camera = before.orbit(1, Some(size))[0];
        write_image(folder.join("before.png"), &before.render(&camera).color)?;
        let after = Scene::of_draft(&self.draft, options);
        let camera = if self.moved.is_identity() {
            camera
        } else {
            // The same camera, moved with the scene.
            after.orbit(1, Some(size))[0]
        };
        write_image(folder.join("after.png"), &after.render(&camera).color)
    }
}

/// Rejects a folder with files that an edited scene's folder also has, unless they are an edited scene's.
fn check_folder(folder: &Path) -> Result<(), RunError> {
    if folder.join("run.json").exists() {
        let message = format!("{} holds a run: name another folder", folder.display());
        return Err(RunError::Refused(message));
    }
    let is_list = |path: PathBuf| fs::read_to_string(path).is_ok_and(|text| EditList::parse(&text).is_ok());
    if folder.join(SCENE).is_file() && is_list(folder.join(EDITS)) {
        return Ok(());
    }
    let mut names = [CAMERAS, EDITS].into_iter().chain(RENDERING);
    match names.find(|name| folder.join(name).exists()) {
        Some(name) => Err(RunError::Refused(format!(
            "{} would be replaced, and {} is not the folder of an edited scene: name another folder",
            folder.join(name).display(),
            folder.display()
        ))),
        None => Ok(()),
    }
}

/// The scene `file` and its path, looked up in the current folder, then beside the scene `path`.
fn open_scene(file: &str, path: &Path) -> Result<(PathBuf, SplatFile), String> {
    let here = Path::new(file);
    let path = if here.exists() {
        scene_path(here)
    } else {
        scene_path(&path.with_file_name(file))
    };
    let scene = read_splat_file(&path).map_err(|error| error.to_string())?;
    Ok((path, scene))
}

/// What was left out of the merged scene `file`, whether its splats look different in a scene that is `antialiased` or not, and which of
/// its numbers have no place in that scene's extra `columns`; a line each.
pub fn merge_notes(file: &str, other: &SplatFile, antialiased: bool, columns: &[ExtraColumn]) -> Vec<String> {
    let difference = match (other.cloud.antialiased, antialiased) {
        (true, false) => Some("with Mip-Splatting's filter, this scene without: its smallest splats become too opaque"),
        (false, true) => {
            Some("without Mip-Splatting's filter, this scene with it: its smallest splats become too transparent")
        }
        _ => None,
    };
    let difference = difference.map(|difference| format!("trained {difference}"));
    // A file has one type for each name.
    let is_lost = |column: &&ExtraColumn| {
        let own = columns.iter().find(|own| own.name == column.name);
        own.is_some_and(|own| !own.is_like(column))
    };
    let lost: Vec<&str> = (other.cloud.extra.iter().filter(is_lost))
        .map(|column| column.name.as_str())
        .collect();
    let lost = (!lost.is_empty()).then(|| {
        let names = lost.join(", ");
        format!("properties that have another type in this scene become zero: {names}")
    });
    let notes = other.warnings().into_iter().chain(difference).chain(lost);
    notes.map(|note| format!("{file}: {note}")).collect()
}
