//! Whether the poses of a dataset agree with its photographs.
//!
//! Programs that find poses may take one part of a scene for another that looks alike, and the dataset then jumps between adjacent photographs. Their
//! own reprojection errors do not show it, since they dropped the matches that contradict them; matching the photographs again does. Where nothing else matches,
//! nothing contradicts: there the points tell, which photographs from nearly the same place do not share.

use super::look::{Look, pose};
use irradia_scene::{Dataset, View};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::{
    ABSENT_PAIRS, MapOptions, Model, ModelPoint, PairKind, PhotoInfo, VerifiedPair, absent, agreement, contradictions,
    strengths, telling, verify,
};
use irradia_sfm::matching::{MatchOptions, PairOptions, candidate_pairs, match_pairs};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Long side of the photographs that are compared, px, and the most features of each: neighbours are told by a fraction of what poses need.
const SIDE: u32 = 480;
const FEATURES: usize = 1000;
/// Photographs that are compared; of more, evenly spaced ones.
const PHOTOGRAPHS: usize = 120;

/// Pairs across which the poses must jump, to be told from parts of a scene that do look alike.
const JUMPS: usize = 2;
/// Neighbours that must agree with a photograph for it to be in place.
const SEVERAL: usize = 2;
/// The share of pairs that contradict their poses from which on it is not single photographs that are wrong.
const SHARE: f64 = 0.1;

/// What the matches of photographs say of their poses.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PoseCheck {
    /// Pairs of adjacent photographs with enough matches to tell.
    pub pairs: usize,
    /// Names of those whose matches contradict their poses, those with most matches first.
    pub contradicting: Vec<[String; 2]>,
    /// Those of them whose photographs agree with others: there the poses jump.
    pub jumps: Vec<[String; 2]>,
    /// Names of those that by their poses see the same and share nothing, neither points of the dataset nor matches, those that should share most
    /// first; none where they are so few that it may be chance.
    pub absent: Vec<[String; 2]>,
}

impl PoseCheck {
    /// Whether more is wrong than the poses of single photographs.
    pub fn is_broken(&self) -> bool {
        self.jumps.len() >= JUMPS || (self.contradicting.len() >= JUMPS && self.share() >= SHARE)
    }

    /// The share of pairs that contradict their poses.
    pub fn share(&self) -> f64 {
        self.contradicting.len() as f64 / self.pairs.max(1) as f64
    }
}

/// Matches the photographs of `dataset` and compares what they say with its poses. Photographs that cannot be read are left out.
pub fn check_poses(dataset: &Dataset) -> PoseCheck {
    let step = dataset.views.len().div_ceil(PHOTOGRAPHS).max(1);
    let look = |view| Some((view, Look::at(view, SIDE, FEATURES)?));
    let seen: Vec<(&View, Look)> = dataset.views.par_iter().step_by(step).filter_map(look).collect();
    let (mut views, mut photos, mut features) = (Vec::new(), Vec::new(), Vec::new());
    for (group, (view, look)) in seen.into_iter().enumerate() {
        views.push(view);
        photos.push(PhotoInfo { group, ..look.info });
        features.push(look.features);
    }
    let matching = MatchOptions::default();
    let mut candidates = candidate_pairs(&features, &PairOptions::default(), &matching);
    let absent = absent_pairs(dataset, &views, &photos);
    candidates.extend(&absent);
    candidates.sort_unstable();
    candidates.dedup();
    let matches = match_pairs(&features, &candidates, &matching, || ());
    let (_, mut pairs) = verify(&photos, &features, &matches, &MapOptions::default(), &mut |_| ());
    let related: BTreeSet<[u32; 2]> = pairs.iter().map(|pair| pair.photos).collect();
    let absent: Vec<[u32; 2]> = absent.into_iter().filter(|pair| !related.contains(pair)).collect();
    // What only turns or stands still, such as the background of a turntable, tells little of the places.
    pairs.retain(|pair| pair.kind != PairKind::Rotation);
    let strengths = strengths(&photos, &features, &pairs);
    let model = Model {
        cameras: photos.iter().map(|photo| photo.camera).collect(),
        poses: poses(&views),
        ..Model::default()
    };
    let agreement = agreement(&photos, &features, &pairs, &model);
    let in_place = in_place(photos.len(), &pairs, &strengths, &agreement);
    let names = |pair: [u32; 2]| pair.map(|photo| photos[photo as usize].name.clone());
    let contradicting: Vec<[u32; 2]> = contradictions(&pairs, &strengths, &agreement)
        .into_iter()
        .map(|i| pairs[i].photos)
        .collect();
    let jump = |photos: &&[u32; 2]| photos.iter().all(|photo| in_place[*photo as usize]);
    PoseCheck {
        pairs: telling(&pairs, &strengths).count(),
        jumps: contradicting.iter().filter(jump).copied().map(names).collect(),
        contradicting: contradicting.into_iter().map(names).collect(),
        absent: match absent.len() >= ABSENT_PAIRS {
            true => absent.into_iter().map(names).collect(),
            false => Vec::new(),
        },
    }
}

