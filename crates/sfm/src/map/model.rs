//! The state of a growing model: which photographs have poses, which tracks have points, which observations agree.

use super::focal::FocalSource;
use super::tracks::Tracks;
use super::types::{KnownGeometry, MapOptions, Model, PhotoInfo, rigs};
use super::verify::Cameras;
use crate::geometry::camera::DCamera;
use crate::geometry::pose::DPose;
use crate::geometry::triangulate::ViewRay;
use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;

/// A growing model.
#[derive(Clone)]
pub(super) struct GrowingModel<'a> {
    pub photos: &'a [PhotoInfo],
    pub tracks: &'a Tracks,
    pub options: &'a MapOptions,
    /// `[groups]` cameras.
    pub cameras: Vec<DCamera>,
    /// `[groups]` their initial focal lengths, px, and the sources of these.
    pub initial_focals: Vec<f64>,
    pub sources: Vec<FocalSource>,
    /// `[groups]` whether the focal length is held fixed because no value is better than another.
    pub focal_held: Vec<bool>,
    /// Whether principal points are adjusted instead of tangential coefficients.
    pub principal_free: bool,
    /// `[photos]` the photographs on the same rig, or the photograph alone.
    pub rigs: Vec<Vec<usize>>,
    /// `[photos]` and `[groups]` whether the pose or camera was known before mapping and stays as it is.
    pub held_poses: Vec<bool>,
    pub held_cameras: Vec<bool>,
    /// `[observations]` positions on the plane z = 1, undistorted by the current cameras; NaN where the lens is not invertible.
    pub plane: Vec<DVec2>,
    /// `[photos]` poses of registered photographs.
    pub poses: Vec<Option<DPose>>,
    /// `[tracks]` points of triangulated tracks.
    pub points: Vec<Option<DVec3>>,
    /// `[observations]` whether an observation belongs to its track's point.
    pub used: Vec<bool>,
    /// `[photos]` how often a photograph could not be registered, and how often it was registered and removed.
    pub failures: Vec<usize>,
    pub removals: Vec<usize>,
}

impl<'a> GrowingModel<'a> {
    /// A model without photographs.
    pub fn new(photos: &'a [PhotoInfo], cameras: &Cameras, tracks: &'a Tracks, options: &'a MapOptions) -> Self {
        let mut model = Self {
            photos,
            tracks,
            options,
            cameras: cameras.iter().map(|of| of.camera).collect(),
            initial_focals: cameras.iter().map(|of| of.camera.focal()).collect(),
            sources: cameras.iter().map(|of| of.source).collect(),
            focal_held: vec![false; cameras.len()],
            principal_free: false,
            rigs: rigs(photos),
            held_poses: vec![false; photos.len()],
            held_cameras: vec![false; cameras.len()],
            plane: Vec::new(),
            poses: vec![None; photos.len()],
            points: vec![None; tracks.len()],
            used: vec![false; tracks.observations.len()],
            failures: vec![0; photos.len()],
            removals: vec![0; photos.len()],
        };
        for photo in photos.iter().filter(|photo| photo.camera.is_some()) {
            model.held_cameras[photo.group] = true;
        }
        model.undistort();
        model
    }

    /// Sets the pose of a photograph, and of those on its rig.
    pub fn set_pose(&mut self, photo: usize, pose: DPose) {
        for i in 0..self.rigs[photo].len() {
            let other = self.rigs[photo][i];
            self.poses[other] = Some(DPose {
                rotation: pose.rotation * self.rig_from_camera(photo).inverse() * self.rig_from_camera(other),
                ..pose
            });
        }
    }

    /// Sets the pose of the rig of the photograph `reference`.
    pub fn set_rig_pose(&mut self, reference: usize, pose: DPose) {
        let rotation = pose.rotation * self.rig_from_camera(reference);
        self.set_pose(reference, DPose { rotation, ..pose });
    }

    /// The rotation of a photograph's axes into those of its rig.
    pub fn rig_from_camera(&self, photo: usize) -> DQuat {
        self.photos[photo].mount.map_or(DQuat::IDENTITY, |mount| mount.rotation)
    }

    /// Tracks that photographs of the rig of `photo` show.
    pub fn tracks_of_rig(&self, photo: usize) -> Vec<usize> {
        let mut tracks: Vec<usize> = self.rigs[photo].iter().flat_map(|p| self.tracks_of(*p)).collect();
        tracks.sort_unstable();
        tracks.dedup();
        tracks
    }

    /// Adopts known poses and cameras, which are held fixed, and triangulates the points that they see.
    pub fn hold(&mut self, known: &KnownGeometry) {
        self.held_poses = known.poses.iter().map(Option::is_some).collect();
        for (held, camera) in self.held_cameras.iter_mut().zip(&known.cameras) {
            *held |= camera.is_some();
        }
        self.adopt_poses(&known.poses);
    }

