//! The results of a finished run: its scene, the held-out views, and the report.

use crate::evaluate::NOT_MEASURED;
use crate::folder::{FIELD, SCENE, to_json};
use crate::levels::write_scene;
use crate::request::has_perceptual_loss;
use crate::{Run, RunError, RunFolder, evaluate, file_stems, unmeasured};
use irradia_compute::Level;
use irradia_formats::{WriteOptions, write_png};
use irradia_measure::{Lpips, Networks};
use irradia_scene::{Image, sh};
use irradia_train::Trainer;
use irradia_train::eval::{EvalOptions, EvaluatedView, Metrics};
use irradia_train::field_file;
use irradia_train::model::Model;
use irradia_train::report::{
    Breakdown, Course, InsideLoop, OutsideLoop, Report, ViewReport, machine, peak_rss_bytes, schedule, to_html,
};
use irradia_train::socket::Vignette;
use rayon::prelude::*;
use std::path::Path;
use std::time::Instant;

const NOTHING_HELD_OUT: &str = "no view is held out";

impl Run {
    /// Writes the splats with the components trained beside them, or the field.
    pub(crate) fn write_scene(&self) -> Result<(), RunError> {
        let folder = &self.folder;
        match self.trainer.scene() {
            Model::Splats { splats, .. } => {
                let mut cloud = splats.to_cloud();
                cloud.antialiased = self.trainer.recipe.render.antialias;
                cloud.world_from_dataset = self.trainer.dataset.world_from_dataset;
                write_scene(&folder.file(SCENE), &cloud, &WriteOptions::default())?;
                for (name, bytes) in self.trainer.sockets.files() {
                    folder.write(&name, &bytes)?;
                }
                folder.write_cameras(&self.trainer)?;
                // Of an earlier stage of the recipe.
                folder.remove(FIELD)
            }
            Model::Field(field) => {
                folder.write(FIELD, &field_file::to_bytes(&field))?;
                folder.remove(SCENE)
            }
        }
    }

    /// Evaluates the held-out views, writes their images, and creates the report.
    ///
    /// `finishing` is when the run began to finish; `stop`, polled after each view, ends the evaluation.
    pub(crate) fn report(&self, finishing: Instant, stop: &dyn Fn() -> bool) -> Result<Report, RunError> {
        let (trainer, input, journal) = (&self.trainer, &self.request.input, &self.journal);
        let names = trainer.dataset.views.iter().map(|view| view.name.as_str());
        let stems = file_stems(names);
        let mut stems = trainer.dataset.test.iter().map(|i| &stems[*i]);
        let mut views = Vec::new();
        let networks = Networks {
            first: trainer.options.lpips.as_deref(),
            unseen: self.unseen_lpips.as_ref(),
        };
        let name_of = |lpips: Option<&Lpips>| lpips.map(|lpips| lpips.net().name().to_owned());
        let mean = evaluate(
            &trainer.scene(),
            &trainer.dataset,
            &trainer.dataset.test,
            &EvalOptions {
                render: trainer.render_options(sh::MAX_DEGREE),
                metrics: Metrics::All(networks),
                half_fit: trainer.half_fit(),
                vignette: trainer.sockets.vignette.as_ref(),
                device: &trainer.options.device,
            },
            |view| {
                let stem = stems.next().expect("one per view");
                views.push(write_view(&self.folder, stem, view)?);
                if stop() {
                    Err(RunError::EvaluationStopped)
                } else {
                    Ok(())
                }
            },
        )?;
        let mut warnings = journal.all_warnings();
        warnings.extend(unmeasured(
            views.iter().map(|view| (view.name.as_str(), !view.psnr.is_nan())),
        ));
        let is_explained = |line: &String| line.contains(NOTHING_HELD_OUT) || line.contains(NOT_MEASURED);
        if trainer.dataset.test.is_empty() && !warnings.iter().any(is_explained) {
            warnings.push(format!("{NOTHING_HELD_OUT}: nothing was evaluated"));
        }
        let beside = OutsideLoop {
            preparing: self.preparing.unwrap_or(0.0),
            finishing: finishing.elapsed().as_secs_f64(),
        };
        Ok(Report {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            device: device(trainer),
            dataset: input.data.display().to_string(),
            recipe: trainer.recipe.name.clone(),
            recipe_hash: trainer.recipe.hash(),
            recipe_toml: trainer.recipe.to_toml(),
            seed: trainer.options.seed,
            steps: trainer.clock.step,
            seconds: trainer.times.wall,
            training_seconds: trainer.seconds,
            breakdown: Breakdown {
                inside: InsideLoop::of(&trainer.times, trainer.seconds),
                beside,
            },
            cpu_seconds: trainer.cpu_seconds,
            // Of all processes of a resumed run, as the seconds are.
            total_seconds: beside.preparing + trainer.times.wall + beside.finishing,
            splats: trainer.engine.len() as u64,
            parameters: trainer.parameters().map(|n| n as u64),
            peak_rss_bytes: peak_rss_bytes(),
            background: self.background(),
            psnr: mean.psnr,
            ssim: mean.ssim,
            lpips: mean.lpips,
            lpips_net: name_of(networks.first),
            unseen_lpips: mean.unseen_lpips,
            unseen_lpips_net: name_of(networks.unseen),
            trained_on_lpips: name_of(networks.first).filter(|_| has_perceptual_loss(&trainer.recipe)),
            psnr_corrected: mean.psnr_corrected,
            half_fit_psnr: mean.half_fit_psnr,
            corner_brightness: trainer.sockets.vignette.as_ref().and_then(Vignette::corner_gain),
            views,
            schedule: schedule(&Course {
                recipe: &trainer.recipe,
                stages: &journal.stages,
                clock: &trainer.clock,
                skipped: trainer.skipped,
                steps: input.steps,
                timed: input.budget.is_some(),
            }),
            stages: journal.stages.clone(),
            curve: journal.curve.clone(),
            machine: machine(),
            warnings,
        })
    }

