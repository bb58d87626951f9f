//! Pairs that cannot all be right: parts of a scene that look alike fold the model.
//!
//! A wrong two-view rotation does not prove a wrong pair: two rotations fit a plane, and with little parallax many fit. A pair
//! therefore contradicts the rest only if no motion near the rotation that the rest predicts explains its matches.

use super::{Diagnosis, Evidence, GlobalRotations, average_rotations};
use crate::Features;
use crate::geometry::essential::{Motion, refine_motion};
use crate::map::{
    GroupCamera, PhotoInfo, VerifiedPair, agreement, contradicted_pairs, contradictions, explains_matches,
    normalized_matches, strengths,
};
use glam::{DQuat, DVec2};
use irradia_scene::Rng;
use rayon::prelude::*;

/// Minimum disagreement with the prediction at which another motion is searched for, radians.
const MIN_DISAGREEMENT_RADIANS: f64 = 0.17;
/// Maximum angle between such a motion and the prediction, radians.
const MAX_DEVIATION_RADIANS: f64 = 0.26;
/// Number of translation directions that are tried.
const TRANSLATION_SAMPLES: usize = 50;
/// Errors up to which matches agree, on the plane z = 1: first coarse, for a predicted rotation a few degrees off, then finer.
const REFINEMENT_THRESHOLDS: [f64; 3] = [0.06, 0.03, 0.012];
/// The final such error, about eight pixels at the usual focal length: the lens is still unknown.
const INLIER_THRESHOLD: f64 = 0.01;
/// Minimum fraction of a pair's matches that agree with the rest.
const MIN_INLIER_FRACTION: f64 = 0.6;
/// Fraction of pairs without any motion near the prediction at which the prediction is rejected.
const MAX_UNEXPLAINED_FRACTION: f64 = 0.15;
/// Minimum number of contradicting pairs for a diagnosis.
const MIN_CONTRADICTING_PAIRS: usize = 2;

/// Rotations that agree with most pairs, and how well each pair agrees with them.
#[derive(Clone, Debug, PartialEq)]
pub struct Consistency {
    /// Rotations of all photographs.
    pub rotations: GlobalRotations,
    /// `[pairs]` the fraction of the matches that are explained by some motion near the predicted rotation.
    pub inlier_fractions: Vec<f64>,
}

/// Finds pairs that do not fit into loops with the others: averages rotations over all pairs, and searches for another motion near
/// the prediction for those that disagree, until no further pair agrees.
pub fn consistency(
    photos: &[PhotoInfo],
    features: &[Features],
    cameras: &[GroupCamera],
    pairs: &[VerifiedPair],
) -> Consistency {
    const MAX_ROUNDS: usize = 3;
    let mut rotations: Vec<DQuat> = pairs.iter().map(|pair| pair.motion.rotation).collect();
    let mut averaged = average_rotations(photos.len(), pairs, &rotations);
    let mut inlier_fractions = vec![1.0; pairs.len()];
    for _ in 0..MAX_ROUNDS {
        let found: Vec<(f64, Option<DQuat>)> = pairs
            .par_iter()
            .enumerate()
            .map(|(i, pair)| {
                let [a, b] = pair.photos.map(|p| averaged.world_from_camera[p as usize]);
                let (Some(a), Some(b)) = (a, b) else { return (1.0, None) };
                if averaged.disagreement[i] < MIN_DISAGREEMENT_RADIANS {
                    return (1.0, None);
                }
                let camera = |photo: u32| &cameras[photos[photo as usize].group].camera;
                let points = normalized_matches(pair, features, pair.photos.map(camera));
                motion_near_prediction(&points, b.inverse() * a, i as u64)
            })
            .collect();
        let mut changed = false;
        for (i, (fraction, rotation)) in found.into_iter().enumerate() {
            inlier_fractions[i] = fraction;
            if let Some(rotation) = rotation {
                rotations[i] = rotation;
                changed = true;
            }
        }
        if !changed {
            break;
        }
        averaged = average_rotations(photos.len(), pairs, &rotations);
    }
    Consistency {
        rotations: averaged,
        inlier_fractions,
    }
}

