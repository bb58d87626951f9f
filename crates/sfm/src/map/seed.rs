//! Selection of the pairs from which models start.

use super::types::{PairKind, VerifiedPair};

/// Requirements of a seed, strictest first: minimum number of inliers, minimum median angle in degrees, maximum forward component of
/// the unit translation.
const ROUNDS: [(usize, f64, f64); 5] = [
    (100, 16.0, 0.95),
    (100, 8.0, 0.95),
    (60, 4.0, 0.97),
    (30, 2.0, 1.01),
    (15, 1.5, 1.01),
];

/// Indices of at most `count` pairs to start from, the most promising first; photographs already `taken` are avoided.
///
/// In each round, pairs are ordered by their number of inliers times their angle, up to twice the required one.
pub(super) fn seeds(pairs: &[VerifiedPair], taken: &[bool], count: usize) -> Vec<usize> {
    let mut seeds: Vec<usize> = Vec::new();
    for (inliers, degrees, forward) in ROUNDS {
        let least = f64::to_radians(degrees);
        let mut round: Vec<(f64, usize)> = pairs
            .iter()
            .enumerate()
            .filter(|(i, pair)| {
                pair.kind != PairKind::Rotation
                    && pair.matches.len() >= inliers
                    && pair.angle >= least
                    && pair.motion.translation.z.abs() < forward
                    && pair.photos.iter().all(|p| !taken[*p as usize])
                    && !seeds.contains(i)
            })
            .map(|(i, pair)| {
                // Several motions fit a plane, some of them wrong: general pairs first.
                let trust = if pair.kind == PairKind::Planar { 0.3 } else { 1.0 };
                (trust * pair.matches.len() as f64 * (pair.angle / least).min(2.0), i)
            })
            .collect();
        round.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        // Pairs that share a photograph tend to fail together: one seed per photograph and round.
        let mut seen = vec![false; taken.len()];
        for (_, i) in round {
            let photos = pairs[i].photos.map(|p| p as usize);
            if photos.iter().any(|p| seen[*p]) {
                continue;
            }
            photos.iter().for_each(|p| seen[*p] = true);
            seeds.push(i);
            if seeds.len() == count {
                return seeds;
            }
        }
    }
    seeds
}
