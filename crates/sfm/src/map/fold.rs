//! Folds that only weak pairs reveal: a group of photographs that agree with one another, but not with the rest.

use super::agreement::{agrees, contradicts, evidence_pairs, join};
use super::loops::MAX_LOOP_ERROR_RADIANS;
use super::types::VerifiedPair;
use crate::geometry::pose::DPose;
use glam::DQuat;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// Minimum number of photographs of each group in pairs that turn it alike: a single photograph is wrong by itself, and a few weak pairs
/// may be of parts of the scene that look alike.
const MIN_FOLDED_PHOTOS: usize = 3;

/// Indices of the pairs, strong or weak, across folds; `strengths` and `agreement` are `[pairs]`. If pairs between two groups of
/// photographs say that one is turned relative to the other, all by the same rotation, the model is folded, no matter how few matches a
/// pair has, since nothing else connects the two; wrong matches say different rotations.
pub fn folded_pairs(
    poses: &[Option<DPose>],
    pairs: &[VerifiedPair],
    strengths: &[f64],
    agreement: &[Option<f64>],
) -> Vec<usize> {
    let group = groups(poses.len(), pairs, strengths, agreement);
    let mut between: BTreeMap<[usize; 2], Vec<(usize, DQuat)>> = BTreeMap::new();
    for (i, pair) in pairs.iter().enumerate().filter(|(i, _)| contradicts(agreement[*i])) {
        let [Some(a), Some(b)] = pair.photos.map(|photo| poses[photo as usize]) else {
            continue;
        };
        let turn = b.rotation * pair.motion.rotation * a.rotation.inverse();
        let is_turned = turn.angle_between(DQuat::IDENTITY) >= MAX_LOOP_ERROR_RADIANS;
        let [of_a, of_b] = pair.photos.map(|photo| group[photo as usize]);
        if is_turned && of_a < of_b {
            between.entry([of_a, of_b]).or_default().push((i, turn));
        } else if is_turned && of_a > of_b {
            between.entry([of_b, of_a]).or_default().push((i, turn.inverse()));
        }
    }
    let mut folded = Vec::new();
    for (ends, turns) in &between {
        let alike = turned_alike(turns);
        let photos: BTreeSet<u32> = alike.iter().flat_map(|i| pairs[*i].photos).collect();
        let is_folded = |of: &usize| photos.iter().filter(|p| group[**p as usize] == *of).count() >= MIN_FOLDED_PHOTOS;
        if ends.iter().all(is_folded) {
            folded.extend(alike);
        }
    }
    folded.sort_unstable();
    folded
}

/// `[photos]` the number of each photograph's group. Photographs are one group if neighbours agree, and groups are joined while more of
/// the pairs between them agree with the model than contradict it.
fn groups(photos: usize, pairs: &[VerifiedPair], strengths: &[f64], agreement: &[Option<f64>]) -> Vec<usize> {
    let mut group: Vec<usize> = (0..photos).collect();
    let ends = |group: &[usize], i: usize| {
        let [a, b] = pairs[i].photos.map(|photo| group[photo as usize]);
        [a.min(b), a.max(b)]
    };
    for i in evidence_pairs(pairs, strengths).filter(|i| agrees(agreement[*i])) {
        let joined = ends(&group, i);
        join(&mut group, joined);
    }
    loop {
        let mut balance: BTreeMap<[usize; 2], i64> = BTreeMap::new();
        for (i, fraction) in agreement.iter().enumerate() {
            *balance.entry(ends(&group, i)).or_default() +=
                i64::from(agrees(*fraction)) - i64::from(contradicts(*fraction));
        }
        let apart = balance.into_iter().filter(|([a, b], balance)| a != b && *balance > 0);
        let Some((joined, _)) = apart.max_by_key(|(ends, balance)| (*balance, Reverse(*ends))) else {
            return group;
        };
        join(&mut group, joined);
    }
}

