//! Edited scenes on disk, and runs that begin with them.

use crate::{SMALL, begin, dataset, finished, folder, input};
use glam::{Quat, Vec3};
use irradia_edit::EditList;
use irradia_runs::formats::{WriteOptions, read_splats, write_splats};
use irradia_runs::prelude::*;
use irradia_runs::scene::{GaussianCloud, Rng, sh};
use irradia_runs::synth::{SceneName, SynthLens, dataset as traced};
use irradia_runs::train::eval::EvalOptions;
use irradia_runs::train::event::{Event, Observer, Signal};
use irradia_runs::train::schedule::plan;
use irradia_runs::{EDITS, Editing, ReadingOptions, convert, is_moved};
use irradia_splat::logit;
use serde_json::Value;
use std::fs;
use std::path::Path;

fn list(lines: &[&str]) -> EditList {
    EditList {
        edits: lines.iter().map(|line| line.parse().expect(line)).collect(),
        ..EditList::default()
    }
}

fn edited(input: &Path, lines: &[&str]) -> Editing {
    let mut editing = Editing::open(input).expect("a scene");
    editing.apply(&list(lines)).expect("edits");
    editing
}

/// The mean PSNR of held-out views, dB.
fn held_out_psnr(scene: &Scene, data: &Dataset) -> Result<f64, RunError> {
    let options = EvalOptions::psnr(scene.options, None, &irradia_compute::Device::Cpu);
    evaluate(&scene.model, data, &data.test, &options, |_| Ok::<(), RunError>(())).map(|mean| mean.psnr)
}

#[test]
fn a_folder_gets_the_scene_its_moved_cameras_and_the_edits() {
    let folder = folder();
    finished(folder.path(), "run", 5);
    let (path, out) = (folder.path().join("run"), folder.path().join("out"));
    let editing = edited(&path, &["rotate axis=1,2,0 degrees=40", "move by=0,0,3"]);
    editing.write(&out, &WriteOptions::default()).expect("writes");

    // The scene and its cameras have moved together.
    let (before, after) = (Scene::read(&path).expect("a run"), Scene::read(&out).expect("a folder"));
    let cameras = |scene: &Scene| scene.cameras.clone().expect("beside it");
    for (old, new) in cameras(&before).iter().zip(cameras(&after).iter()) {
        let (a, b) = (before.render(old).color, after.render(new).color);
        let worst = a
            .data
            .iter()
            .zip(&b.data)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(worst < 2e-3, "{worst}");
    }
    let written = EditList::parse(&fs::read_to_string(out.join(EDITS)).expect("a list")).expect("valid");
    assert_eq!(&written, editing.list());

    // Replayed on the same scene, the list gives the same bytes.
    let again = folder.path().join("again.ply");
    let mut replayed = Editing::open(&path).expect("a scene");
    replayed.apply(&written).expect("the same edits");
    replayed.write(&again, &WriteOptions::default()).expect("writes");
    assert!(fs::read(&again).unwrap() == fs::read(out.join("scene.ply")).unwrap());

    // Outputs that must not be overwritten are rejected.
    for (out, words) in [
        (path.join("scene.ply"), "would be replaced"),
        (path.clone(), "would be replaced"),
        (folder.path().join("scene.xyz"), "known extensions"),
    ] {
        let error = editing
            .write(&out, &WriteOptions::default())
            .expect_err("refused")
            .to_string();
        assert!(error.contains(words) && !error.contains('\n'), "{error}");
    }
    let error = editing.write_in_place().expect_err("moved").to_string();
    assert!(error.contains("photographs"), "{error}");

    // Neither is a folder with files of somebody else.
    let foreign = folder.path().join("foreign");
    fs::create_dir(&foreign).unwrap();
    fs::write(foreign.join("cameras.json"), "[]").unwrap();
    let error = editing.write(&foreign, &WriteOptions::default()).expect_err("refused");
    assert!(error.to_string().contains("cameras.json would be replaced"), "{error}");
    assert!(foreign.join("cameras.json").is_file() && !foreign.join("scene.ply").exists());

    // Another scene written to the same folder keeps no files of this one.
    edited(&again, &["opacity factor=0.9 all"])
        .write(&out, &WriteOptions::default())
        .expect("writes");
    assert!(out.join("scene.ply").exists() && !out.join("cameras.json").exists() && !out.join("recipe.toml").exists());
}

