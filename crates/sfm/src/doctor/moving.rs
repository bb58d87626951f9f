//! Something in the scene that moves.
//!
//! In many pairs, matches on a small part of the photographs agree with one plane, and not with the motion of the rest, which covers
//! most of the photographs and is that of the scene. It does not matter which of the two was verified as the pair's motion. Wallpaper
//! looks similar where a motif is mistaken for its copy, but seldom between photographs that share most, and a third photograph
//! that shows both motifs tells them apart: a moving object is the same object in all three.

use super::motion::photos_by_pair_count;
use super::{Diagnosis, Evidence};
use crate::PairMatches;
use crate::geometry::correspondences::{Correspondences, sampson_squared, transfer_squared};
use crate::geometry::essential::cross_matrix;
use crate::geometry::fundamental::Fundamental;
use crate::geometry::homography::Homography;
use crate::geometry::ransac::estimate;
use crate::map::{MAX_INLIER_ERROR_LONG_SIDES, centered_points, pairs_with_value, ransac_limits};
use crate::median;
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Number of partners with which each photograph is compared, those with most matches.
const MAX_PARTNERS: usize = 5;
/// Minimum number of matches on what moves, and on the scene.
const MIN_OBJECT_MATCHES: usize = 12;
const MIN_SCENE_MATCHES: usize = 15;
/// Minimum fraction of the other matches that are on the scene.
const MIN_SCENE_FRACTION: f64 = 0.4;
/// Number of planes that are tried for a pair.
const MAX_PLANES: usize = 3;
/// Minimum median distance of what moves from the scene's epipolar lines, relative to the long side.
const MIN_EPIPOLAR_DISTANCE: f64 = 0.012;
/// Maximum extent of what moves along each axis, relative to the long side.
const MAX_OBJECT_EXTENT: f64 = 0.5;
/// A group in front of a plane is parallax: number of its matches whose lines of parallax are tried, and minimum fractions of the
/// group's matches and of the scene's that one motion explains.
const MAX_PARALLAX_LINES: usize = 20;
const MIN_GROUP_FRACTION: f64 = 0.5;
const MIN_SCENE_RATIO: f64 = 0.9;
/// Minimum fraction of matches in third photographs that confirm a single object.
const MIN_CONFIRMED_FRACTION: f64 = 0.8;
/// Minimum number of pairs, and minimum fraction of the compared ones, for a diagnosis. Four captures with a moving board reach 0.22
/// to 0.76, clean ones 0.1 (in front of wallpaper) or less.
const MIN_PAIRS: usize = 4;
const MIN_PAIR_FRACTION: f64 = 0.15;

/// The partners of each keypoint: `[photos][keypoints]` photograph and keypoint, ascending.
type Partners = Vec<Vec<Vec<[u32; 2]>>>;

/// A match `[keypoint, keypoint]` with its places.
type Match = ([u32; 2], [DVec2; 2]);

/// What moves, and the pairs that show it.
pub(super) fn moving(evidence: &Evidence) -> (Vec<Diagnosis>, Vec<[u32; 2]>) {
    let compared = strongest_pairs(evidence);
    let partners = partners(evidence);
    let counts: Vec<Option<usize>> = compared
        .par_iter()
        .map(|pair| {
            let group = moving_group(evidence, pair)?;
            is_single_object(&partners, pair.photos, &group).then_some(group.len())
        })
        .collect();
    let found = pairs_with_value(&compared, &counts);
    if found.len() < MIN_PAIRS || (found.len() as f64) < MIN_PAIR_FRACTION * compared.len() as f64 {
        return (Vec::new(), Vec::new());
    }
    let matches = median(counts.into_iter().flatten().map(|count| count as f64).collect());
    let diagnosis = Diagnosis::Moving {
        photos: photos_by_pair_count(&found),
        pairs: [found.len(), compared.len()],
        matches: matches.unwrap_or(0.0) as usize,
    };
    (vec![diagnosis], found)
}

