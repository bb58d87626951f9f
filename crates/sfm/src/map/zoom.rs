//! Detection of photographs of one camera that were zoomed, or cropped and enlarged, without metadata that say so.
//!
//! A model with a single focal length looks sound: cameras move closer instead. But when each photograph is given its own focal length,
//! those of a zoomed capture form two clusters, and the errors fall. The clusters then become separate cameras, and the scene is mapped
//! again. This was measured on seven unmodified captures, and on four of them and a ray-traced ring with half of the photographs enlarged
//! 1.6 times: unmodified, the cost falls by 0 to 7 % and no clusters differ by a ratio of more than 1.1; enlarged, it falls by 5 to 58 %,
//! and the clusters differ by 1.23 to 1.58 before the scene is mapped again.
//!
//! If focal lengths differ from photograph to photograph instead, as in photographs from many cameras scaled to one size, each photograph
//! becomes its own camera. For four captures whose photographs were cropped to 65 to 100 % of their width and scaled back, the cost falls
//! by 35 to 70 % and the focal lengths are 8 to 14 % from their median; for twenty unmodified captures, at most 8 % and 2.3 %.

use super::focal::{FocalSource, are_similar};
use super::observable::determines_focal;
use super::readjust::{self, posed};
use super::types::{GroupCamera, Model, ModelPoint, PhotoInfo, Progress, Reconstruction, Zoom};
use super::{Unverified, map_with_cameras};
use crate::adjust::{AdjustedCamera, Focal, Freedom, Prior};
use crate::geometry::camera::DCamera;
use crate::{Features, median};

/// Minimum number of photographs in a cluster: fewer hardly determine a camera.
const MIN_CLUSTER_PHOTOS: usize = 3;
/// Maximum ratio of the focal lengths of two models: that of a model that follows something moving in front of the scene is arbitrary.
const MAX_FOCAL_RATIO: f64 = 2.5;
/// Minimum number of photographs of a model whose focal length is compared with another model's.
const MIN_COMPARED_PHOTOS: usize = 8;
/// The same, relative to the number in the largest model: for fewer the scene is not mapped again.
const MIN_COMPARED_FRACTION: f64 = 0.1;
/// Minimum ratio of the focal lengths of two clusters.
const MIN_FOCAL_RATIO: f64 = 1.2;
/// Minimum gap between the two clusters, relative to the distance of their medians. Along a drone's film of 90 frames without a zoom,
/// focal lengths drift from 590 to 946 px, and the cost falls by 40 %: split at the 63rd frame, its camera jumps there by 32 times the
/// usual step.
const MIN_CLUSTER_GAP: f64 = 0.25;
/// Maximum mean distance of the photographs from the median of their cluster, relative to the distance of the two medians.
const MAX_CLUSTER_SCATTER: f64 = 0.15;
/// Minimum fraction by which the cost falls with a focal length for each photograph.
const MIN_COST_REDUCTION: f64 = 0.02;
/// Minimum fraction by which the cost falls, and minimum median logarithmic distance of the focal lengths from their median, for each
/// photograph to get its own focal length.
const MIN_OWN_COST_REDUCTION: f64 = 0.25;
const MIN_OWN_FOCAL_DEVIATION: f64 = 0.05;
/// Cost of a change of a focal length by half, as a squared error, px^2.
const PRIOR_COST: f64 = 10.0;
/// Maximum number of zoom settings that are distinguished besides the first.
const MAX_ZOOMS: usize = 3;
/// Maximum number of photographs that are adjusted together with a camera each: their system is dense and takes 250 MB for 400
/// photographs, but 6 GB for 2,000.
const MAX_OWN_CAMERAS: usize = 400;
/// Maximum mean error of a model in which each photograph has its own focal length, relative to that of the model with shared ones.
const MAX_ERROR_RATIO: f64 = 0.8;

