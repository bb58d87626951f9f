//! `--memory` bounds splats and photographs, and changes nothing else.

use crate::process::*;
use std::fs;

#[test]
fn a_training_that_cannot_fit_is_refused_with_the_memory_that_suffices() {
    let folder = with_data();
    let refused = irradia(folder.path(), "train data --out run --steps 5 --memory 60MiB");
    let error = refused.refused(1, &["0.06 GiB", "--memory "]).stderr;
    assert!(!folder.path().join("run").exists());
    let suffices = error
        .split("--memory ")
        .nth(1)
        .and_then(|rest| rest.split(' ').next())
        .expect("a size");
    let suffices = suffices.trim_end_matches(',');
    irradia(
        folder.path(),
        &format!("train data --out run --steps 5 --memory {suffices}"),
    )
    .success();
    irradia(folder.path(), "train data --out x --memory much").refused(2, &["8GiB"]);
}

#[test]
fn density_control_stops_at_the_memory_and_says_so() {
    let folder = with_data();
    let train = |out: &str, memory: &str| {
        let lively = DENSIFYING_ARGS.join(" ");
        let set = "--set stage.grow.density.gradient_threshold=1e-9 --set max_splats=1000000";
        irradia(
            folder.path(),
            &format!("train data --out {out} --steps 60 --memory {memory} {lively} {set}"),
        )
        .success()
    };
    let (small, large) = (train("small", "85MiB"), train("large", "1GiB"));
    let counts = ["small", "large"].map(|run| json(&folder.path().join(run).join("report.json"))["splats"].as_u64());
    assert!(counts[0] < counts[1], "{counts:?}");
    assert!(small.stderr.contains("density control adds fewer"), "{small:#?}");
    assert!(large.stderr.contains("memory: at most 1.00 GiB"), "{large:#?}");
    // Where nothing is withheld, the amount does not matter.
    train("larger", "1500MiB");
    let scenes = ["large", "larger"].map(|run| fs::read(folder.path().join(run).join("scene.ply")).expect("a scene"));
    assert!(scenes[0] == scenes[1]);
}
