//! Every built-in recipe on every posed folder of `../shared/data`, downscaled to 120 pixels and kept in memory.

use irradia_field::Sampler;
use irradia_runs::formats::{DatasetOptions, read_dataset};
use irradia_runs::prelude::*;
use irradia_runs::train::recipe::BUILT_IN;
use std::path::Path;
use std::sync::Arc;

const MAX_SIDE: u32 = 120;
const STEPS: u64 = 30;
/// Held-out views per run: enough to see that evaluation works.
const HELD_OUT: usize = 2;

/// The dataset at `path` with its photographs decoded; `None` if the folder contains no posed photographs.
fn in_memory(path: &Path) -> Option<Dataset> {
    let options = DatasetOptions {
        max_side: Some(MAX_SIDE),
        ..DatasetOptions::default()
    };
    let mut dataset = read_dataset(path, &options).ok()?;
    dataset.test.truncate(HELD_OUT);
    for view in dataset.train.iter().chain(&dataset.test) {
        let view = &mut dataset.views[*view];
        view.photo = Arc::new(view.photo.load().expect("a photograph"));
    }
    Some(dataset)
}

/// Fewer samples and occupancy cells than a recipe's field has, so that the test takes less than two minutes.
fn smaller_field(recipe: &str) -> Vec<String> {
    let text = Recipe::built_in(recipe).expect("it is");
    let field = Recipe::parse(recipe, text, &[]).expect("it is valid").field;
    let Some(field) = field else { return Vec::new() };
    let side = matches!(field.sampler, Sampler::Occupancy(_)).then_some("field.sampler.side=32");
    let changes = [Some("field.samples=2048"), side];
    changes.into_iter().flatten().map(str::to_owned).collect()
}

#[test]
fn every_recipe_trains_on_every_scene() {
    let Some(shared) = irradia_testkit::shared("data") else {
        return;
    };
    let mut folders: Vec<_> = std::fs::read_dir(&shared)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    folders.sort();
    let weights = shared.join("lpips/lpips_squeeze.safetensors");
    let out = super::folder();
    let mut trained = Vec::new();
    for data in folders {
        let Some(dataset) = in_memory(&data) else { continue };
        let name = data.file_name().expect("a name").to_string_lossy().into_owned();
        for (recipe, _) in BUILT_IN {
            let what = format!("{recipe} on {name}");
            let mut input = TrainInput {
                recipe: (*recipe).to_owned(),
                lpips: Some(weights.clone()),
                ..super::input(out.path(), &what, STEPS)
            };
            input.set.extend(smaller_field(recipe));
            let started = std::time::Instant::now();
            let request = input.check().unwrap_or_else(|error| panic!("{what}: {error}"));
            let mut run = Run::begin_on(request, dataset.clone()).unwrap_or_else(|error| panic!("{what}: {error}"));
            run.train(&mut []).unwrap_or_else(|error| panic!("{what}: {error}"));
            let finished = run.finish().unwrap_or_else(|error| panic!("{what}: {error}"));
            let psnr = finished.report.psnr;
            eprintln!("{what}: {psnr:.2} dB, {:.2} s", started.elapsed().as_secs_f64());
            assert!(finished.complete && psnr.is_finite(), "{what}: {psnr}");
            Scene::read(finished.folder.path()).unwrap_or_else(|error| panic!("{what}: {error}"));
        }
        trained.push(name);
    }
    for name in [
        "can",
        "chair",
        "cup",
        "fern",
        "fox",
        "fox_colmap",
        "lund_door",
        "maryRose",
    ] {
        assert!(
            trained.iter().any(|done| done == name),
            "{name} is not among {trained:?}"
        );
    }
}
