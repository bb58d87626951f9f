//! Bad input gets one clear line and the right exit code, and no file is lost or partially written.

use crate::process::*;
use serde_json::{Value, json as value};
use std::fs;
use std::path::Path;

/// Asserts that training on `data` fails with exit code 1 and `words`, and creates no run.
fn data_refused(folder: &Path, words: &[&str]) {
    irradia(folder, "train data --out run --steps 5").refused(1, words);
    assert!(!folder.join("run").exists(), "a rejected run leaves no folder");
}

#[test]
fn command_line_mistakes_exit_with_2_and_change_nothing() {
    let folder = with_run();
    let cases: [(&str, &[&str]); 34] = [
        ("train", &["<DATA>"]),
        ("train data", &["--out"]),
        (
            "train data --out run",
            &["run", "already holds a run", "--overwrite", "--resume"],
        ),
        ("train data --out run/scene.ply", &["run/scene.ply", "is a file"]),
        ("train run --out x", &["run is a run", "--resume run"]),
        ("train data --out x --recipe clasic", &["`clasic`", "classic"]),
        ("train data --out x --recipe none.toml", &["none.toml"]),
        (
            "train data --out x --set max_splat=3",
            &["`max_splat`", "nearest", "`max_splats`"],
        ),
        (
            "train data --out x --set stage.grow.params.sim_weight=1",
            &["`sim_weight`", "`ssim_weight`"],
        ),
        ("train data --out x --set stage.grwo.steps=1", &["`grwo`", "grow"]),
        (
            "train data --out x --set max_splats",
            &["--set max_splats", "key=value"],
        ),
        ("train data --out x --set max_splats=many", &["in `max_splats`", "many"]),
        (
            "train data --out x --set params.ssim_weight=2",
            &["params.ssim_weight", "0 to 1"],
        ),
        ("train data --out x --steps 0", &["--steps", "0"]),
        ("train data --out x --downscale 0.5", &["--downscale", "1 or more"]),
        ("train data --out x --max-side 0", &["--max-side"]),
        ("train data --out x --format exr", &["`exr`", "colmap"]),
        ("train data --out x --budget soon", &["--budget", "90s"]),
        ("train data --out x --threads 0", &["--threads"]),
        ("train --resume run --downscale 2", &["--resume", "--downscale"]),
        (
            "convert run/scene.ply x.xyz",
            &["x.xyz", ".ply", ".spz", ".ksplat", "meta.json"],
        ),
        ("convert run/scene.ply x.spz --spz-version 2", &["--spz-version"]),
        ("convert run/scene.ply x --spz-version 4", &["known extensions"]),
        (
            "convert run/scene.ply x.sog --spz-version 4",
            &["--spz-version 4", ".sog"],
        ),
        ("train data --out x --port 9999", &["--port", "add --view"]),
        ("render run --out x", &["--data", "--orbit"]),
        ("render run --orbit 0 --out x", &["--orbit"]),
        ("synth x --views 1", &["1 views"]),
        ("synth x --size 0x5", &["size 0x5", "8 to 4096"]),
        ("synth x --size large", &["--size", "640x480"]),
        ("synth x --turn 90", &["90.0 degrees", "0 to 28.6"]),
        ("render run --orbit 2 --size 0x5 --out x", &["--size", "1 to 16384"]),
        (
            "train data --out x --set visits=18446744073709551615",
            &["visits=18446744073709551615", "9223372036854775807"],
        ),
        (
            "train data --out x --set render.background=[5,-3,0]",
            &["render.background", "0 to 1"],
        ),
    ];
    for (line, words) in cases {
        let ended = irradia(folder.path(), line);
        let error = ended.stderr.clone();
        if line.starts_with("train") && words.len() == 1 || line.starts_with("render run --out") {
            // clap lists missing arguments below its line.
            assert_eq!(ended.code, Some(2), "{line}: {error}");
            assert!(words.iter().all(|word| error.contains(word)), "{line}: {error}");
        } else {
            ended.refused(2, words);
        }
        assert!(
            !folder.path().join("x").exists() && !folder.path().join("x.gltf").exists(),
            "{line}"
        );
    }
}

