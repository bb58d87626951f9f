//! Photographs in, a dataset out: ray-traced photographs with known poses, and folders that cannot be posed.

use glam::{Quat, Vec3};
use irradia_runs::formats::{DatasetFormat, DatasetOptions, Lenses, read_dataset, read_image, write_png};
use irradia_runs::scene::{Camera, Dataset, Photo, PointCloud, Rng, View};
use irradia_runs::synth::{Capture, SceneName, Shot, Split, SynthOptions};
use irradia_runs::{
    DoctorInput, Finding, KnownDistance, Mapper, PoseInput, PoseProgress, PoseReport, RunError, check_poses, doctor,
    pose,
};
use irradia_testkit::shared;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

pub(crate) const OPTIONS: SynthOptions = SynthOptions {
    scene: SceneName::Demo,
    views: 40,
    width: 320,
    height: 240,
    seed: 3,
    lens: irradia_runs::synth::SynthLens::Pinhole,
    turn: 0.0,
};

/// The training photographs of a ray-traced scene, and their true cameras by name.
pub(crate) fn photographs(folder: &Path) -> Vec<(String, Camera)> {
    let capture = Capture::new(&OPTIONS).unwrap();
    let scene = OPTIONS.scene.build(OPTIONS.seed).0;
    let shots = capture.shots().iter().filter(|shot| shot.split == Split::Train);
    shots
        .enumerate()
        .map(|(i, shot)| {
            let name = format!("{i:02}.png");
            // A quarter of the usual samples: features tolerate the noise.
            let frame = scene.trace(&shot.camera, 4, i as u64);
            write_png(&folder.join(&name), OPTIONS.width, OPTIONS.height, 4, &frame.rgba()).unwrap();
            (name, shot.camera)
        })
        .collect()
}

/// Degrees by which the rotations between successive photographs of `dataset` differ from the true ones, independent of the world.
fn rotation_errors(dataset: &Dataset, truth: &[(String, Camera)]) -> Vec<f32> {
    let of = |name: &str| {
        let (_, camera) = truth.iter().find(|(known, _)| name.ends_with(known.as_str())).unwrap();
        camera.pose.rotation
    };
    let off = |pair: &[View]| {
        let found = pair[0].camera.pose.rotation.inverse() * pair[1].camera.pose.rotation;
        let known = of(&pair[0].name).inverse() * of(&pair[1].name);
        found.angle_between(known).to_degrees()
    };
    dataset.views.windows(2).map(off).collect()
}

pub(crate) fn pose_silently(input: &PoseInput) -> Result<PoseReport, RunError> {
    pose(input, &|_| {})
}

/// Training views by the cameras of [`OPTIONS`] of the given `scene`.
pub(crate) fn views_of(scene: SceneName) -> Vec<View> {
    let capture = Capture::new(&OPTIONS).unwrap();
    let scene = scene.build(OPTIONS.seed).0;
    let view = |shot: &Shot| {
        let frame = scene.trace(&shot.camera, 4, 1);
        let photo = Photo {
            width: OPTIONS.width,
            height: OPTIONS.height,
            channels: 4,
            data: frame.rgba(),
            mask: None,
        };
        View::new(shot.name(), shot.camera, Arc::new(photo))
    };
    let shots = capture.shots().iter().filter(|shot| shot.split == Split::Train);
    shots.map(view).collect()
}

