//! Radiance fields are trained, resumed, evaluated and rendered like splats.

use crate::process::*;
use std::path::Path;

/// Fast steps.
const SMALL: &str = "--set field.samples=4096 --set checkpoint_every=25";

fn field(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("field.safetensors")).expect("a field")
}

#[test]
fn a_field_trains_to_the_same_bytes_with_any_threads_and_across_a_resume() {
    let folder = with_data();
    for (recipe, steps) in [("hashgrid", 60), ("nerf", 30)] {
        for threads in [1, 2] {
            let line = format!("train data --recipe {recipe} --steps {steps} {SMALL} --threads {threads}");
            irradia(folder.path(), &format!("{line} --out {recipe}{threads}")).success();
        }
        let [one, two] = [1, 2].map(|threads| folder.path().join(format!("{recipe}{threads}")));
        let unbroken = field(&one);
        assert!(unbroken == field(&two), "{recipe}");
        unfinish(&two, "field.safetensors");
        let ended = irradia(folder.path(), &format!("train --resume {recipe}2")).success();
        assert!(ended.stderr.contains("resuming at step"), "{ended:?}");
        assert!(unbroken == field(&two), "{recipe}");
    }
}

#[test]
fn a_field_trains_and_is_evaluated_and_rendered_like_splats() {
    let folder = with_data();
    let line = format!("train data --recipe hashgrid --steps 300 {SMALL} --out run");
    irradia(folder.path(), &line).success();
    // Eight views constrain novel views too little, but the field must fit the training views (21.8 dB; 12 before training).
    irradia(folder.path(), "eval run --data data --split train --json seen.json").success();
    let seen = json(&folder.path().join("seen.json"));
    assert!(seen["psnr"].as_f64() > Some(20.0), "{}", seen["psnr"]);
    let report = json(&folder.path().join("run/report.json"));
    irradia(folder.path(), "eval run --json figures.json").success();
    let figures = json(&folder.path().join("figures.json"));
    assert_eq!(figures["psnr"], report["psnr"], "a field round-trips bit for bit");
    irradia(
        folder.path(),
        "render run --orbit 3 --size 40x30 --out round --depth --alpha",
    )
    .success();
    let files = files_under(&folder.path().join("round"));
    assert_eq!(files.len(), 9, "{files:?}");
    for file in files.iter().filter(|file| file.to_string_lossy().contains(".depth.")) {
        let picture = image::open(file).expect("a picture").to_luma8();
        let high = picture.pixels().map(|p| p.0[0]).max();
        assert!(high > Some(60), "{}: {high:?}", file.display());
    }
}

#[test]
fn splats_begin_as_the_surfaces_of_a_field() {
    let folder = with_data();
    let line = "train data --recipe hybrid --steps 160 --set field.samples=8192 --set stage.field.steps=1500";
    irradia(folder.path(), &format!("{line} --out run")).success();
    let run = folder.path().join("run");
    assert!(run.join("scene.ply").is_file() && !run.join("field.safetensors").exists());
    let report = json(&run.join("report.json"));
    assert!(report["splats"].as_u64() > Some(100), "{}", report["splats"]);
    let names: Vec<String> = events(&run)
        .iter()
        .filter(|event| event["event"] == "stage_entered")
        .filter_map(|event| event["stage"].as_str().map(str::to_owned))
        .collect();
    assert_eq!(names, ["field", "grow", "refine"]);
}

#[test]
fn a_residual_field_is_saved_beside_the_splats_bit_for_bit() {
    let folder = with_data();
    for threads in [1, 2] {
        let line = format!("train data --recipe shiny --steps 120 --set checkpoint_every=50 --threads {threads}");
        irradia(folder.path(), &format!("{line} --out run{threads}")).success();
    }
    let [one, two] = [1, 2].map(|threads| folder.path().join(format!("run{threads}")));
    let both = |run: &Path| ["scene.ply", "residual.safetensors"].map(|f| std::fs::read(run.join(f)).expect(f));
    let unbroken = both(&one);
    assert!(unbroken == both(&two));
    unfinish(&two, "scene.ply");
    std::fs::remove_file(two.join("residual.safetensors")).expect("removed");
    irradia(folder.path(), "train --resume run2").success();
    assert!(unbroken == both(&two));

    let output = irradia(folder.path(), "info run1").success().stdout;
    assert!(output.contains("reflections"), "{output}");
    irradia(folder.path(), "render run1/residual.safetensors --orbit 1 --out x").refused(1, &["scene.ply"]);

    let report = json(&one.join("report.json"));
    irradia(folder.path(), "eval run1 --data data --json whole.json").success();
    let psnr = |file: &str| json(&folder.path().join(file))["psnr"].as_f64().expect("a figure");
    let reported = report["psnr"].as_f64().expect("a figure");
    assert!(
        (psnr("whole.json") - reported).abs() < 0.01,
        "{} and {reported}",
        psnr("whole.json")
    );
    std::fs::copy(one.join("scene.ply"), folder.path().join("alone.ply")).expect("copied");
    irradia(folder.path(), "eval alone.ply --data data --json alone.json").success();
    let first = |file: &str| {
        json(&folder.path().join(file))["views"][0]["psnr"]
            .as_f64()
            .expect("a figure")
    };
    assert!(
        (first("alone.json") - first("whole.json")).abs() > 1e-3,
        "the field adds something"
    );
}

