//! The doctor on synthetic worlds: each fault is found where it is and nowhere else.

mod world;

use glam::{DQuat, DVec3};
use irradia_scene::Rng;
use irradia_sfm::Features;
use irradia_sfm::PairMatches;
use irradia_sfm::doctor::{Appearance, Diagnosis, Evidence, Kind, diagnose};
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::{MapOptions, Model, Reconstruction, verify};
use world::{CAMERA, World, around, look};

/// All diagnoses of a world: with its model, and from its pairs only.
fn examine(world: &World, appearances: &[Appearance], colors: &[Vec<[u8; 3]>]) -> [Vec<Diagnosis>; 2] {
    examine_mapped(world, &world.map(), appearances, colors)
}

/// All diagnoses of a world: with the models `found`, and from its pairs only.
fn examine_mapped(
    world: &World,
    found: &Reconstruction,
    appearances: &[Appearance],
    colors: &[Vec<[u8; 3]>],
) -> [Vec<Diagnosis>; 2] {
    let (cameras, pairs) = verify(
        &world.photos,
        &world.features,
        &world.pairs,
        &MapOptions::default(),
        &mut |_| (),
    );
    let evidence = Evidence {
        photos: &world.photos,
        appearances,
        features: &world.features,
        colors,
        matches: &world.pairs,
        masked: None,
        pairs: &pairs,
        cameras: &cameras,
        models: &found.models,
        zooms: &found.zooms,
        own_focals: found.own_focals,
        missing: &found.missing,
        split_models: found.split_models,
        left_out: &found.left_out,
    };
    let alone = Evidence {
        models: &[],
        zooms: &[],
        own_focals: false,
        missing: &[],
        split_models: None,
        left_out: &[],
        ..evidence
    };
    [diagnose(&evidence), diagnose(&alone)]
}

fn sharp(world: &World) -> Vec<Appearance> {
    vec![Appearance::from_array([0.1, 0.5, 0.0, 0.0, 0.0]); world.photos.len()]
}

fn grey(world: &World) -> Vec<Vec<[u8; 3]>> {
    world
        .features
        .iter()
        .map(|f| vec![[128; 3]; f.keypoints.len()])
        .collect()
}

fn examine_plain(world: &World) -> [Vec<Diagnosis>; 2] {
    examine(world, &sharp(world), &grey(world))
}

fn kinds(found: &[Diagnosis]) -> Vec<Kind> {
    found.iter().map(Diagnosis::kind).collect()
}

/// A ring of `n` around a scene of `points`, without the photographs `missing`.
fn ring(n: usize, points: usize, missing: std::ops::Range<usize>) -> World {
    let poses = around(n, 1.0)
        .into_iter()
        .enumerate()
        .filter(|(i, _)| !missing.contains(i))
        .map(|p| p.1);
    World::new(poses.collect(), points, 0.5, 0.1, 21)
}

#[test]
fn nothing_is_wrong_with_a_good_ring() {
    for found in examine_plain(&ring(24, 2500, 0..0)) {
        assert_eq!(found, []);
    }
}

#[test]
fn photographs_are_compared_with_their_neighbours() {
    let world = ring(24, 2500, 0..0);
    let (mut appearances, mut colors) = (sharp(&world), grey(&world));
    appearances[5].sharpness = 0.02;
    // Gamma 2.2: a quarter of the light.
    colors[9] = vec![[68; 3]; colors[9].len()];
    appearances[14].white = 0.6;
    for found in examine(&world, &appearances, &colors) {
        assert_eq!(
            kinds(&found),
            [Kind::Blurred, Kind::Exposure, Kind::Exposure],
            "{found:?}"
        );
        assert!(matches!(found[0], Diagnosis::Blurred { photo: 5, times, .. } if (times - 5.0).abs() < 0.1));
        assert!(matches!(found[1], Diagnosis::ExposureJump { photo: 9, stops, .. } if (stops + 2.0).abs() < 0.1));
        assert!(matches!(
            found[2],
            Diagnosis::Clipped {
                photo: 14,
                bright: true,
                ..
            }
        ));
        let names: Vec<String> = world.photos.iter().map(|p| p.name.clone()).collect();
        let sentence = found[1].sentence(&names).to_string();
        assert!(sentence.starts_with("009.jpg is 2.0 stops darker than "), "{sentence}");
    }
}

