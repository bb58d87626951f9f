//! Training and held-out views, their size and their background.

use crate::process::*;
use image::{Rgba, RgbaImage};
use serde_json::json as value;
use std::fs;
use std::path::Path;

/// Names of the held-out views in a run's report.
fn held_out(run: &Path) -> Vec<String> {
    let report = json(&run.join("report.json"));
    let views = report["views"].as_array().expect("views").iter();
    views
        .map(|view| view["name"].as_str().expect("a name").to_owned())
        .collect()
}

#[test]
fn without_held_out_views_all_are_trained_on_and_no_metric_is_reported() {
    let folder = with_data();
    let ended = irradia(folder.path(), "train data --out run --steps 5 --holdout 0").success();
    assert!(!ended.stdout.contains("PSNR") && ended.stdout.contains("nothing was evaluated"));
    let text = fs::read_to_string(folder.path().join("run/report.json")).expect("a report");
    assert!(
        !text.contains("null") && !text.contains("NaN") && !text.contains("\"psnr\""),
        "{text}"
    );
    assert!(text.contains("no view is held out"));
    assert_eq!(events(&folder.path().join("run"))[0]["views"], 10);
    // Training views are not evaluated later by default.
    irradia(folder.path(), "eval run --data data").refused(2, &["no such views"]);
    irradia(folder.path(), "train data --out x --steps 5 --holdout 0 --until-psnr 9").refused(2, &["--until-psnr"]);
}

#[test]
fn a_number_or_a_list_selects_the_held_out_views() {
    let folder = with_data();
    irradia(folder.path(), "train data --out run --steps 5 --holdout 5").success();
    assert_eq!(
        held_out(&folder.path().join("run")),
        ["test/r_000.png", "train/r_003.png"]
    );
    let ended = irradia(folder.path(), "eval run --data data").success();
    assert!(
        ended.stdout.contains("train/r_003.png") && ended.stdout.contains("mean of 2"),
        "{ended:?}"
    );
    fs::write(folder.path().join("list.txt"), "train/r_001\n").expect("written");
    irradia(folder.path(), "train data --out listed --steps 5 --holdout list.txt").success();
    assert_eq!(held_out(&folder.path().join("listed")), ["train/r_001.png"]);
    for wrong in ["1", "none.txt"] {
        irradia(folder.path(), &format!("train data --out x --holdout {wrong}")).refused(2, &["--holdout", wrong]);
    }
    fs::write(folder.path().join("list.txt"), "nobody\n").expect("written");
    irradia(folder.path(), "train data --out x --holdout list.txt").refused(2, &["list.txt", "names none"]);
}

#[test]
fn a_moved_run_resumes_with_its_own_photographs_and_the_views_of_a_list_that_is_gone() {
    let folder = with_data();
    let here = |name: &str| folder.path().join(name);
    fs::create_dir(here("run")).expect("a folder");
    fs::rename(here("data"), here("run/posed")).expect("moved");
    fs::write(here("list.txt"), "train/r_001\n").expect("written");
    let line = "train run/posed --out run --steps 40 --set checkpoint_every=20 --holdout list.txt";
    irradia(folder.path(), line).success();
    let before = fs::read(here("run/scene.ply")).expect("a scene");
    fs::rename(here("run"), here("moved")).expect("moved");
    fs::rename(here("list.txt"), here("other.txt")).expect("moved");
    for option in ["", "--holdout other.txt"] {
        unfinish(&here("moved"), "scene.ply");
        irradia(folder.path(), &format!("train --resume moved {option}")).success();
        assert!(
            fs::read(here("moved/scene.ply")).expect("a scene") == before,
            "{option}"
        );
        assert_eq!(held_out(&here("moved")), ["train/r_001.png"], "{option}");
    }
    fs::remove_file(here("other.txt")).expect("removed");
    let ended = irradia(folder.path(), "eval moved --data moved/posed").success();
    assert!(
        ended.stdout.contains("train/r_001.png") && ended.stdout.contains("mean of 1"),
        "{ended:?}"
    );
    irradia(folder.path(), "train --replay moved --out again").success();
    assert_eq!(held_out(&here("again")), ["train/r_001.png"]);
    unfinish(&here("moved"), "scene.ply");
    irradia(folder.path(), "train --resume moved --holdout 5").refused(2, &["--holdout 5", "other views"]);
}

