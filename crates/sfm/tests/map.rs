//! The mapper on synthetic worlds with known cameras.

mod world;

use glam::{DQuat, DVec3};
use irradia_scene::Rng;
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::{
    Distance, FocalSource, KnownGeometry, MapOptions, Model, ModelPoint, PairKind, PhotoInfo, Reason, Reconstruction,
    RigMount, add_guided_points, agreement, complete, determines_focal, duplicate_pairs, extend, find_still_region,
    reconstruct, scale_to_distances, verify,
};
use irradia_sfm::{DESCRIPTOR_BYTES, Features, Keypoint, PairMatches};
use std::f64::consts::{FRAC_PI_2, PI};
use world::{CAMERA, World, around, look};

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
    assert_eq!(
        camera.parameters[2..4],
        [500.0, 375.0],
        "nothing asks for another principal point"
    );
    // Noise of 0.5 px on both axes has a mean length of 0.63 px.
    assert!((0.5..0.7).contains(&model.mean_error()), "{}", model.mean_error());
    // Wrong matches that happen to agree with the geometry are few.
    assert!(model.points.len() < 3300, "{}", model.points.len());
    // The model is upright and centred: cameras are above the points on average, and the centre of their ring is near the origin.
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
fn photographs_are_registered_into_a_known_model_that_stays_as_it_is() {
    let mut world = World::new(around(24, 1.0), 2000, 0.5, 0.3, 4);
    // The last photographs are from another camera.
    for photo in &mut world.photos[20..] {
        photo.group = 1;
    }
    let known = KnownGeometry {
        poses: (0..24).map(|i| (i < 16).then_some(world.poses[i])).collect(),
        cameras: vec![Some(world::CAMERA), None],
    };
    let result = world.extend(&known);
    let model = &result.models[0];
    assert_eq!(model.registered(), 24);
    assert!(model.poses[..16] == known.poses[..16] && model.cameras[0] == known.cameras[0]);
    // The model is in the world of the known poses: positions agree, not only relative poses.
    for (found, truth) in model.poses.iter().flatten().zip(&world.poses) {
        assert!((found.position - truth.position).length() < 0.03, "{found:?} {truth:?}");
    }
    let focal = model.cameras[1].expect("registered").focal();
    assert!((focal / 870.0 - 1.0).abs() < 0.02, "{focal}");
    // A camera that is known exactly stays as it is, also without a known pose.
    for photo in &mut world.photos[20..] {
        photo.camera = Some(world::CAMERA);
    }
    let model = &world.extend(&known).models[0];
    assert_eq!(model.registered(), 24);
    assert_eq!(model.cameras[1], Some(world::CAMERA));
}

#[test]
fn a_model_is_completed_and_another_beside_it_stays() {
    let world = World::new(around(24, 1.0), 2000, 0.5, 0.3, 4);
    // Pairs within each of three parts, and between the third and the first.
    let part = |photo: u32| [16, 20, 24].iter().position(|end| photo < *end).expect("a part");
    let pairs = |keep: &dyn Fn([usize; 2]) -> bool| -> Vec<PairMatches> {
        let kept = world.pairs.iter().filter(|pair| keep(pair.photos.map(part)));
        kept.cloned().collect()
    };
    let apart = pairs(&|[a, b]| a == b && a < 2);
    let joined = pairs(&|[a, b]| a == b || [a, b] == [0, 2]);
    let options = MapOptions::default();
    let mut first = reconstruct(&world.photos, &world.features, &apart, &options, &mut |_| ());
    first.models[0].focal_held = vec![true];
    let sizes = |found: &Reconstruction| found.models.iter().map(Model::registered).collect::<Vec<_>>();
    assert_eq!((sizes(&first), first.left_out.len()), (vec![16, 4], 4));
    let completed = complete(&world.photos, &world.features, &joined, &first, &options, &mut |_| ());
    assert_eq!((sizes(&completed), completed.left_out.len()), (vec![20, 4], 0));
    let [before, after] = [&first, &completed].map(|found| &found.models[0]);
    assert!(before.poses[..16] == after.poses[..16] && before.cameras == after.cameras);
    assert_eq!(before.focal_held, after.focal_held);
    assert!(completed.models[1] == first.models[1]);
    let source = |found: &Reconstruction| found.cameras[0].source;
    assert_eq!([&first, &completed].map(source), [FocalSource::Guess; 2]);
    let seen = World {
        poses: world.poses[..16].iter().chain(&world.poses[20..]).copied().collect(),
        ..world
    };
    let found = Model {
        poses: after.poses[..16].iter().chain(&after.poses[20..]).copied().collect(),
        ..after.clone()
    };
    assert!(seen.auc(&found, 1.0) > 90.0, "{}", seen.auc(&found, 1.0));
}

