//! What is handed out: an upright, centred model, and a reason for each photograph that is in none.

use super::model::Working;
use super::types::{LeftOut, MapOptions, Model, ModelPoint, PairKind, PhotoInfo, Reason, VerifiedPair};
use crate::geometry::align::Alignment;
use crate::geometry::linear::{scatter, symmetric_eigen};
use crate::geometry::pose::DPose;
use crate::{Features, PairMatches, median};
use glam::{DQuat, DVec3};

/// The model in a world of its own.
pub(super) fn finish(working: &Working, photos: &[PhotoInfo]) -> Model {
    let mut model = collected(working, photos);
    let alignment = upright(&model, photos);
    for pose in model.poses.iter_mut().flatten() {
        *pose = alignment.pose(pose);
    }
    for point in &mut model.points {
        point.position = alignment.point(point.position);
    }
    model
}

/// The model in the world in which it grew.
pub(super) fn collected(working: &Working, photos: &[PhotoInfo]) -> Model {
    let mut model = Model {
        cameras: Vec::new(),
        poses: working.poses.clone(),
        points: Vec::new(),
        focal_held: working.focal_held.clone(),
    };
    for (group, camera) in working.cameras.iter().enumerate() {
        let present = photos
            .iter()
            .zip(&working.poses)
            .any(|(photo, pose)| photo.group == group && pose.is_some());
        model.cameras.push(present.then_some(*camera));
    }
    for track in working.with_points() {
        let position = working.points[track].expect("listed");
        let used: Vec<usize> = working.tracks.range(track).filter(|o| working.used[*o]).collect();
        let errors = used
            .iter()
            .filter_map(|o| Some(working.sight(*o)?.error_squared(position).sqrt()));
        model.points.push(ModelPoint {
            position,
            error: errors.sum::<f64>() / used.len() as f64,
            track: used
                .iter()
                .map(|o| {
                    let observation = working.tracks.observations[*o];
                    (observation.photo, observation.keypoint)
                })
                .collect(),
        });
    }
    model
}

/// Standard deviation of the viewing directions of a survey about their mean at most, degrees.
const PARALLEL: f64 = 15.0;
/// Standard deviation of the positions of its cameras across their views at least, in the direction in which it is less, by the distance of the points.
/// Of 50 captures those by kite and by drone have 0.27 and 0.47 (12 and 3 degrees); those that look ahead so nearly in parallel up to 0.21.
const SPREAD: f64 = 0.25;

/// Up is +Z, the points' median is the origin, and the cameras' median distance from it is 1.
fn upright(model: &Model, photos: &[PhotoInfo]) -> Alignment {
    let cameras = photos.iter().zip(&model.poses);
    let up = up(cameras.filter_map(|(photo, pose)| Some((pose.as_ref()?.rotation, photo.up))));
    let is_open = photos.iter().all(|photo| photo.up.is_none());
    let up = is_open.then(|| survey(model)).flatten().unwrap_or(up);
    let rotation = DQuat::from_rotation_arc(up, DVec3::Z);
    let middle = |values| median(values).unwrap_or(0.0);
    let center =
        DVec3::from_array([0, 1, 2].map(|axis| middle(model.points.iter().map(|p| p.position[axis]).collect())));
    let distance = middle(
        model
            .poses
            .iter()
            .flatten()
            .map(|p| (p.position - center).length())
            .collect(),
    );
    let scale = if distance > 0.0 { 1.0 / distance } else { 1.0 };
    Alignment {
        scale,
        rotation,
        translation: -scale * (rotation * center),
    }
}

/// Up, if the cameras look straight down as those of a survey do: in one direction, from all over a plane across it, farther apart than anybody's
/// arms who takes a wall. No photograph of it has an up of its own.
fn survey(model: &Model) -> Option<DVec3> {
    let poses: Vec<_> = model.poses.iter().flatten().collect();
    let n = poses.len() as f64;
    let forward = (poses.iter().map(|pose| pose.rotation * DVec3::Z).sum::<DVec3>()).try_normalize()?;
    let off = |pose: &&DPose| (pose.rotation * DVec3::Z).angle_between(forward).to_degrees().powi(2);
    let apart = (poses.iter().map(off).sum::<f64>() / n).sqrt();
    let center = poses.iter().map(|pose| pose.position).sum::<DVec3>() / n;
    let depths = model.points.iter().map(|point| (point.position - center).dot(forward));
    let depth = median(depths.collect())?;
    let across = poses
        .iter()
        .map(|pose| (pose.position - center).reject_from_normalized(forward));
    // The first eigenvalue is that along the views.
    let ([_, narrow, _], _) = symmetric_eigen(scatter(across));
    (apart < PARALLEL && depth > 0.0 && (narrow / n).sqrt() > SPREAD * depth).then_some(-forward)
}