#[test]
fn what_is_split_off_and_merged_again_is_the_same_scene() {
    let folder = folder();
    finished(folder.path(), "run", 5);
    let path = folder.path().join("run");
    let out = folder.path().join("rest.ply");
    let editing = edited(&path, &["split name=part half-space point=0,0,0.5 normal=0,0,1"]);
    let notes = editing.write(&out, &WriteOptions::default()).expect("writes");
    let part = folder.path().join("part.ply");
    assert!(
        part.is_file() && notes.iter().any(|note| note.contains("split off")),
        "{notes:?}"
    );
    // A folder that does not exist yet is created; the scene's own name and duplicate names are rejected.
    let fresh = folder.path().join("fresh");
    editing.write(&fresh, &WriteOptions::default()).expect("writes");
    assert!(fresh.join("part.ply").is_file() && fresh.join("scene.ply").is_file());
    let refused = |edits: &[&str], out: &str, words: &str| {
        let error = edited(&path, edits).write(&folder.path().join(out), &WriteOptions::default());
        let error = error.expect_err("refused").to_string();
        assert!(error.contains(words) && !folder.path().join(out).exists(), "{error}");
    };
    let half = "half-space point=0,0,0.5 normal=0,0,1";
    refused(&[&format!("split name=new {half}")], "new.ply", "the scene itself");
    let twice = format!("split name=twice {half}");
    refused(
        &[&twice, &twice.replace("normal=0,0,1", "normal=0,0,-1")],
        "other.ply",
        "split off before",
    );
    let merged = edited(&out, &[&format!("merge file={}", part.display())]);
    // A merged scene is not replaced, however its path is spelled.
    for name in ["part.ply", "missing/../part.ply"] {
        let error = merged.write(&folder.path().join(name), &WriteOptions::default());
        let error = error.expect_err("refused").to_string();
        assert!(
            error.contains("would be replaced") && !folder.path().join("missing").exists(),
            "{error}"
        );
    }
    let whole = read_splats(&path.join("scene.ply")).unwrap();
    assert_eq!(merged.draft().len(), whole.len());
    let sorted = |cloud: &GaussianCloud| {
        let mut means = cloud.means.clone();
        means.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        means
    };
    assert_eq!(sorted(&merged.draft().cloud), sorted(&whole));
}

/// Stops after a number of steps.
struct StopAt(u64);

impl Observer for StopAt {
    fn on_event(&mut self, event: &Event, _: &Trainer) -> Signal {
        match event {
            Event::Step(report) if report.step >= self.0 => Signal::Stop,
            _ => Signal::Continue,
        }
    }
}

#[test]
fn merged_scenes_that_look_different_are_reported() {
    let folder = folder();
    let [plain, filtered] = [false, true].map(|antialiased| {
        let cloud = GaussianCloud {
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            log_scales: vec![[-3.0; 3]],
            opacity_logits: vec![1.0],
            sh: vec![0.5; 3],
            antialiased,
            ..GaussianCloud::default()
        };
        let path = folder.path().join(format!("{antialiased}.ply"));
        write_splats(&path, &cloud).expect("writes");
        path
    });
    let notes = |scene: &Path, other: &Path| edited(scene, &[&format!("merge file={}", other.display())]).notes;
    assert_eq!(notes(&plain, &plain), [""; 0]);
    for (scene, other, words) in [
        (&plain, &filtered, "true.ply: trained with Mip-Splatting's filter"),
        (&filtered, &plain, "false.ply: trained without Mip-Splatting's filter"),
    ] {
        assert!(notes(scene, other).concat().contains(words), "{words}");
    }
}

