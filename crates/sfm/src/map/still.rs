//! Detection of what stands still in the photographs while the rest moves: parts of what carries the camera, text laid over the
//! photographs, the background of a turntable.
//!
//! Poses that follow it are those of a camera at rest. Where it is found, its matches are therefore left out, and the poses are those
//! relative to what moves. In twelve photographs by a robot that shows parts of itself, 20 % of the matches stand still: with them three
//! photographs turn by 1.6 degrees instead of 16 to 20; without them all turn as the robot did, within 0.3 degrees.

use super::types::PhotoInfo;
use super::verify::{centered_points, seed_of};
use crate::geometry::correspondences::{Correspondences, sampson_squared};
use crate::geometry::fundamental::Fundamental;
use crate::geometry::ransac::{Limits, estimate};
use crate::{Features, PairMatches, connected, median};
use glam::DVec2;
use rayon::prelude::*;
use std::borrow::Cow;

/// Maximum shift of a match that stands still, relative to the long side: keypoints of the same pixels repeat within a pixel.
const STILL: f64 = 0.002;
/// Minimum shift of a match that certainly moves, relative to the long side.
const MOVES: f64 = 0.015;
/// Maximum error of a match that agrees with a geometry, relative to the long side: four pixels of a thousand, as in verification.
pub(crate) const AGREES: f64 = 0.004;
/// Minimum number and fraction of matches that stand still for a pair to count.
const MATCHES: usize = 12;
const FRACTION: f64 = 0.08;
/// Minimum fraction of the pairs for a fault of the capture.
const PAIRS: f64 = 0.1;

/// Minimum fraction of the features that match, and maximum median shift relative to the long side, for photographs taken twice from one
/// place.
const SAME_FEATURES: f64 = 0.4;
const SAME_SHIFT: f64 = 0.001;
/// Minimum number of photographs, and minimum fraction of all, in a chain of pairs from the same place for it to be a background that
/// stands still, with more features than the object that turns in front of it, rather than photographs taken twice.
const CHAIN: usize = 6;
const CHAIN_FRACTION: f64 = 0.2;

/// Evidence that a part of the photographs stands still.
#[derive(Clone, Debug, PartialEq)]
pub struct StandsStill {
    /// The photographs of each pair that shows it.
    pub pairs: Vec<[u32; 2]>,
    /// Number of pairs that were compared.
    pub compared: usize,
    /// Median fraction of the matches of these pairs that stand still.
    pub fraction: f64,
}

impl StandsStill {
    /// Groups of the `photos` photographs in which the same part stands still, largest first; photographs without such a part are left out.
    pub fn groups(&self, photos: usize) -> Vec<Vec<usize>> {
        let mut parts = parts(photos, &self.pairs);
        parts.retain(|part| part.len() > 1);
        parts
    }
}

/// Whether a part of the photographs stands still while the rest follows a motion with which it does not agree, or while nothing that
/// moves is matched.
pub fn stands_still(photos: &[PhotoInfo], features: &[Features], pairs: &[PairMatches]) -> Option<StandsStill> {
    beside_what_moves(photos, features, pairs).or_else(|| alone(photos, features, pairs))
}

fn beside_what_moves(photos: &[PhotoInfo], features: &[Features], pairs: &[PairMatches]) -> Option<StandsStill> {
    let (compared, fractions): (Vec<&PairMatches>, Vec<Option<f64>>) = pairs
        .par_iter()
        .filter(|pair| pair.matches.len() >= 3 * MATCHES)
        .filter_map(|pair| Some((pair, fraction(photos, features, pair)?)))
        .unzip();
    let found = showing(&compared, &fractions);
    (found.len() >= 3 && found.len() as f64 >= PAIRS * compared.len() as f64).then(|| StandsStill {
        pairs: found,
        compared: compared.len(),
        fraction: median(fractions.into_iter().flatten().collect()).unwrap_or(0.0),
    })
}

