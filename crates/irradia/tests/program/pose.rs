//! Photographs without poses.

use crate::process::*;
use std::fs;

#[test]
fn bare_photographs_are_posed_and_trained_on() {
    let folder = tempfile::tempdir().expect("a folder");
    irradia(folder.path(), "synth data --views 40 --size 320x240").success();
    let posed = irradia(folder.path(), "pose data/train --out posed").success();
    assert!(
        posed.stdout.contains("photographs posed") && posed.stdout.contains("features"),
        "{posed:#?}"
    );
    let report = json(&folder.path().join("posed/pose.json"));
    assert!(report["registered"].as_u64().is_some_and(|n| n >= 36), "{report}");
    // The posed photographs lie beside their poses: no other folder is needed.
    fs::rename(folder.path().join("data/train"), folder.path().join("photos")).expect("renamed");
    irradia(folder.path(), "train posed --out first --steps 3").success();
    let trained = irradia(folder.path(), "train photos --out second --steps 3").success();
    assert!(trained.stderr.contains("no poses"), "{trained:#?}");
    assert!(folder.path().join("second/posed/sparse/0/images.bin").is_file());
    assert!(folder.path().join("second/scene.ply").is_file());
    irradia(folder.path(), "train --resume second").success();
    assert_no_leftovers(folder.path());
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
    irradia(folder.path(), "pose none --out x").refused(1, &["none"]);
    irradia(folder.path(), "pose empty --out x").refused(2, &["0 readable photographs"]);
    irradia(folder.path(), "pose text --out x").refused(2, &["a.jpg", "not a readable"]);
    irradia(folder.path(), "pose film.mp4 --out x").refused(2, &["film.mp4", "ffmpeg"]);
    irradia(folder.path(), "pose text --out x --max-features 0").refused(2, &["--max-features"]);
    irradia(folder.path(), "train text --out run").refused(2, &["a.jpg"]);
    irradia(folder.path(), "train empty --out run").refused(1, &["no dataset found", "COLMAP"]);
}