/// Maps again with separate cameras for photographs that were zoomed, one setting after the other, or with a camera for each photograph;
/// `found` where there are no such photographs, or where that is no better.
pub(super) fn split_cameras(
    input: &Unverified,
    mut found: Reconstruction,
    progress: &mut dyn FnMut(Progress),
) -> Reconstruction {
    while found.zooms.len() < MAX_ZOOMS {
        let mut grouped = found.regrouped(input.photos);
        let largest = found.models.first();
        let distribution = largest.map(|model| focal_distribution(&grouped, input.features, model));
        let clustered = match distribution {
            Some(FocalDistribution::Own) if found.zooms.is_empty() => {
                return with_own_focals(input, &found, progress).unwrap_or(found);
            }
            Some(FocalDistribution::Clustered(zoom)) => Some(zoom),
            _ => None,
        };
        let Some(zoom) = clustered.or_else(|| between_models(&grouped, &found.models)) else {
            break;
        };
        zoom.regroup(&mut grouped);
        let mut cameras: Vec<_> = found.cameras.iter().copied().map(Some).collect();
        let lens = found.cameras[zoom.previous_group].camera;
        cameras.push(None);
        for (group, focal) in [zoom.previous_group, zoom.group].into_iter().zip(zoom.focals) {
            cameras[group] = Some(lens_like(&lens, [lens.width, lens.height], focal, FocalSource::Pairs));
        }
        let input = Unverified {
            photos: &grouped,
            ..*input
        };
        let again = map_with_cameras(&input, &cameras, progress);
        if again.registered() < found.registered() || !is_distinct(&zoom, &again.models) {
            break;
        }
        let zooms = [std::mem::take(&mut found.zooms), vec![zoom]].concat();
        found = Reconstruction { zooms, ..again };
    }
    found
}

/// Maps again with each photograph as its own camera, starting with the focal length of its camera in `found`; `None` unless the errors
/// fall as much as they do where focal lengths really differ.
fn with_own_focals(
    input: &Unverified,
    found: &Reconstruction,
    progress: &mut dyn FnMut(Progress),
) -> Option<Reconstruction> {
    let shared = found.models.first()?;
    let shared_camera = |photo: &PhotoInfo| {
        let lens = shared.cameras[photo.group].as_ref()?;
        let size = [photo.width, photo.height];
        Some(lens_like(lens, size, lens.focal(), FocalSource::Guess))
    };
    let cameras: Vec<_> = input.photos.iter().map(shared_camera).collect();
    let each = input.photos.iter().cloned().enumerate();
    let each: Vec<PhotoInfo> = each.map(|(group, photo)| PhotoInfo { group, ..photo }).collect();
    let input = Unverified {
        photos: &each,
        ..*input
    };
    let own = map_with_cameras(&input, &cameras, progress);
    let model = own.models.first()?;
    let is_better =
        model.registered() >= shared.registered() && model.mean_error() < MAX_ERROR_RATIO * shared.mean_error();
    is_better.then_some(Reconstruction {
        own_focals: true,
        ..own
    })
}

/// A camera with a focal length of its own, a fisheye if `lens` is one.
fn lens_like(lens: &DCamera, [width, height]: [u32; 2], focal: f64, source: FocalSource) -> GroupCamera {
    let mut of = GroupCamera::centered(width, height, focal, source);
    of.camera.fisheye = lens.fisheye;
    of
}

/// How the focal lengths of a model's photographs are distributed.
enum FocalDistribution {
    /// Photographs of one camera have one focal length.
    Shared,
    /// The photographs of one camera form two clusters: the smaller one becomes a new group.
    Clustered(Zoom),
    /// They differ from photograph to photograph.
    Own,
}