/// A wide lens whose photographs bend inwards.
const DISTORTING: DCamera = DCamera {
    parameters: [600.0, 600.0, 500.0, 375.0, -0.25, 0.06, 0.0, 0.0],
    ..CAMERA
};

/// A wavy wall in front of `photos` cameras 9 degrees apart, on which each descriptor is shared by four points far from each other: its
/// points, its photographs with their features, and the point of each keypoint.
fn repetitive_wall(photos: usize, camera: DCamera) -> (Vec<DVec3>, Vec<PhotoInfo>, Vec<Features>, Vec<Vec<usize>>) {
    let mut rng = Rng::new(5, 0);
    let wall: Vec<DVec3> = (0..400)
        .map(|_| {
            let [y, z] = [0, 1].map(|_| f64::from(rng.range(-2.0, 2.0)));
            DVec3::new(0.2 * (2.0 * y).sin(), y, z)
        })
        .collect();
    let looks: Vec<[u8; DESCRIPTOR_BYTES]> = (0..100)
        .map(|_| {
            let values: Vec<f32> = (0..DESCRIPTOR_BYTES).map(|_| rng.uniform().powi(3)).collect();
            let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
            std::array::from_fn(|i| (512.0 * values[i] / length).round().min(255.0) as u8)
        })
        .collect();
    let (mut features, mut shown) = (Vec::new(), Vec::new());
    for pose in &around(40, 1.0)[..photos] {
        let here: Vec<usize> = (0..wall.len()).filter(|_| rng.uniform() < 0.8).collect();
        let place = |point: &usize| {
            let at = camera.pixel(pose.camera_from_world(wall[*point]));
            let mut noise = || 0.3 * rng.normal();
            Keypoint {
                x: at.x as f32 + noise(),
                y: at.y as f32 + noise(),
                scale: 2.0,
                angle: 0.0,
            }
        };
        features.push(Features {
            keypoints: here.iter().map(place).collect(),
            descriptors: here.iter().map(|point| looks[point % looks.len()]).collect(),
            frontal: Vec::new(),
        });
        shown.push(here);
    }
    (wall, vec![photo(); photos], features, shown)
}

/// A photograph by a known camera.
fn photo() -> PhotoInfo {
    PhotoInfo {
        camera: Some(CAMERA),
        ..PhotoInfo::new(String::new(), CAMERA.width, CAMERA.height)
    }
}

#[test]
fn a_verified_pair_gains_the_look_alikes_along_its_lines() {
    for camera in [CAMERA, DISTORTING] {
        let (_, photos, features, shown) = repetitive_wall(2, camera);
        let right = |[i, j]: &[u32; 2]| shown[0][*i as usize] == shown[1][*j as usize];
        let all: Vec<[u32; 2]> = (0..shown[0].len() as u32)
            .flat_map(|i| (0..shown[1].len() as u32).map(move |j| [i, j]))
            .filter(right)
            .collect();
        let pairs = [PairMatches {
            photos: [0, 1],
            matches: all.iter().step_by(8).copied().collect(),
        }];
        // The weaker lens is not known.
        let known = KnownGeometry {
            poses: vec![None; 2],
            cameras: vec![Some(camera)],
        };
        let matches = |guided: bool| {
            let options = MapOptions {
                guided,
                ..MapOptions::default()
            };
            let mut verified = if camera == CAMERA {
                verify(&photos, &features, &pairs, &options, &mut |_| ()).1
            } else {
                extend(&photos, &features, &pairs, &known, &options, &mut |_| ()).pairs
            };
            verified.remove(0).matches
        };
        let (given, guided) = (matches(false), matches(true));
        assert!(given.len() <= pairs[0].matches.len());
        let right = guided.iter().filter(|pair| right(pair)).count();
        assert!(
            right > 5 * given.len() && 20 * right > 19 * guided.len(),
            "{right} of {} are right, {} without lines",
            guided.len(),
            given.len()
        );
    }
}

