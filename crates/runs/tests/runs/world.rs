//! Datasets far from the origin or in unusual units train like others, and their results are in their own coordinates.

use crate::folder;
use irradia_runs::formats::read_points_ply;
use irradia_runs::prelude::*;
use serde_json::{Value, json};
use std::fmt::Write;
use std::fs;
use std::path::Path;

/// Millimetres, 500 km from the origin.
const SCALE: f64 = 1000.0;
const SHIFT: [f64; 3] = [5e8, -5e8, 1e5];

fn to_far_world(position: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| SCALE * position[i] + SHIFT[i])
}

/// Moves the dataset in `folder`, its cameras and points.
fn move_far_away(folder: &Path) {
    for part in ["train", "val", "test"] {
        let path = folder.join(format!("transforms_{part}.json"));
        let mut json: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        for frame in json["frames"].as_array_mut().unwrap() {
            let matrix = &mut frame["transform_matrix"];
            let position = to_far_world([0, 1, 2].map(|row: usize| matrix[row][3].as_f64().unwrap()));
            (0..3).for_each(|row| matrix[row][3] = json!(position[row]));
        }
        fs::write(&path, json.to_string()).unwrap();
    }
    let path = folder.join("points.ply");
    let points = read_points_ply(&path).unwrap();
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", points.len());
    text += "property double x\nproperty double y\nproperty double z\n";
    text += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    for (position, [r, g, b]) in points.positions.iter().zip(&points.colors) {
        let [x, y, z] = to_far_world(position.as_dvec3().to_array());
        writeln!(text, "{x} {y} {z} {r} {g} {b}").unwrap();
    }
    fs::write(&path, text).unwrap();
}

/// Trains in `folder/name`, resuming halfway; returns the held-out PSNR.
fn train(folder: &Path, name: &str) -> f64 {
    let data = folder.join(name);
    let out = folder.join(format!("{name}.run"));
    let input = TrainInput {
        steps: Some(60),
        recipe: "classic".into(),
        ..TrainInput::new(data, &out)
    };
    let mut run = Run::begin(input.check().unwrap()).unwrap();
    run.train(&mut [&mut StopAt(30)]).unwrap();
    assert!(!run.finish().unwrap().complete);
    let mut run = Run::resume(TrainInput::of_run(&out).unwrap().check().unwrap()).unwrap();
    run.train(&mut []).unwrap();
    run.finish().unwrap().report.psnr
}

struct StopAt(u64);

impl Observer for StopAt {
    fn on_event(&mut self, _: &Event, trainer: &Trainer) -> Signal {
        if trainer.clock.step >= self.0 {
            Signal::Stop
        } else {
            Signal::Continue
        }
    }
}

#[test]
fn a_dataset_in_millimetres_500_km_away_trains_alike_and_is_exported_to_the_millimetre() {
    let folder = folder();
    let options = SynthOptions {
        views: 16,
        width: 120,
        height: 80,
        seed: 1,
        ..SynthOptions::default()
    };
    for name in ["near", "far"] {
        write_synth_dataset(folder.path().join(name), &options).unwrap();
    }
    move_far_away(&folder.path().join("far"));
    let [near, away] = ["near", "far"].map(|name| train(folder.path(), name));
    // The cameras' median becomes the origin, so only rounding differs.
    assert!((near - away).abs() < 0.05, "{near} and {away} dB");

    let cameras = |name: &str| -> Value {
        let path = folder.path().join(format!("{name}.run/cameras.json"));
        serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
    };
    let position = |camera: &Value| [0, 1, 2].map(|i: usize| camera["position"][i].as_f64().unwrap());
    let [here, there] = ["near", "far"].map(cameras);
    for (here, there) in here.as_array().unwrap().iter().zip(there.as_array().unwrap()) {
        let expected = to_far_world(position(here));
        // In millimetres: at 10 m, f32 resolves a thousandth of one.
        assert!((0..3).all(|i| (position(there)[i] - expected[i]).abs() < 1e-2));
    }

    let scenes = ["near", "far"].map(|name| Scene::read(folder.path().join(format!("{name}.run"))).unwrap());
    let world = scenes[1].world_from_dataset;
    assert!(scenes[0].world_from_dataset.is_identity() && (world.scale - 1e-3).abs() < 1e-12);
    // No densification occurs within 60 steps: both have the same splats, which moved by less than their size.
    let means = scenes.map(|scene| {
        let splats = scene.model.splats().unwrap().clone();
        let of = |i: usize| in_dataset(&scene, splats.mean(i));
        (0..splats.len()).map(of).fold([0.0; 3], |sum, p| {
            std::array::from_fn(|i| sum[i] + p[i] / splats.len() as f64)
        })
    });
    let expected = to_far_world(means[0]);
    assert!((0..3).all(|i| (means[1][i] - expected[i]).abs() < 1.0), "{means:?}");

    let data = Reading::default().read(&folder.path().join("far")).unwrap();
    assert!(data.world_from_dataset == world);
    let description = describe(folder.path().join("far"), &ReadingOptions::default())
        .unwrap()
        .to_string();
    assert!(description.contains("in units of 1000"), "{description}");
}

/// A point of the scene's world in the dataset's coordinates.
fn in_dataset(scene: &Scene, mean: [f32; 3]) -> [f64; 3] {
    let world = scene.world_from_dataset;
    let center = world.center.to_array();
    std::array::from_fn(|i| f64::from(mean[i]) / world.scale + center[i])
}