/// The largest set of pairs, given with the rotation that each says, that say one rotation.
fn turned_alike(turns: &[(usize, DQuat)]) -> Vec<usize> {
    let alike = |(_, of): &(usize, DQuat)| -> Vec<usize> {
        let alike = turns
            .iter()
            .filter(|(_, turn)| of.angle_between(*turn) < MAX_LOOP_ERROR_RADIANS);
        alike.map(|(i, _)| *i).collect()
    };
    let mut best = Vec::new();
    for of in turns.iter().map(alike) {
        if of.len() > best.len() {
            best = of;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::super::types::PairKind;
    use super::*;
    use crate::geometry::essential::Motion;
    use glam::{DQuat, DVec3};

    /// The folded pairs among photographs in two rows, 0, 1, 2 and 3, 4, 5, of which the second is turned by `turn`, radians, beyond its
    /// poses; neighbours agree. `across` are weak pairs, their agreement, and the error of their rotation, radians.
    fn folded(turn: f64, across: &[([u32; 2], f64, f64)]) -> Vec<[u32; 2]> {
        let rotation = |photo: u32| DQuat::from_rotation_y(0.2 * f64::from(photo));
        let pose = |photo: u32| DPose::from_camera_from_world(rotation(photo), DVec3::X);
        let poses: Vec<Option<DPose>> = (0..6).map(|photo| Some(pose(photo))).collect();
        let true_rotation = |photo: u32| rotation(photo) * DQuat::from_rotation_x(if photo < 3 { 0.0 } else { turn });
        let pair = |photos: [u32; 2], matches: u32, error: f64| VerifiedPair {
            photos,
            matches: (0..matches).map(|i| [i, i]).collect(),
            kind: PairKind::General,
            motion: Motion {
                rotation: true_rotation(photos[1]) * true_rotation(photos[0]).inverse() * DQuat::from_rotation_z(error),
                translation: DVec3::X,
            },
            angle: 0.1,
        };
        let neighbours = [[0, 1], [1, 2], [3, 4], [4, 5]].map(|photos| (pair(photos, 50, 0.0), 1.0, Some(1.0)));
        let weak = across
            .iter()
            .map(|(photos, agreement, error)| (pair(*photos, 16, *error), 0.5, Some(*agreement)));
        let mut pairs = Vec::new();
        let (mut strengths, mut agreement) = (Vec::new(), Vec::new());
        for (pair, strength, agrees) in neighbours.into_iter().chain(weak) {
            pairs.push(pair);
            strengths.push(strength);
            agreement.push(agrees);
        }
        let found = folded_pairs(&poses, &pairs, &strengths, &agreement);
        found.into_iter().map(|i| pairs[i].photos).collect()
    }

    const ACROSS: [([u32; 2], f64, f64); 4] = [
        ([0, 3], 0.0, 0.0),
        ([0, 4], 0.1, 0.05),
        ([1, 4], 0.0, -0.05),
        ([2, 5], 0.2, 0.0),
    ];

    #[test]
    fn a_group_that_is_turned_relative_to_the_rest_is_a_fold() {
        let all: Vec<[u32; 2]> = ACROSS.iter().map(|pair| pair.0).collect();
        assert_eq!(folded(2.0, &ACROSS), all);
        // Neither a pair that agrees by chance nor a wrong one changes that.
        let by_chance = [ACROSS.as_slice(), &[([1, 5], 0.8, 2.0), ([1, 3], 0.0, 0.7)]].concat();
        assert_eq!(folded(2.0, &by_chance), all);
    }

    #[test]
    fn wrong_matches_are_no_fold() {
        let scattered = ACROSS.map(|(photos, agreement, _)| (photos, agreement, f64::from(photos[0] + photos[1])));
        assert_eq!(folded(0.0, &scattered), [[0; 2]; 0]);
        assert_eq!(
            folded(0.05, &ACROSS),
            [[0; 2]; 0],
            "not turned: parts that look alike side by side"
        );
        let connected = [
            ([2, 3], 1.0, 0.0),
            ([2, 4], 0.9, 0.0),
            ([1, 3], 0.9, 0.0),
            ([1, 5], 0.8, 0.0),
            ([0, 5], 1.0, 0.0),
        ];
        assert_eq!(folded(2.0, &[ACROSS.as_slice(), &connected].concat()), [[0; 2]; 0]);
        assert_eq!(folded(2.0, &ACROSS[..3]), [[0; 2]; 0], "two photographs of each side");
    }
}