#[test]
fn matches_in_the_corners_of_a_known_distorting_lens_are_kept() {
    let mut rng = Rng::new(6, 1);
    let mut direction = move || DVec3::from_array([0; 3].map(|_| f64::from(rng.range(-1.0, 1.0))));
    let points: Vec<(DVec3, DVec3)> = (0..1000)
        .map(|_| (4.0 * direction(), direction().normalize()))
        .collect();
    let world = World::of_points(DISTORTING, around(6, 0.2), &points, 0, 0.3, 0.0, 6);
    let known = KnownGeometry {
        poses: vec![None; 6],
        cameras: vec![Some(DISTORTING)],
    };
    let result = world.extend(&known);
    let kept: usize = result.pairs.iter().map(|pair| pair.matches.len()).sum();
    let all: usize = world.pairs.iter().map(|pair| pair.matches.len()).sum();
    assert!(20 * kept > 19 * all, "{kept} of {all}");
}

#[test]
fn look_alikes_match_along_the_lines_of_known_poses() {
    let (wall, photos, features, shown) = repetitive_wall(6, CAMERA);
    let known = ModelPoint {
        position: DVec3::new(9.0, 9.0, 9.0),
        error: 0.5,
        track: vec![(0, 3), (1, 7)],
    };
    let before = Model {
        cameras: vec![Some(CAMERA)],
        poses: around(40, 1.0)[..6].iter().copied().map(Some).collect(),
        points: vec![known],
        focal_held: vec![true],
    };
    let mut model = before.clone();
    add_guided_points(&photos, &features, &[], &mut model, &MapOptions::default());
    assert!(model.poses == before.poses && model.cameras == before.cameras);
    let truth = |(photo, keypoint): &(u32, u32)| shown[*photo as usize][*keypoint as usize];
    let right = |point: &&ModelPoint| {
        let of = truth(&point.track[0]);
        point.track.iter().all(|seen| truth(seen) == of) && point.position.distance(wall[of]) < 0.05
    };
    let right = model.points.iter().filter(right).count();
    assert!(
        right > 300 && right + 8 > model.points.len(),
        "{right} of {}",
        model.points.len()
    );
    let of_two = model.points.iter().filter(|point| point.track.len() == 2).count();
    assert!(of_two > 5, "{of_two}");
    let mut observations: Vec<(u32, u32)> = model.points.iter().flat_map(|point| point.track.clone()).collect();
    let all = observations.len();
    observations.sort_unstable();
    observations.dedup();
    assert_eq!(observations.len(), all, "an observation is of one point");

    // Without a third photograph, look-alikes on a line cannot be told apart.
    let mut two = Model {
        poses: before.poses[..2].to_vec(),
        ..before.clone()
    };
    add_guided_points(&photos[..2], &features[..2], &[], &mut two, &MapOptions::default());
    assert_eq!(two.points, before.points);
}

/// A world in which every photograph has the same `still` keypoints at the same positions, matched in all pairs.
fn world_with_still_points(still: usize) -> World {
    let mut world = World::new(around(24, 1.0), 1500, 0.5, 0.2, 1);
    let mut rng = Rng::new(11, 0);
    let [width, height] = [CAMERA.width, CAMERA.height].map(|side| side as f32);
    let still_points: Vec<Keypoint> = (0..still)
        .map(|_| Keypoint {
            x: rng.range(0.0, width),
            y: rng.range(0.0, height),
            scale: 2.0,
            angle: 0.0,
        })
        .collect();
    let first: Vec<u32> = world.features.iter().map(|of| of.keypoints.len() as u32).collect();
    for features in &mut world.features {
        features.keypoints.extend(&still_points);
        features.descriptors.extend(vec![[0; DESCRIPTOR_BYTES]; still]);
    }
    for pair in &mut world.pairs {
        let [a, b] = pair.photos.map(|photo| first[photo as usize]);
        pair.matches.extend((0..still as u32).map(|i| [a + i, b + i]));
    }
    world
}

#[test]
fn poses_follow_what_moves_and_not_what_stands_still() {
    let world = world_with_still_points(400);
    let most = world.pairs.iter().filter(|pair| pair.matches.len() < 800).count();
    assert!(2 * most > world.pairs.len(), "most matches stand still in most pairs");
    let found = find_still_region(&world.photos, &world.features, &world.pairs).expect("400 keypoints stand still");
    assert!(found.fraction > 0.5, "{found:?}");
    let result = world.map();
    let model = &result.models[0];
    assert_eq!(model.registered(), 24);
    assert!(world.auc(model, 1.0) > 90.0, "{}", world.auc(model, 1.0));
    let clean = world_with_still_points(0);
    assert_eq!(find_still_region(&clean.photos, &clean.features, &clean.pairs), None);
    assert!(duplicate_pairs(&clean.photos, &clean.features, &clean.pairs).is_empty());
}

