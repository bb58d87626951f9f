use crate::{apply_line, cloud, difference, draft, edited};
use glam::{DQuat, DVec3, Vec3};
use irradia_edit::{Draft, Edit, History, Operation, apply, open_nothing};
use irradia_scene::{Camera, ExtraColumn, Intrinsics, Pose, Scalar, Similarity};

/// Edits that do not change a single bit.
#[test]
fn neutral_edits_are_the_identity() {
    let before = draft(200, 3);
    for line in [
        "move by=0,0,0",
        "rotate axis=1,2,3 degrees=0",
        "rotate axis=1,2,3 degrees=360 sphere center=0,0,0 radius=0.5",
        "scale factor=1 sphere center=0,0,0 radius=0.5",
        "recolor",
        "recolor all",
        "opacity factor=1",
        "reduce count=200",
        "set-length from=0,0,0 to=0,0,2 length=2",
        "keep all",
        "delete all -all",
        "delete sphere center=50,0,0 radius=1",
        "upright up=0,-1,0 ground=5,0,5",
    ] {
        let mut after = edited(&before, &[line]);
        // The last selection is remembered.
        after.last.clone_from(&before.last);
        assert!(after == before, "{line}");
    }
}

/// An edit and its inverse.
#[test]
fn inverse_edits_restore_the_scene() {
    let before = draft(200, 4);
    let half = "half-space point=0,0,0 normal=1,0,0";
    let pairs = [
        ["move by=1,-2,3".to_owned(), "move by=-1,2,-3".to_owned()],
        [
            "rotate axis=1,2,3 degrees=50 about=1,0,0".to_owned(),
            "rotate axis=1,2,3 degrees=-50 about=1,0,0".to_owned(),
        ],
        [
            "scale factor=4 about=1,1,1".to_owned(),
            "scale factor=0.25 about=1,1,1".to_owned(),
        ],
        [
            format!("rotate axis=1,0,0 degrees=70 about=0,0,0 {half}"),
            format!("rotate axis=-1,0,0 degrees=70 about=0,0,0 {half}"),
        ],
        [
            "recolor exposure=1 temperature=0.5 tint=-0.5".to_owned(),
            "recolor exposure=-1 temperature=-0.5 tint=0.5".to_owned(),
        ],
        ["recolor contrast=2".to_owned(), "recolor contrast=0.5".to_owned()],
        [format!("hide {half}"), "show".to_owned()],
        [format!("lock {half}"), "unlock".to_owned()],
    ];
    for pair in pairs {
        let after = edited(&before, &[&pair[0], &pair[1]]);
        // Rounding of f32 at coordinates up to 5.
        assert!(difference(&after.cloud, &before.cloud) < 1e-5, "{pair:?}");
        assert_eq!((&after.hidden, &after.locked), (&before.hidden, &before.locked));
        for (a, b) in after.cameras.iter().zip(&before.cameras) {
            assert!(a.pose.position.distance(b.pose.position) < 1e-5, "{pair:?}");
        }
        let between = edited(&before, &[&pair[0]]);
        assert_ne!(between, before, "{pair:?}");
    }
}

/// Two edits that equal one.
#[test]
fn edits_compose() {
    let before = draft(200, 3);
    for (two, one) in [
        (["move by=1,0,0", "move by=0,2,0"], "move by=1,2,0"),
        (
            ["rotate axis=0,0,1 degrees=30", "rotate axis=0,0,1 degrees=60"],
            "rotate axis=0,0,1 degrees=90",
        ),
        (["scale factor=2", "scale factor=3"], "scale factor=6"),
        (["recolor exposure=0.5", "recolor exposure=0.7"], "recolor exposure=1.2"),
        (
            ["recolor saturation=0.5", "recolor saturation=0.5"],
            "recolor saturation=0.25",
        ),
        (["opacity factor=0.5", "opacity factor=0.5"], "opacity factor=0.25"),
        (
            [
                "delete sphere center=1,0,0 radius=1",
                "delete sphere center=0,1,0 radius=1",
            ],
            "delete sphere center=1,0,0 radius=1 sphere center=0,1,0 radius=1",
        ),
        (
            ["keep sphere center=1,0,0 radius=1", "keep sphere center=0,1,0 radius=1"],
            "keep sphere center=1,0,0 radius=1 &sphere center=0,1,0 radius=1",
        ),
        (["reduce count=100", "reduce count=50"], "reduce count=50"),
    ] {
        let (two, one) = (edited(&before, &two), edited(&before, &[one]));
        assert!(difference(&two.cloud, &one.cloud) < 2e-5, "{one:?}");
        assert_ne!(one.cloud, before.cloud);
    }
}

