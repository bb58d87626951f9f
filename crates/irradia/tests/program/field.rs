//! Radiance fields, treated as splats are: trained, resumed, measured, rendered.

use crate::process::*;
use std::path::Path;

/// Steps that take no time.
const SMALL: &str = "--set field.samples=4096 --set checkpoint_every=25";

fn field(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("field.safetensors")).expect("a field")
}

#[test]
fn a_field_trains_to_the_same_bytes_with_any_threads_and_over_a_break() {
    let folder = with_data();
    for (recipe, steps) in [("hashgrid", 60), ("nerf", 30)] {
        for threads in [1, 2] {
            let line = format!("train data --recipe {recipe} --steps {steps} {SMALL} --threads {threads}");
            irradia(folder.path(), &format!("{line} --out {recipe}{threads}")).well();
        }
        let [one, two] = [1, 2].map(|threads| folder.path().join(format!("{recipe}{threads}")));
        let unbroken = field(&one);
        assert!(unbroken == field(&two), "{recipe}");
        unfinish(&two, "field.safetensors");
        let ended = irradia(folder.path(), &format!("train --resume {recipe}2")).well();
        assert!(ended.stderr.contains("resuming at step"), "{ended:?}");
        assert!(unbroken == field(&two), "{recipe}");
    }
}

#[test]
fn a_field_learns_and_is_measured_and_rendered_as_splats_are() {
    let folder = with_data();
    let line = format!("train data --recipe hashgrid --steps 300 {SMALL} --out run");
    irradia(folder.path(), &line).well();
    // Eight views say too little of what lies between them; those that it saw it must know (21.8 dB; 12 before training).
    irradia(folder.path(), "eval run --data data --split train --json seen.json").well();
    let seen = json(&folder.path().join("seen.json"));
    assert!(seen["psnr"].as_f64() > Some(20.0), "{}", seen["psnr"]);
    let report = json(&folder.path().join("run/report.json"));
    irradia(folder.path(), "eval run --data data --json figures.json").well();
    let figures = json(&folder.path().join("figures.json"));
    assert_eq!(figures["psnr"], report["psnr"], "a field survives its file to the bit");
    irradia(
        folder.path(),
        "render run --orbit 3 --size 40x30 --out round --depth --alpha",
    )
    .well();
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
    irradia(folder.path(), &format!("{line} --out run")).well();
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
fn what_a_field_adds_to_splats_is_kept_beside_them_to_the_bit() {
    let folder = with_data();
    for threads in [1, 2] {
        let line = format!("train data --recipe shiny --steps 120 --set checkpoint_every=50 --threads {threads}");
        irradia(folder.path(), &format!("{line} --out run{threads}")).well();
    }
    let [one, two] = [1, 2].map(|threads| folder.path().join(format!("run{threads}")));
    let both = |run: &Path| ["scene.ply", "residual.safetensors"].map(|f| std::fs::read(run.join(f)).expect(f));
    let unbroken = both(&one);
    assert!(unbroken == both(&two));
    unfinish(&two, "scene.ply");
    std::fs::remove_file(two.join("residual.safetensors")).expect("removed");
    irradia(folder.path(), "train --resume run2").well();
    assert!(unbroken == both(&two));

    let report = json(&one.join("report.json"));
    irradia(folder.path(), "eval run1 --data data --json whole.json").well();
    let psnr = |file: &str| json(&folder.path().join(file))["psnr"].as_f64().expect("a figure");
    let told = report["psnr"].as_f64().expect("a figure");
    assert!(
        (psnr("whole.json") - told).abs() < 0.01,
        "{} and {told}",
        psnr("whole.json")
    );
    std::fs::copy(one.join("scene.ply"), folder.path().join("alone.ply")).expect("copied");
    irradia(folder.path(), "eval alone.ply --data data --json alone.json").well();
    assert!((psnr("alone.json") - told).abs() > 1e-3, "the field adds something");
}

#[test]
fn what_is_no_field_is_refused() {
    let folder = with_data();
    irradia(
        folder.path(),
        &format!("train data --recipe hashgrid --steps 2 {SMALL} --out run"),
    )
    .well();
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
    }
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
