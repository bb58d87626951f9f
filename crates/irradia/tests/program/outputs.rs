//! The outputs of the program.

use crate::process::*;
use std::fs;

#[test]
fn info_reads_datasets_with_the_options_of_training() {
    let folder = with_run();
    let info = |line: &str| irradia(folder.path(), &format!("info {line}"));
    let [whole, half] = ["data", "data --downscale 2"].map(|line| info(line).success().stdout);
    assert!(whole != half && half.contains("image size"), "{half}");
    let none = info("data --holdout 0").success().stdout;
    assert!(none.contains(", 0\n"), "{none}");
    info("data --format colmap").refused(1, &["no dataset found", "COLMAP"]);
    info("data --max-side 0").refused(2, &["--max-side"]);
    info("run --downscale 2").refused(2, &["not a dataset"]);
}

#[test]
fn a_run_contains_all_outputs() {
    let folder = with_run();
    let run = folder.path().join("run");
    for file in [
        "recipe.toml",
        "events.jsonl",
        "report.json",
        "report.html",
        "scene.ply",
        "cameras.json",
    ] {
        assert!(run.join(file).is_file(), "{file}");
    }
    let report = json(&run.join("report.json"));
    for key in ["psnr", "ssim", "seconds", "cpu_seconds", "total_seconds"] {
        assert!(
            report[key].as_f64().is_some_and(f64::is_finite),
            "{key}: {}",
            report[key]
        );
    }
    for key in ["device", "recipe", "version"] {
        assert!(report[key].as_str().is_some_and(|s| !s.is_empty()), "{key}");
    }
    assert!(
        report.get("lpips").is_some_and(serde_json::Value::is_null),
        "no weights here"
    );
    assert_eq!((&report["steps"], &report["seed"]), (&60.into(), &7.into()));
    assert!(report["total_seconds"].as_f64() > report["seconds"].as_f64());
    assert!(report["splats"].as_u64() > Some(0) && report["peak_rss_bytes"].as_u64() > Some(1 << 20));
    assert!(report["psnr"].as_f64() > Some(14.0), "{}", report["psnr"]);
    let views = report["views"].as_array().expect("views");
    assert_eq!(views.len(), 2);
    for view in views {
        for picture in ["truth", "render", "error"] {
            let name = view[picture].as_str().expect("a path");
            assert!(name.starts_with("eval/") && run.join(name).is_file(), "{name}");
        }
    }
    let page = fs::read_to_string(run.join("report.html")).expect("page");
    assert!(page.contains("eval/") && !page.contains("https://"));
    assert_no_leftovers(&run);
}

#[test]
fn events_describe_the_run_from_start_to_end() {
    let folder = with_run();
    let events = events(&folder.path().join("run"));
    let names: Vec<&str> = events.iter().filter_map(|e| e["event"].as_str()).collect();
    assert_eq!((names[0], *names.last().expect("events")), ("started", "finished"));
    for name in ["stage_entered", "step", "densified"] {
        assert!(names.contains(&name), "{name}");
    }
    let stages: Vec<&str> = events
        .iter()
        .filter(|e| e["event"] == "stage_entered")
        .filter_map(|e| e["stage"].as_str())
        .collect();
    assert_eq!(stages, ["warmup", "grow", "refine"]);
}

#[test]
fn the_scene_has_the_inria_layout_and_converts_to_the_same_bytes() {
    let folder = with_run();
    irradia(folder.path(), "convert run/scene.ply copy.ply").success();
    let (first, second) = (
        scene(&folder.path().join("run")),
        fs::read(folder.path().join("copy.ply")).expect("copy"),
    );
    assert!(first == second);
    let end = first.windows(10).position(|w| w == b"end_header").expect("a header");
    let header = String::from_utf8_lossy(&first[..end]);
    let count = header.lines().filter(|line| line.contains("f_rest_")).count();
    assert_eq!(count, 45);
    assert!(header.contains("property float nx") && header.contains("format binary_little_endian 1.0"));
}

#[test]
fn converting_says_what_it_costs_and_every_format_renders() {
    let folder = with_run();
    let said = irradia(folder.path(), "convert run scene.spz --quality high")
        .success()
        .stdout;
    for word in ["splats", "size", "MB PLY ->", "MB SPZ", "PSNR", "12 views"] {
        assert!(said.contains(word), "{said}");
    }
    irradia(folder.path(), "convert scene.spz scene.sog --no-compare").success();
    irradia(folder.path(), "convert scene.sog scene.glb").success();
    irradia(folder.path(), "render scene.glb --orbit 1 --size 32x24 --out frames").success();
    irradia(folder.path(), "eval scene.sog --data data").success();
    irradia(folder.path(), "eval scene.sog").refused(2, &["scene.sog", "--data"]);
    let said = irradia(folder.path(), "info scene.sog").success().stdout;
    assert!(said.contains("SOG with"), "{said}");
}

#[test]
fn info_describes_every_kind() {
    let folder = with_run();
    let cases = [
        ("run/scene.ply", "Gaussians"),
        ("run", "Gaussians"),
        ("data", "Blender dataset with 10 views"),
        ("data/points.ply", "point cloud with 6000 points"),
    ];
    for (path, says) in cases {
        let ended = irradia(folder.path(), &format!("info {path}")).success();
        assert!(ended.stdout.contains(says), "{path}: {}", ended.stdout);
    }
}

