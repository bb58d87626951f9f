//! The library's public API as a program uses it: requests, runs, observers, and scenes.

mod compact;
mod edits;
mod every_recipe;
#[cfg(feature = "gpu")]
mod gpu;
mod points;
mod pose;
mod pose_into;
mod requests;
mod scenes;
mod snapshots;
mod turntable;
mod watched;
mod wide;
mod world;

use irradia_runs::prelude::*;
use std::path::Path;
use tempfile::TempDir;

/// A dataset that trains in moments.
const SMALL: SynthOptions = SynthOptions {
    scene: irradia_runs::synth::SceneName::Demo,
    views: 4,
    width: 24,
    height: 16,
    seed: 1,
    lens: irradia_runs::synth::SynthLens::Pinhole,
    turn: 0.0,
};

fn folder() -> TempDir {
    tempfile::tempdir().expect("a folder")
}

fn dataset() -> Dataset {
    irradia_runs::synth::dataset(&SMALL).expect("options")
}

/// A request for `steps` steps in `folder/name`.
fn input(folder: &Path, name: &str, steps: u64) -> TrainInput {
    TrainInput {
        steps: Some(steps),
        ..TrainInput::new("memory", folder.join(name))
    }
}

/// A run of `steps` steps in `folder/name`.
fn begin(folder: &Path, name: &str, steps: u64) -> Run {
    let request = input(folder, name, steps).check().expect("a request");
    Run::begin_on(request, dataset()).expect("a run")
}

/// The result of a run of `steps` steps in `folder/name`.
fn finished(folder: &Path, name: &str, steps: u64) -> Finished {
    let mut run = begin(folder, name, steps);
    run.train(&mut []).expect("trains");
    run.finish().expect("finishes")
}

/// The bytes of the scene of a run of `steps` steps without observers.
fn unwatched(folder: &Path, steps: u64) -> Vec<u8> {
    assert!(finished(folder, "unwatched", steps).complete);
    scene(folder, "unwatched")
}

fn scene(folder: &Path, name: &str) -> Vec<u8> {
    std::fs::read(folder.join(name).join("scene.ply")).expect("a scene")
}
