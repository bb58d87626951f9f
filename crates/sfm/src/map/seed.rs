//! Selection of the pairs from which models start.

use super::types::{PairKind, VerifiedPair};

/// Requirements of a seed, strictest first: minimum number of inliers, minimum median angle in degrees, maximum forward component of
/// the unit translation.
const SEED_CRITERIA: [(usize, f64, f64); 5] = [
    (100, 16.0, 0.95),
    (100, 8.0, 0.95),
    (60, 4.0, 0.97),
    (30, 2.0, 1.01),
    (15, 1.5, 1.01),
];

/// Indices of at most `count` pairs to start from, the most promising first; photographs already `assigned` are avoided.
///
/// In each round, pairs are ordered by their number of inliers times their angle, up to twice the required one.
pub(super) fn seeds(pairs: &[VerifiedPair], assigned: &[bool], count: usize) -> Vec<usize> {
    let mut seeds: Vec<usize> = Vec::new();
    for (min_inliers, min_degrees, max_forward) in SEED_CRITERIA {
        let min_angle = f64::to_radians(min_degrees);
        let mut round: Vec<(f64, usize)> = pairs
            .iter()
            .enumerate()
            .filter(|(i, pair)| {
                pair.kind != PairKind::Rotation
                    && pair.matches.len() >= min_inliers
                    && pair.angle >= min_angle
                    && pair.motion.translation.z.abs() < max_forward
                    && pair.photos.iter().all(|p| !assigned[*p as usize])
                    && !seeds.contains(i)
            })
            .map(|(i, pair)| {
                // Several motions fit a plane, some of them wrong: general pairs first.
                let weight = if pair.kind == PairKind::Planar { 0.3 } else { 1.0 };
                (
                    weight * pair.matches.len() as f64 * (pair.angle / min_angle).min(2.0),
                    i,
                )
            })
            .collect();
        round.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        // Pairs that share a photograph tend to fail together: one seed per photograph and round.
        let mut used = vec![false; assigned.len()];
        for (_, i) in round {
            let photos = pairs[i].photos.map(|p| p as usize);
            if photos.iter().any(|p| used[*p]) {
                continue;
            }
            photos.iter().for_each(|p| used[*p] = true);
            seeds.push(i);
            if seeds.len() == count {
                return seeds;
            }
        }
    }
    seeds
}