/// For cameras that only move sideways, another focal length is equivalent to another depth.
#[test]
fn cameras_that_turn_determine_a_focal_length() {
    for turn in [true, false] {
        let mut rng = Rng::new(7, 0);
        let mut within = |range: f32| f64::from(rng.range(-range, range));
        let wall: Vec<DVec3> = (0..300)
            .map(|_| {
                let [y, z] = [within(2.0), within(2.0)];
                DVec3::new(4.0 + 0.5 * (3.0 * y).sin() * z, y, z)
            })
            .collect();
        let poses: Vec<DPose> = (0..8)
            .map(|_| {
                let eye = DVec3::new(0.0, within(1.0), within(1.0));
                look(eye, if turn { 4.0 * DVec3::X } else { eye + DVec3::X })
            })
            .collect();
        let mut keypoint = |pose: &DPose, point: &DVec3| {
            let at = CAMERA.pixel(pose.camera_from_world(*point)).as_vec2();
            let [x, y] = [at.x, at.y].map(|v| v + within(0.5) as f32);
            Keypoint {
                x,
                y,
                scale: 2.0,
                angle: 0.0,
            }
        };
        let features: Vec<Features> = poses
            .iter()
            .map(|pose| Features {
                keypoints: wall.iter().map(|point| keypoint(pose, point)).collect(),
                ..Features::default()
            })
            .collect();
        let track = |point: u32| (0..poses.len() as u32).map(|photo| (photo, point)).collect();
        let points = (0..).zip(&wall).map(|(i, position)| ModelPoint {
            position: *position,
            error: 0.3,
            track: track(i),
        });
        let model = Model {
            cameras: vec![Some(CAMERA)],
            points: points.collect(),
            focal_held: vec![false],
            poses: poses.iter().copied().map(Some).collect(),
        };
        let photos = vec![photo(); poses.len()];
        let determined = determines_focal(&photos, &features, &model, 0);
        assert_eq!(determined, turn);
    }
}

/// Panoramas on a walk through a room, each as the six faces of a cube, with a known camera.
fn panoramas(count: usize, points: usize) -> World {
    let face = DCamera::centered(600, 600, 300.0);
    let turns = [
        DQuat::IDENTITY,
        DQuat::from_rotation_y(FRAC_PI_2),
        DQuat::from_rotation_y(PI),
        DQuat::from_rotation_y(-FRAC_PI_2),
        DQuat::from_rotation_x(FRAC_PI_2),
        DQuat::from_rotation_x(-FRAC_PI_2),
    ];
    let mut poses = Vec::new();
    for i in 0..count {
        let at = i as f64 / count as f64;
        let eye = DVec3::new(3.0 * at - 1.5, (4.0 * at).sin(), 0.2 * (9.0 * at).cos());
        let rig = world::look(eye, eye + DVec3::new((2.0 * at).cos(), (2.0 * at).sin(), 0.1));
        poses.extend(turns.map(|turn| DPose {
            rotation: rig.rotation * turn,
            ..rig
        }));
    }
    let mut rng = Rng::new(31, 0);
    let mut uniform = |range: f64| range * f64::from(rng.range(-1.0, 1.0));
    let walls: Vec<(DVec3, DVec3)> = (0..points)
        .map(|i| {
            let side = if i % 2 == 0 { 1.0 } else { -1.0 };
            let (a, b) = (uniform(1.0), uniform(1.0));
            match i % 10 {
                0..4 => (DVec3::new(4.0 * side, 3.0 * a, 1.5 * b), DVec3::X * -side),
                4..8 => (DVec3::new(4.0 * a, 3.0 * side, 1.5 * b), DVec3::Y * -side),
                _ => (DVec3::new(4.0 * a, 3.0 * b, 1.5 * side), DVec3::Z * -side),
            }
        })
        .collect();
    let mut world = World::of_points(face, poses, &walls, 0, 0.5, 0.2, 32);
    for (i, photo) in world.photos.iter_mut().enumerate() {
        photo.camera = Some(face);
        photo.focal_prior_px = Some(300.0);
        photo.up = Some(turns[i % 6].inverse() * DVec3::NEG_Y);
        photo.mount = Some(RigMount {
            rig: i / 6,
            rotation: turns[i % 6],
        });
    }
    world
}

