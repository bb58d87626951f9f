//! Separate mapping of the parts of a scene that were mistaken for one another, which missing matches reveal.
//!
//! Photographs of one part are connected by their strongest pairs, while parts that look alike are connected by weaker ones. Parts are
//! therefore grown starting with the strongest pairs, and two parts are not joined if many pairs between them should share points and do
//! not. After Heinly, Dunn and Frahm, "Correcting for duplicate scene structure in sparse 3D reconstruction" (ECCV 2014), who split a
//! model by structure that is visible and should not be.

use super::agreement::{strengths, strongest_first};
use super::missing::{MIN_MISSING_PAIRS, Overlap, missing_matches, missing_pairs, overlaps};
use super::types::{MissingMatches, Model, Progress, VerifiedPair};
use super::{GrownModels, Input, grow_models};
use std::collections::BTreeMap;

/// Two parts are different if at least this fraction of the pairs between them that should share points do not.
const MIN_MISSING_FRACTION: f64 = 0.25;
/// Minimum number of photographs in all models of the parts, relative to the number before.
const MIN_REGISTERED_RATIO: f64 = 0.9;
/// Maximum number of rounds in which photographs move to other parts.
const MAX_ROUNDS: usize = 10;

/// The result of splitting a model in which matches are missing.
pub(super) struct Split {
    /// Models of the parts, or the original ones.
    pub found: GrownModels,
    /// The pairs whose matches were missing before.
    pub missing: Vec<MissingMatches>,
    /// Number of models of the parts, if the model was split.
    pub split_models: Option<usize>,
}

/// Models of the parts, if photographs of `found` should share points and do not, and the models of the parts have at most half as many
/// such pairs; else `found`.
pub(super) fn split(input: &Input, found: GrownModels, progress: &mut dyn FnMut(Progress)) -> Split {
    let Input {
        photos,
        features,
        pairs,
        ..
    } = *input;
    let seen = found.models.first().map_or(Vec::new(), |model| overlaps(photos, model));
    let missing = missing_pairs(&seen);
    if missing.len() >= MIN_MISSING_PAIRS {
        let part = parts(photos.len(), pairs, &strengths(photos, features, pairs), &seen);
        let within = |pair: &&VerifiedPair| part[pair.photos[0] as usize] == part[pair.photos[1] as usize];
        let kept: Vec<VerifiedPair> = pairs.iter().filter(within).cloned().collect();
        if kept.len() < pairs.len() {
            let parts = grow_models(input, &kept, progress);
            let registered = |found: &GrownModels| found.models.iter().map(Model::registered).sum::<usize>() as f64;
            let remaining: usize = parts
                .models
                .iter()
                .map(|model| missing_matches(photos, model).len())
                .sum();
            if registered(&parts) >= MIN_REGISTERED_RATIO * registered(&found) && 2 * remaining <= missing.len() {
                return Split {
                    split_models: Some(parts.models.len()),
                    found: parts,
                    missing,
                };
            }
        }
    }
    Split {
        found,
        missing,
        split_models: None,
    }
}

/// `[photos]` the part of each photograph. Parts are joined by pairs, strongest first, unless the fraction [`MIN_MISSING_FRACTION`] of the
/// pairs between them that should share points do not. Then each photograph moves to the part with which its pairs are strongest: a chain
/// of a few pairs may have pulled it away.
fn parts(photos: usize, pairs: &[VerifiedPair], strengths: &[f64], overlaps: &[Overlap]) -> Vec<usize> {
    let order = strongest_first(strengths);
    // Pairs between two photographs, later between two parts, that should share points: [missing, all].
    let mut photo_counts = vec![[0u32; 2]; photos * photos];
    for overlap in overlaps {
        let [a, b] = overlap.pair.photos.map(|p| p as usize);
        for at in [a * photos + b, b * photos + a] {
            photo_counts[at] = [u32::from(overlap.is_missing), 1];
        }
    }
    let are_different =
        |[missing, all]: [u32; 2]| missing > 0 && f64::from(missing) >= MIN_MISSING_FRACTION * f64::from(all);
    let sum = |a: [u32; 2], b: [u32; 2]| [a[0] + b[0], a[1] + b[1]];
    let mut part_counts = photo_counts.clone();
    let mut part: Vec<usize> = (0..photos).collect();
    let mut joined = true;
    while joined {
        joined = false;
        for i in &order {
            let [to, from] = pairs[*i].photos.map(|p| part[p as usize]);
            if to == from || are_different(part_counts[to * photos + from]) {
                continue;
            }
            part.iter_mut()
                .filter(|part| **part == from)
                .for_each(|part| *part = to);
            for other in 0..photos {
                let both = sum(part_counts[to * photos + other], part_counts[from * photos + other]);
                (part_counts[to * photos + other], part_counts[other * photos + to]) = (both, both);
            }
            joined = true;
        }
    }
    let mut partners = vec![Vec::new(); photos];
    for (pair, strength) in pairs.iter().zip(strengths) {
        let [a, b] = pair.photos.map(|p| p as usize);
        partners[a].push((b, *strength));
        partners[b].push((a, *strength));
    }
    for _ in 0..MAX_ROUNDS {
        let before = part.clone();
        for photo in 0..photos {
            let mut strength = BTreeMap::new();
            for (other, of_pair) in &partners[photo] {
                *strength.entry(part[*other]).or_insert(0.0) += of_pair;
            }
            let overlaps = |to: &usize| {
                let of_part = (0..photos).filter(|other| part[*other] == *to);
                of_part
                    .map(|other| photo_counts[photo * photos + other])
                    .fold([0, 0], sum)
            };
            let own = strength.get(&part[photo]).copied().unwrap_or(0.0);
            let best = strength
                .into_iter()
                .filter(|(to, total)| *total > own && !are_different(overlaps(to)))
                .max_by(|a, b| a.1.total_cmp(&b.1));
            if let Some((to, _)) = best {
                part[photo] = to;
            }
        }
        if part == before {
            break;
        }
    }
    part
}
