//! The dataset to which photographs are added.

use crate::RunError;
use glam::{DQuat, DVec3};
use irradia_formats::{ColmapCamera, ColmapImage, PhotoFolder, SiblingFolder, read_colmap_poses, read_photo_folders};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::{KnownGeometry, PhotoInfo, Sensor};
use std::collections::{BTreeSet, HashMap};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Cameras and poses of a dataset in COLMAP's format.
pub(super) struct KnownPoses {
    data: PathBuf,
    /// The folder of the dataset's model.
    pub model: PathBuf,
    cameras: HashMap<u32, ColmapCamera>,
    images: HashMap<String, ColmapImage>,
}

impl KnownPoses {
    /// Reads the dataset in `data`.
    pub fn read(data: &Path) -> Result<Self, RunError> {
        let (model, cameras, images) = read_colmap_poses(data)?;
        Ok(Self {
            data: data.to_owned(),
            model,
            cameras: cameras.into_iter().map(|camera| (camera.id, camera)).collect(),
            images: images.into_iter().map(|image| (image.name.clone(), image)).collect(),
        })
    }

    /// The photographs in `images` and its subfolders, under their names in the model; folders without posed photographs are skipped.
    fn photographs(&self) -> Result<PhotoFolder, RunError> {
        let images = self.data.join("images");
        let folders = self.images.keys().map(|name| images.join(name));
        let folders: BTreeSet<PathBuf> = folders.filter_map(|photo| Some(photo.parent()?.to_owned())).collect();
        let folders: Vec<PathBuf> = folders.into_iter().filter(|folder| folder.is_dir()).collect();
        let masks = SiblingFolder::masks(&self.data, "images");
        let mut found = read_photo_folders(&folders)?;
        for photo in &mut found.photos {
            let inside = photo.path.strip_prefix(&images).unwrap_or(&photo.path);
            let parts = inside.iter().map(OsStr::to_string_lossy);
            photo.name = parts.collect::<Vec<_>>().join("/");
            let mask = masks.as_ref().and_then(|masks| masks.file_of(&photo.name));
            if let (None, Some(mask)) = (&photo.mask, mask) {
                *photo = photo.with_mask(mask)?;
            }
        }
        Ok(found)
    }

    /// The dataset's photographs and those of `more`, by name.
    pub fn combined_with(&self, more: PhotoFolder) -> Result<PhotoFolder, RunError> {
        let mut folder = self.photographs()?;
        let present = |name: &&String| folder.photos.iter().any(|photo| photo.name == **name);
        if let Some(name) = self.images.keys().filter(|name| !present(name)).min() {
            let unused = folder.unused().find(|(unused, _)| unused == name);
            let why = match unused {
                Some((_, reason)) => format!("which is in its folder images but cannot be used ({reason})"),
                None => "which is not in its folder images: add the photograph there".to_owned(),
            };
            let message = format!("{} has a pose for {name}, {why}", self.data.display());
            return Err(RunError::Refused(message));
        }
        let before = folder.photos.len();
        folder.left_out.extend(more.left_out);
        folder.repeated.extend(more.repeated);
        for photo in more.photos {
            let reason = |other: &&irradia_formats::PhotoEntry| other.hash == photo.hash || other.name == photo.name;
            match folder.photos.iter().find(reason) {
                None => folder.photos.push(photo),
                Some(other) if other.hash == photo.hash => {
                    folder
                        .repeated
                        .push((photo.name, format!("in the dataset already, as {}", other.name)));
                }
                Some(_) => {
                    let reason = "another photograph of the dataset has this name: rename it".to_owned();
                    folder.left_out.push((photo.name, reason));
                }
            }
        }
        if folder.photos.len() == before {
            let reasons = folder.left_out.iter().take(3);
            let reasons: String = reasons.map(|(name, reason)| format!("; {name}: {reason}")).collect();
            return Err(RunError::Refused(format!(
                "there is no photograph to add that {} does not already have{reasons}",
                self.data.display()
            )));
        }
        folder.photos.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(folder)
    }

