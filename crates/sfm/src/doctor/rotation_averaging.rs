//! Rotations of all photographs from those of their pairs.
//!
//! Symbols: `R_i` is the rotation from the world to camera `i`; a pair says `R_j = R_ij R_i`.

use crate::map::{PairKind, VerifiedPair, closed_loop_fractions};
use glam::{DQuat, DVec4};

/// Number of matches beyond which the weight of a pair stays constant.
const MAX_WEIGHTED_MATCHES: usize = 150;
/// Successive scales of the robust weight, radians.
const LOSS_SCALES_RADIANS: [f64; 4] = [0.5, 0.25, 0.12, 0.08];
/// Sweeps over all photographs for each scale.
const SWEEPS_PER_SCALE: usize = 40;
/// Weight of a pair that shows a plane: two rotations fit it.
const PLANAR_PAIR_WEIGHT: f64 = 0.2;

/// Rotations of all photographs, estimated from pairs alone.
#[derive(Clone, Debug, PartialEq)]
pub struct GlobalRotations {
    /// `[photos]` rotation from the camera to the world of its part; `None` without a pair.
    pub world_from_camera: Vec<Option<DQuat>>,
    /// `[photos]` the number of the connected part that each photograph is in.
    pub component: Vec<usize>,
    /// `[pairs]` angle between the rotation of each pair and the one that these rotations predict, radians.
    pub disagreement: Vec<f64>,
}

/// The rotations that agree best with those of `pairs`, where `measured` holds the rotation from the first camera to the second of
/// each pair: first along the spanning tree of the best pairs, then as robust means (Hartley et al., "Rotation averaging", 2013, with
/// Geman and McClure's weight).
pub fn average_rotations(photos: usize, pairs: &[VerifiedPair], measured: &[DQuat]) -> GlobalRotations {
    let closed_fractions = closed_loop_fractions(photos, pairs, measured);
    let weight = |i: usize| {
        let matches = pairs[i].matches.len().min(MAX_WEIGHTED_MATCHES) as f64;
        matches
            * (0.1 + closed_fractions[i])
            * if pairs[i].kind == PairKind::Planar {
                PLANAR_PAIR_WEIGHT
            } else {
                1.0
            }
    };
    let weights: Vec<f64> = (0..pairs.len()).map(weight).collect();
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    // Beyond the full weight, a branch with more matches is still the better one.
    let branch_weight = |i: usize| weights[i] * (pairs[i].matches.len() as f64).sqrt();
    order.sort_by(|a, b| branch_weight(*b).total_cmp(&branch_weight(*a)).then(a.cmp(b)));
    let mut partners: Vec<Vec<(usize, DQuat, f64)>> = vec![Vec::new(); photos];
    for ((pair, weight), b_from_a) in pairs.iter().zip(&weights).zip(measured) {
        let [a, b] = pair.photos.map(|p| p as usize);
        partners[b].push((a, *b_from_a, *weight));
        partners[a].push((b, b_from_a.inverse(), *weight));
    }
    let (mut rotations, component) = spanning_tree_rotations(photos, pairs, measured, &order);
    for scale in LOSS_SCALES_RADIANS {
        for _ in 0..SWEEPS_PER_SCALE {
            for photo in 0..photos {
                let Some(own) = rotations[photo] else { continue };
                let mut sum = DVec4::ZERO;
                for (other, from_other, weight) in &partners[photo] {
                    let Some(other) = rotations[*other] else { continue };
                    let predicted = *from_other * other;
                    let error = predicted.angle_between(own) / scale;
                    let robust = weight / (1.0 + error * error).powi(2);
                    let vector = DVec4::from_array(predicted.to_array());
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
        .zip(measured)
        .map(|(pair, b_from_a)| {
            let [a, b] = of(pair);
            (*b_from_a * a).angle_between(b)
        })
        .collect();
    GlobalRotations {
        world_from_camera: rotations.into_iter().map(|r| Some(r?.inverse())).collect(),
        component,
        disagreement,
    }
}

/// Rotations along the spanning tree of the first pairs of `order` that join two parts, and each photograph's part.
fn spanning_tree_rotations(
    photos: usize,
    pairs: &[VerifiedPair],
    measured: &[DQuat],
    order: &[usize],
) -> (Vec<Option<DQuat>>, Vec<usize>) {
    let mut rotations: Vec<Option<DQuat>> = vec![None; photos];
    let mut component: Vec<usize> = (0..photos).collect();
    for (pair, b_from_a) in order.iter().map(|i| (&pairs[*i], measured[*i])) {
        let [a, b] = pair.photos.map(|p| p as usize);
        if component[a] == component[b] {
            continue;
        }
        let (of_a, of_b) = (rotations[a].unwrap_or_default(), rotations[b].unwrap_or_default());
        (rotations[a], rotations[b]) = (Some(of_a), Some(of_b));
        // The part of b turns into the world of a: R_b' = R_ab R_a.
        let change = of_b.inverse() * b_from_a * of_a;
        let (from, to) = (component[b], component[a]);
        for photo in (0..photos).filter(|p| component[*p] == from) {
            rotations[photo] = rotations[photo].map(|r| (r * change).normalize());
        }
        component.iter_mut().filter(|p| **p == from).for_each(|p| *p = to);
    }
    (rotations, component)
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

    fn measured(pairs: &[VerifiedPair]) -> Vec<DQuat> {
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
        let found = average_rotations(24, &pairs, &measured(&pairs));
        let first = found.world_from_camera[0].unwrap();
        for (found, truth) in found.world_from_camera.iter().zip(&cameras) {
            let relative = first.inverse() * found.unwrap();
            assert!(relative.angle_between(cameras[0].inverse() * *truth) < 0.04);
        }
        assert!(found.disagreement.iter().all(|off| *off < 0.1));
        assert!(found.component.iter().all(|component| *component == found.component[0]));
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
        let found = average_rotations(24, &pairs, &measured(&pairs));
        for (i, off) in found.disagreement.iter().enumerate() {
            assert_eq!(*off > 1.0, i >= genuine, "{i} {off}");
        }
    }

    #[test]
    fn photographs_without_pairs_have_no_rotation() {
        let pairs = [pair(0, 2, DQuat::from_rotation_y(0.2), 30)];
        let found = average_rotations(3, &pairs, &measured(&pairs));
        assert!(found.world_from_camera[1].is_none() && found.world_from_camera[2].is_some());
        assert_eq!(average_rotations(0, &[], &[]).component, []);
    }
}
