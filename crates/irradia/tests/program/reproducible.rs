//! The same seed writes the same bytes: with any number of threads, and across every kind of interruption.

use crate::process::*;
use std::path::Path;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

/// Long enough to be interrupted midway, and with everything that could differ: density control, resets, a new view order.
const LONG_RUN: &str = "train data --steps 500 --seed 3 --set checkpoint_every=20";

fn train_uninterrupted(folder: &Path) -> Vec<u8> {
    irradia_with(folder, &format!("{LONG_RUN} --out unbroken"), &DENSIFYING_ARGS).success();
    scene(&folder.join("unbroken"))
}

/// Starts the long run and waits for a checkpoint.
fn start_until_checkpoint(folder: &Path) -> Child {
    let mut command = program(folder);
    command
        .args(LONG_RUN.split_whitespace())
        .args(["--out", "run"])
        .args(DENSIFYING_ARGS);
    let child = command.spawn().expect("the program starts");
    let (checkpoints, started) = (folder.join("run/checkpoints"), Instant::now());
    let has_checkpoint = || {
        files_under(&checkpoints)
            .iter()
            .any(|f| f.extension().is_some_and(|e| e == "safetensors"))
    };
    while !(checkpoints.is_dir() && has_checkpoint()) {
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
        irradia_with(folder.path(), &line, &DENSIFYING_ARGS).success();
    }
    let one = scene(&folder.path().join("run1"));
    assert!(one == scene(&folder.path().join("run2")) && one == scene(&folder.path().join("run3")));
    assert!(
        events(&folder.path().join("run1"))
            .iter()
            .any(|e| e["event"] == "densified"),
        "density control was active"
    );
}

#[test]
fn the_default_recipe_writes_the_same_scene_with_any_threads_and_across_a_resume() {
    let folder = with_data();
    let line = "train data --steps 90 --set checkpoint_every=40 --set stage.grow.density.every=10";
    for threads in [1, 3] {
        irradia(folder.path(), &format!("{line} --threads {threads} --out run{threads}")).success();
    }
    let one = scene(&folder.path().join("run1"));
    assert!(one == scene(&folder.path().join("run3")));
    // As after a kill following step 80.
    let run = folder.path().join("run3");
    unfinish(&run, "scene.ply");
    irradia(folder.path(), "train --resume run3").success();
    assert!(one == scene(&run));
}

#[test]
fn a_killed_run_resumes_to_the_bytes_of_an_uninterrupted_one() {
    let folder = with_data();
    let mut child = start_until_checkpoint(folder.path());
    child.kill().expect("killed");
    child.wait().expect("gone");
    let run = folder.path().join("run");
    assert!(!run.join("report.json").exists(), "killed too late to prove anything");
    assert!(!run.join("scene.ply").exists());
    irradia(folder.path(), "train --resume run").success();
    assert!(scene(&run) == train_uninterrupted(folder.path()));
    assert_no_leftovers(&run);
    // The journal, too, is that of one run.
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
    // As after a kill at step 30.
    unfinish(&run, "scene.ply");
    irradia(folder.path(), "train --resume run").success();
    assert!(scene(&run) == finished);
}

#[cfg(unix)]
#[test]
fn ctrl_c_saves_everything_and_the_run_resumes_to_the_same_bytes() {
    let folder = with_data();
    let child = start_until_checkpoint(folder.path());
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(sent.expect("kill").success());
    let ended: ProgramOutput = child.wait_with_output().expect("ends").into();
    let ended = ended.success();
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

    irradia(folder.path(), "train --resume run --threads 1").success();
    assert_eq!(json(&run.join("report.json"))["steps"], 500);
    assert!(scene(&run) == train_uninterrupted(folder.path()) && scene(&run) != partial);
    // A complete run stays unchanged.
    let again = irradia(folder.path(), "train --resume run").success();
    assert!(again.stdout.contains("complete"), "{again:?}");
}

#[test]
fn two_processes_do_not_train_into_one_folder() {
    let folder = with_data();
    let mut child = start_until_checkpoint(folder.path());
    let number = child.id().to_string();
    for line in ["train data --out run --overwrite --steps 5", "train --resume run"] {
        irradia(folder.path(), line).refused(1, &["run is in use", &number]);
    }
    child.kill().expect("killed");
    child.wait().expect("gone");
    // The lock was released with its process; partial files are removed now.
    let half = folder.path().join("run/checkpoints/.step_20.safetensors.1.0.tmp");
    std::fs::write(&half, "half a checkpoint").expect("written");
    irradia(folder.path(), "train data --out run --overwrite --steps 5").success();
    assert_no_leftovers(&folder.path().join("run"));
}

#[test]
fn a_run_does_not_resume_on_other_data() {
    let folder = with_data();
    irradia(
        folder.path(),
        "train data --out run --steps 40 --set checkpoint_every=20",
    )
    .success();
    let run = folder.path().join("run");
    let before = scene(&run);
    unfinish(&run, "scene.ply");
    let picture = folder.path().join("data/train/r_002.png");
    std::fs::rename(&picture, folder.path().join("kept.png")).expect("moved");
    irradia(folder.path(), "train --resume run").refused(1, &["run", "data", "1 views are gone", "r_002"]);
    std::fs::rename(folder.path().join("kept.png"), &picture).expect("back");
    irradia(folder.path(), "train --resume run").success();
    assert!(scene(&run) == before);
}