#[test]
fn a_gap_in_a_ring_and_an_open_loop_are_told_apart() {
    // 7.5 degrees between photographs; facing points are seen over about 50 degrees.
    for (missing, kind, width) in [(10..20, Kind::Gap, 82.5), (44..48, Kind::OpenLoop, 37.5)] {
        let mut world = ring(48, 2500, missing.clone());
        // Features match over 30 degrees at most.
        let azimuth = |pose: &DPose| pose.position.y.atan2(pose.position.x);
        let poses = world.poses.clone();
        world.pairs.retain(|pair| {
            let [a, b] = pair.photos.map(|p| azimuth(&poses[p as usize]));
            (a - b).sin().atan2((a - b).cos()).abs() < 0.53
        });
        for found in examine_plain(&world) {
            assert!(kinds(&found).contains(&kind), "{found:?}");
            let degrees = found.iter().find_map(|diagnosis| match diagnosis {
                Diagnosis::Gap { degrees, .. } | Diagnosis::OpenLoop { degrees, .. } => Some(*degrees),
                _ => None,
            });
            assert!((degrees.unwrap() - width).abs() < 12.0, "{found:?}");
        }
    }
}

#[test]
fn two_scenes_are_separate_parts() {
    let world = World::new(around(10, 0.4), 900, 0.5, 0.2, 3).and(World::new(around(6, 0.3), 900, 0.5, 0.2, 4));
    let [_, alone] = examine_plain(&world);
    let parts = alone.iter().find_map(|d| match d {
        Diagnosis::SeparateParts { parts } => Some(parts.clone()),
        _ => None,
    });
    assert_eq!(parts, Some(vec![(0..10).collect(), (10..16).collect()]), "{alone:?}");
}

#[test]
fn turning_on_the_spot_is_named_and_is_the_one_reason() {
    let here = look(DVec3::new(5.0, 0.0, 1.0), DVec3::ZERO);
    let turned = |i: usize| DPose {
        rotation: here.rotation * DQuat::from_rotation_y(0.05 * i as f64),
        ..here
    };
    let world = World::new((0..8).map(turned).collect(), 1500, 0.3, 0.1, 5);
    let [mapped, alone] = examine_plain(&world);
    assert!(kinds(&alone).contains(&Kind::RotationOnly), "{alone:?}");
    let reasons: Vec<&Diagnosis> = mapped.iter().filter(|d| d.kind() == Kind::LeftOut).collect();
    assert_eq!(reasons.len(), 8);
    assert!(
        reasons
            .iter()
            .all(|d| matches!(d, Diagnosis::LeftOut { reason, .. } if reason.contains("same place")))
    );
}