#[test]
fn eval_reproduces_the_figures_of_the_run() {
    let folder = with_run();
    let line = "eval run --data data --json figures.json --save-images seen";
    let ended = irradia(folder.path(), line).success();
    assert!(ended.stdout.contains("mean of 2"), "{}", ended.stdout);
    let (figures, report) = (
        json(&folder.path().join("figures.json")),
        json(&folder.path().join("run/report.json")),
    );
    for key in ["psnr", "ssim"] {
        let both = [&figures, &report].map(|v| v[key].as_f64().expect("a number"));
        // A scene round-trips bit for bit, and so do the figures.
        assert_eq!(both[0], both[1], "{key}");
    }
    assert_eq!(figures["views"].as_array().map(Vec::len), Some(2));
    assert_eq!(files_under(&folder.path().join("seen")).len(), 2);
    for (split, views) in [("train", 8), ("all", 10)] {
        let line = format!("eval run/scene.ply --data data --split {split}");
        let ended = irradia(folder.path(), &line).success();
        assert!(ended.stdout.contains(&format!("mean of {views}")), "{}", ended.stdout);
    }
}

#[test]
fn render_orbits_the_scene_with_depth_and_alpha() {
    let folder = with_run();
    irradia(
        folder.path(),
        "render run --orbit 4 --size 40x30 --out round --depth --alpha",
    )
    .success();
    let files = files_under(&folder.path().join("round"));
    assert_eq!(files.len(), 12, "{files:?}");
    for file in &files {
        let picture = image::open(file).expect("a picture");
        assert_eq!((picture.width(), picture.height()), (40, 30));
        let (low, high) = picture
            .to_luma8()
            .pixels()
            .fold((255, 0), |(l, h), p| (l.min(p.0[0]), h.max(p.0[0])));
        let is_alpha = file.to_string_lossy().contains(".alpha.");
        // The table fills the frame: alpha is uniform, and everything else has contrast.
        assert!(
            if is_alpha { high > 200 } else { high > low + 20 },
            "{}: {low} to {high}",
            file.display()
        );
    }
    irradia(folder.path(), "render run/scene.ply --data data --out views").success();
    assert_eq!(files_under(&folder.path().join("views")).len(), 2);
}

#[test]
fn a_run_stops_at_the_requested_psnr() {
    let folder = with_data();
    let ended = irradia(folder.path(), "train data --out run --steps 2000 --until-psnr 12").success();
    assert!(ended.stderr.contains("held-out PSNR reached"), "{ended:?}");
    let report = json(&folder.path().join("run/report.json"));
    assert!(report["steps"].as_u64() < Some(200) && report["psnr"].as_f64() >= Some(11.9));
}

#[test]
fn a_limit_on_splats_applies_from_the_start() {
    let folder = with_data();
    irradia(folder.path(), "train data --out run --steps 20 --max-splats 500").success();
    let most = events(&folder.path().join("run"))
        .iter()
        .filter_map(|event| event["splats"].as_u64())
        .max();
    assert!(most <= Some(500) && most > Some(100), "{most:?}");
}

#[test]
fn a_budget_covers_the_whole_recipe() {
    let folder = with_data();
    // The limit on the steps of sparse photographs would leave a part of the budget unused.
    let ended = irradia(
        folder.path(),
        "train data --out run --budget 2s --max-splats 8000 --set sparse_visits=0",
    )
    .success();
    assert!(ended.stderr.contains("recipe complete"), "{ended:?}");
    let run = folder.path().join("run");
    let seconds = json(&run.join("report.json"))["seconds"].as_f64().expect("a number");
    // Other tests use the same cores at times, and the pace adapts only when a step is measured.
    assert!((1.0..4.0).contains(&seconds), "{seconds}");
    assert_eq!(events(&run).iter().filter(|e| e["event"] == "stage_entered").count(), 2);
}

#[test]
fn overwriting_removes_the_earlier_run() {
    let folder = with_run();
    let run = folder.path().join("run");
    fs::write(run.join("eval/stale.render.png"), "x").expect("written");
    fs::write(run.join("mine.txt"), "x").expect("written");
    irradia(folder.path(), "train data --out run --steps 5 --overwrite").success();
    assert!(!run.join("eval/stale.render.png").exists() && run.join("mine.txt").exists());
    assert_eq!(json(&run.join("report.json"))["steps"], 5);
    assert_eq!(events(&run).iter().filter(|e| e["event"] == "started").count(), 1);
}

#[test]
fn the_demo_writes_data_and_a_run() {
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a folder");
    let ended = irradia(folder.path(), "demo --steps 10 --views 4 --size 32x32 --threads 1").success();
    assert!(ended.stdout.contains("demo/run/report.html") && ended.stdout.contains("irradia render demo/run"));
    for file in [
        "data/transforms_train.json",
        "data/depth/train/r_000.png",
        "run/report.html",
        "run/scene.ply",
    ] {
        assert!(folder.path().join("demo").join(file).is_file(), "{file}");
    }
}

#[cfg(unix)]
#[test]
fn a_closed_pipe_does_not_end_a_run() {
    let folder = with_data();
    // Both streams go to a pipe that is closed at once.
    let line = format!(
        "'{}' train data --out run --steps 30 2>&1 | true",
        env!("CARGO_BIN_EXE_irradia")
    );
    let status = std::process::Command::new("sh")
        .args(["-c", &line])
        .current_dir(folder.path())
        .status();
    assert!(status.expect("a shell").success());
    assert_eq!(json(&folder.path().join("run/report.json"))["steps"], 30);
}
