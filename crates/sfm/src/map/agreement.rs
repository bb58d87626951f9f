//! Agreement of pairs with a model: parts of a scene that look alike may fold the model, and the pairs across the fold reveal it.

use super::types::{Model, PhotoInfo, VerifiedPair};
use crate::Features;
use crate::geometry::camera::DCamera;
use crate::geometry::essential::Motion;
use crate::geometry::homography::rotates;
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Maximum number of matches of a pair that are examined.
const MAX_EXAMINED_MATCHES: usize = 100;
/// Maximum error of a match that agrees, on the plane z = 1: about eight pixels at the usual focal length.
pub(super) const MAX_INLIER_ERROR_ON_PLANE: f64 = 0.01;
/// A pair agrees with the model if more than this fraction of its matches do, and contradicts it if less than the second does.
const MIN_AGREEING_FRACTION: f64 = 0.5;
const MIN_CONSISTENT_FRACTION: f64 = 0.3;
/// Distance between two cameras, relative to that of the cameras from the centre of the scene, up to which their pair only turns.
const MIN_BASELINE: f64 = 0.003;
/// Number of a photograph's strongest partners that are its neighbours: parts that only look alike share less than one part does.
const NEIGHBOUR_COUNT: usize = 3;
/// Number of cells along the long side of a photograph; each cell with matches counts once.
const GRID_CELLS: f32 = 16.0;
/// Minimum number of matches for neighbours to count as evidence.
const MIN_EVIDENCE_MATCHES: usize = 30;

/// `[pairs]` the fraction of the matches of each pair that agree with a model; `None` if a photograph is not in the model.
pub fn agreement(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[VerifiedPair],
    model: &Model,
) -> Vec<Option<f64>> {
    // A model may have any unit: metres, or that of poses that were known.
    let (_, radius) = model.center_and_radius();
    let inlier_fraction = |pair: &VerifiedPair| {
        let [a, b] = pair.photos.map(|p| model.poses[p as usize]);
        let (a, b) = (a?, b?);
        let [camera_a, camera_b] = pair.photos.map(|p| model.cameras[photos[p as usize].group].as_ref());
        let (camera_a, camera_b) = (camera_a?, camera_b?);
        let points = normalized_matches(pair, features, [camera_a, camera_b]);
        let rotation = b.rotation.inverse() * a.rotation;
        let baseline = b.camera_from_world(a.position);
        if baseline.length() <= MIN_BASELINE * radius {
            let turn = DMat3::from_quat(rotation);
            let is_inlier = |p: &&[DVec2; 2]| rotates(&turn, **p, MAX_INLIER_ERROR_ON_PLANE);
            return Some(points.iter().filter(is_inlier).count() as f64 / points.len().max(1) as f64);
        }
        let motion = Motion {
            rotation,
            translation: baseline.normalize(),
        };
        Some(motion.agreeing_fraction(&points, MAX_INLIER_ERROR_ON_PLANE))
    };
    pairs.par_iter().map(inlier_fraction).collect()
}

/// Whether a pair of which this fraction of the matches agrees ([`agreement`]) agrees with the model.
pub fn agrees(fraction: Option<f64>) -> bool {
    fraction.is_some_and(|fraction| fraction > MIN_AGREEING_FRACTION)
}

/// Whether such a pair contradicts the model.
pub(super) fn contradicts(fraction: Option<f64>) -> bool {
    fraction.is_some_and(|fraction| fraction < MIN_CONSISTENT_FRACTION)
}

/// Some of the matches of a pair on the planes z = 1.
pub(crate) fn normalized_matches(
    pair: &VerifiedPair,
    features: &[Features],
    cameras: [&DCamera; 2],
) -> Vec<[DVec2; 2]> {
    let step = pair.matches.len().div_ceil(MAX_EXAMINED_MATCHES).max(1);
    let normalized = |side: usize, keypoint: u32| {
        let features = &features[pair.photos[side] as usize];
        cameras[side].unproject(features.keypoints[keypoint as usize].at())
    };
    let matches = pair.matches.iter().step_by(step);
    matches
        .filter_map(|[i, j]| Some([normalized(0, *i)?, normalized(1, *j)?]))
        .collect()
}