    /// Adopts the poses and cameras of a finished model, to refine it once more.
    pub fn resume(&mut self, model: &Model) {
        for (camera, found) in self.cameras.iter_mut().zip(&model.cameras) {
            *camera = found.unwrap_or(*camera);
        }
        self.focal_held.clone_from(&model.focal_held);
        self.undistort();
        self.adopt_poses(&model.poses);
    }

    /// Makes later adjustments move principal points instead of tangential coefficients.
    pub fn free_principal_points(&mut self) {
        self.principal_free = true;
        let held = self.cameras.iter_mut().zip(&self.held_cameras);
        for (camera, _) in held.filter(|(_, held)| !**held) {
            *camera = camera.without_tangential();
        }
        self.undistort();
    }

    /// Adopts poses, and triangulates the points that their photographs see.
    fn adopt_poses(&mut self, poses: &[Option<DPose>]) {
        self.poses = poses.to_vec();
        let all: Vec<usize> = (0..self.tracks.len()).collect();
        self.triangulate(&all);
        let points = self.triangulated_tracks();
        self.filter(&points);
    }

    /// Recomputes what depends on the cameras' intrinsics.
    pub fn undistort(&mut self) {
        let (tracks, cameras, photos) = (self.tracks, &self.cameras, self.photos);
        self.plane = tracks
            .observations
            .par_iter()
            .zip(&tracks.pixels)
            .map(|(o, pixel)| {
                cameras[photos[o.photo as usize].group]
                    .unproject(*pixel)
                    .unwrap_or(DVec2::NAN)
            })
            .collect();
    }

    /// The camera of a photograph.
    pub fn camera(&self, photo: u32) -> &DCamera {
        &self.cameras[self.photos[photo as usize].group]
    }

    /// The ray of an observation; `None` if its photograph is not registered or its lens is not invertible there.
    pub fn view_ray(&self, observation: usize) -> Option<ViewRay> {
        let photo = self.tracks.observations[observation].photo;
        let pose = self.poses[photo as usize].as_ref()?;
        let at = self.plane[observation];
        at.is_finite()
            .then(|| ViewRay::new(pose, at, self.camera(photo).focal_at(at)))
    }

    /// The track of an observation.
    pub fn track_of(&self, observation: u32) -> usize {
        self.tracks.track_of[observation as usize] as usize
    }

    /// Number of registered photographs.
    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Number of registered photographs of a camera.
    pub fn registered_in_group(&self, group: usize) -> usize {
        let posed = self.photos.iter().zip(&self.poses).filter(|(_, pose)| pose.is_some());
        posed.filter(|(photo, _)| photo.group == group).count()
    }

    /// Number of points.
    pub fn point_count(&self) -> usize {
        self.points.iter().flatten().count()
    }

    /// Number of observations that belong to points.
    pub fn used_count(&self) -> usize {
        self.used.iter().filter(|used| **used).count()
    }

    /// The fraction of the tracked observations in registered photographs that belong to points.
    pub fn explained_fraction(&self) -> f64 {
        let registered = (0..self.poses.len()).filter(|photo| self.poses[*photo].is_some());
        let shown: usize = registered.map(|photo| self.tracks.of_photo[photo].len()).sum();
        self.used_count() as f64 / shown.max(1) as f64
    }

    /// Number of observations in a photograph, and in those on its rig, that belong to points.
    pub fn used_in(&self, photo: usize) -> usize {
        let observations = self.rigs[photo].iter().flat_map(|p| &self.tracks.of_photo[*p]);
        observations.filter(|o| self.used[**o as usize]).count()
    }

    /// Removes a point.
    pub fn remove_point(&mut self, track: usize) {
        self.points[track] = None;
        self.used[self.tracks.range(track)].fill(false);
    }

    /// Removes the poses of a photograph and of those on its rig, and the points that are then seen less than twice. Removals are
    /// counted: the photograph might be registered with the same pose and removed for ever.
    pub fn deregister(&mut self, photo: usize) {
        for i in 0..self.rigs[photo].len() {
            let removed = self.rigs[photo][i];
            self.remove_pose(removed);
            self.removals[removed] += 1;
        }
    }

    fn remove_pose(&mut self, photo: usize) {
        self.poses[photo] = None;
        for i in 0..self.tracks.of_photo[photo].len() {
            let observation = self.tracks.of_photo[photo][i];
            self.used[observation as usize] = false;
            let track = self.track_of(observation);
            if self.points[track].is_some() && self.tracks.range(track).filter(|o| self.used[*o]).count() < 2 {
                self.remove_point(track);
            }
        }
    }

    /// Mean reprojection error, px.
    pub fn mean_error(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0usize);
        for track in 0..self.tracks.len() {
            let Some(point) = self.points[track] else { continue };
            for o in self.tracks.range(track).filter(|o| self.used[*o]) {
                if let Some(ray) = self.view_ray(o) {
                    sum += ray.error_squared(point).sqrt();
                    count += 1;
                }
            }
        }
        sum / count.max(1) as f64
    }
}