#[test]
fn a_run_edited_in_place_resumes_with_the_edited_splats() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 12);
    run.train(&mut [&mut StopAt(6)]).expect("trains");
    assert!(!run.finish().expect("is saved").complete);
    let path = folder.path().join("run");
    let before = Editing::open(&path).expect("a scene").draft().len();
    let half = "half-space point=0,0,0.6 normal=0,0,1";
    let editing = edited(
        &path,
        &[
            &format!("delete {half}"),
            "recolor exposure=0.2 sphere center=0,0,0 radius=0.5",
        ],
    );
    let notes = editing.write_in_place().expect("writes");
    assert!(notes.iter().any(|note| note.contains("optimiser state")), "{notes:?}");
    let left = read_splats(&path.join("scene.ply")).unwrap().len();
    assert!(left < before && left == editing.draft().len());
    // A second edit is appended to the list.
    edited(&path, &["opacity factor=0.9 all"])
        .write_in_place()
        .expect("writes");
    // The file of a split is the only copy of its splats, so it is not overwritten.
    let split = |half: &str| edited(&path, &[&format!("split name=part {half}")]).write_in_place();
    split("half-space point=0,0,0.3 normal=0,0,1").expect("writes");
    let part = fs::read(path.join("part.ply")).expect("was split off");
    let error = split("half-space point=0,0,0 normal=0,0,1")
        .expect_err("exists")
        .to_string();
    assert!(error.contains("part.ply exists already"), "{error}");
    assert_eq!(fs::read(path.join("part.ply")).expect("is kept"), part);
    let left = read_splats(&path.join("scene.ply")).unwrap().len();
    let listed = EditList::parse(&fs::read_to_string(path.join(EDITS)).unwrap()).unwrap();
    assert_eq!(listed.edits.len(), 4);
    // A list that cannot be read is not replaced, and neither is the scene.
    let [list, scene] = [EDITS, "scene.ply"].map(|name| fs::read(path.join(name)).expect("a file"));
    fs::write(path.join(EDITS), b"\xff").unwrap();
    let error = edited(&path, &["opacity factor=0.9 all"])
        .write_in_place()
        .expect_err("unreadable")
        .to_string();
    assert!(error.contains(EDITS), "{error}");
    assert_eq!(fs::read(path.join(EDITS)).unwrap(), b"\xff");
    assert!(fs::read(path.join("scene.ply")).unwrap() == scene);
    fs::remove_file(path.join(EDITS)).unwrap();
    // A list that cannot be written leaves the checkpoint as it is, too.
    #[cfg(unix)]
    {
        let checkpoints = || {
            let files = fs::read_dir(path.join("checkpoints")).unwrap().flatten();
            files
                .map(|file| (file.path(), fs::read(file.path()).unwrap()))
                .collect::<Vec<_>>()
        };
        let before = checkpoints();
        std::os::unix::fs::symlink("/proc/no folder/list", path.join(EDITS)).unwrap();
        let error = edited(&path, &["opacity factor=0.9 all"])
            .write_in_place()
            .expect_err("no folder")
            .to_string();
        assert!(error.contains("cannot"), "{error}");
        assert!(checkpoints() == before && fs::read(path.join("scene.ply")).unwrap() == scene);
        fs::remove_file(path.join(EDITS)).unwrap();
    }
    fs::write(path.join(EDITS), list).unwrap();

    let request = TrainInput::of_run(&path).unwrap().check().unwrap();
    let mut run = Run::resume_on(request, dataset()).expect("resumes");
    let state = run.trainer().engine.state();
    assert_eq!((run.trainer().clock.step, state.len()), (6, left));
    run.train(&mut []).expect("trains");
    assert!(run.finish().expect("finishes").complete);
    // A finished run needs no checkpoints.
    fs::remove_dir_all(path.join("checkpoints")).unwrap();
    edited(&path, &["opacity factor=0.9 all"])
        .write_in_place()
        .expect("writes");
}

#[test]
fn a_training_begins_with_the_splats_of_a_scene() {
    let folder = folder();
    let first = finished(folder.path(), "run", 30).report;
    let from = TrainInput {
        from: Some(folder.path().join("run")),
        ..input(folder.path(), "next", 1)
    };
    let mut run = Run::begin_on(from.clone().check().expect("a request"), dataset()).expect("a run");
    let splats = run.trainer().engine.state().splats.clone();
    assert_eq!(splats.len(), first.splats as usize);
    let shown = plan(&run.trainer().recipe, &run.trainer().clock).sh_degree;
    assert_eq!(
        shown, 3,
        "colours that depend on the direction do so from the first step on"
    );
    run.train(&mut []).expect("trains");
    let second = run.finish().expect("finishes").report;
    assert!(second.psnr > first.psnr - 1.0, "{} after {}", second.psnr, first.psnr);

    let fewer = TrainInput {
        out: folder.path().join("fewer"),
        max_splats: Some(1000),
        ..from.clone()
    };
    let error = Run::begin_on(fewer.check().unwrap(), dataset())
        .err()
        .expect("too many")
        .to_string();
    assert!(error.contains("reduce count=1000"), "{error}");
    let field = TrainInput {
        recipe: "hashgrid".into(),
        ..from.clone()
    };
    assert!(field.check().unwrap_err().to_string().contains("from"));
    let missing = TrainInput {
        from: Some("nowhere.ply".into()),
        ..from
    };
    assert!(
        Run::begin_on(
            TrainInput {
                out: folder.path().join("other"),
                ..missing
            }
            .check()
            .unwrap(),
            dataset()
        )
        .is_err()
    );
    assert!(!folder.path().join("other").exists());
}

