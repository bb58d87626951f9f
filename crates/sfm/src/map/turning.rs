//! Photographs of one camera that was held level and on its side: turned alike, they share a lens.

use super::focal::FocalSource;
use super::principal::with_free_principal_points;
use super::types::{GroupCamera, MapOptions, Model, PhotoInfo, Progress, Reconstruction, Zoom};
use crate::geometry::camera::DCamera;
use crate::geometry::pose::quarter_turns;
use crate::{Features, Keypoint};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// The camera that took a photograph, and how it was held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sensor {
    /// Photographs of the same camera have the same number, even if they are turned and therefore in different groups.
    pub camera: usize,
    /// Clockwise quarter turns from the sensor's image to the photograph, 0 to 3; photographs of a group have the same.
    pub quarter_turns: u8,
}

/// Photographs that were turned like most of those of their camera and joined their group, so that a few portraits among landscapes have no
/// lens of their own: that of one among 12 photographs had a focal length that was wrong by 1.9 %.
#[derive(Debug)]
pub struct Turning {
    turned: BTreeMap<usize, Turned>,
}

/// A turned photograph.
#[derive(Debug)]
struct Turned {
    /// Clockwise quarter turns by which it was turned, 1 to 3.
    turns: u8,
    /// What it was before.
    info: PhotoInfo,
    keypoints: Vec<Keypoint>,
}

impl Turned {
    /// Clockwise quarter turns that restore it.
    fn back(&self) -> u8 {
        4 - self.turns
    }
}

impl Turning {
    /// Turns `photos` and their `features`. Photographs of exactly known cameras and on rigs stay as they are.
    pub fn apply(photos: &mut [PhotoInfo], features: &mut [Features]) -> Self {
        let mut by_camera: BTreeMap<usize, Vec<(usize, u8)>> = BTreeMap::new();
        for (i, photo) in photos.iter().enumerate() {
            if let (Some(sensor), None, None) = (photo.sensor, photo.camera, photo.mount) {
                let members = by_camera.entry(sensor.camera).or_default();
                members.push((i, sensor.quarter_turns));
            }
        }
        let mut turned = BTreeMap::new();
        for members in by_camera.values() {
            let count = |turns: u8| members.iter().filter(|(_, of)| *of == turns).count();
            let most = (0..4).rev().max_by_key(|turns| count(*turns)).expect("four turns");
            let group = members
                .iter()
                .find(|(_, of)| *of == most)
                .map(|(i, _)| photos[*i].group);
            for (i, of) in members {
                let turns = (4 + most - of) % 4;
                if let (1.., Some(group)) = (turns, group) {
                    turned.insert(*i, turn(&mut photos[*i], &mut features[*i], turns));
                    photos[*i].group = group;
                }
            }
        }
        Self { turned }
    }

    /// Restores `photos` and their `features`, and turns what was `found` from them back. Principal points are freed where the cameras need
    /// it that were one before: photographs may have been turned to the wrong side.
    pub fn undo(
        self,
        photos: &mut [PhotoInfo],
        features: &mut [Features],
        found: &mut Reconstruction,
        options: &MapOptions,
        progress: &mut dyn FnMut(Progress),
    ) {
        if self.turned.is_empty() {
            return;
        }
        let mut restored = photos.to_vec();
        for (photo, turned) in &self.turned {
            restored[*photo].group = turned.info.group;
        }
        if !found.own_focals {
            let [joined, before] = [&*photos, &restored].map(|photos| photos.iter().map(|p| p.group + 1).max());
            insert_groups(found, joined.unwrap_or(0)..before.unwrap_or(0));
        }
        self.split_groups(photos, found);
        found.regroup(&mut restored);
        remove_absent_cameras(found, &restored);
        for pair in &mut found.pairs {
            let [first, second] = pair.photos.map(|photo| quarter_turns(self.back(photo as usize)));
            pair.motion.rotation = second * pair.motion.rotation * first.inverse();
            pair.motion.translation = second * pair.motion.translation;
        }
        for (photo, turned) in self.turned {
            for pose in found.models.iter_mut().filter_map(|model| model.poses[photo].as_mut()) {
                *pose = pose.turned(turned.back());
            }
            photos[photo] = turned.info;
            features[photo].keypoints = turned.keypoints;
        }
        for model in &mut found.models {
            *model = std::mem::take(model).upright(photos);
        }
        if let Some(model) = with_free_principal_points(&found.regrouped(photos), features, found, options, progress) {
            found.models[0] = model;
        }
    }