#[test]
fn a_turn_on_the_spot_between_two_walks_is_why_there_are_two_models() {
    // The camera moves sideways past the scene ahead, turns to the right, and moves sideways again.
    let (walk, turn) = (12, 12);
    let toward = |degrees: f64| DVec3::new(degrees.to_radians().sin(), degrees.to_radians().cos(), 0.0);
    let pose = |degrees: f64, aside: f64| {
        let eye = aside * toward(degrees + 90.0);
        look(eye, eye + toward(degrees))
    };
    let poses = (0..walk)
        .map(|i| pose(0.0, 0.12 * (i - walk) as f64))
        .chain((0..=turn).map(|i| pose(10.0 * f64::from(i), 0.0)))
        .chain((1..=walk).map(|i| pose(10.0 * f64::from(turn), 0.12 * i as f64)));
    let mut rng = Rng::new(8, 1);
    let points: Vec<(DVec3, DVec3)> = (0..3000)
        .map(|_| {
            let far = f64::from(rng.range(4.0, 7.0)) * toward(f64::from(rng.range(-60.0, 200.0)));
            let place = far + DVec3::new(0.0, 0.0, f64::from(rng.range(-2.0, 2.0)));
            (place, -place.normalize())
        })
        .collect();
    let world = World::of_points(CAMERA, poses.collect(), &points, 0, 0.5, 0.1, 8);
    let [mapped, _] = examine_plain(&world);
    let turns: Vec<&Diagnosis> = mapped
        .iter()
        .filter(|found| matches!(found, Diagnosis::RotationBetweenModels { .. }))
        .collect();
    let [Diagnosis::RotationBetweenModels { ends, sides }] = turns[..] else {
        panic!("{mapped:?}")
    };
    let in_turn = walk as usize..=(walk + turn) as usize;
    assert!(ends.iter().all(|end| in_turn.contains(end)), "{ends:?}");
    // A photograph in the middle of the turn may be in neither model.
    assert!(sides.iter().all(|side| (17..20).contains(side)), "{sides:?}");
}

#[test]
fn a_photograph_taken_twice_is_named_once() {
    let mut world = ring(24, 2500, 0..0);
    let last = world.photos.len() as u32;
    world.photos.push(world.photos[3].clone());
    world.features.push(world.features[3].clone());
    let copies: Vec<_> = world
        .pairs
        .iter()
        .filter(|pair| pair.photos.contains(&3))
        .map(|pair| {
            let other = pair.photos[0] + pair.photos[1] - 3;
            let turn = |m: &[u32; 2]| if pair.photos[0] == 3 { [m[1], m[0]] } else { *m };
            irradia_sfm::PairMatches {
                photos: [other, last],
                matches: pair.matches.iter().map(turn).collect(),
            }
        })
        .collect();
    world.pairs.extend(copies);
    world.pairs.push(irradia_sfm::PairMatches {
        photos: [3, last],
        matches: (0..world.features[3].keypoints.len() as u32).map(|i| [i, i]).collect(),
    });
    for found in examine_plain(&world) {
        assert_eq!(
            found,
            [Diagnosis::Duplicate {
                photos: [3, last as usize]
            }]
        );
    }
}

#[test]
fn little_texture_and_few_partners_are_named() {
    let mut world = ring(24, 2500, 0..0);
    // Its keypoints beyond the first 40 are gone.
    world.features[7].keypoints.truncate(40);
    for pair in world.pairs.iter_mut().filter(|pair| pair.photos.contains(&7)) {
        let side = usize::from(pair.photos[1] == 7);
        pair.matches.retain(|m| m[side] < 40);
    }
    for found in examine_plain(&world) {
        assert!(
            found.iter().any(|d| matches!(
                d,
                Diagnosis::FewFeatures {
                    photo: 7,
                    features: 40,
                    ..
                }
            )),
            "{found:?}"
        );
        assert!(
            found
                .iter()
                .any(|d| matches!(d, Diagnosis::FewPartners { photo: 7, .. })),
            "{found:?}"
        );
        assert!(found.iter().all(|d| d.photos() == [7]), "{found:?}");
    }
}

#[test]
fn a_zoom_that_no_metadata_tell_is_named_and_mapped_with_its_own_focal_length() {
    let world = ring(24, 2500, 0..0).zoomed(15, 1.5);
    let [mapped, alone] = examine_plain(&world);
    assert_eq!(alone, []);
    let [Diagnosis::Zoom { photos, ratio }] = &mapped[..] else {
        panic!("{mapped:?}");
    };
    assert_eq!(*photos, (15..24).collect::<Vec<_>>());
    assert!((ratio - 1.5).abs() < 0.01, "{ratio}");
    let found = world.map();
    let model = &found.models[0];
    assert!(world.auc(model, 1.0) > 97.0, "{}", world.auc(model, 1.0));
    let focal = |group: usize| model.cameras[group].as_ref().expect("used").focal();
    assert!((focal(0) / 870.0 - 1.0).abs() < 0.01, "{}", focal(0));
    assert!((focal(1) / 1305.0 - 1.0).abs() < 0.01, "{}", focal(1));
}

