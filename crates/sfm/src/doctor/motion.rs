//! What the motion between photographs tells: none, turns only, something that stands still, something that moves by itself.

use super::{Diagnosis, Evidence, Graph, turns_only};
use crate::geometry::correspondences::{Correspondences, sampson_squared};
use crate::geometry::fundamental::{Fundamental, eight_points};
use crate::geometry::homography::Homography;
use crate::geometry::ransac::{Limits, estimate};
use crate::map::{PairKind, VerifiedPair};
use crate::median;
use crate::{Keypoint, PairMatches};
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};

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

/// Inliers of what moves, beside at least twice as many of the scene.
const MOVING_MATCHES: usize = 12;
/// Median distance from the scene's epipolar lines of what moves, in long sides.
const MOVING_OFF: f64 = 0.012;
/// Largest part of the picture, along each axis, of what moves.
const MOVING_PART: f64 = 0.5;
/// Pairs, and their fraction, from which on something moves.
const MOVING_PAIRS: usize = 4;
const MOVING_FRACTION: f64 = 0.08;

/// Errors in long sides at which a match agrees with a geometry: four pixels of a thousand, as in verification, and half as much
/// again for what is not rigid.
const AGREES: f64 = 0.004;
const AGREES_LOOSELY: f64 = 0.006;

/// Fraction of the features, and largest median shift in long sides, of one photograph taken twice.
const TWICE_FRACTION: f64 = 0.4;
const TWICE_SHIFT: f64 = 0.001;

/// Matches of a pair, centred and divided by the long sides.
fn places(evidence: &Evidence, pair: &PairMatches) -> Vec<[DVec2; 2]> {
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

fn limits(pair: &PairMatches, samples: usize) -> Limits {
    Limits {
        samples,
        confidence: 0.999,
        seed: u64::from(pair.photos[0]) << 32 | u64::from(pair.photos[1]),
    }
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

/// Photographs all of whose pairs only turn.
pub(super) fn rotation_only(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let turned: Vec<usize> = (0..evidence.photos.len())
        .filter(|photo| {
            let partners = &graph.partners[*photo];
            partners.len() > 1 && partners.iter().all(|(_, pair)| turns_only(&evidence.pairs[*pair]))
        })
        .collect();
    let pairs = evidence
        .pairs
        .iter()
        .filter(|pair| turns_only(pair) && pair.photos.iter().all(|p| turned.contains(&(*p as usize))))
        .count();
    if turned.len() < TURNED || pairs == 0 {
        return Vec::new();
    }
    vec![Diagnosis::RotationOnly { photos: turned, pairs }]
}

/// Photographs by how many of `pairs` name them, most first.
fn most_named(pairs: &[[u32; 2]]) -> Vec<usize> {
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
    let found: Vec<[u32; 2]> = compared
        .iter()
        .zip(&fractions)
        .filter(|f| f.1.is_some())
        .map(|f| f.0.photos)
        .collect();
    if found.len() < 3 || (found.len() as f64) < STILL_PAIRS * compared.len() as f64 {
        return Vec::new();
    }
    vec![Diagnosis::StandsStill {
        photos: most_named(&found),
        pairs: [found.len(), compared.len()],
        fraction: median(fractions.into_iter().flatten().collect()).unwrap_or(0.0),
    }]
}

/// Something that follows a motion of its own.
pub(super) fn moving(evidence: &Evidence) -> Vec<Diagnosis> {
    let by_photos: BTreeMap<[u32; 2], &PairMatches> = evidence.matches.iter().map(|pair| (pair.photos, pair)).collect();
    let compared: Vec<&VerifiedPair> = evidence
        .pairs
        .iter()
        .filter(|pair| pair.kind == PairKind::General && pair.matches.len() >= 2 * MOVING_MATCHES)
        .collect();
    let counts: Vec<Option<usize>> = compared
        .par_iter()
        .map(|pair| own_motion(evidence, by_photos.get(&pair.photos)?, pair))
        .collect();
    let found: Vec<[u32; 2]> = compared
        .iter()
        .zip(&counts)
        .filter(|f| f.1.is_some())
        .map(|f| f.0.photos)
        .collect();
    if found.len() < MOVING_PAIRS || (found.len() as f64) < MOVING_FRACTION * compared.len() as f64 {
        return Vec::new();
    }
    let matches = median(counts.into_iter().flatten().map(|count| count as f64).collect());
    vec![Diagnosis::Moving {
        photos: most_named(&found),
        pairs: [found.len(), compared.len()],
        matches: matches.unwrap_or(0.0) as usize,
    }]
}

/// Matches on something compact that agree with one another and not with the rest of a pair.
fn own_motion(evidence: &Evidence, all: &PairMatches, pair: &VerifiedPair) -> Option<usize> {
    let inliers: HashSet<[u32; 2]> = pair.matches.iter().copied().collect();
    let mut rest = PairMatches {
        photos: all.photos,
        matches: all.matches.iter().copied().filter(|m| !inliers.contains(m)).collect(),
    };
    if rest.matches.len() < MOVING_MATCHES {
        return None;
    }
    let scene = places(
        evidence,
        &PairMatches {
            photos: pair.photos,
            matches: pair.matches.clone(),
        },
    );
    let geometry = eight_points(scene.iter().map(|p| (*p, 1.0)))?;
    // What just misses the verification's threshold is part of the scene.
    let candidates = places(evidence, &rest);
    let off = |p: &[DVec2; 2]| sampson_squared(&geometry, *p).sqrt() > MOVING_OFF;
    rest.matches.clear();
    let candidates: Vec<[DVec2; 2]> = candidates.into_iter().filter(off).collect();
    if candidates.len() < MOVING_MATCHES {
        return None;
    }
    let points = Correspondences::new(candidates);
    let problem = Homography {
        points: &points,
        threshold: AGREES_LOOSELY,
    };
    let found = estimate(&problem, Vec::new(), limits(&rest, 500))?;
    let group: Vec<[DVec2; 2]> = points
        .points
        .iter()
        .copied()
        .filter(|p| agrees(&found.model, p))
        .collect();
    let compact = |side: usize, axis: usize| {
        let mut values: Vec<f64> = group.iter().map(|p| p[side][axis]).collect();
        values.sort_by(f64::total_cmp);
        // A tenth on either side may be chance.
        let cut = values.len() / 10;
        let width = values[values.len() - 1 - cut] - values[cut];
        (0.005..MOVING_PART).contains(&width)
    };
    (group.len() >= MOVING_MATCHES && [0, 1].iter().all(|side| compact(*side, 0) && compact(*side, 1)))
        .then_some(group.len())
}

fn agrees(homography: &DMat3, [a, b]: &[DVec2; 2]) -> bool {
    let mapped = *homography * a.extend(1.0);
    (mapped.truncate() / mapped.z - *b).length() < AGREES_LOOSELY
}
