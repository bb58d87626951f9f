//! The final result: an upright, centred model, and a reason for each photograph that is in no model.

use super::model::GrowingModel;
use super::types::{LeftOut, Model, ModelPoint, PairKind, PhotoInfo, Reason, VerifiedPair};
use super::{Input, Unverified};
use crate::PairMatches;
use crate::geometry::align::Alignment;
use crate::upright::up;
use glam::{DQuat, DVec3};
use irradia_scene::survey;

/// The model in its final, upright world.
pub(super) fn finish(growing: &GrowingModel, photos: &[PhotoInfo]) -> Model {
    extract_model(growing).upright(photos)
}

impl Model {
    /// The model, which may be in the world of known poses, in one in which +Z is up as far as `photos` show it, the origin is the centre
    /// of the scene, and the cameras' distance from it is about 1.
    pub fn upright(mut self, photos: &[PhotoInfo]) -> Self {
        self.align(&upright(&self, photos));
        self
    }
}

/// The model in the world in which it grew.
pub(super) fn extract_model(growing: &GrowingModel) -> Model {
    let mut model = Model {
        cameras: Vec::new(),
        poses: growing.poses.clone(),
        points: Vec::new(),
        focal_held: growing.focal_held.clone(),
    };
    for (group, camera) in growing.cameras.iter().enumerate() {
        let is_present = growing.registered_in_group(group) > 0;
        model.cameras.push(is_present.then_some(*camera));
    }
    for track in growing.triangulated_tracks() {
        let position = growing.points[track].expect("listed");
        let used: Vec<usize> = growing.tracks.range(track).filter(|o| growing.used[*o]).collect();
        let errors = used
            .iter()
            .filter_map(|o| Some(growing.view_ray(*o)?.error_squared(position).sqrt()));
        model.points.push(ModelPoint {
            position,
            error: errors.sum::<f64>() / used.len() as f64,
            track: used
                .iter()
                .map(|o| {
                    let observation = growing.tracks.observations[*o];
                    (observation.photo, observation.keypoint)
                })
                .collect(),
        });
    }
    model
}

/// The alignment to a world in which +Z is up, the points' median is the origin and the cameras' median distance from it is 1.
fn upright(model: &Model, photos: &[PhotoInfo]) -> Alignment {
    let cameras = photos.iter().zip(&model.poses);
    let mean_up = || up(cameras.filter_map(|(photo, pose)| Some((pose.as_ref()?.rotation, photo.up))));
    let poses = model.poses.iter().flatten().map(|pose| (pose.rotation, pose.position));
    let poses: Vec<(DQuat, DVec3)> = poses.collect();
    let points = model.points.iter().map(|point| point.position);
    let is_up_unknown = photos.iter().all(|photo| photo.up.is_none());
    let survey = survey(&poses, points).filter(|_| is_up_unknown);
    let up = survey.map_or_else(mean_up, |survey| survey.up);
    let rotation = DQuat::from_rotation_arc(up, DVec3::Z);
    let (center, radius) = model.center_and_radius();
    let scale = if radius > 0.0 { 1.0 / radius } else { 1.0 };
    Alignment {
        scale,
        rotation,
        translation: -scale * (rotation * center),
    }
}

/// Photographs that are in no model, with the reasons.
pub(super) fn left_out(
    input: &Input,
    unverified: &Unverified,
    assigned: &[bool],
    failed_registrations: &[usize],
) -> Vec<LeftOut> {
    let Input {
        photos,
        features,
        pairs,
        options,
        ..
    } = *input;
    let reason = |photo: usize| {
        let of = |photos: &[u32; 2]| photos.contains(&(photo as u32));
        let count = features[photo].keypoints.len();
        if count < options.min_inliers {
            return Reason::FewFeatures { features: count };
        }
        let best_of = |pairs: &[PairMatches]| {
            let counts = pairs.iter().filter(|p| of(&p.photos)).map(|p| p.matches.len());
            counts.max().unwrap_or(0)
        };
        let [best, with_still] = [unverified.pairs, unverified.with_still].map(best_of);
        if with_still < options.min_inliers {
            return Reason::FewMatches { best: with_still };
        }
        if best < options.min_inliers {
            return Reason::StandsStill { best: with_still };
        }
        let partners: Vec<&VerifiedPair> = pairs.iter().filter(|p| of(&p.photos)).collect();
        if partners.is_empty() {
            return Reason::NoGeometry { best };
        }
        let in_model = partners.iter().any(|p| p.photos.iter().any(|p| assigned[*p as usize]));
        if partners.iter().all(|p| p.kind == PairKind::Rotation) {
            return Reason::RotationOnly {
                partners: partners.len(),
            };
        }
        if in_model || failed_registrations[photo] > 0 {
            return Reason::NotRegistered {
                partners: partners.len(),
            };
        }
        Reason::NoModel {
            partners: partners.len(),
        }
    };
    (0..photos.len())
        .filter(|p| !assigned[*p])
        .map(|photo| LeftOut {
            photo,
            reason: reason(photo),
        })
        .collect()
}