/// The pairs with most matches of each photograph, most matches first.
fn strongest_pairs<'a>(evidence: &Evidence<'a>) -> Vec<&'a PairMatches> {
    let mut order: Vec<&PairMatches> = evidence.matches.iter().collect();
    order.retain(|pair| pair.matches.len() >= MIN_OBJECT_MATCHES + MIN_SCENE_MATCHES);
    order.sort_by_key(|pair| (std::cmp::Reverse(pair.matches.len()), pair.photos));
    let mut count = vec![0; evidence.photos.len()];
    order.retain(|pair| {
        let ends = pair.photos.map(|p| p as usize);
        ends.iter().for_each(|p| count[*p] += 1);
        ends.iter().any(|p| count[*p] <= MAX_PARTNERS)
    });
    order
}

/// Matches on a compact object that agree with one another and not with the scene.
fn moving_group(evidence: &Evidence, pair: &PairMatches) -> Option<Vec<[u32; 2]>> {
    let positions = centered_points(evidence.photos, evidence.features, pair);
    let mut rest: Vec<Match> = pair.matches.iter().copied().zip(positions).collect();
    let mut others: Vec<Match> = Vec::new();
    for _ in 0..MAX_PLANES {
        let (group, left) = fit_plane(pair, rest)?;
        if is_compact(&group) {
            let scene: Vec<Match> = [&others[..], &left[..]].concat();
            if disagrees_with_scene(pair, &group, &scene) {
                return Some(keypoints(group));
            }
        }
        others.extend(group);
        rest = left;
    }
    None
}

/// Whether `group` disagrees with the motion of `scene`, provided that `scene` has one and it covers most of the photographs.
fn disagrees_with_scene(pair: &PairMatches, group: &[Match], scene: &[Match]) -> bool {
    let points = Correspondences::new(scene.iter().map(|m| m.1).collect());
    let problem = Fundamental {
        points: &points,
        threshold: MAX_INLIER_ERROR_LONG_SIDES,
    };
    let Some(found) = estimate(&problem, Vec::new(), ransac_limits(pair, 300)) else {
        return false;
    };
    let agrees =
        |m: &&Match| sampson_squared(&found.model, m.1) < MAX_INLIER_ERROR_LONG_SIDES * MAX_INLIER_ERROR_LONG_SIDES;
    let inliers: Vec<Match> = scene.iter().filter(agrees).copied().collect();
    let enough = inliers.len() >= MIN_SCENE_MATCHES && inliers.len() as f64 >= MIN_SCENE_FRACTION * scene.len() as f64;
    let distances = group.iter().map(|m| sampson_squared(&found.model, m.1).sqrt());
    enough
        && !is_compact(&inliers)
        && median(distances.collect()).is_some_and(|distance| distance > MIN_EPIPOLAR_DISTANCE)
        && !is_parallax(pair, group, scene, inliers.len())
}

/// Whether another motion explains `group` and nearly as many matches of `scene` as the one that explains `agreeing` of them. That is
/// so where the scene is one plane, which does not determine the motion: what is in front of that plane then shows parallax (Hartley
/// and Zisserman 2004, 13.3).
fn is_parallax(pair: &PairMatches, group: &[Match], scene: &[Match], agreeing: usize) -> bool {
    let points = Correspondences::new(scene.iter().map(|m| m.1).collect());
    let problem = Homography {
        points: &points,
        threshold: MAX_INLIER_ERROR_LONG_SIDES,
    };
    let Some(found) = estimate(&problem, Vec::new(), ransac_limits(pair, 500)) else {
        return false;
    };
    let plane = found.model;
    // The lines along which points leave the plane meet in the epipole.
    let lines: Vec<DVec3> = group
        .iter()
        .step_by(group.len().div_ceil(MAX_PARALLAX_LINES))
        .map(|(_, [a, b])| (plane * a.extend(1.0)).cross(b.extend(1.0)))
        .collect();
    let agree = |f: &DMat3, matches: &[Match]| {
        let agrees = |m: &&Match| sampson_squared(f, m.1) < MAX_INLIER_ERROR_LONG_SIDES * MAX_INLIER_ERROR_LONG_SIDES;
        matches.iter().filter(agrees).count() as f64
    };
    let pairs = (0..lines.len()).flat_map(|i| (0..i).map(move |j| [i, j]));
    pairs
        .map(|[i, j]| cross_matrix(lines[i].cross(lines[j])) * plane)
        .filter(|f| agree(f, group) >= MIN_GROUP_FRACTION * group.len() as f64)
        .any(|f| agree(&f, scene) >= MIN_SCENE_RATIO * agreeing as f64)
}

