//! The photographs to pose: those of one or several folders, frames of films, faces of panoramas.

use super::import::import_panorama;
use super::{MIN_PHOTOS, PoseProgress, film, is_film};
use crate::RunError;
use crate::scene_file::same_file;
use glam::{DQuat, DVec3};
use irradia_formats::{
    DatasetFormat, FormatError, PanoramaFace, PhotoEntry, PhotoFolder, find_panoramas, photo_files, read_chosen_photos,
    read_photo_folder, write_atomic,
};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::map::{PhotoInfo, RigMount, Sensor};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Subfolders of the dataset's folder for frames of films and faces of panoramas.
const FRAMES_FOLDER: &str = "frames";
const FACES_FOLDER: &str = "faces";
/// File that marks the folder of faces as written by an earlier call.
const FACES_RECORD: &str = "faces.json";
/// Depth of subfolders that are searched.
const MAX_FOLDER_DEPTH: usize = 2;

/// Folders of photographs, and films.
#[derive(Debug, Default, PartialEq)]
struct Sources {
    folders: Vec<PathBuf>,
    /// Films that the user named.
    films: Vec<PathBuf>,
    /// Films found in folders, except `live` ones.
    found_films: Vec<PathBuf>,
    /// Films that a phone took along with a photograph of the same name.
    live: Vec<PathBuf>,
    /// Subfolders with photographs in folders of photographs.
    subfolders: Vec<PathBuf>,
}

impl Sources {
    /// Adds `path`, which is a film or a folder of photographs and films, or otherwise the subfolders of `path` except `out`.
    fn add(&mut self, path: &Path, out: Option<&Path>, depth: usize) -> Result<(), RunError> {
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
        self.found_films.extend(films);
        let is_beside = |entry: &Path| {
            let name = entry.file_name().unwrap_or_default().to_string_lossy();
            ["masks", "depths", "depth", "normals", "normal"].contains(&&*name) || name.starts_with("masks_")
        };
        let is_out = |entry: &Path| out.is_some_and(|out| same_file(entry, out));
        entries.retain(|entry| entry.is_dir() && !is_beside(entry) && !is_out(entry));
        if !photos.is_empty() {
            self.folders.push(path.to_owned());
            // Subfolders may contain smaller copies, or rejected photographs; datasets have subfolders of their own.
            if photos[0].parent() == Some(path) {
                let is_capture =
                    |entry: &PathBuf| DatasetFormat::recognise(entry).is_none() && !photo_files(entry).is_empty();
                self.subfolders.extend(entries.into_iter().filter(is_capture));
            }
        } else if depth > 0 && !path.join("run.json").is_file() {
            // The pictures in the folder of a run are its results, and a folder of datasets is not a capture.
            if !entries.iter().any(|entry| DatasetFormat::recognise(entry).is_some()) {
                for folder in &entries {
                    self.add(folder, out, depth - 1)?;
                }
            }
        }
        Ok(())
    }
}

/// Whether there is anything to pose at `path`: `path` is a film, or contains photographs or films, up to two levels of subfolders deep.
pub fn is_capture(path: &Path) -> bool {
    let mut sources = Sources::default();
    sources.add(path, None, MAX_FOLDER_DEPTH).is_ok() && sources != Sources::default()
}

/// The files of the photographs that [`super::pose`] finds at `path`.
pub fn photographs_in(path: &Path) -> Vec<PathBuf> {
    let mut sources = Sources::default();
    // What cannot be read has no photographs.
    let _ = sources.add(path, None, MAX_FOLDER_DEPTH);
    sources.folders.iter().flat_map(|folder| photo_files(folder)).collect()
}

/// Creates a folder with an empty record, or empties it if its record shows that an earlier call wrote it.
///
/// # Errors
/// When the folder contains files without a record, or cannot be written.
pub(super) fn prepare_folder(folder: &Path, record: &str) -> Result<(), RunError> {
    let record = folder.join(record);
    if folder.exists() {
        let is_empty = fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none());
        if !is_empty && !record.exists() {
            return Err(RunError::Refused(format!(
                "{} contains files from another source: choose another --out",
                folder.display()
            )));
        }
        fs::remove_dir_all(folder).map_err(RunError::io("clear", folder))?;
    }
    write_atomic(&record, |file| file.write_all(b"[]\n"))?;
    Ok(())
}

/// The photographs to pose.
#[derive(Debug)]
pub(super) struct Capture {
    /// The photographs, including frames of films and faces of panoramas.
    pub folder: PhotoFolder,
    /// Whether some are frames of films.
    pub has_films: bool,
    /// Faces of panoramas by name, each with the number of its panorama.
    faces: HashMap<String, (usize, PanoramaFace)>,
}

