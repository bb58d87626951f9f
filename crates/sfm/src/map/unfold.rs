//! Repair of folded models, in which parts of the scene that look alike were mistaken for one another.
//!
//! Photographs of parts that only look alike share a smaller area than photographs of the same part: a label that occurs twice has many
//! matches, but the background around it has none. The strongest pairs, those whose matches cover most, must therefore agree with the
//! model. Where some do not, the scene is mapped again from pairs that are close to one another in the spanning tree of the strongest
//! pairs, then from all pairs that agree with the result.
//!
//! For few photographs, the tree has few pairs across a fold, often a single one, and all pairs are close. All neighbours then count as
//! evidence, and closer and closer pairs are tried.

use super::agreement::{agreement, contradictions, contradicts, near_in_tree, spanning_tree, strengths};
use super::types::{FEW_PHOTOS, Model, Progress, VerifiedPair};
use super::{GrownModels, Input, grow_models};

/// Parameters that differ between few photographs and many.
struct Rules {
    /// Minimum number of pairs that contradict a model for it to count as folded.
    min_contradictions: usize,
    /// Minimum number of photographs in another model, relative to the first. If only a few photographs lack a pose, they get a second
    /// attempt.
    min_registered_ratio: f64,
    /// Maximum number of steps along the tree between the photographs of a pair that is used first: one mapping for each.
    hops: &'static [usize],
}

const SMALL_CAPTURE_RULES: Rules = Rules {
    min_contradictions: 1,
    min_registered_ratio: 0.75,
    hops: &[4, 3, 2, 1],
};
const LARGE_CAPTURE_RULES: Rules = Rules {
    min_contradictions: 2,
    min_registered_ratio: 0.9,
    hops: &[4],
};
/// Minimum fraction of the matches of a pair that agree with the model of the tree for the pair to be used.
const MIN_AGREEMENT: f64 = 0.8;

/// Models, and how well the pairs fit the largest.
struct Candidate {
    grown: GrownModels,
    /// `[pairs]` the fraction of the matches that agree.
    agreement: Vec<Option<f64>>,
    /// Number of pairs that count as evidence and contradict it.
    contradicting: usize,
}

impl Candidate {
    fn registered(&self) -> usize {
        self.grown.models.first().map_or(0, Model::registered)
    }

    /// Total strength of the pairs, weighted by the fractions of their matches that agree with it.
    fn support(&self, strengths: &[f64]) -> f64 {
        let agreeing = self.agreement.iter().zip(strengths);
        agreeing
            .filter_map(|(agrees, strength)| Some((*agrees)? * strength))
            .sum()
    }
}

/// If `found` is folded, the models with the most support among those that at most half as many pairs contradict; `found` if it is not
/// folded or there are none.
pub(super) fn unfold(input: &Input, found: GrownModels, progress: &mut dyn FnMut(Progress)) -> GrownModels {
    let Input {
        photos,
        features,
        pairs,
        ..
    } = *input;
    let few = photos.len() <= FEW_PHOTOS;
    let rules = if few { SMALL_CAPTURE_RULES } else { LARGE_CAPTURE_RULES };
    let strengths = strengths(photos, features, pairs);
    let tree = spanning_tree(photos.len(), pairs, &strengths);
    let evaluate = |grown: GrownModels| {
        let model = grown.models.first();
        let agreement = model.map_or(vec![None; pairs.len()], |model| {
            agreement(photos, features, pairs, model)
        });
        let contradicting = if few {
            contradictions(pairs, &strengths, &agreement).len()
        } else {
            tree.iter().filter(|i| contradicts(agreement[**i])).count()
        };
        Candidate {
            grown,
            agreement,
            contradicting,
        }
    };
    let found = evaluate(found);
    if found.contradicting < rules.min_contradictions {
        return found.grown;
    }
    // Most skeletons of a capture extend to the same pairs, which need not be mapped twice.
    let mut tried: Vec<Vec<bool>> = Vec::new();
    let mut grow_from = |keep: Vec<bool>| {
        if tried.contains(&keep) {
            return None;
        }
        let kept = pairs.iter().zip(&keep).filter(|(_, keep)| **keep);
        let kept: Vec<VerifiedPair> = kept.map(|(pair, _)| pair.clone()).collect();
        tried.push(keep);
        Some(evaluate(grow_models(input, &kept, progress)))
    };
    let min_registered = rules.min_registered_ratio * found.registered() as f64;
    let mut best: Option<Candidate> = None;
    for hops in rules.hops {
        let Some(skeleton) = grow_from(near_in_tree(photos.len(), pairs, &tree, *hops)) else {
            continue;
        };
        let agrees = skeleton
            .agreement
            .iter()
            .map(|a| a.is_none_or(|fraction| fraction > MIN_AGREEMENT));
        let extended = grow_from(agrees.collect());
        for other in extended.into_iter().chain([skeleton]) {
            let is_acceptable =
                other.registered() as f64 >= min_registered && 2 * other.contradicting <= found.contradicting;
            let has_more_support = |best: &Candidate| other.support(&strengths) > best.support(&strengths);
            if is_acceptable && best.as_ref().is_none_or(has_more_support) {
                best = Some(other);
            }
        }
    }
    best.unwrap_or(found).grown
}
