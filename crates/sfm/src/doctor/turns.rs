//! Rotations of all photographs from those of their pairs.
//!
//! Symbols: `R_i` is the rotation from the world to camera `i`; a pair says `R_j = R_ij R_i`.

use crate::map::{PairKind, VerifiedPair};
use glam::{DQuat, DVec4};
use std::collections::BTreeMap;

/// Number of matches beyond which the weight of a pair stays constant.
const FULL_WEIGHT: usize = 150;
/// Maximum angle of a loop of three pairs that agree, radians: the error of two-view rotations with a guessed focal length
/// (Zach, Klopschitz and Pollefeys, "Disambiguating visual relations using loop constraints", 2010, allow 2 to 5 degrees per pair).
const CLOSED: f64 = 0.17;
/// Successive scales of the robust weight, radians.
const SCALES: [f64; 4] = [0.5, 0.25, 0.12, 0.08];
/// Sweeps over all photographs for each scale.
const SWEEPS: usize = 40;
/// Weight of a pair that shows a plane: two rotations fit it.
const PLANAR: f64 = 0.2;

/// Rotations of all photographs, estimated from pairs alone.
#[derive(Clone, Debug, PartialEq)]
pub struct Turns {
    /// `[photos]` rotation from the camera to the world of its part; `None` without a pair.
    pub world_from_camera: Vec<Option<DQuat>>,
    /// `[photos]` the number of the connected part that each photograph is in.
    pub part: Vec<usize>,
    /// `[pairs]` angle between the rotation of each pair and the one that these rotations predict, radians.
    pub disagreement: Vec<f64>,
}

/// The rotations that agree best with those of `pairs`, where `rotations` holds the rotation from the first camera to the second of
/// each pair: first along the spanning tree of the best pairs, then as robust means (Hartley et al., "Rotation averaging", 2013, with
/// Geman and McClure's weight).
pub fn turns(photos: usize, pairs: &[VerifiedPair], rotations: &[DQuat]) -> Turns {
    let said = rotations;
    let closed = closed_loops(photos, pairs, said);
    let weight = |i: usize| {
        let matches = pairs[i].matches.len().min(FULL_WEIGHT) as f64;
        matches * (0.1 + closed[i]) * if pairs[i].kind == PairKind::Planar { PLANAR } else { 1.0 }
    };
    let weights: Vec<f64> = (0..pairs.len()).map(weight).collect();
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    // Beyond the full weight, a branch with more matches is still the better one.
    let branch = |i: usize| weights[i] * (pairs[i].matches.len() as f64).sqrt();
    order.sort_by(|a, b| branch(*b).total_cmp(&branch(*a)).then(a.cmp(b)));
    let mut partners: Vec<Vec<(usize, DQuat, f64)>> = vec![Vec::new(); photos];
    for ((pair, weight), b_from_a) in pairs.iter().zip(&weights).zip(said) {
        let [a, b] = pair.photos.map(|p| p as usize);
        partners[b].push((a, *b_from_a, *weight));
        partners[a].push((b, b_from_a.inverse(), *weight));
    }
    let (mut rotations, part) = along_tree(photos, pairs, said, &order);
    for scale in SCALES {
        for _ in 0..SWEEPS {
            for photo in 0..photos {
                let Some(own) = rotations[photo] else { continue };
                let mut sum = DVec4::ZERO;
                for (other, from_other, weight) in &partners[photo] {
                    let Some(other) = rotations[*other] else { continue };
                    let said = *from_other * other;
                    let off = angle(said, own) / scale;
                    let robust = weight / (1.0 + off * off).powi(2);
                    let vector = DVec4::from_array(said.to_array());
                    sum += robust * vector * vector.dot(DVec4::from_array(own.to_array())).signum();
                }
                if let Some(mean) = sum.try_normalize() {
                    rotations[photo] = Some(DQuat::from_vec4(mean));
                }
            }
        }
    }
    let of = |pair: &VerifiedPair| pair.photos.map(|p| rotations[p as usize].unwrap_or(DQuat::IDENTITY));
    let disagreement = pairs
        .iter()
        .zip(said)
        .map(|(pair, b_from_a)| {
            let [a, b] = of(pair);
            angle(*b_from_a * a, b)
        })
        .collect();
    Turns {
        world_from_camera: rotations.into_iter().map(|r| Some(r?.inverse())).collect(),
        part,
        disagreement,
    }
}

fn angle(a: DQuat, b: DQuat) -> f64 {
    2.0 * a.dot(b).abs().min(1.0).acos()
}