#[test]
fn photographs_that_share_nothing_with_others_from_their_place_are_told() {
    let mut rng = Rng::new(5, 5);
    let mut points = PointCloud::default();
    for _ in 0..1200 {
        points
            .positions
            .push(Vec3::from_array([0; 3].map(|_| rng.range(-0.5, 0.5))));
        points.colors.push([128; 3]);
    }
    let seen = |view: &View, range: std::ops::Range<u32>| -> Vec<u32> {
        range
            .filter(|i| view.camera.sees(points.positions[*i as usize]).is_some())
            .collect()
    };
    let mut views = Vec::new();
    let others = views_of(SceneName::Outdoor);
    for (view, other) in views_of(OPTIONS.scene).into_iter().zip(others).take(16) {
        views.push(View {
            points_seen: seen(&view, 0..600),
            ..view
        });
        views.push(View {
            name: format!("other/{}", other.name),
            points_seen: seen(&other, 600..1200),
            ..other
        });
    }
    let check = |views: Vec<View>| {
        let points = Some(points.clone());
        check_poses(&Dataset {
            views,
            points,
            ..Dataset::default()
        })
    };
    let one = views.iter().step_by(2).cloned().collect();
    assert_eq!(check(one).absent, [[""; 2]; 0]);
    let both = check(views).absent;
    assert!(both.len() >= 12, "{both:?}");
    let is_other = |name: &String| name.starts_with("other");
    assert!(both.iter().all(|[a, b]| is_other(a) != is_other(b)), "{both:?}");
}

#[test]
fn wrong_poses_are_told_from_sound_ones_and_from_a_single_wrong_one() {
    let sound = views_of(OPTIONS.scene);
    let turned = |is_turned: &dyn Fn(&View) -> bool| {
        let mut views = sound.clone();
        let turn = Quat::from_rotation_z(0.4);
        for view in views.iter_mut().filter(|view| is_turned(view)) {
            let pose = &mut view.camera.pose;
            pose.rotation = turn * pose.rotation;
            pose.position = turn * pose.position;
        }
        check_poses(&Dataset {
            views,
            ..Dataset::default()
        })
    };
    let found = turned(&|_| false);
    assert!(
        found.pairs > 40 && found.contradicting.is_empty() && !found.is_broken(),
        "{found:?}"
    );
    let found = turned(&|view| view.name == "train/r_007");
    assert!(
        !found.contradicting.is_empty() && !found.is_broken(),
        "one photograph: {found:?}"
    );
    let is_east = |view: &View| view.camera.pose.position.x > 0.0;
    let found = turned(&is_east);
    assert!(found.is_broken(), "one side: {found:?}");
    let side = |name: &String| sound.iter().find(|view| view.name == *name).map(is_east);
    assert!(found.contradicting.iter().all(|[a, b]| side(a) != side(b)), "{found:?}");
}