#[test]
fn a_run_with_a_budget_is_repeated_bit_for_bit() {
    let folder = with_data();
    irradia_with(
        folder.path(),
        "train data --out run --budget 2s --seed 5 --set render.background=[0.1,0.0,0.0]",
        &DENSIFYING_ARGS,
    )
    .success();
    irradia(folder.path(), "train --replay run --out again").success();
    let [run, again] = ["run", "again"].map(|name| folder.path().join(name));
    assert!(scene(&run) == scene(&again));
    let steps = |run: &Path| json(&run.join("report.json"))["steps"].as_u64();
    assert!(steps(&run) == steps(&again) && steps(&run) > Some(20));
    let paces = |run: &Path| std::fs::read_to_string(run.join("pace.txt")).expect("paces");
    assert_eq!(paces(&run), paces(&again), "a repeated run can be repeated");
    assert!(paces(&run).lines().count() > 10);
    let recipe = |run: &Path| std::fs::read_to_string(run.join("recipe.toml")).expect("a recipe");
    assert_eq!(recipe(&run), recipe(&again), "with the background that was set");
    // An interrupted repetition resumes as one, wherever the original is.
    unfinish(&again, "scene.ply");
    let moved = folder.path().join("moved");
    std::fs::rename(&run, &moved).expect("moved");
    irradia(folder.path(), "train --resume again").success();
    assert!(scene(&moved) == scene(&again));
    std::fs::remove_file(moved.join("pace.txt")).expect("removed");
    irradia(folder.path(), "train --replay moved --out x").refused(1, &["moved/pace.txt"]);
    assert!(!folder.path().join("x").exists());
}

#[test]
fn a_short_run_from_a_scene_ends_like_a_long_one_and_is_repeated_bit_for_bit() {
    let folder = with_data();
    irradia(folder.path(), "train data --out run --steps 60").success();
    irradia(folder.path(), "train data --from run --out next --steps 20").success();
    irradia(folder.path(), "train --replay next --out again").success();
    let [run, next, again] = ["run", "next", "again"].map(|name| folder.path().join(name));
    assert!(scene(&next) == scene(&again) && scene(&next) != scene(&run));
    let paces = |run: &Path| std::fs::read_to_string(run.join("pace.txt")).expect("paces");
    let lines = paces(&next);
    let values: Vec<f64> = lines
        .split_whitespace()
        .map(|word| word.parse().expect("a number"))
        .collect();
    let [0.0, skipped, 1.0, pace] = values[..] else {
        panic!("{lines}");
    };
    assert!(
        skipped > 2500.0 && (skipped + 20.0 * pace - 3000.0).abs() < 1e-6,
        "{lines}"
    );
    assert_eq!(paces(&again), lines);
    let psnr = |run: &Path| json(&run.join("report.json"))["psnr"].as_f64().expect("held-out views");
    assert!(psnr(&next) > psnr(&run), "{} after {}", psnr(&next), psnr(&run));
    irradia(folder.path(), "train data --from run --out timed --budget 1s").success();
    assert!(psnr(&folder.path().join("timed")) > psnr(&run));
}

#[test]
fn after_repeated_kills_it_ends_with_the_same_bytes() {
    let folder = with_data();
    let line = "train data --steps 150 --seed 3 --set checkpoint_every=5";
    let started = Instant::now();
    irradia_with(folder.path(), &format!("{line} --out unbroken"), &DENSIFYING_ARGS).success();
    let whole = started.elapsed();
    let mut rng = irradia_runs::scene::Rng::new(11, 0);
    let (mut kills, mut tries) = (0, 0);
    let mut arguments = format!("{line} --out run");
    while kills < 5 {
        tries += 1;
        assert!(tries < 60, "{kills} kills in {tries} tries");
        let more: &[&str] = if folder.path().join("run/run.json").exists() {
            arguments = "train --resume run".into();
            &[]
        } else {
            &DENSIFYING_ARGS
        };
        let mut child = program(folder.path())
            .args(arguments.split_whitespace())
            .args(more)
            .spawn()
            .expect("it starts");
        std::thread::sleep(whole.mul_f32(0.1 + 0.3 * rng.uniform()));
        if child.try_wait().expect("asked").is_none() {
            child.kill().expect("killed");
            kills += 1;
        }
        child.wait().expect("gone");
        if folder.path().join("run/report.json").exists() {
            // Finished before it was killed often enough: start again.
            std::fs::remove_dir_all(folder.path().join("run")).expect("removed");
            arguments = format!("{line} --out run");
        }
    }
    if folder.path().join("run/run.json").exists() {
        irradia(folder.path(), "train --resume run").success();
    } else {
        irradia_with(folder.path(), &format!("{line} --out run"), &DENSIFYING_ARGS).success();
    }
    assert!(scene(&folder.path().join("run")) == scene(&folder.path().join("unbroken")));
    assert_no_leftovers(&folder.path().join("run"));
}