#[test]
fn an_unknown_key_in_a_recipe_file_is_named() {
    let folder = with_run();
    let path = folder.path().join("run/recipe.toml");
    let text = fs::read_to_string(&path).expect("recipe");
    fs::write(folder.path().join("mine.toml"), format!("eval_evry = 3\n{text}")).expect("written");
    irradia(folder.path(), "train data --out x --recipe mine.toml")
        .refused(2, &["mine.toml", "`eval_evry`", "`eval_every`"]);
    fs::write(folder.path().join("mine.toml"), "name = \"mine\"\nabout = = 3\n").expect("written");
    irradia(folder.path(), "train data --out x --recipe mine.toml").refused(2, &["mine.toml", "line 2"]);
    // The resolved recipe of a run is a valid recipe.
    irradia(
        folder.path(),
        "train data --out again --recipe run/recipe.toml --steps 2",
    )
    .success();
}

#[test]
fn a_folder_without_a_dataset_gets_the_list_of_known_layouts() {
    let folder = with_data();
    irradia(folder.path(), "train nowhere --out run").refused(1, &["nowhere"]);
    irradia(folder.path(), "train . --out run").refused(1, &["transforms.json", "sparse/0", "poses_bounds.npy"]);
    irradia(folder.path(), "train data --out run --format colmap").refused(1, &["data", "COLMAP"]);
    // Photographs without poses are not posed if a layout is requested.
    irradia(folder.path(), "train data/train --out run --format nerfstudio")
        .refused(1, &["data/train", "transforms.json"]);
    irradia(folder.path(), "train --resume nowhere").refused(1, &["nowhere", "no run"]);
    irradia(folder.path(), "info nowhere.ply").refused(1, &["nowhere.ply"]);
    irradia(folder.path(), "compact nowhere.ply --out x.sog --target 5MB").refused(1, &["cannot read nowhere.ply"]);
    assert!(!folder.path().join("run").exists());
}

#[test]
fn fewer_than_three_views_are_rejected_with_reasons() {
    let folder = with_data();
    for view in 2..8 {
        fs::remove_file(folder.path().join(format!("data/train/r_{view:03}.png"))).expect("removed");
    }
    fs::remove_dir_all(folder.path().join("data/test")).expect("removed");
    data_refused(folder.path(), &["data", "2 usable views of 10", "at least 3", "r_002"]);
}

#[test]
fn invalid_poses_are_skipped_and_named() {
    let folder = with_data();
    edit(&folder.path().join("data/transforms_train.json"), |content| {
        // JSON has no NaN; writers that have one write null, or a number beyond f32.
        content["frames"][0]["transform_matrix"][0][0] = Value::Null;
        content["frames"][1]["transform_matrix"][1][3] = value!(1e300);
    });
    let ended = irradia(folder.path(), "train data --out run --steps 5").success();
    let warning = ended
        .stderr
        .lines()
        .find(|line| line.starts_with("warning:"))
        .expect("a warning");
    assert!(
        warning.contains("r_000") && warning.contains("r_001") && !warning.contains("r_002"),
        "{warning}"
    );
    let told = json(&folder.path().join("run/report.json"))["warnings"].to_string();
    assert!(told.contains("r_001"), "the report contains it, too: {told}");
    // Python writes NaN as a bare word.
    let path = folder.path().join("data/transforms_train.json");
    let text = fs::read_to_string(&path).expect("file");
    fs::write(&path, text.replace("null", "NaN")).expect("written");
    let ended = irradia(folder.path(), "train data --out again --steps 5").success();
    assert!(ended.stderr.contains("r_000"), "{ended:?}");
}

#[test]
fn unusable_images_are_skipped_and_named() {
    let folder = with_data();
    let train = folder.path().join("data/train");
    fs::write(train.join("r_001.png"), "").expect("emptied");
    fs::write(train.join("r_002.png"), "no picture at all").expect("replaced");
    let whole = fs::read(train.join("r_003.png")).expect("a picture");
    fs::write(train.join("r_003.png"), &whole[..whole.len() / 2]).expect("cut");
    fs::remove_file(train.join("r_004.png")).expect("removed");
    let ended = irradia(folder.path(), "train data --out run --steps 5").success();
    let warnings: Vec<&str> = ended
        .stderr
        .lines()
        .filter(|line| line.starts_with("warning:"))
        .collect();
    assert_eq!(
        warnings.len(),
        2,
        "one for the missing, one for the unreadable: {warnings:?}"
    );
    for name in ["r_001", "r_002", "r_003", "r_004"] {
        assert!(warnings.iter().any(|line| line.contains(name)), "{name}: {warnings:?}");
    }
}

