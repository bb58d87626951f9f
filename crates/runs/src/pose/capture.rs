//! What is posed: photographs of one or several folders, frames of films, faces of panoramas.

use super::brought::bring_panorama;
use super::{MIN_PHOTOS, PoseProgress, film, is_film};
use crate::RunError;
use glam::{DQuat, DVec3};
use irradia_formats::{
    DatasetFormat, FormatError, PanoramaFace, PhotoEntry, PhotoFolder, find_panoramas, photo_files, read_photo_folder,
    read_photo_folders, write_atomic,
};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::map::{Mount, PhotoInfo};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Where frames of films and faces of panoramas are written, in the folder of the dataset.
const FRAMES: &str = "frames";
const FACES: &str = "faces";
/// What tells that the folder of faces is of an earlier call.
const FACES_RECORD: &str = "faces.json";
/// Folders within folders that are searched.
const DEPTH: usize = 2;

/// Folders of photographs, and films.
#[derive(Debug, Default, PartialEq)]
struct Sources {
    folders: Vec<PathBuf>,
    /// Films that were named.
    films: Vec<PathBuf>,
    /// Films in the folders.
    beside: Vec<PathBuf>,
    /// Those of them that a phone takes with a photograph of the same name.
    live: Vec<PathBuf>,
    /// Folders with photographs in folders of photographs.
    below: Vec<PathBuf>,
}

impl Sources {
    /// What `path` holds: a film; a folder of photographs and films; else what the folders in it hold.
    fn add(&mut self, path: &Path, depth: usize) -> Result<(), RunError> {
        if is_film(path) {
            self.films.push(path.to_owned());
            return Ok(());
        }
        if path.is_file() {
            return Err(FormatError::NotAFolder(path.to_owned()).into());
        }
        let read = RunError::io("read", path);
        let mut entries: Vec<PathBuf> = match fs::read_dir(path) {
            Ok(entries) => entries.flatten().map(|entry| entry.path()).collect(),
            Err(error) => return Err(read(error)),
        };
        entries.retain(|entry| {
            !entry
                .file_name()
                .is_some_and(|name| name.to_string_lossy().starts_with('.'))
        });
        entries.sort();
        let (photos, films) = (photo_files(path), entries.iter().filter(|entry| is_film(entry)));
        let stems: HashSet<PathBuf> = photos.iter().map(|photo| photo.with_extension("")).collect();
        let is_live = |film: &PathBuf| photos.len() >= MIN_PHOTOS && stems.contains(&film.with_extension(""));
        let (live, films): (Vec<_>, Vec<_>) = films.cloned().partition(is_live);
        self.live.extend(live);
        self.beside.extend(films);
        let is_beside = |entry: &Path| {
            let name = entry.file_name().unwrap_or_default().to_string_lossy();
            ["masks", "depths", "depth", "normals", "normal"].contains(&&*name) || name.starts_with("masks_")
        };
        entries.retain(|entry| entry.is_dir() && !is_beside(entry));
        if !photos.is_empty() {
            self.folders.push(path.to_owned());
            // They may hold smaller copies, or what was sorted out; datasets have folders of their own.
            if photos[0].parent() == Some(path) {
                let is_capture =
                    |entry: &PathBuf| DatasetFormat::recognise(entry).is_none() && !photo_files(entry).is_empty();
                self.below.extend(entries.into_iter().filter(is_capture));
            }
        } else if depth > 0 {
            // A folder of datasets is no capture.
            if !entries.iter().any(|entry| DatasetFormat::recognise(entry).is_some()) {
                for folder in &entries {
                    self.add(folder, depth - 1)?;
                }
            }
        }
        Ok(())
    }
}

/// Whether there is anything to pose at `path`: photographs or films, itself, in its folders, or in theirs.
pub fn is_capture(path: &Path) -> bool {
    let mut sources = Sources::default();
    sources.add(path, DEPTH).is_ok() && sources != Sources::default()
}

/// Empties a folder that an earlier call wrote, which its record tells, or creates it, with an empty record.
///
/// # Errors
/// When it holds anything of another origin, or cannot be written.
pub(super) fn begin(folder: &Path, record: &str) -> Result<(), RunError> {
    let record = folder.join(record);
    if folder.exists() {
        let is_empty = fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none());
        if !is_empty && !record.exists() {
            return Err(RunError::Refused(format!(
                "{} holds files of another origin: choose another --out",
                folder.display()
            )));
        }
        fs::remove_dir_all(folder).map_err(RunError::io("clear", folder))?;
    }
    fs::create_dir_all(folder).map_err(RunError::io("create", folder))?;
    write_atomic(&record, |file| file.write_all(b"[]\n"))?;
    Ok(())
}

