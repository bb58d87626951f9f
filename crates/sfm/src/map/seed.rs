//! Selection of the pairs from which models start.

use super::closed_loop_fractions;
use super::types::{PairKind, VerifiedPair};
use glam::DQuat;

/// Requirements of a seed, strictest first: minimum number of inliers, minimum median angle in degrees, maximum forward component of
/// the unit translation.
const SEED_CRITERIA: [(usize, f64, f64); 5] = [
    (100, 16.0, 0.95),
    (100, 8.0, 0.95),
    (60, 4.0, 0.97),
    (30, 2.0, 1.01),
    (15, 1.5, 1.01),
];

/// A pair of which fewer loops with other pairs close has a wrong motion, and is a seed only if no others are left. In a film by a drone
/// above a town, the only pair that met the strictest requirements closed 6 % of its loops; the model from it contradicted most pairs.
const MIN_CLOSED_FRACTION: f64 = 0.5;

/// Indices of at most `count` pairs to start from, the most promising first; photographs already `assigned` are avoided.
///
/// In each round, pairs are ordered by their number of inliers times their angle, up to twice the required one.
pub(super) fn seeds(pairs: &[VerifiedPair], assigned: &[bool], count: usize) -> Vec<usize> {
    let rotations: Vec<DQuat> = pairs.iter().map(|pair| pair.motion.rotation).collect();
    let closed = closed_loop_fractions(assigned.len(), pairs, &rotations);
    let mut seeds: Vec<usize> = Vec::new();
    let rounds = [true, false]
        .into_iter()
        .flat_map(|closes| SEED_CRITERIA.map(|criteria| (closes, criteria)));
    for (closes, (min_inliers, min_degrees, max_forward)) in rounds {
        let min_angle = f64::to_radians(min_degrees);
        let mut round: Vec<(f64, usize)> = pairs
            .iter()
            .enumerate()
            .filter(|(i, pair)| {
                pair.kind != PairKind::Rotation
                    && (closed[*i] >= MIN_CLOSED_FRACTION) == closes
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::essential::Motion;
    use glam::DVec3;

    #[test]
    fn a_pair_whose_loops_do_not_close_is_the_last_seed() {
        let turn = |i: u32| DQuat::from_rotation_y(0.2 * f64::from(i));
        let mut pairs = Vec::new();
        for a in 0..6 {
            for b in a + 1..6 {
                pairs.push(VerifiedPair {
                    photos: [a, b],
                    matches: vec![[0, 0]; 100 + b as usize],
                    kind: PairKind::General,
                    motion: Motion {
                        rotation: turn(b).inverse() * turn(a),
                        translation: DVec3::X,
                    },
                    angle: 0.1 * f64::from(b - a),
                });
            }
        }
        let best = |pairs: &[VerifiedPair]| pairs[seeds(pairs, &[false; 6], 15)[0]].photos;
        assert_eq!(best(&pairs), [0, 5]);
        let widest = pairs.iter_mut().find(|pair| pair.photos == [0, 5]).unwrap();
        widest.motion.rotation = DQuat::from_rotation_x(1.0);
        assert_ne!(best(&pairs), [0, 5]);
        let all = seeds(&pairs, &[false; 6], 15);
        assert_eq!(pairs[*all.last().unwrap()].photos, [0, 5], "it remains a seed");
    }
}