/// The distribution of the focal lengths of a model's photographs when each is given its own.
fn focal_distribution(photos: &[PhotoInfo], features: &[Features], model: &Model) -> FocalDistribution {
    let groups = model.cameras.len();
    let of_group =
        |group: usize| (0..photos.len()).filter(move |p| photos[*p].group == group && model.poses[*p].is_some());
    // A camera that is known exactly has one focal length, such as that of the faces of panoramas.
    let is_known = |group: usize| of_group(group).any(|p| photos[p].camera.is_some());
    let examined: Vec<usize> = (0..groups)
        .filter(|group| of_group(*group).count() >= 2 * MIN_CLUSTER_PHOTOS && !is_known(*group))
        .collect();
    if examined.is_empty() {
        return FocalDistribution::Shared;
    }
    let (focals, cost_reduction) = own_focals(photos, features, model, MAX_OWN_CAMERAS);
    if cost_reduction <= MIN_COST_REDUCTION {
        return FocalDistribution::Shared;
    }
    let sorted = |group: usize| {
        let mut logs: Vec<(f64, usize)> = of_group(group).map(|p| (focals[p].ln(), p)).collect();
        logs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        logs
    };
    let clustered = examined.iter().copied().find_map(|group| {
        let sorted = sorted(group);
        let (split, medians) = clusters(&sorted)?;
        let (short, long) = sorted.split_at(split);
        // The larger cluster keeps the camera.
        let smaller = usize::from(long.len() <= short.len());
        let mut zoomed: Vec<usize> = [short, long][smaller].iter().map(|p| p.1).collect();
        zoomed.sort_unstable();
        Some(Zoom {
            previous_group: group,
            group: groups,
            photos: zoomed,
            focals: [medians[1 - smaller].exp(), medians[smaller].exp()],
        })
    });
    let varies = |group: &usize| {
        let logs = sorted(*group);
        let middle = logs[logs.len() / 2].0;
        median(logs.iter().map(|v| (v.0 - middle).abs()).collect()).is_some_and(|m| m > MIN_OWN_FOCAL_DEVIATION)
    };
    // A lens that is known from metadata or from a rig is not given up.
    let has_no_metadata =
        |photo: &PhotoInfo| photo.focal_prior_px.is_none() && photo.camera.is_none() && photo.mount.is_none();
    match clustered {
        Some(zoom) => FocalDistribution::Clustered(zoom),
        None if cost_reduction > MIN_OWN_COST_REDUCTION
            && photos.iter().all(has_no_metadata)
            && examined.iter().any(varies) =>
        {
            FocalDistribution::Own
        }
        None => FocalDistribution::Shared,
    }
}

/// Photographs of one camera that are in a separate model with another focal length: they were zoomed so far that too few pairs with the
/// others agree with one focal length. `None` if there are none.
fn between_models(photos: &[PhotoInfo], models: &[Model]) -> Option<Zoom> {
    let (first, others) = models.split_first()?;
    let groups = first.cameras.len();
    let mut candidates = others
        .iter()
        .flat_map(|other| (0..groups).map(move |group| (other, group)));
    candidates.find_map(|(other, group)| {
        let focals = [free_focal(first, group)?, free_focal(other, group)?];
        let own = |p: &usize| photos[*p].group == group && other.poses[*p].is_some();
        let zoomed: Vec<usize> = (0..photos.len()).filter(own).collect();
        let log_ratio = (focals[1] / focals[0]).ln().abs();
        let min_photos = MIN_COMPARED_PHOTOS.max((MIN_COMPARED_FRACTION * first.registered() as f64) as usize);
        ((MIN_FOCAL_RATIO.ln()..MAX_FOCAL_RATIO.ln()).contains(&log_ratio) && zoomed.len() >= min_photos).then_some(
            Zoom {
                previous_group: group,
                group: groups,
                photos: zoomed,
                focals,
            },
        )
    })
}

/// Whether a second model, which shares nothing with the first, found the same focal length, and the first determines it, so that it is
/// not merely the initial value of both.
pub(super) fn is_confirmed(photos: &[PhotoInfo], features: &[Features], models: &[Model]) -> bool {
    let Some((first, others)) = models.split_first() else {
        return false;
    };
    let agrees = |group: &usize| {
        let found = free_focal(first, *group);
        let large = others.iter().filter(|other| other.registered() >= MIN_COMPARED_PHOTOS);
        let others = large.filter_map(|other| free_focal(other, *group));
        found.is_some_and(|focal| others.into_iter().any(|other| are_similar(focal, other)))
    };
    let mut groups = 0..first.cameras.len();
    groups.any(|group| agrees(&group) && determines_focal(photos, features, first, group))
}

/// The focal length of a group in a model in which it was free.
fn free_focal(model: &Model, group: usize) -> Option<f64> {
    let camera = model.cameras[group].as_ref().filter(|_| !model.focal_held[group]);
    camera.map(DCamera::focal)
}

/// Whether the focal lengths of both cameras of `zoom` still differ enough in `models`, which were mapped with it.
fn is_distinct(zoom: &Zoom, models: &[Model]) -> bool {
    let focals = [zoom.previous_group, zoom.group].map(|group| camera(models, group).map(DCamera::focal));
    match focals {
        [Some(a), Some(b)] => (b / a).ln().abs() > MIN_FOCAL_RATIO.ln(),
        _ => false,
    }
}

/// The camera of a group in the first model that has one.
pub(super) fn camera(models: &[Model], group: usize) -> Option<&DCamera> {
    models.iter().find_map(|model| model.cameras[group].as_ref())
}