#[test]
fn cameras_follow_moved_scenes_and_splats_are_not_trained_on_other_poses() {
    let folder = folder();
    let here = |name: &str| folder.path().join(name);
    write_synth_dataset(here("photos"), &SMALL).expect("written");
    let request = TrainInput {
        data: here("photos"),
        ..input(folder.path(), "run", 12)
    };
    let mut run = Run::begin(request.clone().check().expect("a request")).expect("a run");
    run.train(&mut [&mut StopAt(6)]).expect("trains");
    assert!(!run.finish().expect("is saved").complete);
    let psnr = |name: &str| {
        let path = here(name);
        let scene = Scene::read(&path)?;
        let data = ReadingOptions::default().read_for(&scene, &path, &here("photos"))?;
        held_out_psnr(&scene, &data)
    };
    let begin_from = |name: &str| {
        let from = TrainInput {
            from: Some(here(name)),
            out: here("next"),
            ..request.clone()
        };
        Run::begin(from.check().expect("a request"))
    };
    let line = |run: Result<Run, RunError>| run.err().expect("refused").to_string();
    let as_trained = psnr("run").expect("photographs");
    let moves = ["rotate axis=1,2,0 degrees=40", "scale factor=2", "move by=0,0,3"];
    let editing = edited(&here("run"), &moves);
    for moved in ["run/up.ply", "subject"] {
        editing.write(&here(moved), &WriteOptions::default()).expect("writes");
        let psnr = psnr(moved).expect("photographs");
        // Splats and cameras are rounded after the move: renders differ by less than a level of 8 bits.
        assert!((psnr - as_trained).abs() < 0.1, "{moved}: {psnr}, not {as_trained}");
        let error = line(begin_from(moved));
        assert!(error.contains("moved away"), "{error}");
    }
    drop(begin_from("run").expect("a run"));
    // Cameras come along to another file, and those of another format of the same name are its own.
    let (up, copy) = (here("run/up.ply"), here("run/copy.ply"));
    convert(&up, &copy, &WriteOptions::default(), false).expect("converts");
    edited(&here("run"), &["opacity factor=0.9"])
        .write(&here("run/up.spz"), &WriteOptions::default())
        .expect("writes");
    assert!(is_moved(&copy) && is_moved(&up) && !is_moved(&here("run/up.spz")));
    assert_eq!(
        psnr("run/copy.ply").expect("photographs"),
        psnr("run/up.ply").expect("photographs")
    );

    // Each photograph gets the pose of another.
    let path = here("photos/transforms_train.json");
    let mut transforms: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let frames = transforms["frames"].as_array_mut().expect("frames");
    let mut poses: Vec<Value> = frames.iter().map(|frame| frame["transform_matrix"].clone()).collect();
    poses.rotate_left(1);
    for (frame, pose) in frames.iter_mut().zip(poses) {
        frame["transform_matrix"] = pose;
    }
    fs::write(&path, transforms.to_string()).unwrap();
    fs::remove_dir_all(here("next")).unwrap();
    let resumed = Run::resume(TrainInput::of_run(here("run")).unwrap().check().unwrap());
    for error in [
        line(begin_from("run")),
        line(resumed),
        psnr("run").expect_err("refused").to_string(),
    ] {
        assert!(error.contains("other poses") && !error.contains('\n'), "{error}");
    }
}

