use super::agreement::{agreement, contradictions, strengths};
use super::focal::FocalSource;
use super::missing::MIN_MISSING_PAIRS;
use super::turning::Sensor;
use crate::geometry::align::Alignment;
use crate::geometry::camera::DCamera;
use crate::geometry::essential::Motion;
use crate::geometry::pose::DPose;
use crate::{Features, PairMatches, median};
use glam::{DQuat, DVec3};
use std::collections::{BTreeMap, BTreeSet};

/// Captures of up to this many photographs count as small: each photograph matters, few pairs contradict a wrong model, and a mapping
/// takes a fraction of a second.
pub const FEW_PHOTOS: usize = 25;

/// What is known about a photograph besides its features.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoInfo {
    /// Name, for messages.
    pub name: String,
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// Photographs of the same group have the same camera; groups are numbered from 0.
    pub group: usize,
    /// Which camera took it and how it was held, if the camera may have taken photographs of other groups as well.
    pub sensor: Option<Sensor>,
    /// Focal length in px, if the photograph's metadata contain it.
    pub focal_prior_px: Option<f64>,
    /// The up direction in camera axes (x right, y down, z forward) if known; otherwise -y, as most photographs are taken, unless all look
    /// down.
    pub up: Option<DVec3>,
    /// The camera of its group, if it is known exactly; it is then held fixed.
    pub camera: Option<DCamera>,
    /// Its mount on a rig, if it is on one.
    pub mount: Option<RigMount>,
}

impl PhotoInfo {
    /// A photograph of `width` x `height` pixels in group 0, of which nothing else is known.
    pub fn new(name: String, width: u32, height: u32) -> Self {
        Self {
            name,
            width,
            height,
            group: 0,
            sensor: None,
            focal_prior_px: None,
            up: None,
            camera: None,
            mount: None,
        }
    }

    /// The longer side, px.
    pub(crate) fn long_side(&self) -> f64 {
        f64::from(self.width.max(self.height))
    }
}

/// The camera of a group before any adjustment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupCamera {
    /// Known exactly, or with a principal point at the centre.
    pub camera: DCamera,
    /// Where its focal length comes from.
    pub source: FocalSource,
}

impl GroupCamera {
    /// The camera of `width` x `height` pixels with a focal length of `focal` pixels and its principal point at the centre.
    pub(super) fn centered(width: u32, height: u32, focal: f64, source: FocalSource) -> Self {
        Self {
            camera: DCamera::centered(width, height, focal),
            source,
        }
    }
}

/// How a photograph is mounted on a rig: all photographs of a rig are taken from one position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigMount {
    /// The rig's number.
    pub rig: usize,
    /// Rotation of the camera's axes into the rig's.
    pub rotation: DQuat,
}

/// `[photos]` the photographs on the same rig, or the photograph alone.
pub(crate) fn rigs(photos: &[PhotoInfo]) -> Vec<Vec<usize>> {
    let mut members: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, photo) in photos.iter().enumerate() {
        if let Some(mount) = photo.mount {
            members.entry(mount.rig).or_default().push(i);
        }
    }
    let of = |(i, photo): (usize, &PhotoInfo)| match photo.mount {
        Some(mount) => members[&mount.rig].clone(),
        None => vec![i],
    };
    photos.iter().enumerate().map(of).collect()
}

/// Poses and cameras that are known before mapping and stay as they are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KnownGeometry {
    /// `[photos]` poses.
    pub poses: Vec<Option<DPose>>,
    /// `[groups]` cameras.
    pub cameras: Vec<Option<DCamera>>,
}

impl From<&Model> for KnownGeometry {
    fn from(model: &Model) -> Self {
        Self {
            poses: model.poses.clone(),
            cameras: model.cameras.clone(),
        }
    }
}