#[test]
fn ray_traced_photographs_get_their_poses_back_and_a_second_call_reuses_the_features() {
    let folder = tempfile::tempdir().unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("data"));
    fs::create_dir(&photos).unwrap();
    let truth = photographs(&photos);
    fs::write(photos.join("broken.jpg"), "no picture").unwrap();
    let input = PoseInput::new(&photos, &out);
    let matched = AtomicUsize::new(0);
    let count = |event: PoseProgress| {
        if let PoseProgress::Stage { name: "matches", of } = event {
            matched.store(of, Ordering::Relaxed);
        }
    };
    let report = pose(&input, &count).unwrap();
    assert_eq!(matched.load(Ordering::Relaxed), truth.len() * (truth.len() - 1) / 2);
    assert_eq!(report.photos, truth.len() + 1);
    assert!(report.registered >= truth.len() - 1, "{report:#?}");
    assert!(
        report
            .left_out
            .iter()
            .any(|left| left.name == "broken.jpg" && left.reason.contains("not a readable"))
    );
    assert_eq!(report.registered + report.left_out.len(), report.photos);
    // One attempt was enough.
    let [attempt] = &report.attempts[..] else {
        panic!("{:?}", report.attempts)
    };
    assert_eq!(attempt.registered, report.registered);

    assert_eq!(DatasetFormat::recognise(&out), Some(DatasetFormat::Colmap));
    let dataset = read_dataset(&out, &DatasetOptions::default()).unwrap();
    assert_eq!(dataset.views.len(), report.registered);
    assert!(dataset.points.as_ref().is_some_and(|points| points.len() > 200));
    let mut angles = rotation_errors(&dataset, &truth);
    angles.sort_by(f32::total_cmp);
    assert!(angles[angles.len() / 2] < 0.5, "{angles:?}");

    let before = fs::read(out.join("sparse/0/images.bin")).unwrap();
    let points = fs::read(out.join("sparse/0/points3D.bin")).unwrap();
    // A second call, on a single thread, gives the same bytes.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let again = pool.install(|| pose(&input, &count)).unwrap();
    assert_eq!(matched.load(Ordering::Relaxed), 0, "matches are reused");
    assert_eq!(again.registered, report.registered);
    assert!(before == fs::read(out.join("sparse/0/images.bin")).unwrap());
    assert!(points == fs::read(out.join("sparse/0/points3D.bin")).unwrap());
    assert!(
        again
            .stages
            .iter()
            .all(|stage| Duration::from_secs_f64(stage.seconds) < Duration::from_secs(600))
    );

    // A known distance makes the unit a metre: here, a metre is two units of the truth.
    let place = |name: &str| {
        truth
            .iter()
            .find(|t| name.ends_with(t.0.as_str()))
            .unwrap()
            .1
            .pose
            .position
    };
    let [first, other] = [0, dataset.views.len() / 2].map(|i| dataset.views[i].name.clone());
    let name = |path: &str| Path::new(path).file_name().unwrap().to_str().unwrap().to_owned();
    let known = KnownDistance {
        photos: [name(&first), name(&other)],
        metres: f64::from(0.5 * place(&first).distance(place(&other))),
    };
    let mut in_metres = input.clone();
    in_metres.distances = vec![known.clone()];
    let scale = pose_silently(&in_metres).unwrap().scale.expect("a scale");
    assert!(
        scale.distances == 1 && (1e-6..0.05).contains(&scale.scale_error),
        "{scale:?}"
    );
    let metric = read_dataset(&out, &DatasetOptions::default()).unwrap();
    let view = |name: &str| {
        metric
            .views
            .iter()
            .find(|v| v.name == name)
            .unwrap()
            .camera
            .pose
            .position
    };
    let unit = metric.world_from_dataset.scale;
    let mut ratios: Vec<f64> = Vec::new();
    for pair in dataset.views.windows(6) {
        let [a, b] = [&pair[0].name, &pair[5].name];
        ratios.push(f64::from(view(a).distance(view(b)) / place(a).distance(place(b))) / unit);
    }
    ratios.sort_by(f64::total_cmp);
    assert!((ratios[ratios.len() / 2] / 0.5 - 1.0).abs() < 0.03, "{ratios:?}");
    for (photos, metres, reason) in [
        (
            ["nobody.png".to_owned(), name(&first)],
            1.0,
            "nobody.png is not among the photographs",
        ),
        ([name(&first), name(&first)], 1.0, "between two photographs"),
        (known.photos.clone(), -1.0, "more than 0 metres"),
    ] {
        in_metres.distances = vec![KnownDistance { photos, metres }];
        let error = pose_silently(&in_metres).unwrap_err().to_string();
        assert!(error.contains(reason), "{error}");
    }
}

