//! Verification: which matches of a pair agree with one geometry, and the kind of this geometry.

use super::Unverified;
use super::focal::{self, FocalSource};
use super::guide::pinhole_features;
use super::types::{GroupCamera, MapOptions, PairKind, PhotoInfo, Progress, VerifiedPair};
use crate::geometry::camera::DCamera;
use crate::geometry::correspondences::Correspondences;
use crate::geometry::essential::{Essential, Motion, closest_essential, cross_matrix, motion_in_front, refine_motion};
use crate::geometry::fundamental::Fundamental;
use crate::geometry::homography::{Homography, count_rotation_inliers};
use crate::geometry::ransac::{Estimate, Limits, estimate};
use crate::matching::{MatchOptions, match_guided};
use crate::{Features, PairMatches, median};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Maximum number of samples. With 40 % inliers, one of 100 samples of five points has inliers only.
const MAX_SAMPLES: usize = 600;
const CONFIDENCE: f64 = 0.9999;
/// A homography or a rotation explains a pair if it has at least this fraction of the essential matrix's inliers.
const MIN_EXPLAINED_FRACTION: f64 = 0.8;

/// Maximum distance of guided matches from their epipolar line, relative to that of inliers. Anything near a line may match: with the
/// full distance, models of weak pairs lose a third of their photographs.
const GUIDED_DISTANCE_RATIO: f64 = 0.5;

/// A pair whose median angle is below this is a rotation, radians: about three pixels for a long side of a thousand.
const MIN_PARALLAX_RADIANS: f64 = 0.003;

/// `[groups]` the camera of each group before any adjustment.
pub type Cameras = Vec<GroupCamera>;

/// A pair's fundamental matrix between pixels that are centred and divided by each photograph's long side.
#[derive(Clone, Debug)]
pub(super) struct UncalibratedPair {
    /// Index into the pairs.
    pub pair: usize,
    pub matrix: DMat3,
    /// `[M]` whether each match is an inlier.
    pub inliers: Vec<bool>,
    pub count: usize,
}

