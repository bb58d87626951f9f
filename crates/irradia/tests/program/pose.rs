//! Photographs without poses.

use crate::process::*;
use irradia_testkit::shared;
use serde_json::json;
use std::fs;
use std::path::Path;

#[test]
fn bare_photographs_are_examined_posed_and_trained_on() {
    let Some(door) = shared("data/lund_door/images") else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let photos = folder.path().join("photos");
    copy(&door, &photos, 12);
    let examined = irradia(folder.path(), "doctor photos --out posed").success();
    assert!(
        examined.stdout.contains("12 photographs, nothing wrong found"),
        "{examined:#?}"
    );
    assert!(folder.path().join("posed/doctor.html").is_file());
    let posed = irradia(folder.path(), "pose photos --out posed").success();
    assert!(
        posed.stdout.contains("photographs posed") && posed.stdout.contains("features"),
        "{posed:#?}"
    );
    let report = json(&folder.path().join("posed/pose.json"));
    assert_eq!(report["registered"].as_u64(), Some(12), "{report}");
    // The posed photographs are stored beside their poses: no other folder is needed.
    irradia(folder.path(), "train posed --out first --steps 3").success();
    let trained = irradia(folder.path(), "train photos --out second --steps 3").success();
    assert!(trained.stderr.contains("no poses"), "{trained:#?}");
    assert!(folder.path().join("second/posed/sparse/0/images.bin").is_file());
    assert!(folder.path().join("second/scene.ply").is_file());
    irradia(folder.path(), "train --resume second").success();
    assert_no_leftovers(folder.path());
}

#[test]
fn given_poses_that_photographs_contradict_are_replaced_and_others_are_on_request() {
    let (Some(can), Some(door)) = (shared("data/can"), shared("data/lund_door")) else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    // The given poses jump between photographs 13 and 14, although both show the same print of the can.
    copy(&can.join("images"), &folder.path().join("can/images"), 24);
    copy(&can.join("sparse/0"), &folder.path().join("can/sparse/0"), 5);
    let trained = irradia(folder.path(), "train can --out run --steps 2 --max-side 120").success();
    assert!(trained.stderr.contains("contradict the given poses"), "{trained:#?}");
    let (report, held_out) = (json(&folder.path().join("run/report.json")), "images/0008.jpg");
    assert!(report["warnings"].to_string().contains("new ones are used"), "{report}");
    assert_eq!(report["views"][1]["name"], held_out, "the same views are held out");
    let kept = irradia(
        folder.path(),
        "train can --out kept --steps 2 --max-side 120 --poses given",
    )
    .success();
    assert!(!kept.stderr.contains("contradict"), "{kept:#?}");
    assert!(!folder.path().join("kept/posed").exists());

    let data = door.display();
    let sound = irradia(
        folder.path(),
        &format!("train {data} --out sound --steps 2 --max-side 120"),
    )
    .success();
    assert!(!folder.path().join("sound/posed").exists(), "{sound:#?}");
    let request = format!("train {data} --out again --steps 2 --max-side 120 --poses irradia");
    irradia(folder.path(), &request).success();
    let names = |run: &str| {
        let report = json(&folder.path().join(run).join("report.json"));
        let views = report["views"].as_array().expect("a list").clone();
        views.into_iter().map(|view| view["name"].clone()).collect::<Vec<_>>()
    };
    assert_eq!(names("again"), names("sound"));
    irradia(folder.path(), "train can/images --out none --poses given").refused(2, &["no poses", "--poses given"]);
}

