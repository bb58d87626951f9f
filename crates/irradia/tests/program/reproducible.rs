//! The same seed writes the same bytes: with any number of threads, and over every kind of interruption.

use crate::process::*;
use std::path::Path;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

/// Long enough to be caught in its midst, and with all that could differ: density control, resets, a new view order.
const LONG: &str = "train data --steps 500 --seed 3 --set checkpoint_every=20";

fn unbroken(folder: &Path) -> Vec<u8> {
    irradia_with(folder, &format!("{LONG} --out unbroken"), &LIVELY).well();
    scene(&folder.join("unbroken"))
}

/// Starts the long run and waits for a checkpoint.
fn caught_in_its_midst(folder: &Path) -> Child {
    let mut command = program(folder);
    command
        .args(LONG.split_whitespace())
        .args(["--out", "run"])
        .args(LIVELY);
    let child = command.spawn().expect("the program starts");
    let (checkpoints, started) = (folder.join("run/checkpoints"), Instant::now());
    let is_there = || {
        files_under(&checkpoints)
            .iter()
            .any(|f| f.extension().is_some_and(|e| e == "safetensors"))
    };
    while !(checkpoints.is_dir() && is_there()) {
        assert!(started.elapsed() < Duration::from_secs(60), "no checkpoint appears");
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

#[test]
fn one_thread_and_two_write_the_same_scene() {
    let folder = with_data();
    for threads in [1, 2, 3] {
        let line = format!("train data --out run{threads} --steps 80 --threads {threads}");
        irradia_with(folder.path(), &line, &LIVELY).well();
    }
    let one = scene(&folder.path().join("run1"));
    assert!(one == scene(&folder.path().join("run2")) && one == scene(&folder.path().join("run3")));
    assert!(
        events(&folder.path().join("run1"))
            .iter()
            .any(|e| e["event"] == "densified"),
        "density control took part"
    );
}

#[test]
fn the_default_recipe_writes_the_same_scene_with_any_threads_and_over_a_break() {
    let folder = with_data();
    let line = "train data --steps 90 --set checkpoint_every=40 --set stage.grow.density.every=10";
    for threads in [1, 3] {
        irradia(folder.path(), &format!("{line} --threads {threads} --out run{threads}")).well();
    }
    let one = scene(&folder.path().join("run1"));
    assert!(one == scene(&folder.path().join("run3")));
    // As a kill after step 80 would have left it.
    let run = folder.path().join("run3");
    unfinish(&run, "scene.ply");
    irradia(folder.path(), "train --resume run3").well();
    assert!(one == scene(&run));
}

#[test]
fn a_killed_run_resumes_to_the_bytes_of_an_unbroken_one() {
    let folder = with_data();
    let mut child = caught_in_its_midst(folder.path());
    child.kill().expect("killed");
    child.wait().expect("gone");
    let run = folder.path().join("run");
    assert!(!run.join("report.json").exists(), "killed too late to prove anything");
    assert!(!run.join("scene.ply").exists());
    irradia(folder.path(), "train --resume run").well();
    assert!(scene(&run) == unbroken(folder.path()));
    assert_no_leftovers(&run);
    // The journal too is that of one run.
    let steps: Vec<u64> = events(&run)
        .iter()
        .filter(|e| e["event"] == "step")
        .filter_map(|e| e["step"].as_u64())
        .collect();
    assert!(steps.windows(2).all(|pair| pair[0] < pair[1]), "{steps:?}");
}

#[test]
fn a_run_killed_before_its_first_checkpoint_resumes_from_its_start() {
    let folder = with_run();
    let run = folder.path().join("run");
    let finished = scene(&run);
    // As a kill at step 30 would have left it.
    unfinish(&run, "scene.ply");
    irradia(folder.path(), "train --resume run").well();
    assert!(scene(&run) == finished);
}

#[cfg(unix)]
#[test]
fn ctrl_c_saves_everything_and_the_run_resumes_to_the_same_bytes() {
    let folder = with_data();
    let child = caught_in_its_midst(folder.path());
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(sent.expect("kill").success());
    let ended: Ended = child.wait_with_output().expect("ends").into();
    let ended = ended.well();
    assert!(ended.stdout.contains("irradia train --resume run"), "{ended:?}");
    let run = folder.path().join("run");
    let (stopped_at, partial) = (json(&run.join("report.json"))["steps"].as_u64(), scene(&run));
    assert!(
        stopped_at.is_some_and(|steps| (20..500).contains(&steps)),
        "{stopped_at:?}"
    );
    assert!(
        run.join(format!("checkpoints/step_{}.safetensors", stopped_at.unwrap_or(0)))
            .exists()
    );

    irradia(folder.path(), "train --resume run --threads 1").well();
    assert_eq!(json(&run.join("report.json"))["steps"], 500);
    assert!(scene(&run) == unbroken(folder.path()) && scene(&run) != partial);
    // What is complete stays as it is.
    let again = irradia(folder.path(), "train --resume run").well();
    assert!(again.stdout.contains("complete"), "{again:?}");
}
