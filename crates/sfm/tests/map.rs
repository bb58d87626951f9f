//! The mapper on synthetic worlds with known cameras.

use glam::{DQuat, DVec2, DVec3};
use irradia_scene::Rng;
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::{MapOptions, Model, PairKind, PhotoInfo, Reason, Reconstruction, reconstruct};
use irradia_sfm::{Features, Keypoint, PairMatches};

/// Photographs, features and matches with known cameras.
#[derive(Default)]
struct World {
    photos: Vec<PhotoInfo>,
    features: Vec<Features>,
    pairs: Vec<PairMatches>,
    poses: Vec<DPose>,
}

const CAMERA: DCamera = DCamera {
    width: 1000,
    height: 750,
    parameters: [870.0, 870.0, 500.0, 375.0, 0.06, -0.04, 0.0, 0.0],
};

/// A pose at `eye` that looks at `target`; +Z is up.
fn look(eye: DVec3, target: DVec3) -> DPose {
    let forward = (target - eye).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DQuat::from_mat3(&glam::DMat3::from_cols(right, forward.cross(right), forward));
    DPose {
        rotation,
        position: eye,
    }
}

/// A turn of `photos` cameras around the origin.
fn around(photos: usize, turns: f64) -> Vec<DPose> {
    (0..photos)
        .map(|i| {
            let angle = std::f64::consts::TAU * turns * i as f64 / photos as f64;
            let eye = DVec3::new(5.0 * angle.cos(), 5.0 * angle.sin(), 1.5 + (3.0 * angle).sin());
            look(
                eye,
                DVec3::new(0.1 * (7.0 * angle).sin(), 0.1 * (5.0 * angle).cos(), 0.0),
            )
        })
        .collect()
}

impl World {
    /// Points in a cube of side 5, each seen by those of `poses` it faces, with noise of `noise` px and a fraction `wrong` of
    /// wrong matches.
    fn new(poses: Vec<DPose>, points: usize, noise: f64, wrong: f64, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 1);
        let mut uniform = move || f64::from(rng.range(-1.0, 1.0));
        let mut direction = move || DVec3::new(uniform(), uniform(), uniform());
        // Position and the direction in which a point faces.
        let points: Vec<(DVec3, DVec3)> = (0..points)
            .map(|_| (2.5 * direction(), direction().normalize()))
            .collect();
        let mut world = Self {
            poses,
            ..Self::default()
        };
        // The point of each keypoint.
        let mut shown: Vec<Vec<usize>> = Vec::new();
        let mut rng = Rng::new(seed, 2);
        for (i, pose) in world.poses.iter().enumerate() {
            let mut keypoints = Vec::new();
            let mut here = Vec::new();
            let mut order: Vec<usize> = (0..points.len()).collect();
            rng.shuffle(&mut order);
            for point in order {
                let (place, normal) = points[point];
                let p = pose.camera_from_world(place);
                let facing = (pose.position - place).normalize().dot(normal);
                if p.z < 0.1 || facing < 0.35 || rng.uniform() < 0.2 {
                    continue;
                }
                let at = CAMERA.pixel(p) + noise * DVec2::new(f64::from(rng.normal()), f64::from(rng.normal()));
                if at.x < 0.0 || at.y < 0.0 || at.x > 1000.0 || at.y > 750.0 {
                    continue;
                }
                keypoints.push(Keypoint {
                    x: at.x as f32,
                    y: at.y as f32,
                    scale: 2.0,
                    angle: 0.0,
                });
                here.push(point);
            }
            shown.push(here);
            world.features.push(Features {
                keypoints,
                descriptors: Vec::new(),
            });
            world.photos.push(PhotoInfo {
                name: format!("{i:03}.jpg"),
                width: CAMERA.width,
                height: CAMERA.height,
                group: 0,
                focal_prior_px: None,
                up: None,
            });
        }
        for a in 0..shown.len() {
            for b in a + 1..shown.len() {
                let mut matches: Vec<[u32; 2]> = Vec::new();
                let mut free_b = vec![true; shown[b].len()];
                let mut place_b = vec![None; points.len()];
                shown[b]
                    .iter()
                    .enumerate()
                    .for_each(|(j, point)| place_b[*point] = Some(j));
                for (i, point) in shown[a].iter().enumerate() {
                    let right = place_b[*point];
                    let chance = rng.below(shown[b].len().max(1) as u32) as usize;
                    let j = if f64::from(rng.uniform()) < wrong {
                        Some(chance)
                    } else {
                        right
                    };
                    if let Some(j) = j
                        && j < free_b.len()
                        && free_b[j]
                    {
                        free_b[j] = false;
                        matches.push([i as u32, j as u32]);
                    }
                }
                if matches.len() >= 8 {
                    world.pairs.push(PairMatches {
                        photos: [a as u32, b as u32],
                        matches,
                    });
                }
            }
        }
        world
    }

    /// Both worlds, without matches between them; the second is another camera.
    fn and(mut self, other: Self) -> Self {
        let shift = self.photos.len() as u32;
        self.photos
            .extend(other.photos.into_iter().map(|p| PhotoInfo { group: 1, ..p }));
        self.features.extend(other.features);
        self.poses.extend(other.poses);
        self.pairs.extend(other.pairs.into_iter().map(|p| PairMatches {
            photos: p.photos.map(|p| p + shift),
            matches: p.matches,
        }));
        self
    }

    fn map(&self) -> Reconstruction {
        reconstruct(
            &self.photos,
            &self.features,
            &self.pairs,
            &MapOptions::default(),
            &mut |_| (),
        )
    }

    /// The area under the recall curve of relative poses up to `degrees`, in percent: errors of rotation and of the direction
    /// of translation, the larger of both; a pair with an unregistered photograph is wrong.
    fn auc(&self, model: &Model, degrees: f64) -> f64 {
        let mut errors = Vec::new();
        for a in 0..self.poses.len() {
            for b in a + 1..self.poses.len() {
                let (Some(found_a), Some(found_b)) = (model.poses[a], model.poses[b]) else {
                    errors.push(f64::INFINITY);
                    continue;
                };
                let relative =
                    |a: &DPose, b: &DPose| (b.rotation.inverse() * a.rotation, b.camera_from_world(a.position));
                let (truth, found) = (relative(&self.poses[a], &self.poses[b]), relative(&found_a, &found_b));
                let turn = 2.0 * (truth.0.inverse() * found.0).w.abs().min(1.0).acos();
                errors.push(turn.max(truth.1.angle_between(found.1)).to_degrees());
            }
        }
        100.0 * errors.iter().map(|e| (1.0 - e / degrees).max(0.0)).sum::<f64>() / errors.len() as f64
    }
}

