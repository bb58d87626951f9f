//! The committed benchmark: `cargo run --release -p irradia --example speed -- DATA [steps]`.
//!
//! Trains with the `classic` recipe for the given steps (500) without density control, at full resolution, and prints the
//! CPU time a step with its parts; then rates of the blend's inner loop.

use anyhow::{Context, Result};
use cpu_time::ProcessTime;
use irradia_formats::{DatasetOptions, read_dataset};
use irradia_splat::{OutputGradient, RenderOptions, Renderer, SplatGradients, ViewParams};
use irradia_train::{Recipe, TrainOptions, Trainer};
use std::sync::Arc;
use std::time::Instant;

fn main() -> Result<()> {
    let mut args = std::env::args().skip(1);
    let data = args.next().context("give a dataset's folder")?;
    let steps: u64 = args.next().map_or(Ok(500), |s| s.parse())?;
    let dataset = Arc::new(read_dataset(data.as_ref(), &DatasetOptions::default())?);
    let recipe = Recipe::parse("classic", Recipe::built_in("classic")?, &["eval_every=1000000".into()])?;
    let mut fixed = recipe.clone();
    for stage in &mut fixed.stage {
        stage.density = None;
    }
    let mut trainer = Trainer::new(dataset.clone(), fixed, TrainOptions::default())?;
    let started = Instant::now();
    let mut mse = 0.0;
    for _ in 0..steps {
        mse = trainer.step(&mut Vec::new())?.mse;
    }
    println!(
        "{steps} steps, {} splats: {:.2} ms wall, {:.2} ms CPU a step ({:.1} s with loading), last training PSNR {:.2} dB",
        trainer.state.len(),
        1e3 * trainer.seconds / steps as f64,
        1e3 * trainer.cpu_seconds / steps as f64,
        started.elapsed().as_secs_f64(),
        -10.0 * mse.log10()
    );

    // The parts, over a few views, with what was trained.
    let mut renderer = Renderer::new();
    let options = RenderOptions {
        sh_degree: 0,
        ..RenderOptions::default()
    };
    let mut gradients = SplatGradients::default();
    let (mut forward, mut backward, mut pairs, mut entries) = (0.0, 0.0, 0, 0);
    let views = &dataset.train[..10.min(dataset.train.len())];
    for repeat in 0..4 {
        for view in views {
            let view = ViewParams::new(&dataset.views[*view].camera);
            let v_color = vec![1e-6; 3 * (view.width * view.height) as usize];
            let start = ProcessTime::now();
            renderer.render(&trainer.state.splats, &view, &options);
            let middle = ProcessTime::now();
            renderer.backward(
                &trainer.state.splats,
                &OutputGradient {
                    color: &v_color,
                    alpha: None,
                    depth: None,
                },
                &mut gradients,
            );
            if repeat > 0 {
                forward += middle.duration_since(start).as_secs_f64();
                backward += middle.elapsed().as_secs_f64();
                pairs += renderer.pairs();
                entries += renderer.tile_entries();
            }
        }
    }
    let n = 3.0 * views.len() as f64;
    println!(
        "forward {:.2} ms, backward {:.2} ms CPU a frame; {:.2} M pairs, {:.1} k tile entries; {:.2} G pairs/s forward, {:.2} backward, all included",
        1e3 * forward / n,
        1e3 * backward / n,
        pairs as f64 / n / 1e6,
        entries as f64 / n / 1e3,
        pairs as f64 / forward / 1e9,
        pairs as f64 / backward / 1e9
    );
    Ok(())
}
