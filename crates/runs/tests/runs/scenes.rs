//! Scenes from files and runs.

use crate::{finished, folder};
use irradia_runs::prelude::*;
use irradia_runs::train::eval::{EvalOptions, Metrics};
use irradia_runs::train::half_fit::HalfFit;
use irradia_runs::train::tensor_file::{NamedTensor, to_bytes};
use std::fs;

#[test]
fn a_scene_takes_background_and_cameras_from_its_run_if_it_has_one() {
    let folder = folder();
    finished(folder.path(), "run", 3);
    let path = folder.path().join("run");
    let inside = Scene::read(&path).expect("a scene");
    let cameras = inside.cameras.clone().expect("beside it");
    assert_eq!(cameras.len(), 4);
    let orbit = inside.orbit(5, None);
    assert_eq!(
        (orbit.len(), orbit[0].intrinsics.width, orbit[0].intrinsics.height),
        (5, 24, 16)
    );

    let sky = to_bytes(
        &[NamedTensor::f32s("background", vec![3], &[0.25, 0.5, 0.75])],
        ("irradia_sky", "1".into()),
    );
    fs::write(path.join("sky.safetensors"), sky).expect("written");
    let under_sky = Scene::read(&path).expect("a scene");
    assert_eq!(under_sky.options.background, [0.25, 0.5, 0.75]);
    fs::write(path.join("sky.safetensors"), [7; 40]).expect("written");
    let error = Scene::read(&path).expect_err("a damaged sky");
    assert!(error.to_string().contains("sky.safetensors"), "{error}");
    fs::remove_file(path.join("sky.safetensors")).expect("removed");

    let alone = folder.path().join("alone.ply");
    fs::copy(path.join("scene.ply"), &alone).expect("copied");
    let outside = Scene::read(&alone).expect("a scene");
    assert!(outside.cameras.is_none() && outside.model.splats() == inside.model.splats());
    let camera = outside.orbit(1, Some((32, 20)))[0];
    assert_eq!((camera.intrinsics.width, camera.intrinsics.height), (32, 20));
    assert!(
        describe(&path, &ReadingOptions::default())
            .expect("known")
            .title
            .contains("Gaussians")
    );

    let error = Scene::read(folder.path().join("none.ply")).expect_err("absent");
    assert!(error.to_string().contains("none.ply") && !error.is_request(), "{error}");
}

#[test]
fn the_mean_of_an_evaluation_is_that_of_its_views() {
    let folder = folder();
    let report = finished(folder.path(), "run", 3).report;
    let scene = Scene::read(folder.path().join("run")).expect("a scene");
    let dataset = crate::dataset();
    let mut psnr = Vec::new();
    let options = EvalOptions {
        render: scene.options,
        metrics: Metrics::All(Default::default()),
        half_fit: HalfFit::default(),
        vignette: None,
        device: &irradia_compute::Device::Cpu,
    };
    let mean = evaluate(&scene.model, &dataset, &dataset.test, &options, |view| {
        psnr.push(view.metrics.psnr);
        Ok::<(), RunError>(())
    });
    let mean = mean.expect("measured").psnr;
    assert_eq!(psnr.len(), 2);
    assert!(
        mean == report.psnr && mean == (psnr[0] + psnr[1]) / 2.0,
        "{mean} {}",
        report.psnr
    );
}