#[test]
fn a_dataset_without_its_training_images_is_rejected() {
    let folder = with_data();
    // There are enough held-out views to train on, if that were allowed.
    let path = folder.path().join("data/transforms_test.json");
    let mut test = json(&path);
    let mut frame = test["frames"][0].clone();
    let first = frame["file_path"].as_str().expect("a path").to_owned();
    for copy in ["more", "most"] {
        let at = |name: &str| folder.path().join("data").join(format!("{name}.png"));
        fs::copy(at(&first), at(&format!("{first}_{copy}"))).expect("copied");
        frame["file_path"] = format!("{first}_{copy}").into();
        test["frames"].as_array_mut().expect("frames").push(frame.clone());
    }
    fs::write(&path, test.to_string()).expect("written");
    fs::remove_dir_all(folder.path().join("data/train")).expect("removed");
    irradia(folder.path(), "train data --out x").refused(1, &["data", "no view is left to train on", "r_000"]);
    assert!(!folder.path().join("x").exists());
}

#[test]
fn large_photographs_are_downscaled_unless_another_size_is_requested() {
    let folder = with_data();
    irradia(folder.path(), "synth wide --views 3 --size 1700x8").success();
    for (option, width) in [
        ("", 1600),
        ("--full-size", 1700),
        ("--downscale 2", 850),
        ("--max-side 34", 34),
    ] {
        let ended = irradia(
            folder.path(),
            &format!("train wide --out run --overwrite --steps 1 {option}"),
        )
        .success();
        assert_eq!(
            json(&folder.path().join("run/cameras.json"))[0]["width"],
            width,
            "{option}"
        );
        let told = json(&folder.path().join("run/report.json"))["warnings"].to_string();
        for said in [ended.stderr, told] {
            assert_eq!(
                said.contains("1700x8 pixels, are scaled to 1600"),
                width == 1600,
                "{option}: {said}"
            );
        }
    }
}

#[test]
fn blender_scenes_have_a_white_background_by_default() {
    let folder = with_data();
    for picture in files_under(&folder.path().join("data")) {
        if picture.extension().is_some_and(|e| e == "png") && !picture.to_string_lossy().contains("depth") {
            let mut image = image::open(&picture).expect("a picture").to_rgba8();
            for x in 0..20 {
                (0..48).for_each(|y| image.put_pixel(x, y, Rgba([90, 90, 90, 0])));
            }
            image.save(&picture).expect("written");
        }
    }
    let corner = |run: &str| {
        let view = json(&folder.path().join(run).join("report.json"))["views"][0]["truth"].clone();
        let truth: RgbaImage = image::open(folder.path().join(run).join(view.as_str().expect("a path")))
            .expect("a picture")
            .to_rgba8();
        truth.get_pixel(0, 0).0[0]
    };
    for (run, option, said, level) in [
        ("usual", "", "white", 255),
        ("black", "--background black", "black", 0),
        ("grey", "--background grey", "grey", 128),
        (
            "random",
            "--background random",
            "white; trained over random colours",
            255,
        ),
        ("set", "--set render.background=[0.0,0.0,1.0]", "#0000ff", 0),
    ] {
        let ended = irradia(folder.path(), &format!("train data --out {run} --steps 5 {option}")).success();
        assert!(ended.stderr.contains(&format!("background: {said}")), "{ended:?}");
        let report = json(&folder.path().join(run).join("report.json"));
        assert!(
            report["background"].as_str().is_some_and(|b| b.starts_with(said)),
            "{report}"
        );
        assert_eq!(corner(run), level, "{run}");
        irradia(folder.path(), &format!("eval {run} --data data --json {run}.json")).success();
        let again = json(&folder.path().join(format!("{run}.json")));
        assert!(
            (again["psnr"].as_f64().unwrap() - report["psnr"].as_f64().unwrap()).abs() < 1e-9,
            "{run}"
        );
    }
    irradia(
        folder.path(),
        "eval black --data data --background white --json white.json",
    )
    .success();
    let psnr = |file: &str| json(&folder.path().join(file))["psnr"].as_f64();
    assert!(psnr("white.json") < psnr("black.json"));
    irradia(folder.path(), "train data --out x --background teal").refused(2, &["--background", "teal"]);
}