#[test]
fn cameras_return_from_noise_wrong_matches_and_an_unknown_lens() {
    let world = World::new(around(24, 1.0), 3000, 0.5, 0.3, 1);
    let result = world.map();
    assert_eq!(result.models.len(), 1);
    let model = &result.models[0];
    assert_eq!(model.registered(), 24);
    assert!(
        world.auc(model, 1.0) > 95.0 && world.auc(model, 5.0) > 99.0,
        "{}",
        world.auc(model, 1.0)
    );
    let camera = model.cameras[0].expect("registered");
    assert!((camera.focal() / 870.0 - 1.0).abs() < 0.005, "{camera:?}");
    assert!((camera.parameters[4] - 0.06).abs() < 0.02, "{camera:?}");
    // Noise of 0.5 px on both axes has a mean length of 0.63 px.
    assert!((0.5..0.7).contains(&model.mean_error()), "{}", model.mean_error());
    // Wrong matches that happen to agree with the geometry are few.
    assert!(model.points.len() < 3300, "{}", model.points.len());
    // Upright and centred: cameras above the points on average, the middle of the sphere near the origin.
    let mean = model.poses.iter().flatten().map(|p| p.position).sum::<DVec3>() / 24.0;
    assert!(mean.z > 0.2 && mean.truncate().length() < 0.1, "{mean}");
    let up = model
        .poses
        .iter()
        .flatten()
        .map(|p| (p.rotation * DVec3::NEG_Y).z)
        .fold(f64::INFINITY, f64::min);
    assert!(up > 0.5, "{up}");
    for point in &model.points {
        assert!(point.track.len() >= 2 && point.track.is_sorted() && point.error < 4.0);
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let world = World::new(around(8, 0.3), 400, 0.5, 0.2, 2);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("a pool");
        format!("{:?}", pool.install(|| world.map()))
    };
    let one = run(1);
    assert!(one == run(3), "the reconstruction depends on the number of threads");
    assert!(one.contains("ModelPoint"));
}