#[test]
fn folders_without_enough_photographs_have_one_clear_outcome() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |photos: &Path, words: &[&str]| {
        let out = folder.path().join("out");
        let error = pose_silently(&PoseInput::new(photos, &out)).unwrap_err().to_string();
        assert!(
            !error.contains('\n') && words.iter().all(|word| error.contains(word)),
            "{error}"
        );
        assert!(!out.join("sparse").exists());
    };
    let make = |name: &str| {
        let path = folder.path().join(name);
        fs::create_dir(&path).unwrap();
        path
    };
    refused(&folder.path().join("none"), &["none"]);
    refused(&make("empty"), &["0 readable photographs", "at least 3"]);
    let one = make("one");
    // Squares of 6 pixels of random greys: corners are features.
    let picture = |seed: u32| -> Vec<u8> {
        let grey = |square: u32| ((square.wrapping_mul(seed) ^ (square << 7)).wrapping_mul(0x9e37_79b9) >> 24) as u8;
        (0..256 * 192).map(|i| grey(i / 256 / 6 * 64 + i % 256 / 6)).collect()
    };
    write_png(&one.join("a.png"), 256, 192, 1, &picture(977)).unwrap();
    fs::copy(one.join("a.png"), one.join("b.png")).unwrap();
    fs::copy(one.join("a.png"), one.join("c.png")).unwrap();
    refused(&one, &["1 readable photographs", "b.png: a copy of a.png"]);
    let apart = make("apart");
    for (name, seed) in [("a.png", 977), ("b.png", 3571), ("c.png", 104_729)] {
        write_png(&apart.join(name), 256, 192, 1, &picture(seed)).unwrap();
    }
    refused(&apart, &["no three of 3 photographs", "overlap"]);
    let smooth = make("smooth");
    for (name, slope) in [("a.png", 2), ("b.png", 3), ("c.png", 4)] {
        let ramp: Vec<u8> = (0..160 * 120u32)
            .map(|i| (i % 160 / slope + i / 160 / 2) as u8)
            .collect();
        write_png(&smooth.join(name), 160, 120, 1, &ramp).unwrap();
    }
    refused(
        &smooth,
        &["no three of 3 photographs", "3 show little texture", "newspaper"],
    );
    let two = make("two");
    fs::copy(apart.join("a.png"), two.join("a.png")).unwrap();
    fs::copy(apart.join("b.png"), two.join("b.png")).unwrap();
    refused(&two, &["2 readable photographs", "at least 3"]);
    let none = doctor(&DoctorInput::new(&two), &|_| {}).unwrap_err().to_string();
    assert!(none.contains("2 readable photographs"), "{none}");
    // A dataset from another source is not replaced.
    let foreign = make("foreign");
    fs::create_dir(foreign.join("sparse")).unwrap();
    let error = pose_silently(&PoseInput::new(&apart, &foreign))
        .unwrap_err()
        .to_string();
    assert!(error.contains("another source"), "{error}");
    let film = folder.path().join("film.mp4");
    fs::write(&film, "no film").unwrap();
    refused(&film, &["film.mp4", "ffmpeg"]);
}

/// Noise has more features than the maximum and none that match; a small image of noise has few.
#[test]
fn a_second_attempt_has_more_features_where_there_are_more_and_none_were_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let tries = |name: &str, side: u32, max_features: Option<usize>| {
        let photos = folder.path().join(format!("{name}-photos"));
        let out = folder.path().join(name);
        fs::create_dir(&photos).unwrap();
        for i in 0..3 {
            let mut rng = Rng::new(i, 1);
            let noise: Vec<u8> = (0..side * side).map(|_| rng.range(0.0, 256.0) as u8).collect();
            write_png(&photos.join(format!("{i}.png")), side, side, 1, &noise).unwrap();
        }
        let input = PoseInput {
            max_features,
            ..PoseInput::new(&photos, &out)
        };
        let told = std::sync::Mutex::new(Vec::new());
        let progress = |event| {
            if let PoseProgress::Warned(warning) = event {
                told.lock().unwrap().push(warning);
            }
        };
        pose(&input, &progress).unwrap_err();
        assert!(out.join("features-more.bin").exists());
        let told = told.into_inner().unwrap();
        assert!(told.len() == 1 && told[0].contains("0 of 3"), "{told:?}");
        told[0].clone()
    };
    assert!(tries("noise", 1600, None).contains("16384"));
    assert!(tries("small", 120, None).contains("8192"));
    assert!(tries("asked", 400, Some(300)).contains("300"));
}

/// Every second photograph around the demo scene.
#[test]
fn photographs_far_apart_are_posed_as_they_look_from_the_front() {
    let folder = tempfile::tempdir().unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("data"));
    fs::create_dir(&photos).unwrap();
    let all = photographs(&photos);
    for (i, (name, _)) in all.iter().enumerate() {
        if i % 2 == 0 {
            fs::remove_file(photos.join(name)).unwrap();
        }
    }
    let report = pose_silently(&PoseInput::new(&photos, &out)).unwrap();
    let [first, second] = &report.attempts[..] else {
        panic!("{:?}", report.attempts)
    };
    assert!(!first.frontal && second.frontal);
    assert!(first.registered < 8 && second.registered >= 13, "{:?}", report.attempts);
    assert_eq!(report.registered, second.registered);
    let dataset = read_dataset(&out, &DatasetOptions::default()).unwrap();
    let off = rotation_errors(&dataset, &all);
    assert!(off.iter().all(|off| *off < 3.0), "{off:?}");
}