/// Options of verification and mapping. The defaults are COLMAP's where it has the same parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// Maximum distance of an inlier from its epipolar line, px.
    pub max_epipolar_error: f64,
    /// Minimum number of inliers of a pair that is kept.
    pub min_inliers: usize,
    /// Whether a verified pair is matched once more along its epipolar lines, where features need not be distinct from those elsewhere.
    pub guided: bool,
    /// Whether the photographs are mapped once more with a narrow field of view if the model is in doubt and there are no metadata with a
    /// focal length.
    pub narrow: bool,
    /// Maximum reprojection error of an observation, px.
    pub max_error: f64,
    /// Maximum reprojection error of an inlier when a photograph is registered, px.
    pub max_registration_error: f64,
    /// Minimum number of inliers to register a photograph.
    pub min_registration_inliers: usize,
    /// Minimum angle between two rays of a point, radians.
    pub min_angle: f64,
    /// Growth factor of the number of photographs or points after which everything is adjusted again.
    pub global_growth: f64,
    /// Maximum number of photographs in a local adjustment.
    pub local_photos: usize,
    /// Minimum number of photographs of a model that is kept.
    pub min_model_photos: usize,
    /// Maximum number of models.
    pub max_models: usize,
    /// Minimum number of photographs of a camera to adjust fx and fy, k2 and the tangential coefficients, not only f and k1.
    pub full_lens_photos: usize,
}

impl Default for MapOptions {
    fn default() -> Self {
        Self {
            max_epipolar_error: 4.0,
            min_inliers: 15,
            guided: false,
            narrow: true,
            max_error: 4.0,
            max_registration_error: 8.0,
            min_registration_inliers: 20,
            min_angle: 1.5f64.to_radians(),
            global_growth: 1.1,
            local_photos: 6,
            min_model_photos: 3,
            max_models: 10,
            full_lens_photos: 15,
        }
    }
}

/// What [`reconstruct`](super::reconstruct) is doing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Progress {
    /// Pairs have been verified.
    Verified {
        /// Number of pairs with a common geometry.
        pairs: usize,
        /// Number of pairs with matches.
        total: usize,
    },
    /// A photograph has been registered.
    Registered {
        /// Photographs in this model.
        photos: usize,
        /// Total number of photographs.
        total: usize,
        /// Points in this model.
        points: usize,
    },
    /// A global adjustment ended.
    Adjusted {
        /// Photographs in this model.
        photos: usize,
        /// Points in this model.
        points: usize,
        /// Mean reprojection error, px.
        error: f64,
    },
}

/// How two photographs are related.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PairKind {
    /// A scene with depth, seen from two places.
    General,
    /// A plane, seen from two places.
    Planar,
    /// One place, two directions: it extends tracks but is never a seed.
    Rotation,
}

/// A pair whose matches agree with one geometry.
#[derive(Clone, Debug, PartialEq)]
pub struct VerifiedPair {
    /// Indices of the two photographs, ascending.
    pub photos: [u32; 2],
    /// `[M]` indices of keypoints in the first and in the second photograph.
    pub matches: Vec<[u32; 2]>,
    /// How they are related.
    pub kind: PairKind,
    /// The motion between them, with a translation of unknown length, for the known or guessed focal lengths.
    pub motion: Motion,
    /// The median angle between the two rays of a match, radians.
    pub angle: f64,
}

/// The result of mapping: models, and the photographs that are in none.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reconstruction {
    /// Largest first.
    pub models: Vec<Model>,
    /// Photographs in no model.
    pub left_out: Vec<LeftOut>,
    /// The pairs that were used.
    pub pairs: Vec<VerifiedPair>,
    /// `[groups]` the camera of each group before the last mapping.
    pub cameras: Vec<GroupCamera>,
    /// Photographs of one group that turned out to have another focal length: each `Zoom` adds a group.
    pub zooms: Vec<Zoom>,
    /// Whether each photograph became its own group, because each has its own focal length and the metadata do not contain it.
    pub own_focals: bool,
    /// Pairs that share next to nothing, although their poses in the largest model, or in the model that was split, say that they see the
    /// same part of the scene; most expected points first.
    pub missing: Vec<MissingMatches>,
    /// Number of models of parts that were first mistaken for one another, if the model was split into them.
    pub split_models: Option<usize>,
}