#[test]
fn a_model_that_moves_otherwise_than_most_pairs_is_named() {
    let world = ring(24, 2500, 0..0);
    let mut found = world.map();
    found.models[0].poses.reverse();
    let [mapped, alone] = examine_mapped(&world, &found, &sharp(&world), &grey(&world));
    assert!(
        mapped
            .iter()
            .any(|d| matches!(d, Diagnosis::OtherMotion { pairs } if pairs.len() > 20)),
        "{mapped:?}"
    );
    assert_eq!(alone, [], "no model");
}

#[test]
fn focal_lengths_that_differ_from_photograph_to_photograph_make_as_many_cameras() {
    let mut rng = irradia_scene::Rng::new(3, 3);
    let zooms: Vec<f32> = (0..24).map(|_| rng.range(1.0, 1.5)).collect();
    let first = ring(24, 2500, 0..0).zoomed(0, zooms[0]);
    let world = (1..24).fold(first, |world, i| world.zoomed(i, zooms[i] / zooms[i - 1]));
    let found = world.map();
    let model = &found.models[0];
    assert!(found.own_focals && model.registered() == 24, "{}", model.registered());
    for (camera, zoom) in model.cameras.iter().flatten().zip(&zooms) {
        assert!(
            (camera.focal() / (870.0 * f64::from(*zoom)) - 1.0).abs() < 0.03,
            "{camera:?}"
        );
    }
    assert!(world.auc(model, 5.0) > 95.0, "{}", world.auc(model, 5.0));
    let longest = (0..24)
        .max_by(|a, b| zooms[*a].total_cmp(&zooms[*b]))
        .expect("photographs");
    let contradictions = found.contradictions(&world.photos, &world.features);
    assert_eq!(contradictions, 0, "each pair is compared through its own cameras");
    let photos = found.regrouped(&world.photos);
    assert!(photos.iter().enumerate().all(|(i, photo)| photo.group == i));
    let [mapped, _] = examine_plain(&world);
    assert!(
        mapped
            .iter()
            .any(|d| matches!(d, Diagnosis::OwnFocals { ends: [_, long], .. } if *long == longest)),
        "{mapped:?}"
    );
}

#[test]
fn photographs_cut_beside_their_middles_are_named() {
    let all = ring(24, 2500, 0..0);
    let corner = all.clone().cropped_beside(|_| 0.8, |_| [0.0, 1.0]);
    for (world, beside) in [(all.cropped(|_| 0.8), None), (corner, Some(100.0f64.hypot(75.0)))] {
        let [mapped, alone] = examine_plain(&world);
        let cropped = |found: &[Diagnosis]| {
            found.iter().find_map(|d| match d {
                Diagnosis::Cropped { photos, distance } => Some((photos.len(), *distance)),
                _ => None,
            })
        };
        assert_eq!(cropped(&alone), None);
        match (cropped(&mapped), beside) {
            (None, None) => (),
            (Some((24, found)), Some(truth)) => assert!((found - truth).abs() < 20.0, "{found}"),
            (found, truth) => panic!("{found:?} is not {truth:?}"),
        }
    }
}