/// `[pairs]` the strength of each pair: the area that its matches cover, relative to that of the third-best pair of whichever of its
/// photographs is less covered; 1 or more for neighbours. A label that occurs twice has many matches, but on a small area.
pub fn strengths(photos: &[PhotoInfo], features: &[Features], pairs: &[VerifiedPair]) -> Vec<f64> {
    let covered: Vec<usize> = pairs
        .par_iter()
        .map(|pair| covered_cells(photos, features, pair))
        .collect();
    let mut of_photo: Vec<Vec<usize>> = vec![Vec::new(); photos.len()];
    for (pair, covered) in pairs.iter().zip(&covered) {
        pair.photos.iter().for_each(|p| of_photo[*p as usize].push(*covered));
    }
    for of in &mut of_photo {
        of.sort_unstable_by_key(|covered| std::cmp::Reverse(*covered));
    }
    let neighbour_coverage = |photo: u32| {
        let of = &of_photo[photo as usize];
        of[NEIGHBOUR_COUNT.min(of.len()) - 1]
    };
    let reference = |pair: &VerifiedPair| {
        pair.photos
            .map(neighbour_coverage)
            .into_iter()
            .min()
            .unwrap_or(1)
            .max(1)
    };
    pairs
        .iter()
        .zip(&covered)
        .map(|(pair, covered)| *covered as f64 / reference(pair) as f64)
        .collect()
}

/// Number of cells with a match, in the photograph that has fewer of them.
fn covered_cells(photos: &[PhotoInfo], features: &[Features], pair: &VerifiedPair) -> usize {
    let of_side = |side: usize| {
        let photo = pair.photos[side] as usize;
        let cell = photos[photo].width.max(photos[photo].height) as f32 / GRID_CELLS;
        let place = |seen: &[u32; 2]| {
            let k = features[photo].keypoints[seen[side] as usize];
            ((k.x / cell) as u32, (k.y / cell) as u32)
        };
        pair.matches.iter().map(place).collect::<BTreeSet<_>>().len()
    };
    of_side(0).min(of_side(1))
}

/// Indices of the pairs of neighbours with enough matches to count as evidence.
pub fn evidence_pairs(pairs: &[VerifiedPair], strengths: &[f64]) -> impl Iterator<Item = usize> {
    (0..pairs.len()).filter(|i| pairs[*i].matches.len() >= MIN_EVIDENCE_MATCHES && strengths[*i] >= 1.0)
}

/// Indices of the neighbours whose matches contradict the model, most matches first: these pairs are across a fold.
pub fn contradictions(pairs: &[VerifiedPair], strengths: &[f64], agreement: &[Option<f64>]) -> Vec<usize> {
    let mut found: Vec<usize> = evidence_pairs(pairs, strengths)
        .filter(|i| contradicts(agreement[*i]))
        .collect();
    found.sort_by_key(|i| (std::cmp::Reverse(pairs[*i].matches.len()), *i));
    found
}

/// Indices of pairs, strongest first.
pub(super) fn strongest_first(strengths: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..strengths.len()).collect();
    order.sort_by(|a, b| strengths[*b].total_cmp(&strengths[*a]).then(a.cmp(b)));
    order
}

/// The spanning tree of the strongest pairs.
pub fn spanning_tree(photos: usize, pairs: &[VerifiedPair], strengths: &[f64]) -> Vec<usize> {
    let mut order = strongest_first(strengths);
    let mut part: Vec<usize> = (0..photos).collect();
    order.retain(|i| {
        let ends = pairs[*i].photos.map(|p| part[p as usize]);
        join(&mut part, ends);
        ends[0] != ends[1]
    });
    order
}