impl Capture {
    /// Reads the photographs, films and panoramas in `paths`, of the photographs those whose files `is_chosen`. Frames and faces are written into subfolders of `out`, to whose dataset the
    /// photographs are to be added if `into`.
    ///
    /// # Errors
    /// When a path or a film cannot be read, frames or faces cannot be written, for instance without `out`, or panoramas are to be added.
    pub fn read(
        paths: &[PathBuf],
        is_chosen: &dyn Fn(&Path) -> bool,
        out: Option<&Path>,
        into: bool,
        progress: &(dyn Fn(PoseProgress) + Sync),
    ) -> Result<Self, RunError> {
        let mut sources = Sources::default();
        for path in paths {
            sources.add(path, out, MAX_FOLDER_DEPTH)?;
        }
        let mut repeated: Vec<(String, String)> = Vec::new();
        let mut unused = |paths: Vec<PathBuf>, why: &str| {
            let name = |path: PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            repeated.extend(paths.into_iter().map(|path| (name(path), why.to_owned())));
        };
        sources.subfolders.retain(|folder| !sources.folders.contains(folder));
        unused(
            sources.subfolders,
            "a folder beside photographs: name it as well if its photographs are of the same scene",
        );
        unused(sources.live, "a film taken with the photograph of the same name");
        let named = sources.films.len();
        if sources.found_films.is_empty() || sources.folders.is_empty() || film::is_ffmpeg_installed() {
            sources.films.append(&mut sources.found_films);
        } else {
            unused(
                sources.found_films,
                "a film, which cannot be read without ffmpeg: install ffmpeg to use its frames",
            );
        }
        let needs_out = |what: &str| {
            let path = paths.first().map(|path| path.display().to_string()).unwrap_or_default();
            RunError::Refused(format!("{path}: {what} need a folder to be written to: give --out"))
        };
        let mut damaged = Vec::new();
        if !sources.films.is_empty() {
            let folder = out.ok_or_else(|| needs_out("frames of a film"))?.join(FRAMES_FOLDER);
            damaged = film::write_frames(&sources.films, named, &folder, progress)?;
            sources.folders.push(folder);
        }
        let mut capture = Self {
            folder: read_chosen_photos(&sources.folders, is_chosen)?,
            has_films: !sources.films.is_empty(),
            faces: HashMap::new(),
        };
        capture.folder.repeated.append(&mut repeated);
        capture.folder.left_out.append(&mut damaged);
        let panoramas = capture.take_panoramas();
        if !panoramas.is_empty() {
            let out = out.ok_or_else(|| needs_out("faces of panoramas"))?;
            if into {
                return Err(RunError::setting(
                    "into",
                    out.display(),
                    "panoramas cannot be added to a dataset: pose all photographs again, with --out",
                ));
            }
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
        let is_panorama = find_panoramas(&photos);
        let mut panoramas = Vec::new();
        for (photo, is) in photos.into_iter().zip(is_panorama) {
            if is {
                panoramas.push(photo);
            } else {
                self.folder.photos.push(photo);
            }
        }
        panoramas
    }

    fn add_faces(&mut self, panoramas: &[PhotoEntry], out: &Path) -> Result<(), RunError> {
        let folder = &out.join(FACES_FOLDER);
        prepare_folder(folder, FACES_RECORD)?;
        let faces_of_panoramas: Vec<Vec<PanoramaFace>> = panoramas
            .par_iter()
            .map(|panorama| panorama.cut_panorama(folder))
            .collect::<Result<_, _>>()?;
        for panorama in panoramas {
            import_panorama(out, panorama)?;
        }
        let all = || faces_of_panoramas.iter().flatten().map(|face| &face.name);
        let is_taken = |name: &&String| self.folder.photos.iter().any(|photo| photo.name == **name);
        let mut names = HashSet::new();
        if let Some(name) = all().find(|name| is_taken(name) || !names.insert(*name)) {
            return Err(RunError::Refused(format!(
                "a face of a panorama is named {name}, like another photograph: rename the panorama"
            )));
        }
        let of: HashMap<String, (usize, PanoramaFace)> = (faces_of_panoramas.into_iter().enumerate())
            .flat_map(|(rig, faces)| faces.into_iter().map(move |face| (face.name.clone(), (rig, face))))
            .collect();
        let written = read_photo_folder(folder)?;
        self.folder.left_out.extend(written.left_out);
        self.folder.repeated.extend(written.repeated);
        for mut photo in written.photos {
            let (rig, face) = &of[&photo.name];
            let tags = &panoramas[*rig].tags;
            // Only one face has the panorama's GPS position, so that it counts once.
            photo.tags.gps = tags.gps.filter(|_| face.rotation == DQuat::IDENTITY);
            photo.tags.time.clone_from(&tags.time);
            photo.tags.focal = Some(f64::from(face.camera.fx) / f64::from(photo.width.max(photo.height)));
            self.folder.photos.push(photo);
        }
        self.folder.photos.sort_by(|a, b| a.name.cmp(&b.name));
        self.faces = of;
        Ok(())
    }

    /// The mapper's input for the photographs `used`, indices of the folder's photographs.
    pub fn infos(&self, used: &[usize]) -> Vec<PhotoInfo> {
        let (groups, cameras) = (self.folder.groups(), self.folder.cameras());
        // Groups are numbered from 0 without gaps, even if some photographs could not be decoded.
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
                sensor: Some(Sensor {
                    camera: cameras[*i],
                    quarter_turns: photo.quarter_turns(),
                }),
                focal_prior_px: photo.focal_px(),
                up: face.map_or(photo.up, |(_, face)| Some(face.rotation.inverse() * DVec3::NEG_Y)),
                camera: face.map(|(_, face)| DCamera::pinhole(&face.camera)),
                mount: face.map(|(rig, face)| RigMount {
                    rig: *rig,
                    rotation: face.rotation,
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
        prepare_folder(&folder, "record.json").unwrap();
        fs::write(folder.join("old.jpg"), "written by an earlier call").unwrap();
        prepare_folder(&folder, "record.json").unwrap();
        assert!(!folder.join("old.jpg").exists());
        fs::remove_file(folder.join("record.json")).unwrap();
        prepare_folder(&folder, "record.json").unwrap();
        fs::remove_file(folder.join("record.json")).unwrap();
        fs::write(folder.join("mine.jpg"), "somebody's").unwrap();
        let error = prepare_folder(&folder, "record.json").unwrap_err().to_string();
        assert!(error.contains("another source"), "{error}");
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
            sources.add(root.path(), None, MAX_FOLDER_DEPTH).unwrap();
            let [live, found_films] = [sources.live, sources.found_films];
            assert_eq!(
                live,
                expected.iter().map(|name| root.path().join(name)).collect::<Vec<_>>()
            );
            assert_eq!(live.len() + found_films.len(), 2);
        };
        write(&["IMG_1.MOV", "walk.mp4", "walk.jpg"]);
        // A single photograph with the name of a film does not make the film a phone's.
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
        photo("days/run/eval/1.truth.png");
        fs::write(root.path().join("days/run/run.json"), "{}").unwrap();
        fs::write(root.path().join("days/walk.mp4"), "a film by its name").unwrap();
        let mut sources = Sources::default();
        let days = root.path().join("days");
        sources.add(&days, None, MAX_FOLDER_DEPTH).unwrap();
        assert_eq!(
            sources.folders,
            ["monday", "tuesday/morning"].map(|name| days.join(name))
        );
        assert_eq!(sources.found_films, [days.join("walk.mp4")]);
        assert!(sources.films.is_empty() && sources.live.is_empty());
        assert!(is_capture(&days) && is_capture(&days.join("walk.mp4")) && !is_capture(&days.join("run")));
        // One of several folders has poses: the others do not form one capture with it.
        photo("sets/posed/images/1.png");
        fs::write(root.path().join("sets/posed/transforms.json"), "{}").unwrap();
        photo("sets/other/1.png");
        let sets = root.path().join("sets");
        assert!(!is_capture(&sets));
        // Unless it is the output of an earlier call.
        let mut sources = Sources::default();
        sources.add(&sets, Some(&sets.join("posed")), MAX_FOLDER_DEPTH).unwrap();
        assert_eq!(sources.folders, [sets.join("other")]);
    }

    #[test]
    fn panoramas_to_add_are_refused_before_the_faces_of_others_are_removed() {
        let root = tempfile::tempdir().unwrap();
        let (photos, out) = (root.path().join("photos"), root.path().join("data"));
        fs::create_dir_all(&photos).unwrap();
        let panorama = photos.join("1.png");
        write_png(&panorama, 512, 256, 1, &[7; 512 * 256]).unwrap();
        let mut bytes = fs::read(&panorama).unwrap();
        // Where metadata are searched for the projection.
        bytes.extend(b"equirectangular");
        fs::write(&panorama, bytes).unwrap();
        prepare_folder(&out.join(FACES_FOLDER), FACES_RECORD).unwrap();
        let face = out.join(FACES_FOLDER).join("0_front.jpg");
        fs::write(&face, "written by an earlier call").unwrap();
        let error = Capture::read(&[photos], &|_| true, Some(&out), true, &|_| ())
            .unwrap_err()
            .to_string();
        assert!(error.contains("panoramas cannot be added"), "{error}");
        assert!(face.exists());
    }
}