#[test]
fn a_zoom_so_far_that_nothing_matches_is_named_from_both_models() {
    let mut world = ring(24, 2500, 0..0).zoomed(14, 1.6);
    world
        .pairs
        .retain(|pair| (pair.photos[0] < 14) == (pair.photos[1] < 14));
    let found = world.map();
    let sizes: Vec<usize> = found.models.iter().map(Model::registered).collect();
    assert_eq!(sizes, [14, 10]);
    let [mapped, _] = examine_plain(&world);
    let zoom = mapped.iter().find_map(|diagnosis| match diagnosis {
        Diagnosis::Zoom { photos, ratio } => Some((photos.clone(), *ratio)),
        _ => None,
    });
    let (photos, ratio) = zoom.unwrap_or_else(|| panic!("{mapped:?}"));
    assert_eq!(photos, (14..24).collect::<Vec<_>>());
    assert!((ratio / 1.6 - 1.0).abs() < 0.03, "{ratio}");
}

#[test]
fn a_background_with_most_of_the_features_stands_still() {
    // Nothing on the object matches: the background of each photograph is in the same position as in the one before.
    let mut world = ring(24, 2500, 0..0);
    let background = world.features[0].clone();
    world
        .features
        .iter_mut()
        .for_each(|features| *features = background.clone());
    let count = background.keypoints.len() as u32;
    let all = |photos: [u32; 2]| PairMatches {
        photos,
        matches: (0..count).map(|i| [i, i]).collect(),
    };
    world.pairs = (0..12).map(|i| all([i, i + 1])).collect();
    let [_, alone] = examine_plain(&world);
    let still = alone
        .iter()
        .find(|diagnosis| matches!(diagnosis, Diagnosis::StillRegion { .. }));
    // The photographs at both ends of the chain have one partner.
    let named = (1..12).chain([0, 12]).collect();
    assert_eq!(still.map(Diagnosis::photos), Some(named), "{alone:?}");
    assert!(
        !alone
            .iter()
            .any(|diagnosis| matches!(diagnosis, Diagnosis::Duplicate { .. })),
        "{alone:?}"
    );
    // Two shots of each place are no background.
    world.pairs = (0..12).map(|i| all([2 * i, 2 * i + 1])).collect();
    let [_, alone] = examine_plain(&world);
    let twice = alone
        .iter()
        .filter(|diagnosis| matches!(diagnosis, Diagnosis::Duplicate { .. }));
    assert_eq!(twice.count(), 12, "{alone:?}");
}

#[test]
fn a_mask_that_hides_all_is_named_in_place_of_darkness_and_texture() {
    let mut world = ring(24, 2500, 0..0);
    world.features[7] = Features::default();
    world.pairs.retain(|pair| !pair.photos.contains(&7));
    let mut appearances = sharp(&world);
    // As for a photograph that is hidden entirely.
    appearances[7] = Appearance::from_array([0.0, 0.0, 0.0, 0.0, 1.0]);
    // Hidden parts of a photograph with features are not a fault.
    appearances[11].hidden = 0.95;
    for found in examine(&world, &appearances, &grey(&world)) {
        let kinds_of_photo = [Kind::Hidden, Kind::FewFeatures, Kind::Exposure, Kind::Blurred];
        let reported: Vec<&Diagnosis> = found.iter().filter(|d| kinds_of_photo.contains(&d.kind())).collect();
        assert!(
            matches!(reported[..], [Diagnosis::Hidden { photo: 7, fraction }] if *fraction == 1.0),
            "{found:?}"
        );
    }
}

#[test]
fn nothing_and_one_photograph_have_nothing_wrong() {
    let world = World::default();
    assert_eq!(examine_plain(&world), [Vec::new(), Vec::new()]);
    let mut one = ring(24, 100, 1..24);
    one.features[0] = Features::default();
    let [found, _] = examine_plain(&one);
    assert!(
        kinds(&found)
            .iter()
            .all(|kind| [Kind::LeftOut, Kind::FewFeatures].contains(kind)),
        "{found:?}"
    );
}

