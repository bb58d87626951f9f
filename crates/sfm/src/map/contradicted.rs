//! Models that fit the points of a plane with another motion than the cameras': what stands on the plane contradicts them.

use super::agreement::{MAX_INLIER_ERROR_ON_PLANE, normalized_matches};
use super::types::{PairKind, VerifiedPair};
use crate::Features;
use crate::geometry::camera::DCamera;
use crate::geometry::pose::DPose;

/// A pair contradicts a model if its rotation differs from that of its photographs by more than this, relative to the median angle between
/// the two rays of a match (the less parallax, the more a rotation can be mistaken for a translation), and its direction of translation by
/// more than the second, radians. Of a film by a drone above a town, a model with another motion that also fits the ground explains 0.73 of
/// its observations; over the pairs that show depth the medians are 7.5 and 100 degrees. For models of eleven captures that are right, one
/// of the two is small: 0.05 to 0.36, or 1.1 degrees for a walk along a street, of little parallax.
const MAX_RELATIVE_ROTATION_ERROR: f64 = 1.0;
const MAX_DIRECTION_ERROR: f64 = 0.5;
/// Minimum number of pairs that show depth, and of the matches of each, for a judgement.
const MIN_JUDGED_PAIRS: usize = 10;
const MIN_JUDGED_MATCHES: usize = 30;
/// Minimum fraction of a pair's matches that its motion explains with the cameras of a grown model: a motion that was found with another
/// focal length says nothing. In the film it is 0.99 to 1.00; for twelve photographs of a fox, whose focal length began as a guess, 0.01 to
/// 0.76, and these motions contradict the right model.
const MIN_OWN_FRACTION: f64 = 0.9;

/// Whether the motion of `pair` agrees with `poses`; `None` if one of its photographs has none.
pub(super) fn agrees_with(poses: &[Option<DPose>], pair: &VerifiedPair) -> Option<bool> {
    let [a, b] = pair.photos.map(|photo| poses[photo as usize]);
    let (a, b) = (a?, b?);
    let rotation = b.rotation.inverse() * a.rotation;
    let turns_alike = rotation.angle_between(pair.motion.rotation) < MAX_RELATIVE_ROTATION_ERROR * pair.angle;
    let direction = b.camera_from_world(a.position).normalize_or_zero();
    Some(turns_alike || direction.angle_between(pair.motion.translation) < MAX_DIRECTION_ERROR)
}

/// Whether the motion of `pair` explains its matches with the cameras of a model, which may differ from those with which it was found.
pub(crate) fn explains_matches(pair: &VerifiedPair, features: &[Features], cameras: [Option<&DCamera>; 2]) -> bool {
    let [Some(a), Some(b)] = cameras else {
        return false;
    };
    let points = normalized_matches(pair, features, [a, b]);
    pair.motion.agreeing_fraction(&points, MAX_INLIER_ERROR_ON_PLANE) >= MIN_OWN_FRACTION
}

/// If most of the `pairs` that show depth, whose photographs both have `poses`, and that are reliable, have other motions than these: the
/// indices of those that do.
pub fn contradicted_pairs(
    pairs: &[VerifiedPair],
    poses: &[Option<DPose>],
    is_reliable: impl Fn(&VerifiedPair) -> bool,
) -> Vec<usize> {
    let judged = pairs
        .iter()
        .enumerate()
        .filter(|(_, pair)| pair.kind == PairKind::General && pair.matches.len() >= MIN_JUDGED_MATCHES);
    let (agreeing, contradicted): (Vec<_>, Vec<_>) = judged
        .filter_map(|(i, pair)| Some((i, agrees_with(poses, pair)?)).filter(|_| is_reliable(pair)))
        .partition(|(_, agrees)| *agrees);
    let is_judged = agreeing.len() + contradicted.len() >= MIN_JUDGED_PAIRS;
    if is_judged && contradicted.len() > agreeing.len() {
        contradicted.into_iter().map(|(i, _)| i).collect()
    } else {
        Vec::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Keypoint;
    use crate::geometry::essential::Motion;
    use glam::{DQuat, DVec2, DVec3};

    #[test]
    fn a_model_with_other_motions_than_most_pairs_with_depth_is_contradicted() {
        let turned = |i: u32, by: f64| DQuat::from_rotation_y(by * f64::from(i));
        let pose = |i| DPose::from_camera_from_world(turned(i, 0.1), DVec3::X);
        let poses: Vec<Option<DPose>> = (0..20).map(|i| (i < 18).then(|| pose(i))).collect();
        // Of each photograph, what is straight ahead, and in the next ones after turns by 0.1 and 0.3.
        let camera = DCamera::centered(1000, 1000, 1000.0);
        let keypoint = |turn: f64| {
            let DVec2 { x, y } = camera.pixel(DVec3::new(turn.sin(), 0.0, turn.cos()));
            let [x, y] = [x as f32, y as f32];
            Keypoint {
                x,
                y,
                scale: 2.0,
                angle: 0.0,
            }
        };
        let keypoints = [0.0, 0.1, 0.3].map(keypoint).to_vec();
        let features = Features {
            keypoints,
            ..Features::default()
        };
        let features = vec![features; 20];
        let pair = |i: u32, kind: PairKind, by: f64| VerifiedPair {
            photos: [i, i + 1],
            matches: vec![[0, if by == 0.1 { 1 } else { 2 }]; MIN_JUDGED_MATCHES],
            kind,
            motion: Motion {
                rotation: turned(1, by),
                translation: DVec3::X,
            },
            angle: 0.1,
        };
        let is_reliable = |pair: &VerifiedPair| explains_matches(pair, &features, [Some(&camera); 2]);
        let contradicted = |pairs: &[VerifiedPair]| contradicted_pairs(pairs, &poses, is_reliable).len();
        let pairs = |wrong: u32, kind: PairKind| -> Vec<VerifiedPair> {
            (0..19)
                .map(|i| pair(i, kind, if i < wrong { 0.3 } else { 0.1 }))
                .collect()
        };
        assert_eq!(contradicted(&pairs(8, PairKind::General)), 0);
        assert_eq!(contradicted(&pairs(9, PairKind::General)), 9, "of 17 with poses");
        assert_eq!(contradicted(&pairs(19, PairKind::Planar)), 0, "planes say little");
        let mut directed = pairs(19, PairKind::General);
        let direction = pose(1).camera_from_world(pose(0).position).normalize();
        directed.iter_mut().for_each(|pair| pair.motion.translation = direction);
        assert_eq!(contradicted(&directed), 0, "they moved in the right direction");
        assert_eq!(contradicted(&pairs(9, PairKind::General)[..9]), 0, "too few");
        let mut unexplained = pairs(19, PairKind::General);
        unexplained.iter_mut().for_each(|pair| {
            pair.motion = Motion {
                rotation: turned(1, -0.3),
                translation: DVec3::Y,
            };
        });
        assert_eq!(contradicted(&unexplained), 0, "motions that explain nothing");
        assert_eq!(contradicted_pairs(&unexplained, &poses, |_| true).len(), 17);
    }
}