#[test]
fn a_field_is_reported_as_a_field() {
    let folder = with_data();
    let line = format!("train data --recipe hashgrid --steps 20 {SMALL} --out run");
    let ended = irradia(folder.path(), &line).success();
    let run = folder.path().join("run");
    let report = json(&run.join("report.json"));
    let parameters = report["parameters"].as_u64().expect("a number");
    // 8 levels of 4 features and at most 2^15 corners, and two small networks.
    assert!((500_000..1_100_000).contains(&parameters), "{parameters}");
    let words = format!("{parameters} parameters");
    assert!(
        ended.stdout.contains(&words) && ended.stderr.contains(&words),
        "{ended:?}"
    );
    assert!(!(ended.stdout + &ended.stderr).contains("splats"));
    for event in events(&run) {
        let counts = ["started", "step", "evaluated"].contains(&event["event"].as_str().unwrap_or(""));
        assert_eq!(event["parameters"].as_u64(), counts.then_some(parameters), "{event}");
    }
    let [by_run, by_file] =
        ["run", "run/field.safetensors"].map(|path| irradia(folder.path(), &format!("info {path}")).success());
    assert_eq!(by_run.stdout, by_file.stdout);
    for says in [
        &words,
        "hash grid of 8 levels",
        "occupancy grid of 128",
        "cube of half side",
        " MB",
    ] {
        assert!(by_run.stdout.contains(says), "{says}: {}", by_run.stdout);
    }
    irradia(folder.path(), "eval run --data data --json figures.json").success();
    assert_eq!(json(&folder.path().join("figures.json"))["parameters"], parameters);

    let line = "compare data --recipes hashgrid,classic --seeds 1 --steps 5 --out both";
    let ended = irradia(folder.path(), line).success();
    assert!(ended.stdout.contains(&words), "{}", ended.stdout);
    let entries = json(&folder.path().join("both/compare.json"))["scenes"][0]["entries"].clone();
    assert_eq!(entries[0]["parameters"]["mean"].as_f64(), Some(parameters as f64));
    assert!(entries[0]["splats"].is_null() && entries[1]["parameters"].is_null());
    assert!(entries[1]["splats"]["mean"].as_f64() > Some(0.0));
}

#[test]
fn a_background_is_learnt_resumed_and_saved_in_the_file() {
    let folder = with_data();
    let line = format!("train data --recipe hashgrid --steps 40 {SMALL} --set field.background_degree=2");
    // The demo's photographs have alpha: they have no background to learn.
    irradia(folder.path(), &format!("{line} --out clear")).success();
    let output = irradia(folder.path(), "info clear").success().stdout;
    assert!(output.contains("given when rendering"), "{output}");
    for file in files_under(&folder.path().join("data")) {
        if file.extension().is_some_and(|extension| extension == "png") {
            let opaque = image::open(&file).expect("a picture").to_rgb8();
            opaque.save(&file).expect("written");
        }
    }
    for threads in [1, 2] {
        irradia(folder.path(), &format!("{line} --threads {threads} --out run{threads}")).success();
    }
    let [one, two] = [1, 2].map(|threads| folder.path().join(format!("run{threads}")));
    let unbroken = field(&one);
    assert!(unbroken == field(&two));
    unfinish(&two, "field.safetensors");
    irradia(folder.path(), "train --resume run2").success();
    assert!(unbroken == field(&two));
    let output = irradia(folder.path(), "info run2").success().stdout;
    assert!(output.contains("learnt, harmonics of degree 2"), "{output}");
    irradia(folder.path(), "eval run1 --data data --json figures.json").success();
    let figures = json(&folder.path().join("figures.json"));
    assert_eq!(figures["psnr"], json(&one.join("report.json"))["psnr"]);
}

#[test]
fn invalid_fields_are_rejected() {
    let folder = with_data();
    irradia(
        folder.path(),
        &format!("train data --recipe hashgrid --steps 2 {SMALL} --out run"),
    )
    .success();
    let bytes = field(&folder.path().join("run"));
    for (name, bytes) in [
        ("cut", &bytes[..bytes.len() / 2]),
        ("empty", &bytes[..0]),
        ("header", &bytes[..8]),
    ] {
        let path = folder.path().join(format!("{name}.safetensors"));
        std::fs::write(&path, bytes).expect("written");
        irradia(folder.path(), &format!("render {name}.safetensors --orbit 1 --out x"))
            .refused(1, &["safetensors", name]);
        irradia(folder.path(), &format!("info {name}.safetensors")).refused(1, &["safetensors", name]);
    }
    // Of the same length, so that the rest of the file keeps its offsets.
    for (from, to, says) in [
        (r#"log2_table\":15"#, r#"log2_table\":24"#, "room for"),
        (r#"\"side\":128"#, r#"\"side\":999"#, "occupancy grid"),
        (r#"\"width\":32"#, r#"\"width\":99"#, "multiple of 8"),
        (r#"\"format\":1"#, r#"\"format\":9"#, "format 9"),
        ("irradia_field", "irradia_filed", "does not describe one"),
    ] {
        let at = bytes.windows(from.len()).position(|window| window == from.as_bytes());
        let at = at.unwrap_or_else(|| panic!("no {from}"));
        let mut wrong = bytes.clone();
        wrong[at..at + to.len()].copy_from_slice(to.as_bytes());
        std::fs::write(folder.path().join("wrong.safetensors"), wrong).expect("written");
        irradia(folder.path(), "info wrong.safetensors").refused(1, &["wrong.safetensors", says]);
    }
    irradia(folder.path(), "info none.safetensors").refused(1, &["none.safetensors"]);
    irradia(
        folder.path(),
        "train data --recipe hashgrid --set field.net.width=7 --out x",
    )
    .refused(2, &["width"]);
    irradia(
        folder.path(),
        "train data --recipe fast --set stage.grow.represents=\"field\" --out x",
    )
    .refused(2, &["grow", "field"]);
}