/// The fraction of a pair's matches that stand still, `Some(None)` if they are few or agree with the motion of the others; `None` if the
/// others are too few or inconsistent, as for opposite sides of a turntable.
fn fraction(photos: &[PhotoInfo], features: &[Features], pair: &PairMatches) -> Option<Option<f64>> {
    let places = centered_points(photos, features, pair);
    let (still, others): (Vec<_>, Vec<_>) = places.into_iter().partition(stays);
    let part = still.len() as f64 / pair.matches.len() as f64;
    let moving: Vec<[DVec2; 2]> = others.into_iter().filter(|p| shift(p) > MOVES).collect();
    if moving.len() < 2 * MATCHES {
        return None;
    }
    if still.len() < MATCHES || part < FRACTION {
        return Some(None);
    }
    let points = Correspondences::new(moving);
    let problem = Fundamental {
        points: &points,
        threshold: AGREES,
    };
    let found = estimate(&problem, Vec::new(), limits(pair, 300))?;
    if found.inliers <= points.points.len() / 3 || found.inliers < 15 {
        return None;
    }
    let off = |p: &&[DVec2; 2]| sampson_squared(&found.model, **p) > AGREES * AGREES;
    // Matches far away or straight ahead stand still but agree with the motion.
    let disagree = 2 * still.iter().filter(off).count() > still.len();
    Some(disagree.then_some(part))
}

/// Pairs that show the same part of the scene from the same place.
pub fn same_place(photos: &[PhotoInfo], features: &[Features], pairs: &[PairMatches]) -> Vec<[u32; 2]> {
    let same = |pair: &&PairMatches| {
        let [a, b] = pair.photos.map(|p| features[p as usize].keypoints.len());
        let enough = (SAME_FEATURES * a.min(b) as f64).max(20.0);
        if (pair.matches.len() as f64) < enough {
            return false;
        }
        let shifts = centered_points(photos, features, pair).iter().map(shift).collect();
        median(shifts).is_some_and(|shift| shift < SAME_SHIFT)
    };
    pairs.iter().filter(same).map(|pair| pair.photos).collect()
}

/// The longest chain of pairs from the same place, if it is long enough for a background that stands still.
fn alone(photos: &[PhotoInfo], features: &[Features], pairs: &[PairMatches]) -> Option<StandsStill> {
    let mut same = same_place(photos, features, pairs);
    let longest = parts(photos.len(), &same).into_iter().next()?;
    same.retain(|pair| longest.contains(&(pair[0] as usize)));
    (longest.len() >= CHAIN && longest.len() as f64 >= CHAIN_FRACTION * photos.len() as f64).then_some(StandsStill {
        pairs: same,
        compared: pairs.len(),
        fraction: 1.0,
    })
}

/// The connected components of photographs under `pairs`, largest first.
fn parts(photos: usize, pairs: &[[u32; 2]]) -> Vec<Vec<usize>> {
    let mut partners = vec![Vec::new(); photos];
    for [a, b] in pairs {
        partners[*a as usize].push(*b as usize);
        partners[*b as usize].push(*a as usize);
    }
    connected(photos, |photo| partners[photo].iter().copied())
}

/// `pairs` without the matches that stand still, if a part of the photographs does.
pub(super) fn without<'a>(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &'a [PairMatches],
) -> Cow<'a, [PairMatches]> {
    match stands_still(photos, features, pairs) {
        Some(_) => moving(photos, features, pairs).into(),
        None => pairs.into(),
    }
}

/// `pairs` without the matches that stand still.
pub fn moving(photos: &[PhotoInfo], features: &[Features], pairs: &[PairMatches]) -> Vec<PairMatches> {
    let moving = |pair: &PairMatches| {
        let places = centered_points(photos, features, pair);
        let matches = pair.matches.iter().zip(&places).filter(|of| !stays(of.1));
        PairMatches {
            photos: pair.photos,
            matches: matches.map(|of| *of.0).collect(),
        }
    };
    pairs.iter().map(moving).collect()
}

/// The photographs of each pair that has a value.
pub(crate) fn showing<T>(pairs: &[&PairMatches], values: &[Option<T>]) -> Vec<[u32; 2]> {
    let both = pairs.iter().zip(values);
    both.filter(|b| b.1.is_some()).map(|b| b.0.photos).collect()
}

/// Sampling limits for the estimation of a pair's motion.
pub(crate) fn limits(pair: &PairMatches, samples: usize) -> Limits {
    Limits {
        samples,
        confidence: 0.999,
        seed: seed_of(pair),
    }
}

fn shift(places: &[DVec2; 2]) -> f64 {
    places[0].distance(places[1])
}

fn stays(places: &[DVec2; 2]) -> bool {
    shift(places) < STILL
}
