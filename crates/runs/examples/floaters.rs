//! Plants 500 floaters of five kinds in the scene of a run, to measure what the search for floaters finds and what it costs:
//!
//! ```text
//! cargo run --release -p irradia-runs --example floaters -- RUN..
//! ```
//!
//! Prints a row for each run: splats; held-out PSNR as trained; share of splats found as floaters, and PSNR without them; PSNR with the
//! planted floaters; how many of each kind are found, and the share of the scene's own splats that are lost; PSNR without what was found.
//! The last column is for a search without photographs.

use glam::{Quat, Vec2, Vec3};
use irradia_edit::{Draft, FloaterScores, floater_scores};
use irradia_formats::{read_splats, write_splats};
use irradia_runs::{Editing, SCENE, Scene, TrainInput, evaluate};
use irradia_scene::{Camera, Dataset, GaussianCloud, Rng, sh};
use irradia_splat::init::focus_point;
use irradia_splat::{Splats, logit};
use irradia_train::eval::EvalOptions;
use irradia_train::model::Model;
use std::error::Error;
use std::path::{Path, PathBuf};

/// Number of floaters of each kind: isolated, needle, huge, unseen, in front.
const FLOATERS_PER_KIND: usize = 100;
const SEED: u64 = 7;
/// The files that belong to a scene in its run.
const RUN_FILES: [&str; 4] = ["run.json", "recipe.toml", "cameras.json", "world.json"];

fn main() -> Result<(), Box<dyn Error>> {
    println!(
        "| run | splats | dB | found | then | planted | isolated, needle, huge, unseen, in front | lost | then | no photographs: then |"
    );
    println!("|---|---:|---:|---:|---:|---:|---|---:|---:|---:|");
    for run in std::env::args().skip(1).map(PathBuf::from) {
        println!("{}", row(&run)?);
    }
    Ok(())
}

fn row(run: &Path) -> Result<String, Box<dyn Error>> {
    let input = TrainInput::of_run(run)?;
    let dataset = input.reading.read(&input.data)?;
    let scene = Scene::read(run)?;
    let dataset = scene.place(dataset);
    let trained = Editing::open(run)?;
    let n = trained.draft().len();
    let found = floater_scores(trained.draft());
    let psnr = |cloud: &GaussianCloud| held_out_psnr(cloud, &scene, &dataset);
    let (before, clean) = (
        psnr(&trained.draft().cloud)?,
        psnr(&without_floaters(trained.draft(), &found))?,
    );

    let mut cloud = read_splats(&run.join(SCENE))?;
    plant(&mut cloud, &trained.draft().cameras, SEED);
    let folder = tempfile::tempdir()?;
    for name in RUN_FILES {
        let _ = std::fs::copy(run.join(name), folder.path().join(name));
    }
    write_splats(&folder.path().join(SCENE), &cloud)?;
    let planted = Editing::open(folder.path())?;
    let scores = floater_scores(planted.draft());
    let count = |scores: &[FloaterScores]| scores.iter().filter(|score| score.score() >= 1.0).count();
    let kinds: Vec<String> = scores[n..]
        .chunks(FLOATERS_PER_KIND)
        .map(|kind| count(kind).to_string())
        .collect();
    let mut without_photographs = planted.draft().clone();
    without_photographs.photographs = None;
    let blind_scores = floater_scores(&without_photographs);
    let percent = |found: usize| 100.0 * found as f64 / n as f64;
    Ok(format!(
        "| {} | {n} | {before:.2} | {:.2} % | {clean:.2} | {:.2} | {} | {:.2} % | {:.2} | {} of 500, {:.2} %: {:.2} |",
        run.file_name().unwrap_or_default().display(),
        percent(count(&found)),
        psnr(&cloud)?,
        kinds.join(", "),
        percent(count(&scores[..n])),
        psnr(&without_floaters(planted.draft(), &scores))?,
        count(&blind_scores[n..]),
        percent(count(&blind_scores[..n])),
        psnr(&without_floaters(&without_photographs, &blind_scores))?,
    ))
}