/// Pairs of `views` that by their poses see the same and share no points of the dataset.
fn absent_pairs(dataset: &Dataset, views: &[&View], photos: &[PhotoInfo]) -> Vec<[u32; 2]> {
    let Some(points) = &dataset.points else {
        return Vec::new();
    };
    let mut tracks = vec![Vec::new(); points.len()];
    for (photo, view) in (0u32..).zip(views) {
        // Which feature it was is not known, and does not matter.
        view.points_seen
            .iter()
            .for_each(|i| tracks[*i as usize].push((photo, 0)));
    }
    let seen = points
        .positions
        .iter()
        .zip(tracks)
        .filter(|(_, track)| !track.is_empty());
    let model = Model {
        cameras: views
            .iter()
            .map(|view| Some(DCamera::pinhole(&view.camera.intrinsics)))
            .collect(),
        poses: views.iter().map(|view| Some(pose(&view.camera))).collect(),
        points: seen
            .map(|(position, track)| ModelPoint {
                position: position.as_dvec3(),
                track,
                error: 0.0,
            })
            .collect(),
        ..Model::default()
    };
    absent(photos, &model).iter().map(|pair| pair.photos).collect()
}

/// `[photos]` whether several neighbours of a photograph agree with its pose: one that is wrong on its own contradicts all of them, while a jump leaves
/// each side in agreement with itself.
fn in_place(photos: usize, pairs: &[VerifiedPair], strengths: &[f64], agreement: &[Option<f64>]) -> Vec<bool> {
    let mut agreeing = vec![0; photos];
    let agree = telling(pairs, strengths).filter(|i| agreement[*i].is_some_and(|agreement| agreement > 0.5));
    for photo in agree.flat_map(|i| pairs[i].photos) {
        agreeing[photo as usize] += 1;
    }
    agreeing.into_iter().map(|agreeing| agreeing >= SEVERAL).collect()
}

/// The poses in a world in which the cameras' median distance from their middle is 1.
fn poses(views: &[&View]) -> Vec<Option<DPose>> {
    let mut poses: Vec<DPose> = views.iter().map(|view| pose(&view.camera)).collect();
    let middle = poses.iter().map(|pose| pose.position).sum::<glam::DVec3>() / poses.len().max(1) as f64;
    let mut distances: Vec<f64> = poses.iter().map(|pose| pose.position.distance(middle)).collect();
    distances.sort_by(f64::total_cmp);
    let scale = distances
        .get(distances.len() / 2)
        .map_or(1.0, |distance| distance.max(f64::MIN_POSITIVE));
    poses
        .iter_mut()
        .for_each(|pose| pose.position = (pose.position - middle) / scale);
    poses.into_iter().map(Some).collect()
}