    fn back(&self, photo: usize) -> u8 {
        self.turned.get(&photo).map_or(0, Turned::back)
    }

    /// Gives photographs that are turned back the cameras of their previous groups, or further zooms.
    fn split_groups(&self, photos: &[PhotoInfo], found: &mut Reconstruction) {
        // The group of the photographs of a joined group that are turned back so far.
        let mut split: BTreeMap<(usize, u8), usize> = BTreeMap::new();
        for (photo, turned) in &self.turned {
            let (joined, own) = match found.own_focals {
                true => (*photo, *photo),
                false => (photos[*photo].group, turned.info.group),
            };
            if split.insert((joined, turned.back()), own).is_none() {
                copy_camera(found, joined, own, turned.back());
            }
        }
        for zoom in std::mem::take(&mut found.zooms) {
            let mut by_turn: BTreeMap<u8, Vec<usize>> = BTreeMap::new();
            for photo in zoom.photos {
                by_turn.entry(self.back(photo)).or_default().push(photo);
            }
            // The first keeps its number and must come last, since the others are copies of its camera.
            for (order, (back, photos)) in by_turn.into_iter().enumerate().rev() {
                let group = if order == 0 { zoom.group } else { found.cameras.len() };
                copy_camera(found, zoom.group, group, back);
                split.insert((zoom.group, back), group);
                found.zooms.push(Zoom {
                    previous_group: *split.get(&(zoom.previous_group, back)).unwrap_or(&zoom.previous_group),
                    group,
                    photos,
                    focals: zoom.focals,
                });
            }
        }
    }
}

/// Inserts the `groups` without photographs.
fn insert_groups(found: &mut Reconstruction, groups: Range<usize>) {
    let shift = |group: &mut usize| {
        if *group >= groups.start {
            *group += groups.len();
        }
    };
    for zoom in &mut found.zooms {
        shift(&mut zoom.previous_group);
        shift(&mut zoom.group);
    }
    let (at, count) = (groups.start..groups.start, groups.len());
    let unknown = GroupCamera::centered(1, 1, 1.0, FocalSource::Guess);
    found.cameras.splice(at.clone(), vec![unknown; count]);
    for model in &mut found.models {
        model.cameras.splice(at.clone(), vec![None; count]);
        model.focal_held.splice(at.clone(), vec![false; count]);
    }
}

/// Removes the cameras of groups none of whose `photos` is registered.
fn remove_absent_cameras(found: &mut Reconstruction, photos: &[PhotoInfo]) {
    for model in &mut found.models {
        let posed = photos.iter().zip(&model.poses).filter(|(_, pose)| pose.is_some());
        let present: BTreeSet<usize> = posed.map(|(photo, _)| photo.group).collect();
        let cameras = model.cameras.iter_mut().enumerate();
        cameras
            .filter(|(group, _)| !present.contains(group))
            .for_each(|(_, camera)| *camera = None);
    }
}

/// Turns a photograph clockwise.
fn turn(photo: &mut PhotoInfo, features: &mut Features, turns: u8) -> Turned {
    let turned = Turned {
        turns,
        info: photo.clone(),
        keypoints: features.keypoints.clone(),
    };
    photo.up = photo.up.map(|up| quarter_turns(turns) * up);
    for _ in 0..turns {
        let height = photo.height as f32;
        for k in &mut features.keypoints {
            (k.x, k.y) = (height - k.y, k.x);
            k.angle += std::f32::consts::FRAC_PI_2;
        }
        (photo.width, photo.height) = (photo.height, photo.width);
    }
    turned
}

/// Sets the camera of group `to`, an existing or the next one, to that of group `from`, turned clockwise.
fn copy_camera(found: &mut Reconstruction, from: usize, to: usize, turns: u8) {
    let GroupCamera { camera, source } = found.cameras[from];
    let camera = camera.turned(turns);
    set(&mut found.cameras, to, GroupCamera { camera, source });
    for Model {
        cameras, focal_held, ..
    } in &mut found.models
    {
        let camera = cameras[from].map(|camera: DCamera| camera.turned(turns));
        set(cameras, to, camera);
        let held = focal_held[from];
        set(focal_held, to, held);
    }
}

fn set<T>(values: &mut Vec<T>, at: usize, value: T) {
    match values.get_mut(at) {
        Some(old) => *old = value,
        None => values.push(value),
    }
}
