//! Repair of folded models, in which parts of the scene that look alike were mistaken for one another.
//!
//! Photographs of parts that only look alike share a smaller area than photographs of the same part: a label that occurs twice has many
//! matches, but the background around it has none. The strongest pairs, those whose matches cover most, must therefore agree with the
//! model. Where some do not, the scene is mapped again from pairs that are close to one another in the spanning tree of the strongest
//! pairs, then from all pairs that agree with the result.
//!
//! For few photographs, the tree has few pairs across a fold, often a single one, and all pairs are close. All neighbours then count as
//! evidence, and closer and closer pairs are tried.

use super::agree::{CONTRADICTS, agreement, contradictions, near_in_tree, spanning_tree, strengths};
use super::types::{FEW_PHOTOS, Model, Progress, VerifiedPair};
use super::{Grown, Input, grown};

/// Parameters that differ between few photographs and many.
struct Rules {
    /// Minimum number of pairs that contradict a model for it to count as folded.
    folded: usize,
    /// Minimum number of photographs in another model, relative to the first. If only a few photographs lack a pose, they get a second
    /// attempt.
    keeps: f64,
    /// Maximum number of steps along the tree between the photographs of a pair that is used first: one mapping for each.
    hops: &'static [usize],
}

const OF_FEW: Rules = Rules {
    folded: 1,
    keeps: 0.75,
    hops: &[4, 3, 2, 1],
};
const OF_MANY: Rules = Rules {
    folded: 2,
    keeps: 0.9,
    hops: &[4],
};
/// Minimum fraction of the matches of a pair that agree with the model of the tree for the pair to be used.
const AGREES: f64 = 0.8;

/// Models, and how well the pairs fit the largest.
struct Judged {
    grown: Grown,
    /// `[pairs]` the fraction of the matches that agree.
    agreement: Vec<Option<f64>>,
    /// Number of pairs that count as evidence and contradict it.
    folds: usize,
}

impl Judged {
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
pub(super) fn unfolded(input: &Input, found: Grown, progress: &mut dyn FnMut(Progress)) -> Grown {
    let Input {
        photos,
        features,
        pairs,
        ..
    } = *input;
    let few = photos.len() <= FEW_PHOTOS;
    let rules = if few { OF_FEW } else { OF_MANY };
    let strengths = strengths(photos, features, pairs);
    let tree = spanning_tree(photos.len(), pairs, &strengths);
    let judged = |grown: Grown| {
        let model = grown.models.first();
        let agreement = model.map_or(vec![None; pairs.len()], |model| {
            agreement(photos, features, pairs, model)
        });
        let folds = match few {
            true => contradictions(pairs, &strengths, &agreement).len(),
            false => {
                let contradicts = |i: &&usize| agreement[**i].is_some_and(|a| a < CONTRADICTS);
                tree.iter().filter(contradicts).count()
            }
        };
        Judged {
            grown,
            agreement,
            folds,
        }
    };
    let found = judged(found);
    if found.folds < rules.folded {
        return found.grown;
    }
    let mut grow_from = |keep: &[bool]| {
        let kept = pairs.iter().zip(keep).filter(|(_, keep)| **keep);
        let kept: Vec<VerifiedPair> = kept.map(|(pair, _)| pair.clone()).collect();
        judged(grown(input, &kept, progress))
    };
    let least = rules.keeps * found.registered() as f64;
    let mut best: Option<Judged> = None;
    for hops in rules.hops {
        let skeleton = grow_from(&near_in_tree(photos.len(), pairs, &tree, *hops));
        let agrees = skeleton
            .agreement
            .iter()
            .map(|a| a.is_none_or(|fraction| fraction > AGREES));
        let again = grow_from(&agrees.collect::<Vec<bool>>());
        for other in [again, skeleton] {
            let unfolds = other.registered() as f64 >= least && 2 * other.folds <= found.folds;
            let better = |best: &Judged| other.support(&strengths) > best.support(&strengths);
            if unfolds && best.as_ref().is_none_or(better) {
                best = Some(other);
            }
        }
    }
    best.unwrap_or(found).grown
}
