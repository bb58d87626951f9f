//! Matches that should exist and do not.
//!
//! Photographs taken from nearly the same place in the same direction share points. Where two share none, their poses cannot both be
//! right: either parts that look alike, such as corridors on two floors, were mistaken for one, or an object was turned over between the
//! photographs while its surroundings, such as a scale bar, were not. All existing matches agree with such a model; only the missing ones
//! reveal it. After Zach, Irschara and Bischof, "What can missing correspondences tell us about 3D structure and motion?" (CVPR 2008).

use super::types::{MissingMatches, Model, PhotoInfo};
use rayon::prelude::*;

/// Maximum number of points of a photograph that are projected into the others.
const MAX_PROJECTED_POINTS: usize = 200;
/// Minimum number of expected points for a pair to count as evidence.
const MIN_EXPECTED_POINTS: usize = 40;
/// Minimum fraction of the points of a photograph that are expected in the other.
const MIN_VISIBLE_FRACTION: f64 = 0.5;
/// A point should be matched up to this angle between its rays, given as a cosine (12 degrees), and up to this ratio of its distances.
const MIN_RAY_COSINE: f64 = 0.978;
const MAX_DISTANCE_RATIO: f64 = 1.35;
/// Width of the border in which no points are expected, as a fraction of the photograph's side along each axis.
const BORDER_FRACTION: f64 = 0.03;
/// Photographs share next to nothing if they share less than this fraction of the expected points. In correct models, the middle half
/// of the pairs share 0.2 to 0.8.
const MAX_SHARED_FRACTION: f64 = 0.1;
/// Minimum number of pairs with missing matches that rules out coincidence. Of the models of 62 captures, the three wrong ones have 13, 27
/// and 1,201, one of panoramas has 10, and all others have at most 2.
pub const MIN_MISSING_PAIRS: usize = 12;

/// A pair of photographs whose poses say that they see the same part of the scene.
pub(super) struct Overlap {
    /// The pair.
    pub pair: MissingMatches,
    /// Whether next to none of its expected points are matched.
    pub is_missing: bool,
}

/// All pairs of photographs whose poses say that they see the same part of the scene.
pub(super) fn overlaps(photos: &[PhotoInfo], model: &Model) -> Vec<Overlap> {
    let seen = sample_points(model, photos.len());
    (0..seen.len())
        .into_par_iter()
        .flat_map_iter(|a| (a + 1..seen.len()).map(move |b| (a, b)))
        .filter_map(|(a, b)| {
            let of_a = shared_and_expected(photos, model, &seen, a, b)?;
            let of_b = shared_and_expected(photos, model, &seen, b, a)?;
            let shares_none = |[shared, of]: [usize; 2]| (shared as f64) < MAX_SHARED_FRACTION * of as f64;
            Some(Overlap {
                pair: MissingMatches {
                    photos: [a as u32, b as u32],
                    expected: of_a[1].min(of_b[1]),
                },
                // Each must lack the points of the other: with an occluding corner, only one of them does.
                is_missing: shares_none(of_a) && shares_none(of_b),
            })
        })
        .collect()
}

/// The pairs with missing matches, most expected points first.
pub(super) fn missing_pairs(overlaps: &[Overlap]) -> Vec<MissingMatches> {
    let mut found: Vec<MissingMatches> = overlaps.iter().filter(|o| o.is_missing).map(|o| o.pair).collect();
    found.sort_by_key(|pair| (std::cmp::Reverse(pair.expected), pair.photos));
    found
}

/// Pairs of photographs that share next to nothing although their poses say that they see the same part of the scene, most expected
/// points first.
pub fn missing_matches(photos: &[PhotoInfo], model: &Model) -> Vec<MissingMatches> {
    missing_pairs(&overlaps(photos, model))
}

/// `[photos]` at most [`MAX_PROJECTED_POINTS`] of the points of each photograph, evenly selected.
fn sample_points(model: &Model, photos: usize) -> Vec<Vec<usize>> {
    let mut seen = vec![Vec::new(); photos];
    for (i, point) in model.points.iter().enumerate() {
        point.track.iter().for_each(|(photo, _)| seen[*photo as usize].push(i));
    }
    for points in &mut seen {
        let step = points.len().div_ceil(MAX_PROJECTED_POINTS).max(1);
        *points = points.iter().copied().step_by(step).collect();
    }
    seen
}

/// How many points of photograph `a` are matched in `b`, and how many should be; `None` if `b` shows another part of the scene, or the
/// same part from another side.
fn shared_and_expected(
    photos: &[PhotoInfo],
    model: &Model,
    seen: &[Vec<usize>],
    a: usize,
    b: usize,
) -> Option<[usize; 2]> {
    let (from, to) = (model.poses[a]?, model.poses[b]?);
    let camera = model.cameras[photos[b].group]?;
    let [width, height] = [camera.width, camera.height].map(f64::from);
    let (mut shared, mut count) = (0, 0);
    for i in &seen[a] {
        let point = &model.points[*i];
        let [ray_a, ray_b] = [from, to].map(|pose| point.position - pose.position);
        let [near, far] = [ray_a.length().min(ray_b.length()), ray_a.length().max(ray_b.length())];
        let local = to.camera_from_world(point.position);
        let is_in_view = local.z > 0.0 && camera.is_shown(local.truncate() / local.z);
        if !is_in_view || far > MAX_DISTANCE_RATIO * near || ray_a.dot(ray_b) < MIN_RAY_COSINE * near * far {
            continue;
        }
        let at = camera.pixel(local);
        let inside = |at: f64, side: f64| at > BORDER_FRACTION * side && at < (1.0 - BORDER_FRACTION) * side;
        if inside(at.x, width) && inside(at.y, height) {
            count += 1;
            shared += usize::from(point.track.binary_search_by_key(&(b as u32), |seen| seen.0).is_ok());
        }
    }
    (count >= MIN_EXPECTED_POINTS && count as f64 >= MIN_VISIBLE_FRACTION * seen[a].len() as f64)
        .then_some([shared, count])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::DCamera;
    use crate::geometry::pose::DPose;
    use crate::map::ModelPoint;
    use glam::{DQuat, DVec3};

    /// Two photographs from one place, `turned` apart, each of which shows 50 points straight ahead that the other does not show.
    fn overlaps_of(turned: f64) -> usize {
        let photo = PhotoInfo::new(String::new(), 1000, 750);
        let mut camera = DCamera::centered(1000, 750, 600.0);
        camera.parameters[4] = -0.25;
        let poses = [0.0, turned].map(|angle| DPose {
            rotation: DQuat::from_rotation_y(angle),
            ..DPose::IDENTITY
        });
        let point = |i: usize| {
            let angle = 0.002 * (i / 2) as f64 - 0.05;
            ModelPoint {
                position: poses[i % 2].rotation * DVec3::new(5.0 * angle.sin(), 0.0, 5.0 * angle.cos()),
                track: vec![(i as u32 % 2, i as u32 / 2)],
                error: 0.0,
            }
        };
        let model = Model {
            cameras: vec![Some(camera)],
            poses: poses.map(Some).to_vec(),
            points: (0..100).map(point).collect(),
            focal_held: vec![false],
        };
        overlaps(&[photo.clone(), photo], &model).len()
    }

    #[test]
    fn points_beyond_the_lens_are_not_expected() {
        assert_eq!(overlaps_of(0.1), 1);
        // Where the distortion turns back, their pixels are inside the photograph again.
        assert_eq!(overlaps_of(1.1), 0);
    }
}