impl Consistency {
    /// Whether most pairs agree with the rotations: with long lenses, two-view rotations are ambiguous and often wrong.
    pub fn is_consistent(&self) -> bool {
        let unexplained = self.inlier_fractions.iter().filter(|fraction| **fraction < 0.5).count();
        (unexplained as f64) < MAX_UNEXPLAINED_FRACTION * self.inlier_fractions.len() as f64
    }
}

/// The best motion whose rotation is near `predicted`: the fraction of matches that agree with it, and its rotation if it explains
/// the pair.
fn motion_near_prediction(points: &[[DVec2; 2]], predicted: DQuat, seed: u64) -> (f64, Option<DQuat>) {
    if points.len() < 8 {
        return (1.0, None);
    }
    // The translation lies in the plane of both rays of each match.
    let normal = |[a, b]: [DVec2; 2]| (predicted * a.extend(1.0)).cross(b.extend(1.0));
    let mut rng = Rng::new(seed, 7);
    let mut best: Option<(f64, Motion)> = None;
    for _ in 0..TRANSLATION_SAMPLES {
        let [i, j] = [0; 2].map(|_| rng.below(points.len() as u32) as usize);
        let Some(translation) = normal(points[i]).cross(normal(points[j])).try_normalize() else {
            continue;
        };
        let motion = Motion {
            rotation: predicted,
            translation,
        };
        let fraction = motion.agreeing_fraction(points, REFINEMENT_THRESHOLDS[1]);
        if best.is_none_or(|(highest, _)| fraction > highest) {
            best = Some((fraction, motion));
        }
    }
    let Some((_, mut motion)) = best else {
        return (1.0, None);
    };
    for threshold in REFINEMENT_THRESHOLDS {
        motion = refine_motion(motion, points, threshold, 3).unwrap_or(motion);
    }
    if motion.rotation.angle_between(predicted) > MAX_DEVIATION_RADIANS {
        return (0.0, None);
    }
    let fraction = motion.agreeing_fraction(points, INLIER_THRESHOLD);
    (fraction, (fraction > MIN_INLIER_FRACTION).then_some(motion.rotation))
}

/// Diagnoses a model that grew from a motion that fits only a plane.
pub(super) fn other_motion(evidence: &Evidence) -> Option<Diagnosis> {
    let model = evidence.model()?;
    let camera_of = |photo: u32| model.cameras[evidence.photos[photo as usize].group].as_ref();
    let is_reliable = |pair: &VerifiedPair| explains_matches(pair, evidence.features, pair.photos.map(camera_of));
    let found = contradicted_pairs(evidence.pairs, &model.poses, is_reliable);
    let pairs: Vec<[usize; 2]> = (found.iter())
        .map(|i| evidence.pairs[*i].photos.map(|photo| photo as usize))
        .collect();
    (!pairs.is_empty()).then_some(Diagnosis::OtherMotion { pairs })
}

/// Diagnoses repeated structures: neighbours that disagree with the model, unless something moves in both (`moving` lists such
/// photographs).
pub(super) fn contradiction(evidence: &Evidence, moving: &[usize]) -> Vec<Diagnosis> {
    let Some(model) = evidence.model() else {
        return Vec::new();
    };
    let pairs = evidence.pairs;
    let agreement = agreement(evidence.photos, evidence.features, pairs, model);
    let strengths = strengths(evidence.photos, evidence.features, pairs);
    let mut found = contradictions(pairs, &strengths, &agreement);
    found.retain(|i| !pairs[*i].photos.iter().all(|p| moving.contains(&(*p as usize))));
    let Some(first) = found
        .first()
        .copied()
        .filter(|_| found.len() >= MIN_CONTRADICTING_PAIRS)
    else {
        return Vec::new();
    };
    vec![Diagnosis::Contradiction {
        pairs: found.iter().map(|i| pairs[*i].photos.map(|p| p as usize)).collect(),
        matches: pairs[first].matches.len(),
        agreement: agreement[first].unwrap_or(0.0),
        total: agreement.iter().flatten().count(),
    }]
}
