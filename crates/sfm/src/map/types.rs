use super::absent::ABSENT_PAIRS;
use super::agree::{agreement, contradictions, strengths};
use super::focal::Source;
use crate::geometry::camera::DCamera;
use crate::geometry::essential::Motion;
use crate::geometry::pose::DPose;
use crate::{Features, PairMatches};
use glam::{DQuat, DVec3};
use std::collections::{BTreeMap, BTreeSet};

/// Photographs up to which each is missed, pairs that contradict a model are few, and a mapping takes a fraction of a second.
pub const FEW_PHOTOS: usize = 25;

/// What is known of a photograph beside its features.
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
    /// Focal length in px if the photograph's metadata tell it.
    pub focal_prior_px: Option<f64>,
    /// The direction up in camera axes (x right, y down, z forward) if known; otherwise -y, as most photographs are held, unless all look down.
    pub up: Option<DVec3>,
    /// The camera of its group, if it is known exactly; it is held.
    pub camera: Option<DCamera>,
    /// Its place on a rig, if it is on one.
    pub mount: Option<Mount>,
}

/// The place of a photograph on a rig: all photographs of a rig are taken from one position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mount {
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

/// What is known before mapping, and stays as it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Known {
    /// `[photos]` poses.
    pub poses: Vec<Option<DPose>>,
    /// `[groups]` cameras.
    pub cameras: Vec<Option<DCamera>>,
}

impl From<&Model> for Known {
    fn from(model: &Model) -> Self {
        Self {
            poses: model.poses.clone(),
            cameras: model.cameras.clone(),
        }
    }
}

/// How to verify and map. The defaults are COLMAP's where it has the same parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// Largest distance from the epipolar line of an inlier, px.
    pub max_epipolar_error: f64,
    /// Inliers below which a pair is dropped.
    pub min_inliers: usize,
    /// Whether a pair that passes is matched once more along its epipolar lines, where features need not differ from those elsewhere.
    pub guided: bool,
    /// Whether what may be a narrow view is mapped once more as one, where the model is in doubt and no metadata tell a focal length.
    pub narrow: bool,
    /// Largest reprojection error of an observation, px.
    pub max_error: f64,
    /// Largest reprojection error of an inlier when a photograph is registered, px.
    pub max_registration_error: f64,
    /// Inliers below which a photograph is not registered.
    pub min_registration_inliers: usize,
    /// Smallest angle between two rays of a point, radians.
    pub min_angle: f64,
    /// Photographs and points grow by this factor between two global adjustments.
    pub global_growth: f64,
    /// Photographs of a local adjustment.
    pub local_photos: usize,
    /// Photographs below which a model is dropped.
    pub min_model_photos: usize,
    /// Models at most.
    pub max_models: usize,
    /// Photographs of one camera from which fx and fy, k2 and the tangential coefficients are adjusted, not only f and k1.
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
        /// Pairs with a common geometry.
        pairs: usize,
        /// Pairs with matches.
        of: usize,
    },
    /// A photograph has been registered.
    Registered {
        /// Photographs in this model.
        photos: usize,
        /// Photographs in all.
        of: usize,
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
    /// One place, two directions: extends tracks, never seeds.
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
    /// The motion between them, of unknown length, with the focal lengths that were known or guessed.
    pub motion: Motion,
    /// The median angle between both rays of a match, radians.
    pub angle: f64,
}

/// Models, and what became of the rest.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reconstruction {
    /// Largest first.
    pub models: Vec<Model>,
    /// Photographs in no model.
    pub left_out: Vec<LeftOut>,
    /// The pairs that were used.
    pub pairs: Vec<VerifiedPair>,
    /// `[groups]` the camera of each group before the last mapping, and where its focal length comes from.
    pub cameras: Vec<(DCamera, Source)>,
    /// Photographs of one group that turned out to have two focal lengths: each `Zoom` makes a further group.
    pub zooms: Vec<Zoom>,
    /// Whether each photograph became a group of its own, because each has a focal length of its own that no metadata tell.
    pub own_focals: bool,
    /// Pairs that share next to nothing, though by their poses in the largest model they see the same, or in the one that was taken apart, those with most
    /// expected points first.
    pub absent: Vec<Absent>,
    /// Models of parts that were taken for one another at first, if there are such.
    pub apart: Option<usize>,
}