/// The index at which sorted values split into two clusters, and the medians of both; `None` if they do not.
fn clusters(sorted: &[(f64, usize)]) -> Option<(usize, [f64; 2])> {
    let median_of = |part: &[(f64, usize)]| median(part.iter().map(|v| v.0).collect());
    let mut best: Option<(f64, usize, [f64; 2])> = None;
    for split in MIN_CLUSTER_PHOTOS..(sorted.len() + 1).saturating_sub(MIN_CLUSTER_PHOTOS) {
        let (low, high) = sorted.split_at(split);
        let medians = [median_of(low)?, median_of(high)?];
        let deviation = |part: &[(f64, usize)], median: f64| part.iter().map(|v| (v.0 - median).abs()).sum::<f64>();
        let scatter = deviation(low, medians[0]) + deviation(high, medians[1]);
        if best.is_none_or(|(lowest, ..)| scatter < lowest) {
            best = Some((scatter, split, medians));
        }
    }
    let (scatter, split, medians) = best?;
    let distance = medians[1] - medians[0];
    let gap = sorted[split].0 - sorted[split - 1].0;
    let is_clear = gap >= MIN_CLUSTER_GAP * distance && scatter / sorted.len() as f64 <= MAX_CLUSTER_SCATTER * distance;
    (distance > MIN_FOCAL_RATIO.ln() && is_clear).then_some((split, medians))
}

/// `[photos]` the focal length of each photograph, px, if each has its own, and the fraction by which the cost falls. At most
/// `max_cameras` photographs are adjusted at once, evenly spaced, so that each part shows the whole scene.
fn own_focals(photos: &[PhotoInfo], features: &[Features], model: &Model, max_cameras: usize) -> (Vec<f64>, f64) {
    let mut focals = vec![f64::NAN; photos.len()];
    let (mut cost_before, mut cost_after) = (0.0, 0.0);
    let parts = model.registered().div_ceil(max_cameras);
    for first in 0..parts {
        let members: Vec<usize> = posed(model).skip(first).step_by(parts).collect();
        let number = |photo: usize| members.binary_search(&photo);
        let part = part_of(model, |photo| number(photo).is_ok());
        let camera = |photo: usize| model.cameras[photos[photo].group].as_ref();
        let own = |photo: &usize| own_camera(camera(*photo).expect("a posed photograph has a camera"));
        let cameras = members.iter().map(own).collect();
        let mut problem = readjust::problem(photos, features, &part, cameras, |photo| {
            number(photo).expect("only members are posed")
        });
        let report = problem.solve(&readjust::OPTIONS);
        cost_before += report.initial_cost;
        cost_after += report.final_cost;
        for (photo, adjusted) in members.iter().zip(&problem.cameras) {
            focals[*photo] = adjusted.camera.focal();
        }
    }
    (focals, readjust::cost_reduction(cost_before, cost_after))
}

/// The photographs of `model` that are `members`, and the points that two of them see.
fn part_of(model: &Model, is_member: impl Fn(usize) -> bool) -> Model {
    let pose = |photo: usize| model.poses[photo].filter(|_| is_member(photo));
    let point = |point: &ModelPoint| {
        let mut track = point.track.clone();
        track.retain(|(photo, _)| is_member(*photo as usize));
        (track.len() >= 2).then_some(ModelPoint { track, ..*point })
    };
    Model {
        cameras: model.cameras.clone(),
        poses: (0..model.poses.len()).map(pose).collect(),
        points: model.points.iter().filter_map(point).collect(),
        focal_held: model.focal_held.clone(),
    }
}