/// Damages the pixels of a picture, but not its header.
fn damage(picture: &Path) {
    let mut bytes = fs::read(picture).expect("a picture");
    let middle = bytes.len() / 2;
    bytes[middle..middle + 100].fill(0);
    fs::write(picture, bytes).expect("damaged");
}

#[test]
fn held_out_images_damaged_inside_are_named_and_the_others_are_measured() {
    let folder = with_data();
    let here = |name: &str| folder.path().join(name);
    let [first, second] = ["data/test/r_000.png", "data/test/r_001.png"].map(here);
    let whole = fs::read(&second).expect("a picture");
    damage(&second);
    let line = "train data --out run --steps 6 --set eval_every=2 --set checkpoint_every=3";
    let ended = irradia(folder.path(), line).success();
    let warning = "1 of 2 views are not measured, since their photographs cannot be read: test/r_001.png";
    assert!(ended.stderr.contains(warning), "{ended:?}");
    let report = || json(&here("run/report.json"));
    assert_eq!(report()["views"].as_array().map(Vec::len), Some(1));
    assert!(report()["psnr"].is_f64() && report()["warnings"].to_string().contains(warning));
    let ended = irradia(folder.path(), "eval run --data data").success();
    assert!(
        ended.stdout.contains("mean of 1") && ended.stderr.contains(warning),
        "{ended:?}"
    );

    // The restored image is held out again.
    unfinish(&here("run"), "scene.ply");
    fs::write(&second, whole).expect("restored");
    irradia(folder.path(), "train --resume run").success();
    assert_eq!(report()["views"].as_array().map(Vec::len), Some(2));

    damage(&first);
    damage(&second);
    let ended = irradia(folder.path(), "train data --out none --steps 2").success();
    assert!(ended.stdout.contains("nothing was evaluated"), "{ended:?}");
    let text = fs::read_to_string(here("none/report.json")).expect("a report");
    assert!(
        !text.contains("\"psnr\"") && !text.contains("no view is held out"),
        "{text}"
    );
    irradia(folder.path(), "eval run --data data").refused(1, &["2 of 2 views are not measured", "r_000.png"]);
    irradia(folder.path(), "train data --out x --steps 2 --until-psnr 9").refused(2, &["--until-psnr"]);
}

#[test]
fn an_image_damaged_inside_is_named_and_the_run_resumes_without_it() {
    let folder = with_data();
    let picture = folder.path().join("data/train/r_005.png");
    damage(&picture);
    // Otherwise poses and background are chosen by photographs before there is a run.
    let line = "train data --out run --steps 5 --poses given --background black";
    irradia(folder.path(), line).refused(1, &["r_005.png", "remove", "--resume run"]);
    assert_no_leftovers(&folder.path().join("run"));
    fs::remove_file(&picture).expect("removed");
    let ended = irradia(folder.path(), "train --resume run").success();
    assert!(ended.stderr.contains("r_005"), "{ended:?}");
    assert_eq!(json(&folder.path().join("run/report.json"))["steps"], 5);
}

#[test]
fn cameras_without_intrinsics_are_rejected() {
    let folder = with_data();
    edit(&folder.path().join("data/transforms_train.json"), |content| {
        content.as_object_mut().expect("an object").remove("camera_angle_x");
    });
    data_refused(
        folder.path(),
        &["transforms_train.json", "intrinsics", "camera_angle_x"],
    );
}

#[test]
fn an_unknown_camera_model_is_rejected_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = folder.path().join("data/sparse/0");
    fs::create_dir_all(&model).expect("a folder");
    fs::write(model.join("cameras.txt"), "1 PANOPTICON 64 48 50 32 24\n").expect("written");
    fs::write(model.join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").expect("written");
    fs::write(model.join("points3D.txt"), "").expect("written");
    data_refused(folder.path(), &["cameras.txt", "PANOPTICON", "OPENCV"]);
}