impl Reconstruction {
    /// Number of photographs with a pose in the largest model.
    pub fn registered(&self) -> usize {
        self.models.first().map_or(0, Model::registered)
    }

    /// Number of neighbours whose matches contradict the largest model; 0 for more than [`FEW_PHOTOS`] photographs, where some always do.
    /// `photos` may have their groups from before mapping.
    pub fn contradictions(&self, photos: &[PhotoInfo], features: &[Features]) -> usize {
        let few = photos.len() <= FEW_PHOTOS;
        let Some(model) = self.models.first().filter(|_| few) else {
            return 0;
        };
        let photos = self.regrouped(photos);
        let agreement = agreement(&photos, features, &self.pairs, model);
        contradictions(&self.pairs, &strengths(&photos, features, &self.pairs), &agreement).len()
    }

    /// Pairs of photographs that should share points and do not, without those in `matched`; empty if there are too few to rule out
    /// coincidence.
    pub fn missing_and_unmatched(&self, matched: &[PairMatches]) -> Vec<[u32; 2]> {
        if self.missing.len() < MIN_MISSING_PAIRS {
            return Vec::new();
        }
        let matched: BTreeSet<[u32; 2]> = matched.iter().map(|pair| pair.photos).collect();
        let pairs = self.missing.iter().map(|pair| pair.photos);
        pairs.filter(|pair| !matched.contains(pair)).collect()
    }

    /// `photos` with the groups by which `cameras` and the cameras of the models are indexed.
    pub fn regrouped(&self, photos: &[PhotoInfo]) -> Vec<PhotoInfo> {
        let mut photos = photos.to_vec();
        self.regroup(&mut photos);
        photos
    }

    /// Sets the groups of `photos` to those by which `cameras` and the cameras of the models are indexed.
    pub fn regroup(&self, photos: &mut [PhotoInfo]) {
        if self.own_focals {
            let groups = photos.iter_mut().enumerate();
            groups.for_each(|(group, photo)| photo.group = group);
        }
        self.zooms.iter().for_each(|zoom| zoom.regroup(photos));
    }
}

/// Two photographs that share next to nothing, although their poses in a model say that they see the same part of the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MissingMatches {
    /// Their indices, ascending.
    pub photos: [u32; 2],
    /// Number of points of the model that should be matched.
    pub expected: usize,
}

/// Photographs whose focal length differs from that of the rest of their group, unknown to the metadata.
#[derive(Clone, Debug, PartialEq)]
pub struct Zoom {
    /// Their previous group.
    pub previous_group: usize,
    /// Their new group.
    pub group: usize,
    /// Their indices, ascending.
    pub photos: Vec<usize>,
    /// Focal lengths of both groups, px.
    pub focals: [f64; 2],
}

impl Zoom {
    /// Moves its photographs to their group.
    pub(super) fn regroup(&self, photos: &mut [PhotoInfo]) {
        self.photos.iter().for_each(|photo| photos[*photo].group = self.group);
    }
}

/// Cameras, poses and points in one world: that of the known poses, if there were any; otherwise +Z is up, the origin is near the centre
/// of the scene, and the cameras' distance from it is about 1.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// `[groups]` the camera of each group; `None` if none of its photographs is registered.
    pub cameras: Vec<Option<DCamera>>,
    /// `[photos]` the pose of each photograph; `None` if it is not registered.
    pub poses: Vec<Option<DPose>>,
    /// Points.
    pub points: Vec<ModelPoint>,
    /// `[groups]` whether the focal length was held fixed because nothing in the photographs determines it.
    pub focal_held: Vec<bool>,
}

impl Model {
    /// Number of photographs with a pose.
    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Number of observations of all points.
    pub fn observations(&self) -> usize {
        self.points.iter().map(|point| point.track.len()).sum()
    }

    /// Moves poses and points to another world.
    pub(crate) fn align(&mut self, alignment: &Alignment) {
        for pose in self.poses.iter_mut().flatten() {
            *pose = alignment.pose(pose);
        }
        for point in &mut self.points {
            point.position = alignment.point(point.position);
        }
    }