#[test]
fn two_scenes_give_two_models() {
    let world = World::new(around(10, 0.4), 500, 0.5, 0.2, 3).and(World::new(around(6, 0.3), 500, 0.5, 0.2, 4));
    let result = world.map();
    let sizes: Vec<usize> = result.models.iter().map(Model::registered).collect();
    assert_eq!(sizes, [10, 6]);
    assert!(result.models[0].poses[10..].iter().all(Option::is_none) && result.left_out.is_empty());
    assert!(result.models[0].cameras[1].is_none() && result.models[1].cameras[1].is_some());
}

#[test]
fn turning_on_the_spot_gives_no_model_and_says_why() {
    let poses = around(8, 0.0)
        .into_iter()
        .enumerate()
        .map(|(i, pose)| DPose {
            rotation: pose.rotation * DQuat::from_rotation_y(0.05 * i as f64),
            ..pose
        })
        .collect();
    let result = World::new(poses, 800, 0.3, 0.1, 5).map();
    assert!(result.models.is_empty());
    assert!(!result.pairs.is_empty() && result.pairs.iter().all(|p| p.kind == PairKind::Rotation));
    assert_eq!(result.left_out.len(), 8);
    for left in &result.left_out {
        assert!(
            matches!(left.reason, Reason::RotationOnly { partners } if partners > 3),
            "{:?}",
            left.reason
        );
        assert!(left.reason.to_string().contains("same place"));
    }
}

#[test]
fn a_photograph_that_was_turned_on_the_spot_joins_the_others() {
    let mut poses = around(8, 0.3);
    let last = poses[7];
    poses.push(DPose {
        rotation: last.rotation * DQuat::from_rotation_z(0.3),
        ..last
    });
    let world = World::new(poses, 600, 0.4, 0.2, 6);
    let result = world.map();
    assert_eq!(result.models[0].registered(), 9);
    assert!(
        result
            .pairs
            .iter()
            .any(|p| p.photos == [7, 8] && p.kind == PairKind::Rotation)
    );
    assert!(
        world.auc(&result.models[0], 5.0) > 85.0,
        "{}",
        world.auc(&result.models[0], 5.0)
    );
}

#[test]
fn metadata_are_checked_against_the_photographs() {
    let mut world = World::new(around(10, 0.5), 600, 0.5, 0.2, 7);
    for prior in [880.0, 3480.0] {
        world.photos.iter_mut().for_each(|p| p.focal_prior_px = Some(prior));
        let result = world.map();
        assert_eq!(result.models[0].registered(), 10);
        let focal = result.models[0].cameras[0].expect("registered").focal();
        assert!((focal / 870.0 - 1.0).abs() < 0.03, "{prior} {focal}");
    }
}

#[test]
fn too_little_has_one_clear_outcome() {
    let none = reconstruct(&[], &[], &[], &MapOptions::default(), &mut |_| ());
    assert_eq!(none, Reconstruction::default());
    let mut world = World::new(around(2, 0.05), 300, 0.5, 0.0, 8);
    let two = world.map();
    assert!(two.models.is_empty());
    assert_eq!(
        two.left_out.iter().map(|l| l.reason).collect::<Vec<_>>(),
        [Reason::NoModel { partners: 1 }; 2]
    );
    // One photograph twice: no motion at all.
    world.features[1] = world.features[0].clone();
    world.pairs[0].matches = (0..world.features[0].keypoints.len() as u32).map(|i| [i, i]).collect();
    let twice = world.map();
    assert!(twice.models.is_empty());
    assert_eq!(twice.left_out[0].reason, Reason::RotationOnly { partners: 1 });
    world.pairs.clear();
    assert_eq!(world.map().left_out[1].reason, Reason::FewMatches { best: 0 });
    world.features[0] = Features::default();
    assert_eq!(world.map().left_out[0].reason, Reason::FewFeatures { features: 0 });
}

#[test]
fn poison_in_keypoints_and_metadata_does_no_harm() {
    let mut world = World::new(around(8, 0.3), 400, 0.5, 0.1, 9);
    for (i, keypoint) in world.features[3].keypoints.iter_mut().enumerate().take(30) {
        keypoint.x = [f32::NAN, f32::INFINITY, -1e30][i % 3];
    }
    world.photos[2].focal_prior_px = Some(f64::NAN);
    world.photos[4].focal_prior_px = Some(0.0);
    let result = world.map();
    assert_eq!(result.models[0].registered(), 8);
    assert!(
        world.auc(&result.models[0], 5.0) > 90.0,
        "{}",
        world.auc(&result.models[0], 5.0)
    );
    assert!(
        result.models[0]
            .points
            .iter()
            .all(|p| p.position.is_finite() && p.error.is_finite())
    );
}