/// Photographs that are to be posed.
#[derive(Debug)]
pub(super) struct Capture {
    /// The photographs, also those that stand for frames and panoramas.
    pub folder: PhotoFolder,
    /// Whether some are frames of films.
    pub has_films: bool,
    /// Faces of panoramas by their names, and the number of the panorama.
    faces: HashMap<String, (usize, PanoramaFace)>,
}

impl Capture {
    /// Reads what `paths` hold. Frames and faces are written into folders of `out`.
    ///
    /// # Errors
    /// When a path or a film cannot be read, or frames and faces have nowhere to be written or cannot be.
    pub fn read(
        paths: &[PathBuf],
        out: Option<&Path>,
        progress: &(dyn Fn(PoseProgress) + Sync),
    ) -> Result<Self, RunError> {
        let mut sources = Sources::default();
        for path in paths {
            sources.add(path, DEPTH)?;
        }
        let mut repeated: Vec<(String, String)> = Vec::new();
        let mut unused = |paths: Vec<PathBuf>, why: &str| {
            let name = |path: PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            repeated.extend(paths.into_iter().map(|path| (name(path), why.to_owned())));
        };
        sources.below.retain(|folder| !sources.folders.contains(folder));
        unused(
            sources.below,
            "a folder beside photographs: name it as well if its photographs are of the same scene",
        );
        unused(sources.live, "a film that was taken with the photograph of its name");
        let named = sources.films.len();
        match sources.beside.is_empty() || sources.folders.is_empty() || film::can_be_read() {
            true => sources.films.append(&mut sources.beside),
            false => unused(
                sources.beside,
                "a film, which needs ffmpeg: install it to use its frames",
            ),
        }
        let needs_out = |what: &str| {
            let path = paths.first().map(|path| path.display().to_string()).unwrap_or_default();
            RunError::Refused(format!("{path}: {what} need a folder to be written to: give --out"))
        };
        let mut damaged = Vec::new();
        if !sources.films.is_empty() {
            let folder = out.ok_or_else(|| needs_out("frames of a film"))?.join(FRAMES);
            damaged = film::frames(&sources.films, named, &folder, progress)?;
            sources.folders.push(folder);
        }
        let mut capture = Self {
            folder: read_photo_folders(&sources.folders)?,
            has_films: !sources.films.is_empty(),
            faces: HashMap::new(),
        };
        capture.folder.repeated.append(&mut repeated);
        capture.folder.left_out.append(&mut damaged);
        let panoramas = capture.take_panoramas();
        if !panoramas.is_empty() {
            let out = out.ok_or_else(|| needs_out("faces of panoramas"))?;
            capture.add_faces(&panoramas, out)?;
        }
        Ok(capture)
    }

    /// Whether there are panoramas.
    pub fn has_panoramas(&self) -> bool {
        !self.faces.is_empty()
    }

    /// Removes panoramas from the photographs.
    fn take_panoramas(&mut self) -> Vec<PhotoEntry> {
        let photos = std::mem::take(&mut self.folder.photos);
        let are = find_panoramas(&photos);
        let mut panoramas = Vec::new();
        for (photo, is) in photos.into_iter().zip(are) {
            match is {
                true => panoramas.push(photo),
                false => self.folder.photos.push(photo),
            }
        }
        panoramas
    }

    fn add_faces(&mut self, panoramas: &[PhotoEntry], out: &Path) -> Result<(), RunError> {
        let folder = &out.join(FACES);
        begin(folder, FACES_RECORD)?;
        let cut: Vec<Vec<PanoramaFace>> = panoramas
            .par_iter()
            .map(|panorama| panorama.cut_panorama(folder))
            .collect::<Result<_, _>>()?;
        for panorama in panoramas {
            bring_panorama(out, panorama)?;
        }
        let all = || cut.iter().flatten().map(|face| &face.name);
        let taken = |name: &&String| self.folder.photos.iter().any(|photo| photo.name == **name);
        let mut names = HashSet::new();
        if let Some(name) = all().find(|name| taken(name) || !names.insert(*name)) {
            return Err(RunError::Refused(format!(
                "a face of a panorama is named {name}, as another photograph: rename the panorama"
            )));
        }
        let of: HashMap<String, (usize, PanoramaFace)> = (cut.into_iter().enumerate())
            .flat_map(|(rig, faces)| faces.into_iter().map(move |face| (face.name.clone(), (rig, face))))
            .collect();
        let written = read_photo_folder(folder)?;
        self.folder.left_out.extend(written.left_out);
        self.folder.repeated.extend(written.repeated);
        for mut photo in written.photos {
            let (rig, face) = &of[&photo.name];
            let tags = &panoramas[*rig].tags;
            // A panorama tells its place once.
            photo.tags.gps = tags.gps.filter(|_| face.turn == DQuat::IDENTITY);
            photo.tags.time.clone_from(&tags.time);
            photo.tags.focal = Some(f64::from(face.camera.fx) / f64::from(photo.width.max(photo.height)));
            self.folder.photos.push(photo);
        }
        self.folder.photos.sort_by(|a, b| a.name.cmp(&b.name));
        self.faces = of;
        Ok(())
    }