#[test]
fn views_with_colliding_names_get_separate_files() {
    let folder = with_data();
    let test = folder.path().join("data/test");
    let image = image::open(test.join("r_001.png")).expect("a picture").to_rgb8();
    image.save(test.join("r_000.jpg")).expect("written");
    let path = folder.path().join("data/transforms_test.json");
    let mut content = json(&path);
    content["frames"][1]["file_path"] = value!("./test/r_000.jpg");
    content["frames"][0]["file_path"] = value!("./test/r_000.png");
    fs::write(&path, content.to_string()).expect("written");
    irradia(folder.path(), "train data --out run --steps 5").success();
    let report = json(&folder.path().join("run/report.json"));
    let render = |i: usize| {
        folder
            .path()
            .join("run")
            .join(report["views"][i]["render"].as_str().expect("a path"))
    };
    assert_ne!(
        fs::read(render(0)).expect("a file"),
        fs::read(render(1)).expect("another")
    );
    irradia(folder.path(), "eval run --data data --save-images seen").success();
    irradia(folder.path(), "render run --data data --out frames").success();
    for name in ["seen", "frames"] {
        assert_eq!(files_under(&folder.path().join(name)).len(), 2, "{name}");
    }
}

/// Cameras that turn by 4 degrees during the readout are trained on with their motion; without their velocities the scene is blurred.
#[test]
fn photographs_by_a_rolling_shutter_train_a_sharp_scene() {
    let folder = tempfile::tempdir().expect("a folder");
    irradia(folder.path(), "synth data --views 16 --size 96x96 --turn 4").success();
    let trained = |run: &str| {
        irradia(
            folder.path(),
            &format!("train data --out {run} --steps 300 --threads 2"),
        )
        .success();
        json(&folder.path().join(run).join("report.json"))["psnr"]
            .as_f64()
            .expect("PSNR")
    };
    let moving = trained("moving");
    // Without a readout time the cameras are at rest.
    let path = folder.path().join("data/transforms_train.json");
    let mut transforms = json(&path);
    transforms["rolling_shutter_time"] = 0.0.into();
    fs::write(&path, transforms.to_string()).expect("a file");
    let at_rest = trained("at_rest");
    assert!(moving > 26.0 && moving > at_rest + 3.0, "{moving} dB and {at_rest} dB");

    // The names of the rendered views have numbers, like those of a film's frames.
    let said = irradia(folder.path(), "train data --out numbered --steps 2 --readout 0.1:left").success();
    assert!(!said.stderr.contains("as if exposed at once"), "{}", said.stderr);
    // The two held-out cameras are half a turn apart: more than a first-order model can describe.
    let said = irradia(folder.path(), "train data --out far --steps 2 --readout 1:left").success();
    assert!(
        said.stderr
            .contains("3 of 18 photographs are taken as if exposed at once"),
        "{}",
        said.stderr
    );
    irradia(folder.path(), "train data --out wrong --steps 2 --readout 2")
        .refused(2, &["--readout 2: expected 0 to 1 frames"]);
}

/// A fisheye of 190 degrees is trained on without undistortion: no faces, no pixels beyond its circle, and pinhole views look right.
#[test]
fn photographs_of_wide_lenses_are_trained_on_and_evaluated_as_they_are() {
    let folder = tempfile::tempdir().expect("a folder");
    irradia(
        folder.path(),
        "synth fisheye --scene room --views 16 --size 96x96 --lens fisheye",
    )
    .success();
    let run = folder.path().join("run");
    let ended = irradia(folder.path(), "train fisheye --out run --steps 300 --threads 2").success();
    assert!(ended.stderr.contains("splats are antialiased"), "{}", ended.stderr);
    assert!(!ended.stderr.contains("cut into the faces"), "{}", ended.stderr);
    assert_eq!(json(&run.join("cameras.json")).as_array().map(Vec::len), Some(16));
    let held_out = json(&run.join("report.json"))["psnr"].as_f64().expect("PSNR");
    assert!(held_out > 20.0, "{held_out} dB by a pinhole");

    let trained_on = |option: &str| {
        irradia(
            folder.path(),
            &format!("eval run --data fisheye --split train --json scores.json {option}"),
        )
        .success();
        let scores = json(&folder.path().join("scores.json"));
        let views = scores["views"].as_array().expect("views").len();
        (views, scores["psnr"].as_f64().expect("PSNR"))
    };
    let (photographs, psnr) = trained_on("");
    assert!(photographs == 16 && psnr > 22.0, "{photographs} {psnr}");
    let (faces, psnr) = trained_on("--lenses undistorted");
    assert!(faces > 16 && psnr > 18.0, "{faces} {psnr}");
}