#[test]
fn a_ply_shorter_than_its_header_promises_is_rejected() {
    let folder = with_run();
    let whole = scene(&folder.path().join("run"));
    fs::write(folder.path().join("cut.ply"), &whole[..whole.len() / 3]).expect("written");
    let end = whole.windows(10).position(|w| w == b"end_header").expect("a header");
    let header = String::from_utf8_lossy(&whole[..end]).into_owned();
    let count = header
        .lines()
        .find_map(|line| line.strip_prefix("element vertex "))
        .expect("a count");
    let boast = header.replace(&format!("vertex {count}"), "vertex 999999999999");
    fs::write(
        folder.path().join("boast.ply"),
        [boast.as_bytes(), &whole[end..]].concat(),
    )
    .expect("written");
    fs::write(folder.path().join("empty.ply"), "").expect("written");
    for name in ["cut.ply", "boast.ply", "empty.ply"] {
        irradia(folder.path(), &format!("info {name}")).refused(1, &[name]);
        irradia(folder.path(), &format!("convert {name} out.ply")).refused(1, &[name]);
        irradia(folder.path(), &format!("render {name} --orbit 2 --out out")).refused(1, &[name]);
        irradia(folder.path(), &format!("eval {name} --data data")).refused(1, &[name]);
    }
    irradia(folder.path(), "convert boast.ply out.ply").refused(1, &["declares", "999999999999", "truncated"]);
    irradia(folder.path(), "eval data/points.ply --data data").refused(1, &["points.ply", "point cloud"]);
    assert!(!folder.path().join("out.ply").exists() && !folder.path().join("out").exists());
}

#[test]
fn a_damaged_checkpoint_is_named() {
    let folder = with_run();
    let run = folder.path().join("run");
    fs::write(run.join("checkpoints/step_30.safetensors"), "no checkpoint").expect("written");
    edit(&run.join("run.json"), |config| config["complete"] = false.into());
    irradia(folder.path(), "train --resume run").refused(1, &["step_30.safetensors", "checkpoint"]);
    fs::write(run.join("run.json"), "{").expect("written");
    irradia(folder.path(), "train --resume run").refused(1, &["run.json", "damaged"]);
}

#[test]
fn a_path_that_cannot_be_written_is_named() {
    let folder = with_run();
    // No user can create a folder below a file.
    irradia(folder.path(), "train data --out run/scene.ply/x --steps 2").refused(1, &["run/scene.ply/x", "--out"]);
    irradia(folder.path(), "convert run/scene.ply run/report.json/a.ply").refused(1, &["run/report.json/a.ply"]);
    irradia(folder.path(), "render run --orbit 1 --out run/scene.ply").refused(1, &["run/scene.ply"]);
    irradia(folder.path(), "synth run/scene.ply/x --views 3 --size 8x8").refused(1, &["run/scene.ply/x"]);
    irradia(folder.path(), "eval run --data data --json run/scene.ply/a.json").refused(1, &["run/scene.ply/a.json"]);
    irradia(folder.path(), "train data --out x --lpips nowhere.safetensors").refused(1, &["nowhere.safetensors"]);
    assert!(!folder.path().join("x").exists());
}

/// A limit on file sizes stands in for a full disk: writes fail in the middle of a file.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_no_partial_file_and_keeps_existing_ones() {
    let folder = with_run();
    let limited = |line: &str| -> ProgramOutput {
        let shell = format!(
            "trap '' XFSZ; ulimit -f 400; exec '{}' {line}",
            env!("CARGO_BIN_EXE_irradia")
        );
        let mut command = std::process::Command::new("sh");
        command
            .args(["-c", &shell])
            .current_dir(folder.path())
            .env_remove("IRRADIA_LPIPS")
            .env("XDG_DATA_HOME", folder.path().join("share"));
        command.output().expect("a shell").into()
    };
    fs::write(folder.path().join("old.ply"), "what was there").expect("written");
    for name in ["old.ply", "new.ply"] {
        limited(&format!("convert run/scene.ply {name}")).refused(1, &[name, "cannot write"]);
    }
    assert_eq!(
        fs::read(folder.path().join("old.ply")).expect("still there"),
        b"what was there"
    );
    assert!(!folder.path().join("new.ply").exists());

    let ended = limited("train data --out full --steps 40 --set checkpoint_every=10");
    let ended = ended.refused(1, &["full/scene.ply", "cannot write", "--resume full"]);
    assert!(ended.stderr.contains("warning: no checkpoint"), "{ended:?}");
    assert!(
        ended.stderr.contains("recipe complete"),
        "training continued: {ended:?}"
    );
    assert!(!folder.path().join("full/scene.ply").exists());
    assert_no_leftovers(folder.path());
    // There is room again.
    irradia(folder.path(), "train --resume full").success();
    assert_eq!(json(&folder.path().join("full/report.json"))["steps"], 40);
}