    /// Writes `report.json` and `report.html`.
    pub(crate) fn write_report(&self, report: &Report) -> Result<(), RunError> {
        let mut json = serde_json::to_value(report).expect("plain data");
        if let Some(fields) = json.as_object_mut().filter(|_| report.views.is_empty()) {
            // Without held-out views, missing values are omitted; with them, null means that there was no network.
            fields.retain(|_, value| !value.is_null());
        }
        self.folder.write("report.json", &to_json(&json))?;
        self.folder.write("report.html", to_html(report).as_bytes())
    }
}

/// Writes `image`, sRGB in \[0, 1\] with 1, 3 or 4 channels, as an 8-bit PNG, atomically.
///
/// # Errors
/// When the file cannot be written.
pub fn write_image(path: impl AsRef<Path>, image: &Image) -> Result<(), RunError> {
    let path = path.as_ref();
    Ok(write_png(
        path,
        image.width,
        image.height,
        image.channels,
        &image.to_u8(),
    )?)
}

/// The devices that trained and measured: the GPU, if one was requested, and the CPU.
fn device(trainer: &Trainer) -> String {
    let cpu = format!(
        "CPU, {} threads, {}",
        rayon::current_num_threads(),
        Level::detect().name()
    );
    let device = &trainer.options.device;
    if device.is_cpu() {
        cpu
    } else {
        format!("{device}; {cpu}")
    }
}

/// Writes truth, render and error of a held-out view under `eval/`.
fn write_view(folder: &RunFolder, stem: &str, view: &EvaluatedView) -> Result<ViewReport, RunError> {
    let error = error_image(view);
    let images = [("truth", &view.truth), ("render", &view.render), ("error", &error)];
    // Encoding takes longer than measuring.
    let written = images.par_iter().map(|(what, image)| {
        let path = format!("eval/{stem}.{what}.png");
        write_image(folder.file(&path), image)?;
        Ok(path)
    });
    let written: Result<Vec<String>, RunError> = written.collect();
    let [truth, render, error] = written?.try_into().expect("a path for each image");
    Ok(ViewReport {
        name: view.name.clone(),
        psnr: view.metrics.psnr,
        ssim: view.metrics.ssim,
        lpips: view.metrics.lpips,
        unseen_lpips: view.metrics.unseen_lpips,
        psnr_corrected: view.metrics.psnr_corrected,
        half_fit_psnr: view.metrics.half_fit_psnr,
        truth,
        render,
        error,
    })
}

/// Absolute difference, amplified four times so that a difference of a quarter is white; black where the mask excludes the
/// pixel.
fn error_image(view: &EvaluatedView) -> Image {
    let (truth, render) = (&view.truth, &view.render);
    let counts = |pixel: usize| view.mask.as_ref().is_none_or(|mask| mask[pixel] != 0);
    let error = |(i, (t, r)): (usize, (&f32, &f32))| if counts(i / 3) { 4.0 * (t - r).abs() } else { 0.0 };
    let data = truth.data.iter().zip(&render.data).enumerate().map(error).collect();
    Image::new(truth.width, truth.height, 3, data)
}