    /// What the mapper is told of the photographs `used`, indices of the folder's.
    pub fn infos(&self, used: &[usize]) -> Vec<PhotoInfo> {
        let groups = self.folder.groups();
        // Groups are numbered from 0 without gaps, also where photographs could not be decoded.
        let mut numbers: Vec<usize> = Vec::new();
        let info = |i: &usize| {
            let photo = &self.folder.photos[*i];
            let known = numbers.iter().position(|group| *group == groups[*i]);
            let group = known.unwrap_or_else(|| {
                numbers.push(groups[*i]);
                numbers.len() - 1
            });
            let face = self.faces.get(&photo.name);
            PhotoInfo {
                name: photo.name.clone(),
                width: photo.width,
                height: photo.height,
                group,
                focal_prior_px: photo.focal_px(),
                up: face.map_or(photo.up, |(_, face)| Some(face.turn.inverse() * DVec3::NEG_Y)),
                camera: face.map(|(_, face)| DCamera::pinhole(&face.camera)),
                mount: face.map(|(rig, face)| Mount {
                    rig: *rig,
                    rotation: face.turn,
                }),
            }
        };
        used.iter().map(info).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_formats::write_png;

    #[test]
    fn folders_of_others_are_not_emptied() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("frames");
        begin(&folder, "record.json").unwrap();
        fs::write(folder.join("old.jpg"), "written by an earlier call").unwrap();
        begin(&folder, "record.json").unwrap();
        assert!(!folder.join("old.jpg").exists());
        fs::remove_file(folder.join("record.json")).unwrap();
        begin(&folder, "record.json").unwrap();
        fs::remove_file(folder.join("record.json")).unwrap();
        fs::write(folder.join("mine.jpg"), "somebody's").unwrap();
        let error = begin(&folder, "record.json").unwrap_err().to_string();
        assert!(error.contains("another origin"), "{error}");
        assert!(folder.join("mine.jpg").exists());
    }

    #[test]
    fn a_phones_film_of_a_photograph_is_none_of_the_capture() {
        let root = tempfile::tempdir().unwrap();
        let write = |names: &[&str]| {
            names
                .iter()
                .for_each(|name| fs::write(root.path().join(name), "by its name").unwrap())
        };
        let live = |expected: &[&str]| {
            let mut sources = Sources::default();
            sources.add(root.path(), DEPTH).unwrap();
            let [live, beside] = [sources.live, sources.beside];
            assert_eq!(
                live,
                expected.iter().map(|name| root.path().join(name)).collect::<Vec<_>>()
            );
            assert_eq!(live.len() + beside.len(), 2);
        };
        write(&["IMG_1.MOV", "walk.mp4", "walk.jpg"]);
        // A picture of a film is no capture beside it.
        live(&[]);
        write(&["IMG_1.HEIC", "IMG_2.JPG"]);
        live(&["IMG_1.MOV", "walk.mp4"]);
    }

    #[test]
    fn folders_in_folders_are_a_capture_and_datasets_are_none() {
        let root = tempfile::tempdir().unwrap();
        let photo = |path: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            write_png(&path, 8, 8, 1, &[7; 64]).unwrap();
        };
        assert!(!is_capture(root.path()));
        photo("days/monday/1.png");
        photo("days/tuesday/morning/1.png");
        photo("days/masks/1.png");
        fs::write(root.path().join("days/walk.mp4"), "a film by its name").unwrap();
        let mut sources = Sources::default();
        let days = root.path().join("days");
        sources.add(&days, DEPTH).unwrap();
        assert_eq!(
            sources.folders,
            ["monday", "tuesday/morning"].map(|name| days.join(name))
        );
        assert_eq!(sources.beside, [days.join("walk.mp4")]);
        assert!(sources.films.is_empty() && sources.live.is_empty());
        assert!(is_capture(&days) && is_capture(&days.join("walk.mp4")));
        // One of several folders has poses: whatever the others are, they are not one capture with it.
        photo("sets/posed/images/1.png");
        fs::write(root.path().join("sets/posed/transforms.json"), "{}").unwrap();
        photo("sets/other/1.png");
        assert!(!is_capture(&root.path().join("sets")));
    }
}