    /// The known poses and cameras of `photos`, whose groups are replaced by those of the dataset's cameras: new photographs join the
    /// camera of photographs with the same metadata, turned if it was held otherwise.
    pub fn geometry_of(&self, photos: &mut [PhotoInfo]) -> Result<KnownGeometry, RunError> {
        let of_photo: Vec<Option<&ColmapImage>> = photos.iter().map(|photo| self.images.get(&photo.name)).collect();
        for (photo, image) in photos.iter().zip(&of_photo) {
            let Some(camera) = image.and_then(|image| self.cameras.get(&image.camera_id)) else {
                continue;
            };
            let [size, of_camera] = [
                [photo.width, photo.height].map(u64::from),
                [camera.width, camera.height],
            ];
            if size != of_camera {
                return Err(RunError::Refused(format!(
                    "{} of {} is {}x{}, but its camera {}x{}: photographs can only be added if those of the dataset have the size and \
                     orientation of their cameras",
                    photo.name,
                    self.data.display(),
                    size[0],
                    size[1],
                    of_camera[0],
                    of_camera[1]
                )));
            }
        }
        let mut camera_of_group: HashMap<usize, u32> = HashMap::new();
        // The camera of the first photograph of each sensor, and how that was held.
        let mut camera_of_sensor: HashMap<usize, (u32, u8)> = HashMap::new();
        for (photo, image) in photos.iter().zip(&of_photo) {
            if let Some(image) = image {
                camera_of_group.entry(photo.group).or_insert(image.camera_id);
                if let Some(sensor) = photo.sensor {
                    let first = (image.camera_id, sensor.quarter_turns);
                    camera_of_sensor.entry(sensor.camera).or_insert(first);
                }
            }
        }
        // The dataset's cameras by id, then groups of new photographs.
        #[derive(PartialEq)]
        enum Group {
            Camera(u32),
            New(usize, Option<Sensor>),
        }
        let mut groups: Vec<Group> = Vec::new();
        for (photo, image) in photos.iter_mut().zip(&of_photo) {
            let camera = image.map(|image| image.camera_id);
            let group = match camera.or_else(|| camera_of_group.get(&photo.group).copied()) {
                Some(id) => Group::Camera(id),
                None => Group::New(photo.group, photo.sensor),
            };
            photo.group = groups.iter().position(|known| *known == group).unwrap_or_else(|| {
                groups.push(group);
                groups.len() - 1
            });
        }
        let camera = |group: &Group| match group {
            Group::Camera(id) => self.camera(*id).map(Some),
            Group::New(_, sensor) => {
                let known = sensor.and_then(|sensor| Some((camera_of_sensor.get(&sensor.camera)?, sensor)));
                known
                    .map(|((id, turns), sensor)| Ok(self.camera(*id)?.turned((4 + sensor.quarter_turns - turns) % 4)))
                    .transpose()
            }
        };
        Ok(KnownGeometry {
            poses: of_photo.iter().map(|image| image.map(pose)).collect(),
            cameras: groups.iter().map(camera).collect::<Result<_, _>>()?,
        })
    }

    fn camera(&self, id: u32) -> Result<DCamera, RunError> {
        let refused = |what: String| RunError::Refused(format!("{}: {what}", self.data.display()));
        let camera = self
            .cameras
            .get(&id)
            .ok_or_else(|| refused(format!("camera {id} is missing")))?;
        let perspective = camera.opencv().map(|parameters| (parameters, false));
        let lens = perspective.or_else(|| Some((camera.fisheye()?, true)));
        let (parameters, fisheye) = lens.ok_or_else(|| {
            refused(format!(
                "photographs cannot be added to cameras of the model {}, only to pinhole cameras, RADIAL, OPENCV and OPENCV_FISHEYE",
                camera.model
            ))
        })?;
        Ok(DCamera {
            width: camera.width as u32,
            height: camera.height as u32,
            parameters,
            fisheye,
        })
    }
}

fn pose(image: &ColmapImage) -> DPose {
    let [w, x, y, z] = image.rotation;
    DPose::from_camera_from_world(DQuat::from_xyzw(x, y, z, w).normalize(), DVec3::from(image.translation))
}