#[test]
fn photographs_of_a_rig_have_one_place_and_their_turns() {
    let world = panoramas(8, 1500);
    let result = world.map();
    let model = &result.models[0];
    assert_eq!(model.registered(), 48);
    assert_eq!(model.cameras[0], world.photos[0].camera);
    assert!(world.auc(model, 1.0) > 90.0, "{}", world.auc(model, 1.0));
    let mut alone = world;
    for faces in model.poses.chunks(6) {
        let faces: Vec<DPose> = faces.iter().map(|pose| pose.expect("registered")).collect();
        for (face, photo) in faces.iter().zip(&alone.photos) {
            let mount = photo.mount.expect("on a rig").rotation;
            assert_eq!(face.position, faces[0].position);
            assert!((face.rotation * DVec3::ONE - faces[0].rotation * mount * DVec3::ONE).length() < 1e-9);
        }
    }
    // The common position makes them more accurate.
    let auc = alone.auc(model, 1.0);
    alone.photos.iter_mut().for_each(|photo| photo.mount = None);
    let apart = alone.map();
    let of_alone = alone.auc(&apart.models[0], 1.0);
    assert!(auc > of_alone, "{auc} {of_alone}");
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
fn a_photograph_that_is_registered_and_removed_again_and_again_is_given_up() {
    let mut world = World::new(around(8, 0.5), 400, 0.2, 0.0, 3);
    let mut rng = Rng::new(3, 9);
    // Near enough to be registered, but too far from its points to keep them.
    for keypoint in &mut world.features[4].keypoints {
        let (y, x) = rng.range(0.0, std::f32::consts::TAU).sin_cos();
        (keypoint.x, keypoint.y) = (keypoint.x + 4.0 * x, keypoint.y + 4.0 * y);
    }
    let options = MapOptions {
        max_error: 1.0,
        ..MapOptions::default()
    };
    let result = reconstruct(&world.photos, &world.features, &world.pairs, &options, &mut |_| ());
    assert_eq!(result.registered(), 7);
    assert!(matches!(&result.left_out[..], [left] if matches!(left.reason, Reason::NotRegistered { .. })));
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
fn photographs_by_a_camera_that_did_not_move_say_so() {
    let mut world = World::new(around(8, 0.0), 300, 0.0, 0.0, 8);
    world.features = vec![world.features[0].clone(); 8];
    let count = world.features[0].keypoints.len();
    for pair in &mut world.pairs {
        pair.matches = (0..count as u32).map(|i| [i, i]).collect();
    }
    let result = world.map();
    let reasons: Vec<Reason> = result.left_out.iter().map(|left| left.reason).collect();
    assert_eq!(reasons, [Reason::StandsStill { best: count }; 8]);
    // A photograph that matches no other is no part of that.
    world.pairs.retain(|pair| pair.photos[0] != 0);
    assert_eq!(world.map().left_out[0].reason, Reason::FewMatches { best: 0 });
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

/// Photographs around a can with two equal labels on opposite sides. `background` points of the ground, and as many of the wall, have no
/// twin.
fn can_with_equal_labels(photos: usize, background: usize) -> World {
    let mut rng = Rng::new(10, 4);
    let mut uniform = move |low: f64, high: f64| low + (high - low) * f64::from(rng.uniform());
    let label: Vec<(DVec3, DVec3)> = (0..400)
        .map(|_| {
            let (turn, height) = (uniform(-1.2, 1.2), uniform(-0.7, 0.7));
            let out = DVec3::new(turn.cos(), turn.sin(), 0.0);
            (0.5 * out + height * DVec3::Z, out)
        })
        .collect();
    let half_turn = DQuat::from_rotation_z(std::f64::consts::PI);
    let other = label.iter().map(|(place, out)| (half_turn * *place, half_turn * *out));
    let ground: Vec<(DVec3, DVec3)> = (0..background)
        .map(|_| {
            (
                DVec3::new(uniform(-3.0, 3.0), uniform(-3.0, 3.0), uniform(-0.9, -0.6)),
                DVec3::Z,
            )
        })
        .collect();
    // Walls are seen from the inside.
    let wall: Vec<(DVec3, DVec3)> = (0..background)
        .map(|_| {
            let turn = uniform(0.0, std::f64::consts::TAU);
            let out = DVec3::new(turn.cos(), turn.sin(), 0.0);
            (9.0 * out + uniform(-2.0, 3.0) * DVec3::Z, -out)
        })
        .collect();
    let points: Vec<(DVec3, DVec3)> = label.iter().copied().chain(other).chain(ground).chain(wall).collect();
    World::of_points(world::CAMERA, around(photos, 1.0), &points, 400, 0.5, 0.1, 11)
}

#[test]
fn a_label_that_occurs_twice_does_not_fold_the_ring() {
    // Few enough that the labels decide.
    let world = can_with_equal_labels(32, 300);
    let result = world.map();
    let model = &result.models[0];
    assert!(model.registered() >= 31, "{}", model.registered());
    assert!(world.auc(model, 5.0) > 97.0, "{}", world.auc(model, 5.0));
    // The pairs of opposite photographs are known to be wrong.
    let agreement = agreement(&world.photos, &world.features, &result.pairs, model);
    let opposite = |pair: &irradia_sfm::map::VerifiedPair| (13..=19).contains(&(pair.photos[1] - pair.photos[0]));
    let of_opposite: Vec<f64> = result
        .pairs
        .iter()
        .zip(&agreement)
        .filter(|(pair, _)| opposite(pair))
        .filter_map(|(_, a)| *a)
        .collect();
    assert!(
        of_opposite.len() > 8 && of_opposite.iter().all(|a| *a < 0.6),
        "{of_opposite:?}"
    );
}

#[test]
fn a_label_that_occurs_twice_does_not_fold_few_photographs() {
    for (photos, background) in [(10, 300), (12, 200), (14, 300), (16, 400)] {
        let world = can_with_equal_labels(photos, background);
        let result = world.map();
        let model = &result.models[0];
        let auc = world.auc(model, 5.0);
        assert!(model.registered() == photos && auc > 95.0, "{photos}: {auc}");
    }
}

#[test]
fn known_distances_bring_a_model_to_metres_with_an_error_that_holds() {
    let world = World::new(around(16, 1.0), 900, 0.5, 0.1, 12);
    let model = world.map().models.swap_remove(0);
    let distance = |a: usize, b: usize, factor: f64| Distance {
        photos: [a, b],
        metres: factor * world.poses[a].position.distance(world.poses[b].position),
    };
    let scale_of = |model: &Model| {
        let length = |a: usize, b: usize| {
            model.poses[a]
                .unwrap()
                .position
                .distance(model.poses[b].unwrap().position)
        };
        length(1, 9) / world.poses[1].position.distance(world.poses[9].position)
    };
    // A single distance, whose error only the poses determine; between neighbours it is less certain than between opposite cameras.
    let (mut near, mut across) = (model.clone(), model.clone());
    let near_fit = scale_to_distances(&mut near, &world.photos, &[distance(3, 4, 1.0)]).expect("posed");
    let across_fit = scale_to_distances(&mut across, &world.photos, &[distance(3, 11, 1.0)]).expect("posed");
    assert!(near_fit.residual_m < 1e-9 && near_fit.scale_error > 2.0 * across_fit.scale_error);
    assert!(near_fit.scale_error < 0.01, "{near_fit:?}");
    assert!(
        (scale_of(&near) - 1.0).abs() < 4.0 * near_fit.scale_error,
        "{}",
        scale_of(&near)
    );
    assert!(
        (scale_of(&across) - 1.0).abs() < 4.0 * across_fit.scale_error,
        "{}",
        scale_of(&across)
    );
    // Several distances that disagree by 3 %.
    let mut several = model.clone();
    let known = [distance(0, 8, 1.03), distance(2, 10, 0.97), distance(4, 12, 1.0)];
    let fit = scale_to_distances(&mut several, &world.photos, &known).expect("posed");
    assert!(
        (0.01..0.03).contains(&fit.scale_error) && (scale_of(&several) - 1.0).abs() < 0.03,
        "{fit:?}"
    );
    // Cameras at the same position do not determine the scale.
    let mut turned = model.clone();
    turned.poses[4] = turned.poses[3];
    let before = turned.clone();
    assert_eq!(
        scale_to_distances(&mut turned, &world.photos, &[distance(3, 4, 1.0)]),
        None
    );
    assert_eq!(turned, before);
}