#[test]
fn photographs_of_which_most_have_no_poses_get_new_ones() {
    let Some(door) = shared("data/lund_door/images") else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    copy(&door, &folder.path().join("door/images"), 12);
    // As after a program that could not connect the others.
    let frame = |i: usize| {
        let pose = json!([[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
        json!({ "file_path": format!("images/DSC_000{i}.JPG"), "transform_matrix": pose })
    };
    let transforms = json!({ "camera_angle_x": 0.9, "frames": [frame(1), frame(2), frame(3)] });
    fs::write(folder.path().join("door/transforms.json"), transforms.to_string()).expect("written");
    let given = "train door --out given --steps 2 --max-side 120 --poses given";
    let given = irradia(folder.path(), given).success();
    assert!(!given.stderr.contains("have poses"), "{given:#?}");
    let trained = irradia(folder.path(), "train door --out run --steps 2 --max-side 120").success();
    let line = "only 3 of 12 photographs have poses: new ones are used";
    assert!(trained.stderr.contains(line), "{trained:#?}");
    assert_eq!(json(&folder.path().join("run/posed/pose.json"))["registered"], 12);
    let request = "train door --out again --steps 2 --max-side 120 --poses irradia";
    irradia(folder.path(), request).success();
    assert_eq!(json(&folder.path().join("again/posed/pose.json"))["registered"], 12);
    let two = json!({ "camera_angle_x": 0.9, "frames": [frame(1), frame(2)] });
    fs::write(folder.path().join("door/transforms.json"), two.to_string()).expect("written");
    let named = ["2 usable views", "irradia train door/images --out few"];
    irradia(folder.path(), "train door --out few").refused(1, &named);
}

/// The layout of Blender scenes, with opaque photographs, some of them in two folders.
#[test]
fn photographs_laid_out_like_a_rendered_scene_have_their_poses_checked_and_keep_their_split() {
    let Some(door) = shared("data/lund_door/images") else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let here = |name: &str| folder.path().join("door").join(name);
    copy(&door, &here("train"), 12);
    for name in ["test", "val"] {
        fs::create_dir(here(name)).expect("a folder");
    }
    for name in ["DSC_0004.JPG", "DSC_0009.JPG"] {
        fs::rename(here("train").join(name), here("test").join(name)).expect("moved");
        fs::copy(here("test").join(name), here("val").join(name)).expect("copied");
    }
    for split in ["train", "test"] {
        let files = fs::read_dir(here(split)).expect("a folder");
        let mut names: Vec<_> = files
            .map(|file| file.expect("a file").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        let frame = |(i, name): (usize, &String)| {
            let x = 7 * i % 10;
            let pose = json!([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
            json!({ "file_path": format!("./{split}/{name}"), "transform_matrix": pose })
        };
        let frames: Vec<_> = names.iter().enumerate().map(frame).collect();
        let transforms = json!({ "camera_angle_x": 0.9, "frames": frames });
        fs::write(here(&format!("transforms_{split}.json")), transforms.to_string()).expect("written");
    }
    let trained = irradia(folder.path(), "train door --out run --steps 2 --max-side 120").success();
    assert!(trained.stderr.contains("contradict the given poses"), "{trained:#?}");
    let report = json(&folder.path().join("run/report.json"));
    assert!(report["warnings"].to_string().contains("new ones are used"), "{report}");
    let names: Vec<_> = report["views"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|view| &view["name"])
        .collect();
    assert_eq!(names, ["images/DSC_0004.JPG", "images/DSC_0009.JPG"]);
}

#[test]
fn splats_are_trained_further_with_the_poses_of_their_run() {
    let folder = with_data();
    let here = |name: &str| folder.path().join(name);
    fs::create_dir(here("run")).expect("a folder");
    fs::rename(here("data"), here("run/posed")).expect("moved");
    irradia(folder.path(), "train run/posed --out run --steps 2").success();
    irradia(folder.path(), "synth data --views 8 --size 48x48").success();
    // The given poses: each photograph has that of another.
    edit(&here("data/transforms_train.json"), |transforms| {
        let frames = transforms["frames"].as_array_mut().expect("frames");
        let mut poses: Vec<_> = frames.iter().map(|frame| frame["transform_matrix"].clone()).collect();
        poses.rotate_left(1);
        for (frame, pose) in frames.iter_mut().zip(poses) {
            frame["transform_matrix"] = pose;
        }
    });
    let ended = irradia(folder.path(), "train data --from run --out again --steps 2").success();
    assert!(ended.stderr.contains("fit the poses in run/posed"), "{ended:?}");
    let record = json(&here("again/run.json"));
    assert!(
        record["data"].as_str().is_some_and(|data| data.ends_with("run/posed")),
        "{record}"
    );
    irradia(folder.path(), "train data --from run --out x --poses irradia").refused(2, &["--poses", "--from"]);
    fs::remove_dir_all(here("run/posed")).expect("removed");
    irradia(folder.path(), "train data --from run --out x").refused(2, &["other poses", "data"]);
}

#[test]
fn views_with_new_poses_are_trained_on_held_out_and_left_out_as_before() {
    let Some(door) = shared("data/lund_door") else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let here = |name: &str| folder.path().join(name);
    for part in ["images", "sparse/0"] {
        copy(&door.join(part), &here("door").join(part), 12);
    }
    // The dataset still names it as before.
    let [old, new] = ["JPG", "jpeg"].map(|extension| here("door/images/DSC_0001").with_extension(extension));
    fs::rename(old, new).expect("renamed");
    let names: Vec<String> = (1..=12).map(|i| format!("DSC_{i:04}")).collect();
    fs::write(here("door/test.txt"), &names[0]).expect("written");
    fs::write(here("door/train.txt"), names[2..].join("\n")).expect("written");
    let line = "train door --out run --steps 2 --max-side 120 --poses irradia --overwrite";
    irradia(folder.path(), line).success();
    let views = json(&here("run/report.json"))["views"].clone();
    assert_eq!(views.as_array().map(Vec::len), Some(1), "{views}");
    assert_eq!(views[0]["name"], "images/DSC_0001.jpeg");
    assert_eq!(events(&here("run"))[0]["views"], 10);

    // A split without held-out views.
    fs::remove_file(here("door/test.txt")).expect("removed");
    fs::write(here("door/train.txt"), names.join("\n")).expect("written");
    let ended = irradia(folder.path(), line).success();
    assert!(ended.stdout.contains("nothing was evaluated"), "{ended:?}");
    assert_eq!(events(&here("run"))[0]["views"], 12);
}

#[test]
fn a_training_stops_with_the_reasons_when_too_few_photographs_have_poses() {
    let (Some(door), Some(fern)) = (shared("data/lund_door/images"), shared("data/fern/images_8")) else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let photos = folder.path().join("photos");
    copy(&door, &photos, 6);
    copy(&fern, &photos, 5);
    irradia(folder.path(), "train photos --out run --steps 2")
        .refused(2, &["only 6 of 11", "2 parts", "doctor.html", "--anyway"]);
    irradia(folder.path(), "train photos --out run --steps 2 --anyway").success();
}

/// Copies the first photographs of a folder.
fn copy(from: &Path, to: &Path, count: usize) {
    fs::create_dir_all(to).expect("a folder");
    let entries = fs::read_dir(from).expect("the shared folder");
    let mut files: Vec<_> = entries.map(|entry| entry.expect("an entry").path()).collect();
    files.sort();
    for file in files.iter().take(count) {
        fs::copy(file, to.join(file.file_name().expect("a file"))).expect("copied");
    }
}

#[test]
fn what_cannot_be_posed_is_refused_in_one_line() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = |name: &str| folder.path().join(name);
    for name in ["empty", "text"] {
        fs::create_dir(here(name)).expect("a folder");
    }
    for name in ["a.jpg", "b.jpg", "c.jpg"] {
        fs::write(here("text").join(name), "no picture").expect("written");
    }
    fs::write(here("film.mp4"), "no film").expect("written");
    fs::write(here("film.zip"), "PK").expect("written");
    irradia(folder.path(), "pose none --out x").refused(1, &["none"]);
    irradia(folder.path(), "pose empty --out x").refused(2, &["0 readable photographs"]);
    irradia(folder.path(), "pose text --out x").refused(2, &["a.jpg", "not a readable"]);
    // The film itself, not the photographs beside it.
    for command in ["pose film.mp4 --out x", "train film.mp4 --out run"] {
        irradia(folder.path(), command).refused(2, &["film.mp4", "ffmpeg"]);
    }
    for command in ["pose film.zip --out x", "doctor film.zip", "train film.zip --out run"] {
        irradia(folder.path(), command).refused(1, &["film.zip is a file", "unpacked"]);
    }
    irradia(folder.path(), "pose text --out x --max-features 0").refused(2, &["--max-features"]);
    irradia(folder.path(), "train text --out run").refused(2, &["a.jpg"]);
    irradia(folder.path(), "train empty --out run").refused(1, &["no dataset found", "COLMAP"]);
}
