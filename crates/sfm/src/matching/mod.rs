//! Matching: the features of two photographs that look alike.
//!
//! Descriptors are compared exhaustively by exact integer products, so matches depend neither on the instruction set nor on
//! the number of threads.

mod guided;
mod pairs;

use crate::{DESCRIPTOR_BYTES, Features, PairMatches};
use irradia_compute::Level;
use irradia_compute::nearest::{Nearest, nearest};
use rayon::prelude::*;
use std::collections::HashSet;

pub use guided::match_guided;
pub use pairs::{PairOptions, candidate_pairs};

type Descriptor = [u8; DESCRIPTOR_BYTES];

/// Squared length of a RootSIFT descriptor, apart from rounding.
const SQUARED_LENGTH: u32 = 512 * 512;

/// When two features match.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MatchOptions {
    /// Maximum distance of a match relative to that of the second nearest descriptor, in both directions (Lowe 2004, 7.1). Default 0.8.
    pub ratio: f32,
    /// Maximum distance of a match between unit descriptors. Default 0.7, as in COLMAP.
    pub distance: f32,
    /// The result of [`Level::detect`]; tests choose others.
    pub level: Level,
}

impl Default for MatchOptions {
    fn default() -> Self {
        Self {
            ratio: 0.8,
            distance: 0.7,
            level: Level::detect(),
        }
    }
}

impl MatchOptions {
    /// Whether the nearest neighbour is near enough and nearer than all others.
    fn accepts(&self, nearest: &Nearest) -> bool {
        let [first, second] = [nearest.product, nearest.second].map(squared_distance);
        let limit = f64::from(self.distance).powi(2) * f64::from(SQUARED_LENGTH);
        let ratio2 = f64::from(self.ratio).powi(2);
        f64::from(first) <= limit && f64::from(first) < ratio2 * f64::from(second)
    }
}

/// Squared distance between two descriptors with this inner product.
fn squared_distance(product: u32) -> u32 {
    2 * SQUARED_LENGTH.saturating_sub(product)
}

/// Pairs of features, one of `a` and one of `b`, that are each other's nearest and pass the tests of `options`; sorted by the first.
/// Where both have frontal descriptors, these match the features that the usual ones leave unmatched.
pub fn match_features(a: &Features, b: &Features, options: &MatchOptions) -> Vec<[u32; 2]> {
    let matches = comparable_descriptors(a, b).map(|[a, b]| match_descriptors(a, b, options));
    matches.reduce(merge_matches).unwrap_or_default()
}

/// `[N, 128]` descriptors of two photographs that can be compared: the usual ones, then the frontal ones where both have them.
fn comparable_descriptors<'a>(a: &'a Features, b: &'a Features) -> impl Iterator<Item = [&'a [Descriptor]; 2]> {
    let usual: [&[Descriptor]; 2] = [&a.descriptors, &b.descriptors];
    let frontal: [&[Descriptor]; 2] = [&a.frontal, &b.frontal];
    let both = frontal.iter().all(|descriptors| !descriptors.is_empty());
    [usual].into_iter().chain(both.then_some(frontal))
}

/// `first`, and the pairs of `second` whose features `first` leaves unmatched; sorted by the first photograph's feature.
fn merge_matches(first: Vec<[u32; 2]>, second: Vec<[u32; 2]>) -> Vec<[u32; 2]> {
    let [of_a, of_b]: [HashSet<u32>; 2] = [0, 1].map(|side| first.iter().map(|pair| pair[side]).collect());
    let unmatched = second
        .into_iter()
        .filter(|[i, j]| !of_a.contains(i) && !of_b.contains(j));
    let mut all: Vec<[u32; 2]> = first.into_iter().chain(unmatched).collect();
    all.sort_unstable();
    all
}

fn match_descriptors(a: &[Descriptor], b: &[Descriptor], options: &MatchOptions) -> Vec<[u32; 2]> {
    let [of_a, of_b] = nearest(options.level, a, b);
    mutual_matches(&of_a, &of_b, options)
}

fn mutual_matches(of_a: &[Nearest], of_b: &[Nearest], options: &MatchOptions) -> Vec<[u32; 2]> {
    (0u32..)
        .zip(of_a)
        .filter(|(i, nearest)| {
            options.accepts(nearest)
                && of_b
                    .get(nearest.index as usize)
                    .is_some_and(|back| back.index == *i && options.accepts(back))
        })
        .map(|(i, nearest)| [i, nearest.index])
        .collect()
}

/// The matches of each of `pairs`, in their order, in parallel; `done` is called after each, from any thread.
///
/// # Panics
/// When a pair names a photograph that is not in `features`.
pub fn match_pairs(
    features: &[Features],
    pairs: &[[u32; 2]],
    options: &MatchOptions,
    done: impl Fn() + Sync,
) -> Vec<PairMatches> {
    pairs
        .par_iter()
        .map(|&photos| {
            let [a, b] = photos.map(|photo| &features[photo as usize]);
            let matches = match_features(a, b, options);
            done();
            PairMatches { photos, matches }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A descriptor as long as a RootSIFT one with most of its weight at `at`.
    fn descriptor(at: usize, rest: u8) -> [u8; DESCRIPTOR_BYTES] {
        let mut bytes = [rest; DESCRIPTOR_BYTES];
        for i in 0..4 {
            bytes[(at + i) % DESCRIPTOR_BYTES] = 250;
        }
        bytes
    }

    fn features(descriptors: Vec<[u8; DESCRIPTOR_BYTES]>) -> Features {
        Features {
            descriptors,
            ..Features::default()
        }
    }

    #[test]
    fn matches_are_mutual_and_distinct() {
        let a = features(vec![descriptor(0, 5), descriptor(40, 5), descriptor(80, 5)]);
        let b = features(vec![descriptor(80, 6), descriptor(0, 6), descriptor(120, 6)]);
        let options = MatchOptions::default();
        assert_eq!(match_features(&a, &b, &options), [[0, 1], [2, 0]]);
        // Two equal candidates are ambiguous.
        let twice = features(vec![descriptor(0, 6), descriptor(0, 6), descriptor(80, 6)]);
        assert_eq!(match_features(&a, &twice, &options), [[2, 2]]);
        assert_eq!(match_features(&a, &Features::default(), &options), [[0u32; 2]; 0]);
    }

    #[test]
    fn pairs_are_matched_in_their_order() {
        let photos = [0, 20, 0].map(|at| features(vec![descriptor(at, 5), descriptor(60, 5)]));
        let pairs = [[0, 2], [0, 1]];
        let found = match_pairs(&photos, &pairs, &MatchOptions::default(), || {});
        assert_eq!(found[0].matches, [[0, 0], [1, 1]]);
        assert_eq!(found[1].matches, [[1, 1]]);
        assert_eq!([found[0].photos, found[1].photos], pairs);
    }
}