/// A photograph's own camera, whose focal length is free.
fn own_camera(camera: &DCamera) -> AdjustedCamera {
    let mut prior = Prior::default();
    prior.values[0] = camera.focal();
    prior.weights[0] = PRIOR_COST / (0.5 * camera.focal()).powi(2);
    AdjustedCamera {
        camera: *camera,
        freedom: Freedom {
            focal: Focal::Tied,
            ..Freedom::HELD
        },
        prior,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Keypoint;
    use crate::geometry::pose::DPose;
    use glam::{DQuat, DVec3};
    use irradia_scene::Rng;

    /// The focal length of each of twelve photographs around an object.
    fn zoomed(photo: usize) -> f64 {
        [800.0, 1200.0][photo / 2 % 2]
    }

    /// Those photographs with the features of 80 points, and a model in which they share a focal length of 1,000 px.
    fn two_settings() -> (Vec<PhotoInfo>, Vec<Features>, Model) {
        let mut rng = Rng::new(5, 0);
        let mut uniform = || f64::from(rng.range(-1.5, 1.5));
        let points: Vec<DVec3> = (0..80).map(|_| DVec3::new(uniform(), uniform(), uniform())).collect();
        let poses: Vec<DPose> = (0..12)
            .map(|photo| {
                let rotation = DQuat::from_rotation_y(f64::from(photo) * std::f64::consts::TAU / 12.0);
                let position = rotation * DVec3::new(0.0, 0.4 * f64::from(photo % 3), -5.0);
                DPose { rotation, position }
            })
            .collect();
        let keypoint = |photo: usize, point: &DVec3| {
            let camera = DCamera::centered(1000, 1000, zoomed(photo));
            let at = camera.pixel(poses[photo].camera_from_world(*point));
            Keypoint {
                x: at.x as f32,
                y: at.y as f32,
                scale: 2.0,
                angle: 0.0,
            }
        };
        let of_photo = |photo: usize| Features {
            keypoints: points.iter().map(|point| keypoint(photo, point)).collect(),
            ..Features::default()
        };
        let features = (0..12).map(of_photo).collect();
        let photo = PhotoInfo::new(String::new(), 1000, 1000);
        let seen = points.iter().enumerate().map(|(i, position)| ModelPoint {
            position: *position,
            track: (0..12).map(|photo| (photo, i as u32)).collect(),
            error: 0.0,
        });
        let model = Model {
            cameras: vec![Some(DCamera::centered(1000, 1000, 1000.0))],
            points: seen.collect(),
            poses: poses.iter().copied().map(Some).collect(),
            focal_held: vec![false],
        };
        (vec![photo; 12], features, model)
    }

    #[test]
    fn focal_lengths_are_found_in_parts_as_in_one_adjustment() {
        let (photos, features, model) = two_settings();
        for max_cameras in [12, 6] {
            let (focals, cost_reduction) = own_focals(&photos, &features, &model, max_cameras);
            assert!(cost_reduction > 0.9, "{max_cameras}: {cost_reduction}");
            for (i, focal) in focals.into_iter().enumerate() {
                // The prior of the shared focal length is weak: 5 % tells the two settings apart.
                assert!((focal / zoomed(i) - 1.0).abs() < 0.05, "{max_cameras}: {i} {focal}");
            }
        }
    }

    #[test]
    fn a_camera_that_is_known_is_not_divided() {
        let (mut photos, features, model) = two_settings();
        let found = focal_distribution(&photos, &features, &model);
        assert!(matches!(found, FocalDistribution::Clustered(_)));
        photos.iter_mut().for_each(|photo| photo.camera = model.cameras[0]);
        let found = focal_distribution(&photos, &features, &model);
        assert!(matches!(found, FocalDistribution::Shared));
    }

    #[test]
    fn two_clear_clusters_part_and_nothing_else_does() {
        let of = |values: &[f64]| {
            let mut sorted: Vec<(f64, usize)> = values.iter().enumerate().map(|(i, v)| (v.ln(), i)).collect();
            sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
            clusters(&sorted).map(|(split, medians)| (split, medians.map(|m| m.exp().round())))
        };
        assert_eq!(
            of(&[500.0, 800.0, 505.0, 790.0, 495.0, 810.0, 500.0]),
            Some((4, [500.0, 800.0]))
        );
        // A single setting that is poorly determined, too few photographs of another one, and a zoom that never rests.
        assert_eq!(of(&[500.0, 510.0, 470.0, 540.0, 530.0, 505.0]), None);
        assert_eq!(of(&[500.0, 501.0, 502.0, 499.0, 800.0, 500.0]), None);
        assert_eq!(of(&[500.0, 540.0, 580.0, 620.0, 660.0, 700.0, 740.0, 780.0]), None);
        assert_eq!(of(&[500.0, 800.0]), None);
        let drifting: Vec<f64> = (0..90_i32)
            .map(|i| 600.0 + 0.15 * f64::from((i - 30).max(0)).powi(2).min(2200.0))
            .collect();
        assert_eq!(of(&drifting), None);
    }
}