fn keypoints(matches: Vec<Match>) -> Vec<[u32; 2]> {
    matches.into_iter().map(|m| m.0).collect()
}

/// The matches that agree with one plane, and the others; `None` if too few agree.
fn fit_plane(pair: &PairMatches, matches: Vec<Match>) -> Option<(Vec<Match>, Vec<Match>)> {
    if matches.len() < MIN_OBJECT_MATCHES {
        return None;
    }
    let points = Correspondences::new(matches.iter().map(|m| m.1).collect());
    let problem = Homography {
        points: &points,
        threshold: MAX_INLIER_ERROR_LONG_SIDES,
    };
    let found = estimate(&problem, Vec::new(), ransac_limits(pair, 500))?;
    let limit = MAX_INLIER_ERROR_LONG_SIDES * MAX_INLIER_ERROR_LONG_SIDES;
    let agrees = |m: &Match| transfer_squared(&found.model, m.1) < limit;
    let (group, left): (Vec<Match>, Vec<Match>) = matches.into_iter().partition(agrees);
    (group.len() >= MIN_OBJECT_MATCHES).then_some((group, left))
}

/// Whether matches cover a small part of both photographs, but more than a point.
fn is_compact(matches: &[Match]) -> bool {
    let within = |side: usize, axis: usize| {
        let mut values: Vec<f64> = matches.iter().map(|m| m.1[side][axis]).collect();
        values.sort_by(f64::total_cmp);
        // Up to a tenth on either side may be outliers.
        let cut = values.len() / 10;
        let width = values[values.len() - 1 - cut] - values[cut];
        (0.005..MAX_OBJECT_EXTENT).contains(&width)
    };
    [0, 1].iter().all(|side| within(*side, 0) && within(*side, 1))
}

fn partners(evidence: &Evidence) -> Partners {
    let mut partners: Partners = evidence
        .features
        .iter()
        .map(|features| vec![Vec::new(); features.keypoints.len()])
        .collect();
    for PairMatches {
        photos: [a, b],
        matches,
    } in evidence.matches
    {
        for [i, j] in matches {
            partners[*a as usize][*i as usize].push([*b, *j]);
            partners[*b as usize][*j as usize].push([*a, *i]);
        }
    }
    partners.iter_mut().flatten().for_each(|of| of.sort_unstable());
    partners
}

/// Whether third photographs that match both keypoints of these matches do so at the same keypoint.
fn is_single_object(partners: &Partners, [a, b]: [u32; 2], matches: &[[u32; 2]]) -> bool {
    let (mut same, mut both) = (0, 0);
    for [i, j] in matches {
        let of_b: BTreeMap<u32, u32> = partners[b as usize][*j as usize]
            .iter()
            .map(|[p, k]| (*p, *k))
            .collect();
        for [photo, keypoint] in &partners[a as usize][*i as usize] {
            if let Some(other) = of_b.get(photo) {
                both += 1;
                same += usize::from(other == keypoint);
            }
        }
    }
    both >= matches.len() && same as f64 >= MIN_CONFIRMED_FRACTION * both as f64
}