/// `[pairs]` the weighted fraction, in \[0, 1\], of the loops of three pairs through each pair that close; 0.5 without any loop.
fn closed_loops(photos: usize, pairs: &[VerifiedPair], said: &[DQuat]) -> Vec<f64> {
    let mut of: Vec<BTreeMap<usize, usize>> = vec![BTreeMap::new(); photos];
    for (i, pair) in pairs.iter().enumerate() {
        let [a, b] = pair.photos.map(|p| p as usize);
        of[a].insert(b, i);
    }
    let mut counts = vec![[0.0f64; 2]; pairs.len()];
    for (a, partners) in of.iter().enumerate() {
        for (b, ab) in partners {
            for (c, bc) in &of[*b] {
                let Some(ac) = of[a].get(c) else { continue };
                let closes = angle(said[*bc] * said[*ab], said[*ac]) < CLOSED;
                for (pair, others) in [(*ab, [*bc, *ac]), (*bc, [*ab, *ac]), (*ac, [*ab, *bc])] {
                    let weight = others.map(|o| pairs[o].matches.len()).into_iter().min().unwrap_or(0) as f64;
                    counts[pair][0] += if closes { weight } else { 0.0 };
                    counts[pair][1] += weight;
                }
            }
        }
    }
    counts
        .iter()
        .map(|[closed, all]| if *all > 0.0 { closed / all } else { 0.5 })
        .collect()
}

/// Rotations along the spanning tree of the first pairs of `order` that join two parts, and each photograph's part.
fn along_tree(
    photos: usize,
    pairs: &[VerifiedPair],
    said: &[DQuat],
    order: &[usize],
) -> (Vec<Option<DQuat>>, Vec<usize>) {
    let mut rotations: Vec<Option<DQuat>> = vec![None; photos];
    let mut part: Vec<usize> = (0..photos).collect();
    for (pair, b_from_a) in order.iter().map(|i| (&pairs[*i], said[*i])) {
        let [a, b] = pair.photos.map(|p| p as usize);
        if part[a] == part[b] {
            continue;
        }
        let (of_a, of_b) = (rotations[a].unwrap_or_default(), rotations[b].unwrap_or_default());
        (rotations[a], rotations[b]) = (Some(of_a), Some(of_b));
        // The part of b turns into the world of a: R_b' = R_ab R_a.
        let turn = of_b.inverse() * b_from_a * of_a;
        let (from, to) = (part[b], part[a]);
        for photo in (0..photos).filter(|p| part[*p] == from) {
            rotations[photo] = rotations[photo].map(|r| (r * turn).normalize());
        }
        part.iter_mut().filter(|p| **p == from).for_each(|p| *p = to);
    }
    (rotations, part)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::essential::Motion;
    use glam::DVec3;

    fn pair(a: usize, b: usize, rotation: DQuat, matches: usize) -> VerifiedPair {
        VerifiedPair {
            photos: [a as u32, b as u32],
            matches: vec![[0, 0]; matches],
            kind: PairKind::General,
            motion: Motion {
                rotation,
                translation: DVec3::X,
            },
            angle: 0.1,
        }
    }

    fn said(pairs: &[VerifiedPair]) -> Vec<DQuat> {
        pairs.iter().map(|pair| pair.motion.rotation).collect()
    }

    /// A ring of `n` cameras, each paired with the next `reach` cameras.
    fn ring(n: usize, reach: usize) -> (Vec<DQuat>, Vec<VerifiedPair>) {
        let camera = |i: usize| {
            DQuat::from_rotation_y(std::f64::consts::TAU * i as f64 / n as f64) * DQuat::from_rotation_x(0.3)
        };
        let cameras: Vec<DQuat> = (0..n).map(camera).collect();
        let mut pairs = Vec::new();
        for i in 0..n {
            for step in 1..=reach {
                let (a, b) = (i.min((i + step) % n), i.max((i + step) % n));
                let noise = DQuat::from_rotation_z(0.01 * ((i * 7 + step) % 5) as f64 - 0.02);
                pairs.push(pair(a, b, noise * cameras[b].inverse() * cameras[a], 100 / step));
            }
        }
        (cameras, pairs)
    }

    #[test]
    fn rotations_return_and_pairs_that_agree_do_not_contradict() {
        let (cameras, pairs) = ring(24, 3);
        let found = turns(24, &pairs, &said(&pairs));
        let first = found.world_from_camera[0].unwrap();
        for (found, truth) in found.world_from_camera.iter().zip(&cameras) {
            let relative = first.inverse() * found.unwrap();
            assert!(angle(relative, cameras[0].inverse() * *truth) < 0.04);
        }
        assert!(found.disagreement.iter().all(|off| *off < 0.1));
        assert!(found.part.iter().all(|part| *part == found.part[0]));
    }

    #[test]
    fn opposite_sides_that_look_alike_contradict_the_ring() {
        let (cameras, mut pairs) = ring(24, 3);
        let genuine = pairs.len();
        for i in 0..12 {
            for j in [i + 11, i + 12] {
                // The far side is mistaken for the near one.
                let twin = cameras[(j + 12) % 24];
                pairs.push(pair(i, j, twin.inverse() * cameras[i], 60));
            }
        }
        let found = turns(24, &pairs, &said(&pairs));
        for (i, off) in found.disagreement.iter().enumerate() {
            assert_eq!(*off > 1.0, i >= genuine, "{i} {off}");
        }
    }

    #[test]
    fn photographs_without_pairs_have_no_rotation() {
        let pairs = [pair(0, 2, DQuat::from_rotation_y(0.2), 30)];
        let found = turns(3, &pairs, &said(&pairs));
        assert!(found.world_from_camera[1].is_none() && found.world_from_camera[2].is_some());
        assert_eq!(turns(0, &[], &[]).part, []);
    }
}
