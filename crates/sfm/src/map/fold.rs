//! Folds that only weak pairs reveal: a group of photographs that agree with one another, but not with the rest.

use super::agreement::{MIN_CONSISTENT_FRACTION, evidence_pairs};
use super::types::VerifiedPair;
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// A pair agrees with the model if more than this fraction of its matches do.
const MIN_AGREEING_FRACTION: f64 = 0.5;
/// Minimum number of pairs between two groups that contradict the model: fewer may be of parts of the scene that look alike.
const MIN_FOLDED_PAIRS: usize = 3;
/// Minimum number of photographs of a group: a single one is wrong by itself.
const MIN_GROUP: usize = 2;

/// Indices of the pairs, strong or weak, across folds. Photographs are one group if neighbours agree, and groups are joined while more of
/// the pairs between them agree with the model than contradict it; `strengths` and `agreement` are `[pairs]`. What contradicts the model
/// between the groups that remain is across a fold, no matter how few matches a pair has: nothing else connects the groups.
pub fn folded_pairs(photos: usize, pairs: &[VerifiedPair], strengths: &[f64], agreement: &[Option<f64>]) -> Vec<usize> {
    let agrees = |i: usize| agreement[i].is_some_and(|fraction| fraction > MIN_AGREEING_FRACTION);
    let contradicts = |i: usize| agreement[i].is_some_and(|fraction| fraction < MIN_CONSISTENT_FRACTION);
    let mut group: Vec<usize> = (0..photos).collect();
    let ends = |group: &[usize], i: usize| {
        let [a, b] = pairs[i].photos.map(|photo| group[photo as usize]);
        [a.min(b), a.max(b)]
    };
    let join = |group: &mut [usize], [to, from]: [usize; 2]| {
        group.iter_mut().filter(|of| **of == from).for_each(|of| *of = to);
    };
    for i in evidence_pairs(pairs, strengths).filter(|i| agrees(*i)) {
        let joined = ends(&group, i);
        join(&mut group, joined);
    }
    loop {
        let mut balance: BTreeMap<[usize; 2], i64> = BTreeMap::new();
        for i in 0..pairs.len() {
            *balance.entry(ends(&group, i)).or_default() += i64::from(agrees(i)) - i64::from(contradicts(i));
        }
        let apart = balance.into_iter().filter(|([a, b], balance)| a != b && *balance > 0);
        let Some((joined, _)) = apart.max_by_key(|(ends, balance)| (*balance, Reverse(*ends))) else {
            break;
        };
        join(&mut group, joined);
    }
    let mut sizes = vec![0; photos];
    group.iter().for_each(|of| sizes[*of] += 1);
    let mut between: BTreeMap<[usize; 2], Vec<usize>> = BTreeMap::new();
    for i in (0..pairs.len()).filter(|i| contradicts(*i)) {
        let [a, b] = ends(&group, i);
        if a != b && sizes[a].min(sizes[b]) >= MIN_GROUP {
            between.entry([a, b]).or_default().push(i);
        }
    }
    let mut folded: Vec<usize> = between
        .into_values()
        .filter(|pairs| pairs.len() >= MIN_FOLDED_PAIRS)
        .flatten()
        .collect();
    folded.sort_unstable();
    folded
}

#[cfg(test)]
mod tests {
    use super::super::types::PairKind;
    use super::*;
    use crate::geometry::essential::Motion;
    use glam::{DQuat, DVec3};

    /// The folded pairs among photographs in two rows, 0, 1, 2 and 3, 4, .., whose neighbours agree; `across` are weak pairs and their
    /// agreement.
    fn folded(photos: u32, across: &[([u32; 2], f64)]) -> Vec<[u32; 2]> {
        let pair = |photos: [u32; 2], matches: u32| VerifiedPair {
            photos,
            matches: (0..matches).map(|i| [i, i]).collect(),
            kind: PairKind::General,
            motion: Motion {
                rotation: DQuat::IDENTITY,
                translation: DVec3::X,
            },
            angle: 0.1,
        };
        let neighbours = (1..photos)
            .filter(|i| *i != 3)
            .map(|i| (pair([i - 1, i], 50), 1.0, Some(1.0)));
        let weak = across
            .iter()
            .map(|(photos, agreement)| (pair(*photos, 16), 0.5, Some(*agreement)));
        let mut pairs = Vec::new();
        let (mut strengths, mut agreement) = (Vec::new(), Vec::new());
        for (pair, strength, agrees) in neighbours.chain(weak) {
            pairs.push(pair);
            strengths.push(strength);
            agreement.push(agrees);
        }
        let found = folded_pairs(photos as usize, &pairs, &strengths, &agreement);
        found.into_iter().map(|i| pairs[i].photos).collect()
    }

    #[test]
    fn a_group_that_contradicts_the_rest_is_a_fold() {
        let contradicting = [([0, 3], 0.0), ([0, 4], 0.1), ([1, 4], 0.0), ([2, 5], 0.2)];
        let all: Vec<[u32; 2]> = contradicting.iter().map(|pair| pair.0).collect();
        assert_eq!(folded(6, &contradicting), all);
        // A pair that agrees by chance does not connect them.
        let mut by_chance = contradicting.to_vec();
        by_chance.push(([1, 5], 0.8));
        assert_eq!(folded(6, &by_chance), all);
    }

    #[test]
    fn parts_that_look_alike_are_no_fold() {
        let look_alike = [([0, 4], 0.0), ([1, 4], 0.0), ([0, 5], 0.0)];
        let connected = [
            look_alike.as_slice(),
            &[([2, 3], 1.0), ([2, 4], 0.9), ([1, 3], 0.9), ([2, 5], 0.8)],
        ]
        .concat();
        assert_eq!(folded(6, &connected), [[0; 2]; 0]);
        assert_eq!(
            folded(6, &look_alike[..2]),
            [[0; 2]; 0],
            "two pairs may be a coincidence"
        );
        let single = [([0, 3], 0.0), ([1, 3], 0.0), ([2, 3], 0.0)];
        assert_eq!(folded(4, &single), [[0; 2]; 0], "a single photograph");
    }
}
