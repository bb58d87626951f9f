//! What the motion between photographs tells: none, turns only, something that stands still.

use super::{Diagnosis, Evidence, Graph, turns_only};
use crate::map::{VerifiedPair, same_place, stands_still};
use std::collections::BTreeMap;

/// Photographs of one place from which on it is a fault of the capture.
const TURNED: usize = 3;

/// Photographs all of whose pairs only turn. What moves across the picture seems to turn: pairs that are `moving` tell nothing.
pub(super) fn rotation_only(evidence: &Evidence, graph: &Graph, moving: &[[u32; 2]]) -> Vec<Diagnosis> {
    let turns = |pair: &VerifiedPair| turns_only(pair) && !moving.contains(&pair.photos);
    let turned: Vec<usize> = (0..evidence.photos.len())
        .filter(|photo| {
            let partners = &graph.partners[*photo];
            partners.len() > 1 && partners.iter().all(|(_, pair)| turns(&evidence.pairs[*pair]))
        })
        .collect();
    let pairs = evidence
        .pairs
        .iter()
        .filter(|pair| turns(pair) && pair.photos.iter().all(|p| turned.contains(&(*p as usize))))
        .count();
    if turned.len() < TURNED || pairs == 0 {
        return Vec::new();
    }
    vec![Diagnosis::RotationOnly { photos: turned, pairs }]
}

/// Photographs by how many of `pairs` name them, most first.
pub(super) fn most_named(pairs: &[[u32; 2]]) -> Vec<usize> {
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    for photo in pairs.iter().flatten() {
        *counts.entry(*photo as usize).or_default() += 1;
    }
    let mut photos: Vec<(usize, usize)> = counts.into_iter().collect();
    photos.sort_by_key(|(photo, count)| (std::cmp::Reverse(*count), *photo));
    photos.into_iter().map(|p| p.0).collect()
}

/// A part of the pictures that stands still, and photographs that show the same from the same place: pairs on a turntable only seem to.
pub(super) fn still(evidence: &Evidence) -> (Vec<Diagnosis>, Vec<Diagnosis>) {
    let &Evidence {
        photos,
        features,
        matches,
        ..
    } = evidence;
    let found = evidence
        .masked
        .cloned()
        .or_else(|| stands_still(photos, features, matches));
    match found {
        Some(found) => {
            let diagnosis = Diagnosis::StandsStill {
                photos: most_named(&found.pairs),
                pairs: [found.pairs.len(), found.compared],
                fraction: found.fraction,
                masked: evidence.masked.is_some(),
            };
            (vec![diagnosis], Vec::new())
        }
        None => {
            let twice = same_place(photos, features, matches)
                .into_iter()
                .map(|pair| Diagnosis::Twice {
                    photos: pair.map(|p| p as usize),
                });
            (Vec::new(), twice.collect())
        }
    }
}