impl Reconstruction {
    /// Photographs with a pose in the largest model.
    pub fn registered(&self) -> usize {
        self.models.first().map_or(0, Model::registered)
    }

    /// Neighbours whose matches contradict the largest model; 0 for more than [`FEW_PHOTOS`], of which some always do.
    pub fn contradictions(&self, photos: &[PhotoInfo], features: &[Features]) -> usize {
        let few = photos.len() <= FEW_PHOTOS;
        let Some(model) = self.models.first().filter(|_| few) else {
            return 0;
        };
        let agreement = agreement(photos, features, &self.pairs, model);
        contradictions(&self.pairs, &strengths(photos, features, &self.pairs), &agreement).len()
    }

    /// Pairs of photographs that should share points and do not, where they are too many to be chance, and that are not among `matched`.
    pub fn absent_and_unmatched(&self, matched: &[PairMatches]) -> Vec<[u32; 2]> {
        if self.absent.len() < ABSENT_PAIRS {
            return Vec::new();
        }
        let matched: BTreeSet<[u32; 2]> = matched.iter().map(|pair| pair.photos).collect();
        let pairs = self.absent.iter().map(|pair| pair.photos);
        pairs.filter(|pair| !matched.contains(pair)).collect()
    }

    /// Puts photographs that were zoomed into the groups by which `cameras` and those of the models are numbered.
    pub fn regroup(&self, photos: &mut [PhotoInfo]) {
        if self.own_focals {
            let groups = photos.iter_mut().enumerate();
            groups.for_each(|(group, photo)| photo.group = group);
        }
        for zoom in &self.zooms {
            zoom.photos.iter().for_each(|photo| photos[*photo].group = zoom.group);
        }
    }
}

/// Photographs that share next to nothing, though by their poses in a model they see the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Absent {
    /// Their indices, ascending.
    pub photos: [u32; 2],
    /// Points of the model that should be matched.
    pub expected: usize,
}

/// Photographs that have another focal length than the rest of their group, which no metadata tell.
#[derive(Clone, Debug, PartialEq)]
pub struct Zoom {
    /// Their group before.
    pub of: usize,
    /// Their group now.
    pub group: usize,
    /// Their indices, ascending.
    pub photos: Vec<usize>,
    /// Focal lengths of both groups, px.
    pub focals: [f64; 2],
}

/// Cameras, poses and points in one world: that of what was known; else up is +Z, the origin is near the scene's middle, the cameras'
/// distance is about 1.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// `[groups]` the camera of each group; `None` if none of its photographs is registered.
    pub cameras: Vec<Option<DCamera>>,
    /// `[photos]` the pose of each photograph; `None` if it is not registered.
    pub poses: Vec<Option<DPose>>,
    /// Points.
    pub points: Vec<ModelPoint>,
    /// `[groups]` whether the focal length was held, because nothing in the photographs determines it.
    pub focal_held: Vec<bool>,
}

impl Model {
    /// Number of photographs with a pose.
    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Number of observations that points explain.
    pub fn observations(&self) -> usize {
        self.points.iter().map(|point| point.track.len()).sum()
    }

    /// Mean reprojection error, px.
    pub fn mean_error(&self) -> f64 {
        self.points.iter().map(|p| p.error * p.track.len() as f64).sum::<f64>() / self.observations().max(1) as f64
    }
}

/// A point and where it is seen.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelPoint {
    /// World.
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
        /// How many.
        features: usize,
    },
    /// Too few matches with any other photograph.
    FewMatches {
        /// Matches with the best partner.
        best: usize,
    },
    /// Matches that no common geometry explains.
    NoGeometry {
        /// Matches with the best partner.
        best: usize,
    },
    /// Seen from the same place as all its partners.
    RotationOnly {
        /// Number of partners.
        partners: usize,
    },
    /// Its partners are in no model either.
    NoModel {
        /// Number of partners.
        partners: usize,
    },
    /// Partners are in a model, but too few points of it are seen at consistent places.
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
                    "at most {best} features match another photograph: nothing overlaps with it enough"
                )
            }
            Reason::NoGeometry { best } => {
                write!(
                    f,
                    "its matches (at most {best} with one photograph) agree with no common geometry"
                )
            }
            Reason::RotationOnly { partners } => {
                write!(
                    f,
                    "taken from the same place as all {partners} photographs that overlap with it: move between photographs"
                )
            }
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
