//! Checks whether the poses of a dataset agree with its photographs.
//!
//! Programs that find poses may confuse parts of a scene that look alike, and the poses then jump between adjacent photographs. Their
//! own reprojection errors do not show it, since they dropped the contradicting matches; matching the photographs again does. If no other
//! matches exist, nothing contradicts the poses: then the evidence is that photographs from nearly the same place share no points.

use super::view_features::{ViewFeatures, pose};
use irradia_scene::{Dataset, View};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::map::{
    MIN_MISSING_PAIRS, MapOptions, Model, ModelPoint, PairKind, PhotoInfo, VerifiedPair, agreement, agrees,
    contradicted_pairs, contradictions, evidence_pairs, folded_pairs, missing_matches, strengths, verify,
};
use irradia_sfm::matching::{MatchOptions, PairOptions, candidate_pairs, match_pairs};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Longer side of the compared photographs, px, and maximum number of features of each: recognising neighbours takes a fraction of what
/// poses need.
const MAX_SIDE: u32 = 480;
const MAX_FEATURES: usize = 1000;
/// Maximum number of photographs that are compared; if there are more, evenly spaced ones.
const MAX_PHOTOS: usize = 120;

/// Minimum number of pairs at which the poses must jump: a single one may be of parts of the scene that really look alike.
const MIN_JUMPS: usize = 2;
/// Minimum number of neighbours that must agree with a photograph's pose for it to count as in place.
const MIN_AGREEING: usize = 2;
/// Minimum share of contradicting pairs for the error to be more than single wrong photographs.
const MIN_CONTRADICTING_SHARE: f64 = 0.1;

/// How well matches between photographs agree with their poses.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PoseCheck {
    /// Number of pairs that count as evidence: those of adjacent photographs with enough matches, and others that contradict the poses.
    pub pairs: usize,
    /// Names of the pairs whose matches contradict their poses: adjacent ones, those with the most matches first; then weaker ones across
    /// folds; then, if that is most of those that show depth, those of other motions.
    pub contradicting: Vec<[String; 2]>,
    /// Contradicting pairs whose photographs both agree with others: the poses jump there.
    pub jumps: Vec<[String; 2]>,
    /// Names of pairs whose poses say that they see the same part of the scene, but that share neither points of the dataset nor matches;
    /// those that should share most first. Empty if they are so few that it may be coincidence.
    pub absent: Vec<[String; 2]>,
}

impl PoseCheck {
    /// Whether the poses are wrong in more than single photographs.
    pub fn is_broken(&self) -> bool {
        self.jumps.len() >= MIN_JUMPS
            || (self.contradicting.len() >= MIN_JUMPS && self.share() >= MIN_CONTRADICTING_SHARE)
    }

    /// The share of pairs whose matches contradict their poses.
    pub fn share(&self) -> f64 {
        self.contradicting.len() as f64 / self.pairs.max(1) as f64
    }
}

/// Matches the photographs of `dataset` and compares the matches with its poses. Photographs that cannot be read are skipped.
pub fn check_poses(dataset: &Dataset) -> PoseCheck {
    let step = dataset.views.len().div_ceil(MAX_PHOTOS).max(1);
    let look = |view| Some((view, ViewFeatures::extract(view, MAX_SIDE, MAX_FEATURES)?));
    let seen: Vec<(&View, ViewFeatures)> = dataset.views.par_iter().step_by(step).filter_map(look).collect();
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
    // Pure rotations, and what stands still, such as the background of a turntable, say little about the positions.
    pairs.retain(|pair| pair.kind != PairKind::Rotation);
    let strengths = strengths(&photos, &features, &pairs);
    let model = Model {
        cameras: photos.iter().map(|photo| photo.camera).collect(),
        poses: views.iter().map(|view| Some(pose(&view.camera))).collect(),
        ..Model::default()
    };
    let agreement = agreement(&photos, &features, &pairs, &model);
    let supported = find_supported(photos.len(), &pairs, &strengths, &agreement);
    let names = |pair: [u32; 2]| pair.map(|photo| photos[photo as usize].name.clone());
    let mut contradicting = contradictions(&pairs, &strengths, &agreement);
    let mut counted: BTreeSet<usize> = evidence_pairs(&pairs, &strengths).collect();
    let folded = folded_pairs(&model.poses, &pairs, &strengths, &agreement);
    // Motions were found with the cameras of the model.
    let contradicted = contradicted_pairs(&pairs, &model.poses, |_| true);
    for i in folded.into_iter().chain(contradicted) {
        if !contradicting.contains(&i) {
            contradicting.push(i);
        }
    }
    counted.extend(&contradicting);
    let contradicting: Vec<[u32; 2]> = contradicting.into_iter().map(|i| pairs[i].photos).collect();
    let jump = |photos: &&[u32; 2]| photos.iter().all(|photo| supported[*photo as usize]);
    PoseCheck {
        pairs: counted.len(),
        jumps: contradicting.iter().filter(jump).copied().map(names).collect(),
        contradicting: contradicting.into_iter().map(names).collect(),
        absent: if absent.len() >= MIN_MISSING_PAIRS {
            absent.into_iter().map(names).collect()
        } else {
            Vec::new()
        },
    }
}

/// Pairs of `views` whose poses say that they see the same part of the scene, but that share no points of the dataset.
fn absent_pairs(dataset: &Dataset, views: &[&View], photos: &[PhotoInfo]) -> Vec<[u32; 2]> {
    let Some(points) = &dataset.points else {
        return Vec::new();
    };
    let mut tracks = vec![Vec::new(); points.len()];
    for (photo, view) in (0u32..).zip(views) {
        // The index of the feature is unknown and does not matter.
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
    missing_matches(photos, &model).iter().map(|pair| pair.photos).collect()
}

/// `[photos]` whether several neighbours of a photograph agree with its pose: a single wrong photograph contradicts all its neighbours,
/// whereas at a jump the photographs on each side agree with one another.
fn find_supported(photos: usize, pairs: &[VerifiedPair], strengths: &[f64], agreement: &[Option<f64>]) -> Vec<bool> {
    let mut agreeing = vec![0; photos];
    let agree = evidence_pairs(pairs, strengths).filter(|i| agrees(agreement[*i]));
    for photo in agree.flat_map(|i| pairs[i].photos) {
        agreeing[photo as usize] += 1;
    }
    agreeing.into_iter().map(|agreeing| agreeing >= MIN_AGREEING).collect()
}