#[test]
fn photographs_of_two_scenes_a_copy_and_a_text_file_have_one_clear_outcome() {
    let (Some(door), Some(fern)) = (shared("data/lund_door/images"), shared("data/fern/images_8")) else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("data"));
    fs::create_dir(&photos).unwrap();
    let files = |from: &Path, count: usize| {
        let mut files: Vec<_> = fs::read_dir(from).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        files.truncate(count);
        files
    };
    let doors = files(&door, 6);
    for (name, file) in doors
        .iter()
        .map(|f| ("door", f))
        .chain(files(&fern, 5).iter().map(|f| ("fern", f)))
    {
        let own = file.file_name().unwrap().to_str().unwrap();
        fs::copy(file, photos.join(format!("{name}_{own}"))).unwrap();
    }
    // The same pixels in another file.
    let copied = read_image(&doors[2]).unwrap();
    write_png(
        &photos.join("same.png"),
        copied.width,
        copied.height,
        copied.channels,
        &copied.data,
    )
    .unwrap();
    fs::write(photos.join("text.jpg"), "no picture").unwrap();

    let of = |findings: &[Finding], kind: &str| -> Vec<Finding> {
        findings
            .iter()
            .filter(|finding| finding.kind == kind)
            .cloned()
            .collect()
    };
    let report = pose(&PoseInput::new(&photos, &out), &|_| {}).unwrap();
    assert_eq!(
        (report.photos, report.registered, &report.models[..]),
        (13, 7, &[7, 5][..]),
        "{report:#?}"
    );
    assert_eq!(report.left_out.len(), 6);
    let parts = of(&report.findings, "separate-parts");
    assert!(
        parts.len() == 1 && parts[0].sentence.contains("2 parts") && parts[0].photos.len() == 5,
        "{parts:#?}"
    );
    let twice = of(&report.findings, "twice");
    assert!(
        twice.len() == 1 && twice[0].photos.contains(&"same.png".to_owned()),
        "{twice:#?}"
    );
    let page = fs::read_to_string(out.join("doctor.html")).unwrap();
    assert!(page.contains("separate-parts") && out.join("doctor/same.png.png").is_file());
    // The doctor alone reports the same, from the existing features, and names the text file too.
    let alone = DoctorInput {
        out: Some(out.clone()),
        ..DoctorInput::new(&photos)
    };
    let alone = doctor(&alone, &|_| {}).unwrap();
    assert_eq!(of(&alone.findings, "separate-parts"), parts);
    let unread = of(&alone.findings, "left-out");
    assert!(
        unread.len() == 1 && unread[0].sentence.starts_with("text.jpg is left out: "),
        "{unread:#?}"
    );
}

#[test]
fn a_fisheye_is_found_without_metadata_and_photographs_are_added_to_it() {
    let folder = tempfile::tempdir().unwrap();
    let options = SynthOptions {
        scene: irradia_runs::synth::SceneName::Room,
        views: 20,
        width: 480,
        height: 480,
        lens: irradia_runs::synth::SynthLens::Fisheye,
        turn: 0.0,
        ..OPTIONS
    };
    let capture = Capture::new(&options).unwrap();
    let scene = options.scene.build(options.seed).0;
    let [first, more, out] = ["first", "more", "data"].map(|name| folder.path().join(name));
    let mut truth = 0.0;
    let shots = capture.shots().iter().filter(|shot| shot.split == Split::Train);
    for (i, shot) in shots.enumerate() {
        let k = shot.camera.intrinsics;
        truth = f64::from(k.fx);
        let part = if i % 7 == 3 { &more } else { &first };
        fs::create_dir_all(part).unwrap();
        let frame = scene.trace(&shot.camera, 4, i as u64);
        write_png(&part.join(format!("{i:02}.png")), k.width, k.height, 4, &frame.rgba()).unwrap();
    }
    let report = pose_silently(&PoseInput::new(&first, &out)).unwrap();
    assert_eq!(report.registered, report.photos, "{report:#?}");
    assert!(
        (report.cameras[0].focal_px / truth - 1.0).abs() < 0.01,
        "{report:#?}, not {truth}"
    );
    let faces = |name: &str| {
        let dataset = read_dataset(&out, &DatasetOptions::default()).unwrap();
        dataset.views.iter().filter(|view| view.name.contains(name)).count()
    };
    assert!(faces("00.png") > 1, "its lens is written: it is cut into faces");
    let added = PoseInput {
        into: true,
        ..PoseInput::new(&more, &out)
    };
    let report = pose_silently(&added).unwrap();
    assert_eq!(
        (report.registered, report.left_out.len()),
        (options.views as usize, 0),
        "{report:#?}"
    );
    assert!(faces("03.png") > 1);
}

