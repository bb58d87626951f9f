//! The real scenes of `../shared/data`: each trains without flags except those that reduce it, within bounded memory.

use crate::process::*;
use std::path::PathBuf;

/// The shared data, absolute.
fn shared() -> Option<PathBuf> {
    Some(irradia_testkit::shared("data")?.canonicalize().expect("it exists"))
}

#[test]
fn every_scene_trains() {
    let Some(shared) = shared() else { return };
    // Scene, warnings, and the held-out PSNR that 150 steps on small images must reach, about 1.5 dB below the usual result.
    let cases = [
        ("fox", 1, 18.4),
        ("fox_colmap", 0, 18.5),
        ("chair", 0, 21.9),
        ("fern", 1, 21.1),
        ("lund_door", 0, 21.5),
        ("maryRose", 1, 16.8),
    ];
    let folder = tempfile::tempdir().expect("a folder");
    for (scene, warnings, at_least) in cases {
        let data = shared.join(scene).display().to_string();
        let line = format!("--out {scene} --steps 150 --max-side 120");
        let ended = irradia_with(folder.path(), &format!("train {line}"), &[&data]).success();
        let told = ended.stderr.lines().filter(|line| line.starts_with("warning:")).count();
        assert_eq!(told, warnings, "{scene}: {}", ended.stderr);
        let psnr = json(&folder.path().join(scene).join("report.json"))["psnr"]
            .as_f64()
            .expect("a number");
        eprintln!("{scene}: {psnr:.2} dB");
        assert!(psnr > at_least, "{scene}: {psnr}");
    }
}

#[test]
fn fox_takes_less_than_400_megabytes_and_lpips_finds_its_weights() {
    let Some(shared) = shared() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let (data, weights) = (
        shared.join("fox_colmap"),
        shared.join("lpips/lpips_squeeze.safetensors"),
    );
    let more = [&data, &weights].map(|path| path.display().to_string());
    irradia_with(
        folder.path(),
        "train --out run --steps 60 --lpips",
        &[&more[1], &more[0]],
    )
    .success();
    let report = json(&folder.path().join("run/report.json"));
    assert!(
        report["peak_rss_bytes"].as_u64() < Some(400_000_000),
        "{}",
        report["peak_rss_bytes"]
    );
    assert!(
        report["lpips_net"] == "squeeze" && report["lpips"].as_f64().is_some_and(|l| l > 0.0 && l < 1.0),
        "{}",
        report["lpips"]
    );
}

#[test]
fn a_perceptual_loss_finds_the_weights_of_the_evaluation() {
    let Some(shared) = shared() else { return };
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a folder");
    let data = shared.join("chair").display().to_string();
    let weights = shared.join("lpips/lpips_squeeze.safetensors").display().to_string();
    let line = "train --steps 20 --max-side 100 --set params.perceptual_weight=0.1 --out";
    irradia_with(folder.path(), &format!("{line} without"), &[&data]).success();
    let with = irradia_with(folder.path(), &format!("{line} with"), &[&data, "--lpips", &weights]).success();
    assert!(!with.stderr.contains("warning:"), "{with:?}");
    assert!(scene(&folder.path().join("with")) != scene(&folder.path().join("without")));
    let report = json(&folder.path().join("with/report.json"));
    assert!(report["trained_on_lpips"] == "squeeze" && report["unseen_lpips"].is_null());

    // In a folder, AlexNet is found too: the loss does not see it.
    let weights = shared.join("lpips").display().to_string();
    irradia_with(
        folder.path(),
        &format!("{line} both --overwrite"),
        &[&data, "--lpips", &weights],
    )
    .success();
    assert!(scene(&folder.path().join("both")) == scene(&folder.path().join("with")));
    let report = json(&folder.path().join("both/report.json"));
    assert!(report["lpips_net"] == "squeeze" && report["unseen_lpips_net"] == "alex");
    assert!(report["unseen_lpips"].as_f64() > Some(0.0) && report["views"][0]["unseen_lpips"].as_f64() > Some(0.0));
}