/// Five hundred floaters of five kinds in a trained scene: nearly all are removed, the scene stays, and held-out views recover.
#[test]
fn floaters_planted_in_a_trained_scene_are_removed() {
    let folder = folder();
    let options = SynthOptions {
        scene: SceneName::Room,
        views: 24,
        width: 96,
        height: 72,
        seed: 2,
        lens: SynthLens::Pinhole,
        turn: 0.0,
    };
    let data = traced(&options).expect("options");
    let request = input(folder.path(), "run", 300).check().expect("a request");
    let mut run = Run::begin_on(request, data.clone()).expect("a run");
    run.train(&mut []).expect("trains");
    let before = run.finish().expect("finishes").report.psnr;
    let path = folder.path().join("run/scene.ply");
    let clean = read_splats(&path).unwrap();
    let cameras = Scene::read(&path).unwrap().cameras.expect("beside it");
    let planted = planted(&clean, &cameras);
    write_splats(&path, &planted).unwrap();

    let editing = edited(&path, &["delete floaters"]);
    let left = &editing.draft().cloud;
    let found = planted.means[clean.len()..]
        .iter()
        .filter(|mean| !left.means.contains(mean))
        .count();
    let lost = planted.len() - left.len() - found;
    assert!(found >= 475, "{found} of 500 found");
    assert!(lost * 100 <= clean.len(), "{lost} of {} lost", clean.len());

    let psnr = |cloud: &GaussianCloud| {
        write_splats(&path, cloud).unwrap();
        let scene = Scene::read(&path).unwrap();
        held_out_psnr(&scene, &data).expect("photographs")
    };
    let (as_trained, with, after) = (psnr(&clean), psnr(&planted), psnr(left));
    assert!(
        (as_trained - before).abs() < 0.5,
        "the report's own figure: {before}, {as_trained}"
    );
    assert!(with < as_trained - 3.0, "{with}");
    // After this short training, the walls are too sparse to show that every floater is in front of them; the remaining floaters cost the
    // rest.
    assert!(
        after > with + 5.0,
        "{after:.2} dB, {with:.2} dB with floaters, {as_trained:.2} dB as trained"
    );
}

/// Adds a hundred floaters of each kind: isolated in front of a surface, needles, huge, outside all views, close to a camera.
fn planted(clean: &GaussianCloud, cameras: &[Camera]) -> GaussianCloud {
    let mut cloud = clean.clone();
    let mut rng = Rng::new(5, 0);
    let middle = cameras.iter().map(|c| c.pose.position).sum::<Vec3>() / cameras.len() as f32;
    let mut distances: Vec<f32> = clean
        .means
        .iter()
        .map(|mean| middle.distance(Vec3::from(*mean)))
        .collect();
    distances.sort_by(f32::total_cmp);
    let [unit, far] = [0.3, 0.99].map(|q| distances[(distances.len() as f32 * q) as usize]);
    let width = 3 * clean.sh_coefficients();
    for i in 0..500 {
        let (mean, scales, opacity) = loop {
            let camera = &cameras[rng.below(cameras.len() as u32) as usize];
            let k = camera.intrinsics;
            let pixel = glam::Vec2::new(rng.uniform() * k.width as f32, rng.uniform() * k.height as f32);
            let (eye, ray) = camera.ray(pixel);
            let direction = Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize();
            let opacity = rng.range(0.3, 0.95);
            let mut ball = |low: f32, high: f32| [unit * rng.range(low, high); 3];
            let planted = match i / 100 {
                0 => (0.5, ball(0.01, 0.03), opacity),
                1 => (0.5, [0.3 * unit, 0.003 * unit, 0.003 * unit], opacity),
                2 => (0.3, [3.0 * unit, 2.0 * unit, unit], 0.3 * opacity),
                3 => (0.0, ball(0.02, 0.05), opacity),
                _ => (0.1, ball(0.004, 0.02), opacity),
            };
            let (along, scales, opacity) = planted;
            let mean = if along > 0.0 {
                eye + ray * unit * along
            } else {
                middle + direction * far * 3.0
            };
            // Isolated means far from everything.
            let near = clean
                .means
                .iter()
                .any(|other| mean.distance(Vec3::from(*other)) < 5.0 * scales[0]);
            if i >= 100 || !near {
                break (mean, scales, opacity);
            }
        };
        let turn = Quat::from_xyzw(rng.normal(), rng.normal(), rng.normal(), rng.normal()).normalize();
        cloud.means.push(mean.to_array());
        cloud.quats.push([turn.w, turn.x, turn.y, turn.z]);
        cloud.log_scales.push(scales.map(f32::ln));
        cloud.opacity_logits.push(logit(opacity));
        let mut harmonics = vec![0.0; width];
        harmonics[..3].fill_with(|| sh::dc_from_color(rng.uniform()));
        cloud.sh.extend(harmonics);
    }
    cloud
}