/// Cameras with known or guessed focal lengths, and the pairs that agree with a geometry under them.
pub fn verify(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    options: &MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> (Cameras, Vec<VerifiedPair>) {
    let unverified = Unverified {
        photos,
        features,
        pairs,
        with_still: pairs,
        options,
    };
    verify_with(&unverified, &[], progress)
}

/// Like [`verify`], with the cameras of some groups given.
pub(super) fn verify_with(
    unverified: &Unverified,
    given: &[Option<GroupCamera>],
    progress: &mut dyn FnMut(Progress),
) -> (Cameras, Vec<VerifiedPair>) {
    let Unverified {
        photos,
        features,
        pairs,
        options,
        ..
    } = *unverified;
    let is_known = |photo: &u32| {
        let photo = &photos[*photo as usize];
        let given = given.get(photo.group).copied().flatten();
        photo.focal_prior_px.is_some() || given.is_some_and(|camera| camera.source == FocalSource::Prior)
    };
    let known: Vec<bool> = pairs.iter().map(|pair| pair.photos.iter().all(is_known)).collect();
    let is_checked = checked_pairs(pairs, &known);
    let uncalibrated: Vec<Option<UncalibratedPair>> = pairs
        .par_iter()
        .enumerate()
        .map(|(i, pair)| {
            if !is_checked[i] || pair.matches.len() < options.min_inliers {
                return None;
            }
            estimate_fundamental(i, photos, features, pair, options)
        })
        .collect();
    let found: Vec<&UncalibratedPair> = uncalibrated.iter().flatten().collect();
    let mut cameras = focal::cameras(unverified, &found);
    for (camera, given) in cameras.iter_mut().zip(given) {
        *camera = given.unwrap_or(*camera);
    }
    let has_fisheye = |pair: &PairMatches| {
        let mut groups = pair.photos.iter().map(|photo| photos[*photo as usize].group);
        groups.any(|group| cameras[group].camera.fisheye)
    };
    let verified: Vec<VerifiedPair> = pairs
        .par_iter()
        .zip(&uncalibrated)
        .zip(&known)
        .filter_map(|((pair, uncalibrated), known)| {
            // Without a common epipolar geometry there is no calibrated one either, except where a fisheye bends the epipolar lines.
            let has_no_geometry = !known && uncalibrated.is_none() && !has_fisheye(pair);
            if pair.matches.len() < options.min_inliers || has_no_geometry {
                return None;
            }
            verify_calibrated(photos, features, pair, uncalibrated.as_ref(), &cameras, options)
        })
        .collect();
    progress(Progress::Verified {
        pairs: verified.len(),
        total: pairs.len(),
    });
    (cameras, verified)
}

/// `[pairs]` whether the fundamental matrix of each is estimated: not where the focal lengths of both photographs are `known`, except for
/// a few pairs, which suffice to check these.
fn checked_pairs(pairs: &[PairMatches], known: &[bool]) -> Vec<bool> {
    let mut is_checked: Vec<bool> = known.iter().map(|known| !known).collect();
    let mut by_match_count: Vec<usize> = (0..pairs.len()).filter(|i| known[*i]).collect();
    by_match_count.sort_by_key(|i| (std::cmp::Reverse(pairs[*i].matches.len()), *i));
    by_match_count
        .iter()
        .take(focal::MAX_CHECKED_PAIRS)
        .for_each(|i| is_checked[*i] = true);
    is_checked
}

pub(super) fn seed_of(pair: &PairMatches) -> u64 {
    u64::from(pair.photos[0]) << 32 | u64::from(pair.photos[1])
}

fn pixel(features: &Features, keypoint: u32) -> DVec2 {
    features.keypoints[keypoint as usize].at()
}

/// Points of a pair, centred and divided by each photograph's long side.
pub(crate) fn centered_points(photos: &[PhotoInfo], features: &[Features], pair: &PairMatches) -> Vec<[DVec2; 2]> {
    let centered = |side: usize, keypoint: u32| {
        let photo = &photos[pair.photos[side] as usize];
        let center = 0.5 * DVec2::new(f64::from(photo.width), f64::from(photo.height));
        (pixel(&features[pair.photos[side] as usize], keypoint) - center) / photo.long_side()
    };
    pair.matches
        .iter()
        .map(|[i, j]| [centered(0, *i), centered(1, *j)])
        .collect()
}

fn estimate_fundamental(
    index: usize,
    photos: &[PhotoInfo],
    features: &[Features],
    pair: &PairMatches,
    options: &MapOptions,
) -> Option<UncalibratedPair> {
    let points = Correspondences::new(centered_points(photos, features, pair));
    let [a, b] = pair.photos.map(|p| photos[p as usize].long_side());
    let threshold = options.max_epipolar_error * 0.5 * (1.0 / a + 1.0 / b);
    let limits = Limits {
        samples: MAX_SAMPLES,
        confidence: CONFIDENCE,
        seed: seed_of(pair),
    };
    let problem = Fundamental {
        points: &points,
        threshold,
    };
    let enough = |best: &Estimate<DMat3>| best.inliers >= options.min_inliers;
    let best = estimate(&problem, Vec::new(), limits).filter(enough).or_else(|| {
        // If one photograph was taken twice, or for a noiseless turn, seven points do not determine the matrix: any epipole fits.
        let plane = estimate(
            &Homography {
                points: &points,
                threshold,
            },
            Vec::new(),
            limits,
        )?
        .model;
        estimate(
            &problem,
            vec![cross_matrix(DVec3::X) * plane],
            Limits { samples: 0, ..limits },
        )
        .filter(enough)
    })?;
    let inliers = points.epipolar_inliers(&best.model, threshold);
    Some(UncalibratedPair {
        pair: index,
        matrix: best.model,
        count: best.inliers,
        inliers,
    })
}

/// `k_b^T f k_a` for a fundamental matrix between centred pixels relative to the long side, with focal lengths relative to the long side.
pub(super) fn essential_from(fundamental: DMat3, focal_a: f64, focal_b: f64) -> DMat3 {
    let scale = |f: f64| DMat3::from_diagonal(DVec3::new(f, f, 1.0));
    closest_essential(scale(focal_b) * fundamental * scale(focal_a))
}

fn verify_calibrated(
    photos: &[PhotoInfo],
    features: &[Features],
    pair: &PairMatches,
    uncalibrated: Option<&UncalibratedPair>,
    cameras: &Cameras,
    options: &MapOptions,
) -> Option<VerifiedPair> {
    let group = pair.photos.map(|p| &cameras[photos[p as usize].group]);
    let [camera_a, camera_b]: [&DCamera; 2] = group.map(|g| &g.camera);
    // NaN is never an inlier.
    let plane = |camera: &DCamera, at: DVec2| camera.unproject(at).unwrap_or(DVec2::NAN);
    let [features_a, features_b] = pair.photos.map(|p| &features[p as usize]);
    let normalized = |matches: &[[u32; 2]]| -> Vec<[DVec2; 2]> {
        matches
            .iter()
            .map(|[i, j]| {
                [
                    plane(camera_a, pixel(features_a, *i)),
                    plane(camera_b, pixel(features_b, *j)),
                ]
            })
            .collect()
    };
    let all = Correspondences::new(normalized(&pair.matches));
    let threshold = options.max_epipolar_error * 0.5 * (1.0 / camera_a.focal() + 1.0 / camera_b.focal());
    let problem = Essential {
        points: &all,
        threshold,
    };
    let limits = Limits {
        samples: MAX_SAMPLES,
        confidence: CONFIDENCE,
        seed: seed_of(pair),
    };
    let first = uncalibrated.map(|u| {
        let [a, b] = pair.photos.map(|p| photos[p as usize].long_side());
        essential_from(u.matrix, camera_a.focal() / a, camera_b.focal() / b)
    });
    let best = estimate(&problem, first.into_iter().collect(), limits)?;
    let mut inliers = all.epipolar_inliers(&best.model, threshold);
    let mut count = inliers.iter().filter(|i| **i).count();
    let better = uncalibrated.filter(|uncalibrated| {
        group.iter().any(|g| g.source != FocalSource::Prior) && uncalibrated.count as f64 > 1.2 * count as f64
    });
    if let Some(uncalibrated) = better {
        // The guessed focal length is off: the inliers of the fundamental matrix are used.
        inliers.clone_from(&uncalibrated.inliers);
        count = uncalibrated.count;
    }
    if count < options.min_inliers {
        return None;
    }
    let refined = |start: Motion, kept: &[[DVec2; 2]]| {
        refine_motion(start, kept, threshold, 3)
            .map_or(start, |refined| motion_in_front(refined.essential(), kept.iter()).0)
    };
    let mut matches = select(&pair.matches, &inliers);
    let mut kept: Vec<[DVec2; 2]> = select(&all.points, &inliers);
    let mut motion = refined(motion_in_front(best.model, kept.iter()).0, &kept);
    let mut angle = median_angle(&motion, &kept);
    if options.guided && angle >= MIN_PARALLAX_RADIANS && !(camera_a.fisheye || camera_b.fisheye) {
        let guided = match better {
            Some(uncalibrated) => {
                let [a, b] = pair.photos.map(|p| to_centered(&photos[p as usize]));
                let fundamental = b.transpose() * uncalibrated.matrix * a;
                match_along_lines([features_a, features_b], &fundamental, options)
            }
            None => {
                let [a, b] = [camera_a, camera_b].map(inverse_calibration);
                let [seen_a, seen_b] = [(features_a, camera_a), (features_b, camera_b)]
                    .map(|(features, camera)| pinhole_features(features, camera));
                let fundamental = b.transpose() * motion.essential() * a;
                match_along_lines([&seen_a, &seen_b], &fundamental, options)
            }
        };
        if guided.len() > matches.len() {
            kept = normalized(&guided);
            motion = refined(motion, &kept);
            angle = median_angle(&motion, &kept);
            matches = guided;
        }
    }
    let kind = if angle < MIN_PARALLAX_RADIANS {
        PairKind::Rotation
    } else {
        classify(&kept, threshold, pair)
    };
    Some(VerifiedPair {
        photos: pair.photos,
        matches,
        kind,
        motion,
        angle: if kind == PairKind::Rotation { 0.0 } else { angle },
    })
}

/// The matches of two photographs along the epipolar lines of a fundamental matrix between their pixels.
fn match_along_lines([a, b]: [&Features; 2], fundamental: &DMat3, options: &MapOptions) -> Vec<[u32; 2]> {
    let distance = GUIDED_DISTANCE_RATIO * options.max_epipolar_error;
    match_guided(a, b, fundamental, distance, &MatchOptions::default())
}

/// Maps homogeneous pixels to the plane z = 1, ignoring distortion.
pub(super) fn inverse_calibration(camera: &DCamera) -> DMat3 {
    let [fx, fy, cx, cy, ..] = camera.parameters;
    DMat3::from_cols(
        DVec3::new(1.0 / fx, 0.0, 0.0),
        DVec3::new(0.0, 1.0 / fy, 0.0),
        DVec3::new(-cx / fx, -cy / fy, 1.0),
    )
}

/// Maps homogeneous pixels to the coordinates of [`centered_points`].
fn to_centered(photo: &PhotoInfo) -> DMat3 {
    let scale = 1.0 / photo.long_side();
    let center = 0.5 * scale * DVec2::new(f64::from(photo.width), f64::from(photo.height));
    DMat3::from_cols(DVec3::X * scale, DVec3::Y * scale, (-center).extend(1.0))
}

pub(super) fn select<T: Clone>(items: &[T], keep: &[bool]) -> Vec<T> {
    items
        .iter()
        .zip(keep)
        .filter(|(_, keep)| **keep)
        .map(|(item, _)| item.clone())
        .collect()
}

/// The kind of a pair from the inliers of its essential matrix.
fn classify(points: &[[DVec2; 2]], threshold: f64, pair: &PairMatches) -> PairKind {
    let min_explained = MIN_EXPLAINED_FRACTION * points.len() as f64;
    let all = Correspondences::new(points.to_vec());
    let limits = Limits {
        samples: 50,
        confidence: 0.99,
        seed: seed_of(pair),
    };
    let Some(plane) = estimate(
        &Homography {
            points: &all,
            threshold,
        },
        Vec::new(),
        limits,
    ) else {
        return PairKind::General;
    };
    if (plane.inliers as f64) < min_explained {
        return PairKind::General;
    }
    // The second fit leaves out what does not follow the turn. The threshold is doubled because the lens may still be unknown.
    let rotated = count_rotation_inliers(points, &[2.0 * threshold], 2.0 * threshold);
    if rotated as f64 >= min_explained {
        PairKind::Rotation
    } else {
        PairKind::Planar
    }
}

/// The median angle between the two rays of the points in front of both cameras.
fn median_angle(motion: &Motion, points: &[[DVec2; 2]]) -> f64 {
    let angles = points
        .iter()
        .filter(|p| motion.depths(**p).iter().all(|z| *z > 0.0))
        .map(|[a, b]| (motion.rotation * a.extend(1.0)).angle_between(b.extend(1.0)));
    median(angles.collect()).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Keypoint;
    use crate::geometry::pose::DPose;
    use glam::DQuat;
    use irradia_scene::Rng;

    /// Two photographs of a room by a fisheye, and the matches of `points` points.
    fn fisheye_pair(camera: &DCamera, points: usize) -> (Vec<PhotoInfo>, Vec<Features>, PairMatches) {
        let photo = PhotoInfo::new(String::new(), camera.width, camera.height);
        let poses = [
            DPose::IDENTITY,
            DPose {
                rotation: DQuat::from_scaled_axis(DVec3::new(0.3, 0.8, 0.5)),
                position: DVec3::new(1.0, 0.4, 0.3),
            },
        ];
        let mut rng = Rng::new(8, 0);
        let mut features = vec![Features::default(); 2];
        while features[0].keypoints.len() < points {
            let point = DVec3::from_array([0; 3].map(|_| f64::from(rng.range(-3.0, 3.0))));
            let local = poses.each_ref().map(|pose| pose.camera_from_world(point));
            if local.iter().any(|p| p.z <= 0.0 || !camera.is_shown(p.truncate() / p.z)) {
                continue;
            }
            for (features, p) in features.iter_mut().zip(local) {
                let at = camera.pixel(p).as_vec2();
                features.keypoints.push(Keypoint {
                    x: at.x,
                    y: at.y,
                    scale: 2.0,
                    angle: 0.0,
                });
            }
        }
        let matches = (0..points as u32).map(|i| [i, i]).collect();
        let photos = [0, 1];
        (vec![photo; 2], features, PairMatches { photos, matches })
    }

    #[test]
    fn a_fisheye_pair_without_straight_epipolar_lines_is_verified() {
        let camera = DCamera {
            fisheye: true,
            ..DCamera::centered(1000, 1000, 360.0)
        };
        let (photos, features, pair) = fisheye_pair(&camera, 17);
        let options = MapOptions::default();
        assert!(estimate_fundamental(0, &photos, &features, &pair, &options).is_none());
        let unverified = Unverified {
            photos: &photos,
            features: &features,
            pairs: std::slice::from_ref(&pair),
            with_still: std::slice::from_ref(&pair),
            options: &options,
        };
        let source = FocalSource::Pairs;
        let (_, verified) = verify_with(&unverified, &[Some(GroupCamera { camera, source })], &mut |_| ());
        assert_eq!(verified[0].matches.len(), 17);
    }

    #[test]
    fn few_pairs_of_known_focal_lengths_are_checked_beside_all_others() {
        let pair = |i: u32| PairMatches {
            photos: [0, i + 1],
            matches: vec![[0, 0]; i as usize],
        };
        let pairs: Vec<PairMatches> = (0..200).map(pair).collect();
        let known: Vec<bool> = (0..200).map(|i| i % 4 > 0).collect();
        let is_checked = checked_pairs(&pairs, &known);
        // All 50 that are not known, and the 120 with most matches of the others.
        assert_eq!(is_checked.iter().filter(|checked| **checked).count(), 170);
        assert!((0..200).all(|i| is_checked[i] == (!known[i] || i >= 40)));
    }
}
