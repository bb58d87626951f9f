//! Parts of a scene that look alike may be taken for one another, and fold the model.
//!
//! What looks alike shares less of the pictures than what is the same: a label that occurs twice has many matches, but not the
//! background around it. So the strongest pairs, those whose matches cover most, must agree with the model. Where some do not, the
//! scene is mapped again from pairs close to one another in their spanning tree, then from all pairs that agree with the outcome.

use super::agree::{CONTRADICTS, agreement, near_in_tree, spanning_tree, strengths};
use super::types::{Model, Progress, VerifiedPair};
use super::{Grown, Input, grown};

/// Pairs of the tree that contradict a model from which on it is folded.
const FOLDED: usize = 2;
/// Fraction of the matches of a pair that agree with the model of the tree, from which on it is used.
const AGREES: f64 = 0.8;
/// Photographs that another model must hold, of those of the first.
const KEEPS: f64 = 0.9;

/// Models that the strongest pairs contradict at most half as often, where `found` is folded and there are such; else `found`.
pub(super) fn unfolded(input: &Input, found: Grown, progress: &mut dyn FnMut(Progress)) -> Grown {
    let Input {
        photos,
        features,
        pairs,
        ..
    } = *input;
    let tree = spanning_tree(photos.len(), pairs, &strengths(photos, features, pairs));
    let agreement = |found: &Grown| {
        let model = found.models.first();
        model.map_or(Vec::new(), |model| agreement(photos, features, pairs, model))
    };
    let folds = |found: &Grown| {
        let agreement = agreement(found);
        let contradicts = |i: &&usize| agreement.get(**i).is_some_and(|a| a.is_some_and(|a| a < CONTRADICTS));
        tree.iter().filter(contradicts).count()
    };
    let folded = folds(&found);
    if folded < FOLDED {
        return found;
    }
    let mut grow_from = |keep: &[bool]| {
        let kept = pairs
            .iter()
            .zip(keep)
            .filter(|(_, keep)| **keep)
            .map(|(pair, _)| pair.clone());
        grown(input, &kept.collect::<Vec<VerifiedPair>>(), progress)
    };
    let skeleton = grow_from(&near_in_tree(photos.len(), pairs, &tree));
    let agrees: Vec<bool> = agreement(&skeleton)
        .iter()
        .map(|a| a.is_none_or(|fraction| fraction > AGREES))
        .collect();
    let again = grow_from(&agrees);
    let registered = |found: &Grown| found.models.first().map_or(0, Model::registered) as f64;
    let least = KEEPS * registered(&found);
    let unfolds = |other: &Grown| registered(other) >= least && 2 * folds(other) <= folded;
    [again, skeleton].into_iter().find(unfolds).unwrap_or(found)
}
