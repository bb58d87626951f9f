//! What the motion between photographs tells: none, turns only, something that stands still.

use super::{Diagnosis, Evidence, Graph, connected, turns_only};
use crate::geometry::correspondences::{Correspondences, sampson_squared};
use crate::geometry::fundamental::Fundamental;
use crate::geometry::ransac::{Limits, estimate};
use crate::map::VerifiedPair;
use crate::median;
use crate::{Keypoint, PairMatches};
use glam::DVec2;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Photographs of one place from which on it is a fault of the capture.
const TURNED: usize = 3;

/// Largest shift of a match that stands still, in long sides: keypoints of the same pixels repeat within a pixel.
const STILL: f64 = 0.002;
/// Least shift of a match that certainly moves, in long sides.
const MOVES: f64 = 0.015;
/// Matches that stand still, and their fraction, from which on a pair counts.
const STILL_MATCHES: usize = 12;
const STILL_FRACTION: f64 = 0.08;
/// Fraction of the pairs from which on it is a fault of the capture.
const STILL_PAIRS: f64 = 0.1;

/// Error in long sides at which a match agrees with a geometry: four pixels of a thousand, as in verification.
pub(super) const AGREES: f64 = 0.004;

/// Fraction of the features, and largest median shift in long sides, of one photograph taken twice.
const TWICE_FRACTION: f64 = 0.4;
const TWICE_SHIFT: f64 = 0.001;

/// Matches of a pair, centred and divided by the long sides.
pub(super) fn places(evidence: &Evidence, pair: &PairMatches) -> Vec<[DVec2; 2]> {
    let place = |side: usize, keypoint: u32| {
        let photo = pair.photos[side] as usize;
        let (info, Keypoint { x, y, .. }) = (
            &evidence.photos[photo],
            evidence.features[photo].keypoints[keypoint as usize],
        );
        let size = DVec2::new(info.width.into(), info.height.into());
        (DVec2::new(x.into(), y.into()) - 0.5 * size) / size.max_element()
    };
    pair.matches.iter().map(|[i, j]| [place(0, *i), place(1, *j)]).collect()
}

pub(super) fn limits(pair: &PairMatches, samples: usize) -> Limits {
    Limits {
        samples,
        confidence: 0.999,
        seed: u64::from(pair.photos[0]) << 32 | u64::from(pair.photos[1]),
    }
}

/// Photographs that chains of pairs from the same place join, from which on what is in the same place is no photograph taken twice but a
/// background that stands still, with more features than what turns before it; in photographs, and as a fraction of all.
const CHAIN: usize = 6;
const CHAIN_FRACTION: f64 = 0.2;

/// A background that stands still in all of a chain of `twice`.
pub(super) fn stands_behind(evidence: &Evidence, twice: &[Diagnosis]) -> Vec<Diagnosis> {
    let pairs: Vec<[usize; 2]> = (twice.iter())
        .filter_map(|diagnosis| <[usize; 2]>::try_from(diagnosis.photos()).ok())
        .collect();
    let count = evidence.photos.len();
    let mut partners = vec![Vec::new(); count];
    for [a, b] in &pairs {
        partners[*a].push(*b);
        partners[*b].push(*a);
    }
    let chains = connected(count, |photo| partners[photo].iter().copied());
    let longest = chains.into_iter().next().unwrap_or_default();
    if longest.len() < CHAIN || (longest.len() as f64) < CHAIN_FRACTION * count as f64 {
        return Vec::new();
    }
    vec![Diagnosis::StandsStill {
        photos: longest,
        pairs: [pairs.len(), evidence.matches.len()],
        fraction: 1.0,
    }]
}

/// Photographs that show the same from the same place.
pub(super) fn twice(evidence: &Evidence) -> Vec<Diagnosis> {
    let same = |pair: &&PairMatches| {
        let [a, b] = pair.photos.map(|p| evidence.features[p as usize].keypoints.len());
        let enough = (TWICE_FRACTION * a.min(b) as f64).max(20.0);
        if (pair.matches.len() as f64) < enough {
            return false;
        }
        let shifts: Vec<f64> = places(evidence, pair).iter().map(|[a, b]| (*b - *a).length()).collect();
        median(shifts).is_some_and(|shift| shift < TWICE_SHIFT)
    };
    let found = evidence.matches.iter().filter(same);
    found
        .map(|pair| Diagnosis::Twice {
            photos: pair.photos.map(|p| p as usize),
        })
        .collect()
}

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

/// Photographs of the pairs that have a value.
pub(super) fn showing<T>(pairs: &[&PairMatches], values: &[Option<T>]) -> Vec<[u32; 2]> {
    let both = pairs.iter().zip(values);
    both.filter(|b| b.1.is_some()).map(|b| b.0.photos).collect()
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

/// A part of the pictures that stands still while the rest moves by a geometry with which it does not agree.
pub(super) fn stands_still(evidence: &Evidence) -> Vec<Diagnosis> {
    let fraction = |pair: &PairMatches| -> Option<f64> {
        let places = places(evidence, pair);
        let shift = |p: &[DVec2; 2]| (p[1] - p[0]).length();
        let still: Vec<[DVec2; 2]> = places.iter().copied().filter(|p| shift(p) < STILL).collect();
        let moving: Vec<[DVec2; 2]> = places.iter().copied().filter(|p| shift(p) > MOVES).collect();
        let part = still.len() as f64 / places.len().max(1) as f64;
        if still.len() < STILL_MATCHES || part < STILL_FRACTION || moving.len() < 2 * STILL_MATCHES {
            return None;
        }
        let points = Correspondences::new(moving);
        let problem = Fundamental {
            points: &points,
            threshold: AGREES,
        };
        let found = estimate(&problem, Vec::new(), limits(pair, 300))?;
        let off = still
            .iter()
            .filter(|p| sampson_squared(&found.model, **p) > AGREES * AGREES)
            .count();
        // Far away or straight ahead, matches stand still and agree.
        (found.inliers > points.points.len() / 3 && found.inliers >= 15 && 2 * off > still.len()).then_some(part)
    };
    let compared: Vec<&PairMatches> = evidence
        .matches
        .iter()
        .filter(|p| p.matches.len() >= 3 * STILL_MATCHES)
        .collect();
    let fractions: Vec<Option<f64>> = compared.par_iter().map(|pair| fraction(pair)).collect();
    let found = showing(&compared, &fractions);
    if found.len() < 3 || (found.len() as f64) < STILL_PAIRS * compared.len() as f64 {
        return Vec::new();
    }
    vec![Diagnosis::StandsStill {
        photos: most_named(&found),
        pairs: [found.len(), compared.len()],
        fraction: median(fractions.into_iter().flatten().collect()).unwrap_or(0.0),
    }]
}