#[test]
fn deleting_and_keeping_share_the_scene_between_them() {
    let before = draft(300, 1);
    let shape = "box center=0.2,0,0 size=1,1,1 rotation=1,0.2,0,0";
    let deleted = edited(&before, &[&format!("delete {shape}")]);
    let kept = edited(&before, &[&format!("keep {shape}")]);
    assert_eq!(deleted.len() + kept.len(), 300);
    assert!(!deleted.is_empty() && !kept.is_empty());
    assert!(kept.cloud.means.iter().all(|mean| !deleted.cloud.means.contains(mean)));
}

#[test]
fn locked_and_hidden_splats_are_left_alone_but_move_with_the_scene() {
    let before = draft(200, 0);
    for mark in ["lock", "hide"] {
        let shape = "half-space point=0,0,0 normal=0,1,0";
        let marked = edited(&before, &[&format!("{mark} {shape}")]);
        let upper = before.cloud.means.iter().filter(|mean| mean[1] >= 0.0).count();
        assert_eq!(edited(&marked, &["delete all"]).len(), upper, "{mark}");
        assert_eq!(edited(&marked, &["keep all -all"]).len(), upper, "{mark}");
        assert_eq!(
            edited(&marked, &["opacity factor=0.5 all"])
                .cloud
                .opacity_logits
                .iter()
                .zip(&before.cloud.opacity_logits)
                .filter(|(a, b)| a == b)
                .count(),
            upper
        );
        let faded = edited(&marked, &["opacity factor=0.5", "recolor exposure=1"]).cloud;
        let of_same = |i: &usize| faded.opacity_logits[*i] == before.cloud.opacity_logits[*i];
        let stayed: Vec<usize> = (0..200).filter(of_same).collect();
        assert_eq!(stayed.len(), upper, "{mark}: the whole scene without them");
        let width = 3 * before.cloud.sh_coefficients();
        let sh = |cloud: &irradia_scene::GaussianCloud, i: usize| cloud.sh[i * width..][..width].to_vec();
        assert!(stayed.iter().all(|i| sh(&faded, *i) == sh(&before.cloud, *i)));
        let fewest = edited(&marked, &["reduce count=1"]);
        match mark {
            "lock" => assert_eq!(fewest.len(), upper, "what is locked counts and stays"),
            _ => assert_eq!((fewest.len(), fewest.visible_cloud().len()), (upper + 1, 1)),
        }
        let moved = edited(&marked, &["move by=0,0,1"]);
        assert!(
            moved
                .cloud
                .means
                .iter()
                .zip(&before.cloud.means)
                .all(|(a, b)| a[2] != b[2])
        );
    }
    let hidden = edited(&before, &["hide all"]);
    assert_eq!((hidden.len(), hidden.visible_cloud().len()), (200, 0));
    let partly = edited(&hidden, &["show sphere center=0,0,0 radius=0.5"]);
    assert!((1..200).contains(&partly.visible_cloud().len()));
}

/// Numbers 0, 1, .. as an extra column.
fn numbered(name: &str, n: u16) -> ExtraColumn {
    ExtraColumn {
        name: name.into(),
        scalar: Scalar::U16,
        bytes: (0..n).flat_map(u16::to_le_bytes).collect(),
    }
}