#[test]
fn panoramas_in_folders_are_posed_by_their_faces() {
    let folder = tempfile::tempdir().unwrap();
    let options = SynthOptions {
        scene: SceneName::Demo,
        views: 14,
        width: 768,
        height: 384,
        lens: irradia_runs::synth::SynthLens::Equirectangular,
        turn: 0.0,
        ..OPTIONS
    };
    let capture = Capture::new(&options).unwrap();
    let scene = options.scene.build(options.seed).0;
    let mut truth: Vec<(String, Camera)> = Vec::new();
    for (i, shot) in capture
        .shots()
        .iter()
        .filter(|shot| shot.split == Split::Train)
        .enumerate()
    {
        let (part, stem) = (["first", "second"][i % 2], format!("{i:02}"));
        let part = folder.path().join("photos").join(part);
        fs::create_dir_all(&part).unwrap();
        let [width, height] = [shot.camera.intrinsics.width, shot.camera.intrinsics.height];
        let frame = scene.trace(&shot.camera, 4, i as u64);
        write_png(&part.join(format!("{stem}.png")), width, height, 4, &frame.rgba()).unwrap();
        truth.push((stem, shot.camera));
    }
    let (photos, out) = (folder.path().join("photos"), folder.path().join("data"));
    let report = pose_silently(&PoseInput::new(&photos, &out)).unwrap();
    assert_eq!(report.photos, 6 * truth.len());
    assert_eq!(report.registered, report.photos, "{report:#?}");
    let dataset = read_dataset(&out, &DatasetOptions::default()).unwrap();
    let front = |stem: &str| {
        let mut views = dataset.views.iter();
        views
            .find(|view| view.name.contains(&format!("{stem}_front")))
            .unwrap()
            .camera
            .pose
    };
    for pair in truth.windows(2) {
        let [found, known] = [
            [&pair[0].0, &pair[1].0].map(|stem| front(stem).rotation),
            [&pair[0].1, &pair[1].1].map(|camera| camera.pose.rotation),
        ]
        .map(|[a, b]| a.inverse() * b);
        let apart = found.angle_between(known).to_degrees();
        assert!(apart < 0.5, "{} and {}: {apart} degrees", pair[0].0, pair[1].0);
    }
    // All faces have the position of their panorama.
    let of = |side: &str| {
        let name = format!("00_{side}");
        let mut views = dataset.views.iter();
        views
            .find(|view| view.name.contains(&name))
            .unwrap()
            .camera
            .pose
            .position
    };
    assert!(of("front").distance(of("up")) < 1e-5);
    // If panoramas are kept whole, they replace their faces.
    let options = DatasetOptions {
        lenses: Lenses::Whole,
        ..DatasetOptions::default()
    };
    let whole = read_dataset(&out, &options).unwrap();
    assert_eq!(whole.views.len(), truth.len());
    let points = &whole.points.as_ref().unwrap().positions;
    for (view, (stem, _)) in whole.views.iter().zip(&truth) {
        assert_eq!(view.name, format!("faces/panoramas/{stem}.png"));
        let (pose, of_face) = (view.camera.pose, front(stem));
        assert!(pose.position.distance(of_face.position) < 1e-5);
        assert!(pose.rotation.angle_between(of_face.rotation) < 1e-3);
        assert_eq!(
            (view.photo.load().unwrap().width, view.camera.intrinsics.width),
            (768, 768)
        );
        // A point seen by a face is also seen by the panorama.
        assert!(view.points_seen.len() > 10);
        assert!(
            view.points_seen
                .iter()
                .all(|i| view.camera.sees(points[*i as usize]).is_some())
        );
    }
    // Panoramas cannot be added to a dataset.
    let into = PoseInput {
        into: true,
        ..PoseInput::new(&photos, &out)
    };
    assert!(pose_silently(&into).unwrap_err().to_string().contains("panoramas"));
}