    /// The centre of the scene, the median of the points along each axis or, without points, the mean of the cameras; and the median
    /// distance of the cameras from it.
    pub(super) fn center_and_radius(&self) -> (DVec3, f64) {
        let cameras = || self.poses.iter().flatten().map(|pose| pose.position);
        let center = if self.points.is_empty() {
            cameras().sum::<DVec3>() / self.registered().max(1) as f64
        } else {
            let along = |axis: usize| median(self.points.iter().map(|p| p.position[axis]).collect());
            DVec3::from_array([0, 1, 2].map(|axis| along(axis).unwrap_or(0.0)))
        };
        let distances = cameras().map(|position| position.distance(center));
        (center, median(distances.collect()).unwrap_or(0.0))
    }

    /// Mean reprojection error, px.
    pub fn mean_error(&self) -> f64 {
        self.points.iter().map(|p| p.error * p.track.len() as f64).sum::<f64>() / self.observations().max(1) as f64
    }
}

/// A point and where it is seen.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelPoint {
    /// Position, world.
    pub position: DVec3,
    /// Photograph and keypoint, sorted by photograph.
    pub track: Vec<(u32, u32)>,
    /// Mean reprojection error, px.
    pub error: f64,
}

/// A photograph in no model.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Its index.
    pub photo: usize,
    /// Why.
    pub reason: Reason,
}

/// Why a photograph is in no model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// Fewer features than a pair needs.
    FewFeatures {
        /// Its number of features.
        features: usize,
    },
    /// Too few matches with any other photograph.
    FewMatches {
        /// Number of matches with the best partner.
        best: usize,
    },
    /// Nearly all of its matches are at the same pixels of both photographs, as if the camera had not moved, and were left out.
    StandsStill {
        /// Number of matches with the best partner, with those that stand still.
        best: usize,
    },
    /// Matches that no common geometry explains.
    NoGeometry {
        /// Number of matches with the best partner.
        best: usize,
    },
    /// Taken from the same place as all its partners.
    RotationOnly {
        /// Number of partners.
        partners: usize,
    },
    /// Its partners are in no model either.
    NoModel {
        /// Number of partners.
        partners: usize,
    },
    /// Partners are in a model, but too few of its points are seen at consistent positions.
    NotRegistered {
        /// Number of partners.
        partners: usize,
    },
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Reason::FewFeatures { features } => {
                write!(f, "only {features} features: it is blurred, dark or without texture")
            }
            Reason::FewMatches { best } => {
                write!(
                    f,
                    "at most {best} features match another photograph: none overlaps with it enough"
                )
            }
            Reason::StandsStill { best } => write!(
                f,
                "nearly all of its matches (at most {best} with one photograph) stand still: move the camera between photographs, or mask \
                 what stands still"
            ),
            Reason::NoGeometry { best } => {
                write!(
                    f,
                    "its matches (at most {best} with one photograph) agree with no common geometry"
                )
            }
            Reason::RotationOnly { partners: 1 } => write!(
                f,
                "taken from the same place as the only photograph that overlaps with it: move between photographs"
            ),
            Reason::RotationOnly { partners } => write!(
                f,
                "taken from the same place as all {partners} photographs that overlap with it: move between photographs"
            ),
            Reason::NoModel { partners: 1 } => write!(f, "it overlaps with 1 photograph, which is in no model"),
            Reason::NoModel { partners } => {
                write!(
                    f,
                    "it overlaps with {partners} photographs, none of which is in a model"
                )
            }
            Reason::NotRegistered { partners } => {
                let s = if *partners == 1 { "" } else { "s" };
                write!(
                    f,
                    "it overlaps with {partners} photograph{s}, but shows too few points of the model"
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_partner_is_not_called_all_photographs() {
        let sentence = |partners: usize| Reason::RotationOnly { partners }.to_string();
        assert!(sentence(1).contains("the only photograph that overlaps with it"));
        assert!(sentence(2).contains("all 2 photographs that overlap with it"));
    }
}