#[test]
fn what_files_have_beyond_ours_follows_its_splats() {
    let mut draft = draft(100, 1);
    draft.cloud.extra = vec![numbered("label", 100)];
    let before = draft.clone();
    let mut other = cloud(10, 0, 2);
    other.extra = vec![numbered("time", 10), numbered("label", 10)];
    let is_where_it_was = |draft: &Draft, i: usize, label: usize| {
        let place = before.cloud.means[label] == draft.cloud.means[i];
        place && draft.cloud.extra[0].get(i) == (label as u16).to_le_bytes()
    };
    let mut history = History::new(draft);
    let mut edit = |line: &str| history.apply(&line.parse().unwrap(), &|_| Ok(other.clone())).map(drop);
    edit("delete half-space point=0,0,0 normal=1,0,0").unwrap();
    edit("duplicate half-space point=0,0,0 normal=0,1,0").unwrap();
    edit("merge file=other").unwrap();
    edit("recolor exposure=1").unwrap();
    let now = history.draft();
    let label = |i: usize| u16::from_le_bytes(now.cloud.extra[0].get(i).try_into().unwrap()) as usize;
    let n = now.len() - 10;
    assert!(n < 100 && now.cloud.is_consistent());
    assert!((0..n).all(|i| is_where_it_was(now, i, label(i))));
    assert!((0..10).all(|i| label(n + i) == i));
    let time = &now.cloud.extra[1];
    assert!(time.bytes[..2 * n].iter().all(|byte| *byte == 0));
    assert_eq!(time.bytes[2 * n..], numbered("", 10).bytes);
    while history.undo().is_some() {}
    assert_eq!(*history.draft(), before);
}

#[test]
fn copies_merges_and_splits_count_up() {
    let before = draft(100, 2);
    let mut doubled = before.clone();
    let applied = apply_line(&mut doubled, "duplicate by=5,0,0");
    assert_eq!(doubled.len(), 200);
    assert_eq!(applied.provenance.source(150), Some(50));
    assert!(!applied.provenance.changed.contains(99) && applied.provenance.changed.contains(100));
    assert!((doubled.cloud.means[150][0] - before.cloud.means[50][0] - 5.0).abs() < 1e-5);
    // Only the copy is to the right.
    let mut split = doubled.clone();
    let applied = apply_line(&mut split, "split name=copy half-space point=2.5,0,0 normal=1,0,0");
    assert_eq!(split.cloud, before.cloud);
    let (name, cloud) = applied.split.expect("a second scene");
    assert_eq!((name.as_str(), cloud.len()), ("copy", 100));
    // Merged again, from another degree and another world of the same dataset.
    let other = || {
        let mut other = cloud.clone();
        other.bring_to_world(Similarity {
            scale: 3.0,
            center: DVec3::new(1.0, 2.0, 3.0),
        });
        other.set_degree(4);
        other
    };
    let edit: Edit = "merge file=copy.ply".parse().unwrap();
    let merged = apply(&mut split, &edit, &|file| match file {
        "copy.ply" => Ok(other()),
        _ => Err("another".into()),
    });
    assert_eq!(merged.unwrap().provenance.source(100), None);
    assert_eq!((split.len(), split.cloud.sh_degree), (200, 4));
    doubled.cloud.set_degree(4);
    assert!(difference(&split.cloud, &doubled.cloud) < 1e-5);
}

#[test]
fn lengths_and_up_are_as_told() {
    let before = draft(50, 1);
    let scaled = edited(&before, &["set-length from=1,0,0 to=1,0,4 length=0.5"]);
    let position = |draft: &Draft, i: usize| {
        let mean = DVec3::from(draft.cloud.means[i].map(f64::from));
        draft.cloud.world_from_dataset.invert(mean)
    };
    let ratio =
        (position(&scaled, 0) - position(&scaled, 1)).length() / (position(&before, 0) - position(&before, 1)).length();
    assert!((ratio - 0.125).abs() < 1e-6);

    let up = DVec3::new(1.0, 2.0, -0.5).normalize();
    let point = DVec3::new(0.3, 0.2, 0.1);
    for (axis, to) in [("-y", DVec3::NEG_Y), ("y", DVec3::Y), ("z", DVec3::Z)] {
        let mut turned = before.clone();
        let line = format!("upright up=1,2,-0.5 ground=0.3,0.2,0.1 axis={axis}");
        let moved = apply_line(&mut turned, &line).moved.expect("the whole scene");
        assert!((moved.rotation * up - to).length() < 1e-9);
        assert!(moved.apply(point).dot(to).abs() < 1e-9, "the ground is at height 0");
    }
    // Up is found from the cameras, where it is near -y, since there is no plane.
    let mut turned = before.clone();
    let applied = apply_line(&mut turned, "upright");
    let Operation::Upright { up: Some(up), .. } = applied.edit.op else {
        panic!("what was found is written out")
    };
    assert!(DVec3::from(up).dot(DVec3::NEG_Y) > 0.9);
    assert!(
        apply(
            &mut Draft::new(cloud(50, 0, 1), Vec::new()),
            &"upright".parse().unwrap(),
            &open_nothing
        )
        .is_err()
    );
}