/// The splats that are not floaters.
fn without_floaters(draft: &Draft, scores: &[FloaterScores]) -> GaussianCloud {
    let mut draft = draft.clone();
    for (i, score) in scores.iter().enumerate() {
        draft.hidden.set(i, score.score() >= 1.0);
    }
    draft.visible_cloud().into_owned()
}

fn held_out_psnr(cloud: &GaussianCloud, scene: &Scene, dataset: &Dataset) -> Result<f64, Box<dyn Error>> {
    let options = EvalOptions::psnr(scene.options, None, &irradia_compute::Device::Cpu);
    let model = Model::of_splats(Splats::from_cloud(cloud));
    let mean = evaluate(&model, dataset, &dataset.test, &options, |_| {
        Ok::<(), irradia_runs::RunError>(())
    })?;
    Ok(mean.psnr)
}

/// Adds [`FLOATERS_PER_KIND`] floaters of each kind: isolated balls between camera and subject; needles; splats larger than the distance of
/// the cameras; balls outside the scene; balls close to a camera.
fn plant(cloud: &mut GaussianCloud, cameras: &[Camera], seed: u64) {
    let mut rng = Rng::new(seed, 0);
    let focus = focus_point(cameras);
    let distances = cameras.iter().map(|camera| camera.pose.position.distance(focus));
    let distance = distances.sum::<f32>() / cameras.len() as f32;
    let surfaces = cloud.means.clone();
    let width = 3 * cloud.sh_coefficients();
    for kind in 0..5 {
        for _ in 0..FLOATERS_PER_KIND {
            let mut opacity = rng.range(0.3, 0.95);
            let (mean, sizes) = loop {
                let camera = &cameras[rng.below(cameras.len() as u32) as usize];
                let k = camera.intrinsics;
                let mut inside = |side: u32| rng.range(0.1, 0.9) * side as f32;
                let pixel = Vec2::new(inside(k.width), inside(k.height));
                let ray = camera.ray(pixel).1 * distance;
                let mut from_eye = |from: f32, to: f32| camera.pose.position + ray * rng.range(from, to);
                let (mean, sizes) = match kind {
                    0 => (from_eye(0.3, 0.6), [rng.range(0.003, 0.01); 3]),
                    1 => (from_eye(0.3, 0.9), [rng.range(0.1, 0.3), 0.002, 0.002]),
                    2 => {
                        opacity = rng.range(0.02, 0.3);
                        let mean = focus + direction(&mut rng) * distance * rng.uniform();
                        (mean, [rng.range(0.7, 2.0), rng.range(0.5, 1.5), 0.5])
                    }
                    3 => {
                        let mean = focus + direction(&mut rng) * distance * rng.range(1.5, 4.0);
                        (mean, [rng.range(0.005, 0.03); 3])
                    }
                    _ => (from_eye(0.03, 0.15), [rng.range(0.002, 0.01); 3]),
                };
                let sizes = sizes.map(|size| size * distance);
                // In empty space, not in a surface.
                let clear = |surface: &[f32; 3]| mean.distance(Vec3::from(*surface)) > 5.0 * sizes[0];
                if kind != 0 || surfaces.iter().all(clear) {
                    break (mean, sizes);
                }
            };
            let turn = Quat::from_xyzw(rng.normal(), rng.normal(), rng.normal(), rng.normal()).normalize();
            cloud.means.push(mean.to_array());
            cloud.quats.push([turn.w, turn.x, turn.y, turn.z]);
            cloud.log_scales.push(sizes.map(f32::ln));
            cloud.opacity_logits.push(logit(opacity));
            let mut row = vec![0.0; width];
            row[..3].fill_with(|| sh::dc_from_color(rng.uniform()));
            cloud.sh.extend(row);
        }
    }
}

fn direction(rng: &mut Rng) -> Vec3 {
    Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize()
}