/// Joins two parts; `part` holds the part of each photograph.
pub(super) fn join(part: &mut [usize], [to, from]: [usize; 2]) {
    part.iter_mut()
        .filter(|part| **part == from)
        .for_each(|part| *part = to);
}

/// `[pairs]` whether the photographs of each pair are connected by at most `hops` pairs of `tree`.
pub fn near_in_tree(photos: usize, pairs: &[VerifiedPair], tree: &[usize], hops: usize) -> Vec<bool> {
    let mut near: Vec<BTreeSet<usize>> = (0..photos).map(|photo| BTreeSet::from([photo])).collect();
    for _ in 0..hops {
        let before = near.clone();
        for i in tree {
            let [a, b] = pairs[*i].photos.map(|p| p as usize);
            near[a].extend(&before[b]);
            near[b].extend(&before[a]);
        }
    }
    pairs
        .iter()
        .map(|pair| near[pair.photos[0] as usize].contains(&(pair.photos[1] as usize)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::types::{ModelPoint, PairKind};
    use super::*;
    use crate::Keypoint;
    use crate::geometry::align::Alignment;
    use crate::geometry::pose::DPose;
    use glam::{DQuat, DVec3};
    use irradia_scene::Rng;

    #[test]
    fn the_unit_of_a_model_does_not_matter() {
        let camera = DCamera::centered(1000, 1000, 1000.0);
        // Two cameras a degree apart on the unit circle around random points.
        let mut poses = [0.0f64, 1.0].map(|degrees| {
            let turn = DQuat::from_rotation_y(-degrees.to_radians());
            Some(DPose {
                rotation: turn,
                position: turn * DVec3::NEG_Z,
            })
        });
        let mut rng = Rng::new(1, 1);
        let points: Vec<DVec3> = (0..60)
            .map(|_| DVec3::from_array([0; 3].map(|_| f64::from(rng.range(-0.2, 0.2)))))
            .collect();
        let shown = |pose: &Option<DPose>| {
            let keypoint = |point: &DVec3| {
                let at = camera.pixel(pose.unwrap().camera_from_world(*point)).as_vec2();
                Keypoint {
                    x: at.x,
                    y: at.y,
                    scale: 2.0,
                    angle: 0.0,
                }
            };
            Features {
                keypoints: points.iter().map(keypoint).collect(),
                ..Features::default()
            }
        };
        let features = poses.each_ref().map(shown);
        let pair = VerifiedPair {
            photos: [0, 1],
            matches: (0..60).map(|i| [i, i]).collect(),
            kind: PairKind::General,
            motion: Motion {
                rotation: DQuat::IDENTITY,
                translation: DVec3::X,
            },
            angle: 0.0,
        };
        let photos = [0; 2].map(|_| PhotoInfo::new(String::new(), 1000, 1000));
        let agrees_at = |scale: f64, poses: &[Option<DPose>]| {
            let point = |position: &DVec3| ModelPoint {
                position: *position,
                track: vec![(0, 0), (1, 0)],
                error: 0.0,
            };
            let mut model = Model {
                cameras: vec![Some(camera)],
                poses: poses.to_vec(),
                points: points.iter().map(point).collect(),
                focal_held: vec![false],
            };
            model.align(&Alignment {
                scale,
                rotation: DQuat::from_rotation_x(0.3),
                translation: scale * DVec3::new(5.0, -3.0, 7.0),
            });
            agreement(&photos, &features, std::slice::from_ref(&pair), &model)[0].unwrap()
        };
        for scale in [0.01, 0.1, 1.0, 1000.0] {
            assert_eq!(agrees_at(scale, &poses), 1.0, "{scale}");
        }
        // Cameras at one place: what they see differs by more than a turn.
        poses[1].as_mut().unwrap().position = poses[0].unwrap().position;
        for scale in [0.01, 1.0, 1000.0] {
            assert_eq!(agrees_at(scale, &poses), 0.0, "{scale}");
        }
    }
}