#[test]
fn something_that_moves_is_named_and_nothing_else() {
    let mut world = ring(24, 1500, 0..0);
    // A flat object with 40 features, at another position in each photograph.
    let mut rng = irradia_scene::Rng::new(8, 8);
    let thing: Vec<[f32; 2]> = (0..40).map(|_| [0; 2].map(|_| rng.range(0.0, 180.0))).collect();
    let mut first = Vec::new();
    for features in &mut world.features {
        first.push(features.keypoints.len() as u32);
        let corner = [rng.range(0.0, 800.0), rng.range(0.0, 550.0)];
        features.keypoints.extend(thing.iter().map(|at| irradia_sfm::Keypoint {
            x: corner[0] + at[0],
            y: corner[1] + at[1],
            scale: 2.0,
            angle: 0.0,
        }));
    }
    for pair in &mut world.pairs {
        let [a, b] = pair.photos.map(|p| first[p as usize]);
        pair.matches.extend((0..thing.len() as u32).map(|i| [a + i, b + i]));
    }
    for found in examine_plain(&world) {
        assert!(
            matches!(&found[..], [Diagnosis::Moving { pairs: [found, of], .. }] if 2 * found > *of),
            "{found:?}"
        );
    }
}

#[test]
fn what_stands_on_a_flat_ground_does_not_move() {
    let mut rng = irradia_scene::Rng::new(9, 9);
    let mut uniform = |from: f32, to: f32| f64::from(rng.range(from, to));
    let ground: Vec<(DVec3, DVec3)> = (0..1500)
        .map(|_| (DVec3::new(uniform(-2.5, 2.5), uniform(-2.5, 2.5), 0.0), DVec3::Z))
        .collect();
    // The only side of an object that the cameras see.
    let side: Vec<(DVec3, DVec3)> = (0..100)
        .map(|_| (DVec3::new(0.0, uniform(-0.6, 0.6), uniform(0.1, 0.8)), DVec3::X))
        .collect();
    let poses = (0..12).map(|i| {
        let angle = 0.12 * (f64::from(i) - 5.5);
        world::look(DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 3.0), DVec3::ZERO)
    });
    let world = World::of_points(
        world::CAMERA,
        poses.collect(),
        &[ground, side].concat(),
        0,
        0.3,
        0.0,
        21,
    );
    for found in examine_plain(&world) {
        assert!(!kinds(&found).contains(&Kind::Moving), "{found:?}");
    }
}

#[test]
fn places_that_are_one_by_a_part_alone_are_mapped_apart() {
    let mut rng = irradia_scene::Rng::new(4, 4);
    let mut uniform = move || f64::from(rng.range(-1.0, 1.0));
    let mut direction = move || DVec3::new(uniform(), uniform(), uniform());
    let mut some =
        |n: usize| -> Vec<(DVec3, DVec3)> { (0..n).map(|_| (2.5 * direction(), direction().normalize())).collect() };
    // Far below everything that the photographs of the first place show.
    let below = DVec3::new(0.0, 0.0, -1000.0);
    let moved = |points: &[(DVec3, DVec3)]| points.iter().map(|p| (p.0 + below, p.1)).collect::<Vec<_>>();
    let (alike, own, others) = (some(160), some(2600), some(2600));
    let points = [alike.clone(), moved(&alike), own, moved(&others)].concat();
    let first = around(16, 1.0);
    let second = first.iter().map(|pose| DPose {
        position: pose.position + below,
        ..*pose
    });
    let poses = first.iter().copied().chain(second).collect();
    let world = World::of_points(world::CAMERA, poses, &points, 160, 0.5, 0.0, 21);
    let [found, alone] = examine_plain(&world);
    assert!(
        matches!(&found[..], [Diagnosis::Missing { photos, models: 2, .. }] if photos.len() == 32),
        "{found:?}"
    );
    assert_eq!(alone, []);
    let models = world.map().models;
    let of_first = |model: &Model| model.poses.iter().take(16).flatten().count();
    assert_eq!(models.iter().map(Model::registered).collect::<Vec<_>>(), [16, 16]);
    assert!(models.iter().all(|model| [0, 16].contains(&of_first(model))));
}