#[test]
fn the_ground_is_the_densest_plane_below_the_cameras() {
    use irradia_scene::Rng;
    let mut scene = draft(300, 0);
    let normal = DVec3::new(0.2, -1.0, 0.1).normalize();
    let turn = DQuat::from_rotation_arc(DVec3::NEG_Y, normal);
    let mut floor = cloud(600, 0, 7);
    let mut rng = Rng::new(5, 0);
    for mean in &mut floor.means {
        let flat = DVec3::new(f64::from(rng.range(-2.0, 2.0)), 2.0, f64::from(rng.range(-2.0, 2.0)));
        *mean = (turn * flat).as_vec3().to_array();
    }
    let edit: Edit = "merge file=floor".parse().unwrap();
    apply(&mut scene, &edit, &|_| Ok(floor.clone())).unwrap();
    let found = irradia_edit::ground(&scene).expect("there are cameras");
    assert!(DVec3::from(found.up).dot(normal) > 0.9999, "{found:?}");
    let height = DVec3::from(found.point.expect("a plane")).dot(normal);
    assert!((height + 2.0).abs() < 0.01, "{height}");
}

#[test]
fn a_survey_from_above_stays_level() {
    let cameras = (0..20).map(|i| {
        let eye = Vec3::new((i % 5) as f32 - 2.0, (i / 5) as f32 - 1.5, 3.0);
        // +Y is at the top of each photograph.
        Camera::new(
            Pose::look_at(eye, eye + Vec3::NEG_Z, Vec3::Y),
            Intrinsics::from_fov_x(96, 72, 0.9),
        )
    });
    let mut floor = cloud(600, 0, 7);
    floor.means.iter_mut().for_each(|mean| mean[2] *= 0.01);
    let found = irradia_edit::ground(&Draft::new(floor, cameras.collect())).expect("there are cameras");
    assert!(DVec3::from(found.up).dot(DVec3::Z) > 0.999, "{found:?}");
    assert!(found.point.expect("a plane")[2].abs() < 0.02, "{found:?}");
}

#[test]
fn a_reduced_scene_has_the_largest_and_most_opaque_splats() {
    let mut before = draft(100, 0);
    for i in 0..100 {
        before.cloud.log_scales[i] = [-3.0 + 0.01 * i as f32; 3];
        before.cloud.opacity_logits[i] = 1.0;
    }
    let after = edited(&before, &["reduce count=10"]);
    assert_eq!(after.cloud.means, before.cloud.means[90..]);
    let part = edited(&before, &["reduce count=5 half-space point=0,0,0 normal=1,0,0"]);
    let left = before.cloud.means.iter().filter(|mean| mean[0] < 0.0).count();
    assert_eq!(part.len(), left + 5);
}

#[test]
fn a_far_move_loses_no_digits() {
    let before = draft(100, 1);
    let far = edited(&before, &["move by=500000,6000000,0"]);
    let back = edited(&far, &["move by=-500000,-6000000,0"]);
    assert!(!far.cloud.world_from_dataset.is_identity());
    assert_eq!(far.cloud.means, before.cloud.means);
    // Doubles resolve a nanometre there.
    assert!(back.cloud.world_from_dataset.is_identity() && difference(&back.cloud, &before.cloud) < 1e-6);
    let tiny = edited(&before, &["scale factor=0.000001"]);
    assert_eq!(
        tiny.cloud.means, before.cloud.means,
        "the world keeps its size, and so does the near plane"
    );
}