#[test]
fn options_that_exclude_each_other_are_rejected_before_anything_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut input = PoseInput::new(folder.path().join("none"), folder.path().join("out"));
    input.mapper = Mapper::Colmap;
    input.into = true;
    let error = pose_silently(&input).unwrap_err().to_string();
    assert!(error.contains("cannot add photographs"), "{error}");
    input.into = false;
    input.distances.push(KnownDistance {
        photos: ["a.jpg", "b.jpg"].map(str::to_owned),
        metres: 1.0,
    });
    let error = pose_silently(&input).unwrap_err().to_string();
    assert!(error.contains("are not scaled") && !input.out.exists(), "{error}");
}

#[cfg(unix)]
#[test]
fn colmap_is_driven_with_the_options_that_it_knows() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("photos")).unwrap();
    photographs(&at("photos"));
    // The models that the fake COLMAP copies.
    pose_silently(&PoseInput::new(at("photos"), at("ours"))).unwrap();
    let colmap = |option: &str| {
        let script = format!(
            "#!/bin/sh\nif [ \"$2\" = -h ]; then echo '  --{option} arg (=1)'; exit; fi\necho \"$@\" >> {log}\n\
             if [ \"$1\" = mapper ]; then cp -r {ours}/0 \"$7\"; fi\n\
             if [ \"$6\" = --ImageReader.mask_path ]; then cp -r \"$7\" {seen}; fi\n",
            log = at("log").display(),
            seen = at("seen").display(),
            ours = at("ours").join("sparse").display(),
        );
        fs::write(at("colmap"), script).unwrap();
        fs::set_permissions(at("colmap"), fs::Permissions::from_mode(0o755)).unwrap();
    };
    let mut input = PoseInput::new(at("photos"), at("theirs"));
    input.mapper = Mapper::Colmap;
    input.colmap = at("none").display().to_string();
    let error = pose_silently(&input).unwrap_err().to_string();
    assert!(error.contains("install COLMAP"), "{error}");
    input.colmap = at("colmap").display().to_string();
    // Old and new names of the same option.
    for option in ["SiftExtraction.use_gpu", "FeatureExtraction.use_gpu"] {
        colmap(option);
        let report = pose_silently(&input).unwrap();
        assert!(report.registered >= 30 && report.points > 500, "{report:?}");
        let log = fs::read_to_string(at("log")).unwrap();
        let steps: Vec<&str> = log.lines().rev().take(3).collect();
        assert!(
            steps[2].starts_with("feature_extractor") && steps[2].contains(&format!("--{option} 0")),
            "{log}"
        );
        assert!(
            !steps[2].contains("single_camera"),
            "an option that it does not know: {log}"
        );
        assert!(
            steps[1].starts_with("exhaustive_matcher") && steps[0].starts_with("mapper"),
            "{log}"
        );
    }
    let dataset = read_dataset(&at("theirs"), &DatasetOptions::default()).unwrap();
    assert!(dataset.views.len() >= 30);
    // Masks of any format reach it in the form that it knows.
    fs::create_dir(at("photos/masks")).unwrap();
    let half = image::GrayImage::from_fn(320, 240, |x, _| image::Luma([if x < 160 { 9 } else { 240 }]));
    half.save(at("photos/masks/00_mask.jpg")).unwrap();
    colmap("ImageReader.mask_path");
    pose_silently(&input).unwrap();
    let seen = image::open(at("seen/00.png.png")).unwrap().to_luma8();
    assert_eq!(
        (seen.dimensions(), seen.get_pixel(80, 120).0, seen.get_pixel(240, 120).0),
        ((320, 240), [0], [255])
    );
    assert!(at("theirs/masks/00.png.jpg").is_file() && !at("theirs/masks_colmap").exists());
    fs::write(
        at("colmap"),
        "#!/bin/sh\n[ \"$2\" = -h ] && exit\n[ $1 = help ] && exit\necho first >&2\necho 'out of luck' >&2\nexit 3\n",
    )
    .unwrap();
    let error = pose_silently(&input).unwrap_err().to_string();
    assert!(
        error.contains("feature_extractor failed") && error.ends_with("out of luck"),
        "{error}"
    );
}