/// The direction up, from the rotation of each camera to the world and the direction up in its own axes, if known: photographs are
/// held level more often than not, so that all their x axes lie in one horizontal plane.
///
/// Its normal is the answer if the x axes leave no doubt about it and it agrees with the mean of the photographs' own up
/// directions; otherwise that mean.
pub(crate) fn up(cameras: impl Iterator<Item = (DQuat, Option<DVec3>)>) -> DVec3 {
    let mut mean = DVec3::ZERO;
    let rights = cameras.map(|(rotation, own)| {
        let own = own.unwrap_or(DVec3::NEG_Y);
        mean += rotation * own;
        rotation * own.cross(DVec3::NEG_Z).normalize_or_zero()
    });
    let (values, vectors) = symmetric_eigen(scatter(rights));
    let mean = mean.normalize_or(DVec3::NEG_Y);
    let normal = DVec3::from_array(vectors[0]);
    let normal = normal * normal.dot(mean).signum();
    // Within 30 degrees, and the second axis at least five times as wide as what is left over.
    if values[1] > 5.0 * values[0] && values[1] > 0.02 * values[2] && normal.dot(mean) > 0.866 {
        normal
    } else {
        mean
    }
}

/// Why photographs are in no model.
pub(super) fn left_out(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    verified: &[VerifiedPair],
    taken: &[bool],
    tried: &[usize],
    options: &MapOptions,
) -> Vec<LeftOut> {
    let reason = |photo: usize| {
        let of = |photos: &[u32; 2]| photos.contains(&(photo as u32));
        let count = features[photo].keypoints.len();
        if count < options.min_inliers {
            return Reason::FewFeatures { features: count };
        }
        let best = pairs
            .iter()
            .filter(|p| of(&p.photos))
            .map(|p| p.matches.len())
            .max()
            .unwrap_or(0);
        if best < options.min_inliers {
            return Reason::FewMatches { best };
        }
        let partners: Vec<&VerifiedPair> = verified.iter().filter(|p| of(&p.photos)).collect();
        if partners.is_empty() {
            return Reason::NoGeometry { best };
        }
        let in_model = partners.iter().any(|p| p.photos.iter().any(|p| taken[*p as usize]));
        if partners.iter().all(|p| p.kind == PairKind::Rotation) {
            return Reason::RotationOnly {
                partners: partners.len(),
            };
        }
        if in_model || tried[photo] > 0 {
            return Reason::NotRegistered {
                partners: partners.len(),
            };
        }
        Reason::NoModel {
            partners: partners.len(),
        }
    };
    (0..photos.len())
        .filter(|p| !taken[*p])
        .map(|photo| LeftOut {
            photo,
            reason: reason(photo),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras on a grid, `step` apart, that look along +Z at points 4 units away.
    fn grid(step: f64) -> Model {
        let places = (0..20).map(|i| DVec3::new(step * f64::from(i % 5), step * f64::from(i / 5), 0.0));
        let pose = |position| DPose {
            rotation: DQuat::from_rotation_y(0.05),
            position,
        };
        let point = |i| ModelPoint {
            position: DVec3::new(f64::from(i), 1.0, 4.0),
            track: Vec::new(),
            error: 0.0,
        };
        Model {
            poses: places.map(|place| Some(pose(place))).collect(),
            points: (0..9).map(point).collect(),
            ..Model::default()
        }
    }

    #[test]
    fn a_survey_looks_down_and_few_steps_before_a_wall_do_not() {
        let up = survey(&grid(1.0)).expect("a survey");
        assert!(up.angle_between(DVec3::NEG_Z) < 0.06, "{up}");
        assert_eq!(survey(&grid(0.5)), None);
        // Around something.
        let mut around = grid(1.0);
        for (i, pose) in around.poses.iter_mut().flatten().enumerate() {
            pose.rotation = DQuat::from_rotation_y(0.1 * i as f64 - 1.0);
        }
        assert_eq!(survey(&around), None);
    }
}
