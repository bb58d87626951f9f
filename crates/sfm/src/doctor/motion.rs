//! Diagnoses from the motion between photographs: none, rotation only, or something that stands still.

use super::{Diagnosis, Evidence, Graph, MIN_LINK_MATCHES, is_pure_rotation};
use crate::geometry::homography::count_rotation_inliers;
use crate::map::{VerifiedPair, duplicate_pairs, find_still_region, normalized_matches};
use crate::median;
use std::collections::BTreeMap;

/// Minimum number of photographs from one place for a fault of the capture.
const MIN_ROTATED_PHOTOS: usize = 3;
/// The camera only turned between two models if, in the median of the strongest pairs between them, a rotation explains at least this
/// fraction of the matches with an error below this number of pixels. In two flights of a drone through a hall: 0.84 to 0.95 where
/// the models have no common scale, 0.1 and 0.2 where something else separates them.
const MIN_ROTATION_FRACTION: f64 = 0.8;
const MAX_ROTATION_ERROR_PIXELS: f64 = 4.0;

/// Photographs all of whose pairs only turn. Something that moves across the photographs looks like a turn, so `moving` pairs do not
/// count.
pub(super) fn rotation_only(evidence: &Evidence, graph: &Graph, moving: &[[u32; 2]]) -> Vec<Diagnosis> {
    let is_rotation = |pair: &VerifiedPair| is_pure_rotation(pair) && !moving.contains(&pair.photos);
    let rotated: Vec<usize> = (0..evidence.photos.len())
        .filter(|photo| {
            let partners = &graph.partners[*photo];
            partners.len() > 1 && partners.iter().all(|(_, pair)| is_rotation(&evidence.pairs[*pair]))
        })
        .collect();
    let pairs = evidence
        .pairs
        .iter()
        .filter(|pair| is_rotation(pair) && pair.photos.iter().all(|p| rotated.contains(&(*p as usize))))
        .count();
    if rotated.len() < MIN_ROTATED_PHOTOS || pairs == 0 {
        return Vec::new();
    }
    vec![Diagnosis::RotationOnly { photos: rotated, pairs }]
}

/// Pairs of models between which most of the strongest pairs, those with at least half of the matches of the first, only turn: nothing
/// determines the scale of one model relative to the other.
pub(super) fn rotation_between_models(evidence: &Evidence) -> Vec<Diagnosis> {
    if evidence.split_models.is_some() {
        // Parts that look alike are photographed from similar viewpoints, so the wrong pairs between them look like turns.
        return Vec::new();
    }
    let model_of = |photo: u32| {
        let mut models = evidence.models.iter();
        models.position(|model| model.poses[photo as usize].is_some())
    };
    let mut between: BTreeMap<[usize; 2], Vec<&VerifiedPair>> = BTreeMap::new();
    for pair in evidence
        .pairs
        .iter()
        .filter(|pair| pair.matches.len() >= MIN_LINK_MATCHES)
    {
        if let [Some(a), Some(b)] = pair.photos.map(model_of)
            && a != b
        {
            between.entry([a.min(b), a.max(b)]).or_default().push(pair);
        }
    }
    let rotation_fraction = |pair: &VerifiedPair| {
        let camera = |photo: u32| {
            let group = evidence.photos[photo as usize].group;
            model_of(photo).and_then(|model| evidence.models[model].cameras[group].as_ref())
        };
        let [Some(a), Some(b)] = pair.photos.map(camera) else {
            return 0.0;
        };
        let matches = normalized_matches(pair, evidence.features, [a, b]);
        let threshold = MAX_ROTATION_ERROR_PIXELS / b.focal();
        // Wrong matches bias the first rotation, so the first threshold is wide.
        count_rotation_inliers(&matches, &[8.0 * threshold, 2.0 * threshold], threshold) as f64
            / matches.len().max(1) as f64
    };
    let diagnosis = |(models, pairs): ([usize; 2], Vec<&VerifiedPair>)| {
        let first = pairs.iter().max_by_key(|pair| pair.matches.len())?;
        let strong = pairs
            .iter()
            .filter(|pair| 2 * pair.matches.len() >= first.matches.len());
        let fractions: Vec<f64> = strong.map(|pair| rotation_fraction(pair)).collect();
        (fractions.len() >= MIN_ROTATED_PHOTOS && median(fractions)? >= MIN_ROTATION_FRACTION).then(|| {
            Diagnosis::RotationBetweenModels {
                ends: first.photos.map(|photo| photo as usize),
                sides: models.map(|model| evidence.models[model].registered()),
            }
        })
    };
    between.into_iter().filter_map(diagnosis).collect()
}

/// Photographs sorted by the number of `pairs` that they are in, most first.
pub(super) fn photos_by_pair_count(pairs: &[[u32; 2]]) -> Vec<usize> {
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    for photo in pairs.iter().flatten() {
        *counts.entry(*photo as usize).or_default() += 1;
    }
    let mut photos: Vec<(usize, usize)> = counts.into_iter().collect();
    photos.sort_by_key(|(photo, count)| (std::cmp::Reverse(*count), *photo));
    photos.into_iter().map(|p| p.0).collect()
}

/// A part of the photographs that stands still; otherwise, photographs of the same part of the scene from the same place, which pairs
/// on a turntable only seem to be.
pub(super) fn still_and_duplicates(evidence: &Evidence) -> (Vec<Diagnosis>, Vec<Diagnosis>) {
    let &Evidence {
        photos,
        features,
        matches,
        ..
    } = evidence;
    let found = evidence
        .masked
        .cloned()
        .or_else(|| find_still_region(photos, features, matches));
    match found {
        Some(found) => {
            let diagnosis = Diagnosis::StillRegion {
                photos: photos_by_pair_count(&found.pairs),
                pairs: [found.pairs.len(), found.compared],
                fraction: found.fraction,
                masked: evidence.masked.is_some(),
            };
            (vec![diagnosis], Vec::new())
        }
        None => {
            let duplicates = duplicate_pairs(photos, features, matches)
                .into_iter()
                .map(|pair| Diagnosis::Duplicate {
                    photos: pair.map(|p| p as usize),
                });
            (Vec::new(), duplicates.collect())
        }
    }
}