/// The [`photographs`] as two films: the first half of a ring and the second, with each photograph shown for a while.
fn films(folder: &Path) -> Option<Vec<PathBuf>> {
    let frames = folder.join("frames");
    fs::create_dir(&frames).unwrap();
    let mut names: Vec<String> = photographs(&frames).into_iter().map(|(name, _)| name).collect();
    let second = names.split_off(names.len() / 2);
    let film = |(film, names): (&str, Vec<String>)| {
        let list = folder.join(format!("{film}.txt"));
        let lines: String = names
            .iter()
            .flat_map(|name| [format!("file 'frames/{name}'\nduration 0.25\n")])
            .collect();
        fs::write(&list, lines).unwrap();
        let file = folder.join(format!("{film}.mp4"));
        let made = Command::new("ffmpeg")
            .args(["-loglevel", "error", "-y", "-f", "concat", "-i"])
            .arg(&list)
            .args(["-r", "30", "-pix_fmt", "yuv420p", "-q:v", "2"])
            .arg(&file)
            .status();
        made.is_ok_and(|status| status.success()).then_some(file)
    };
    [("first", names), ("second", second)].into_iter().map(film).collect()
}

#[test]
fn several_films_are_posed_together() {
    let folder = tempfile::tempdir().unwrap();
    let Some(films) = films(folder.path()) else {
        eprintln!("SKIPPED: ffmpeg is not installed, so that no film can be made");
        return;
    };
    let out = folder.path().join("data");
    let input = PoseInput {
        photos: films,
        ..PoseInput::new("", &out)
    };
    let report = pose_silently(&input).unwrap();
    let names: Vec<String> = fs::read_dir(out.join("frames"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".jpg"))
        .collect();
    // Each photograph is chosen once.
    for film in ["first_", "second_"] {
        let count = names.iter().filter(|name| name.starts_with(film)).count();
        assert!((15..=22).contains(&count), "{film}: {count}");
    }
    assert!(10 * report.registered >= 9 * names.len(), "{report:#?}");
    assert_eq!(report.models.len(), 1, "{:?}", report.models);
}

#[test]
fn films_are_read_as_they_look_and_damaged_ones_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let Some(films) = films(folder.path()) else {
        eprintln!("SKIPPED: ffmpeg is not installed, so that no film can be made");
        return;
    };
    let photos = folder.path().join("photos");
    fs::create_dir(&photos).unwrap();
    // Pixels twice as wide as high, and an output folder whose name looks like an ffmpeg pattern.
    let made = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-y", "-i"])
        .arg(&films[0])
        .args(["-vf", "scale=iw/2:ih,setsar=2", "-q:v", "2"])
        .arg(photos.join("wide.mp4"))
        .status();
    assert!(made.is_ok_and(|status| status.success()));
    let given = photographs(&photos);
    fs::write(photos.join("damaged.mp4"), "no film").unwrap();
    let out = folder.path().join("half 50%d");
    let report = pose_silently(&PoseInput::new(&photos, &out)).unwrap();
    let left: Vec<&str> = report.left_out.iter().map(|left| left.name.as_str()).collect();
    assert!(left.contains(&"damaged.mp4"), "{left:?}");
    let is_frame = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "jpg");
    let mut frames = fs::read_dir(out.join("frames"))
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let size = |path: &Path| read_image(path).map(|image| (image.width, image.height)).unwrap();
    assert_eq!(size(&frames.find(is_frame).unwrap()), size(&photos.join(&given[0].0)));
}
