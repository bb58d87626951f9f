//! Ways of training beside one another: what `irradia compare` measured, summed up.
//!
//! For every scene and recipe there is one run a seed. A figure over runs is a mean with the sample standard deviation
//! ([`Spread`]); runs that failed are left out of it and counted.

mod curves;
mod page;
mod table;

pub use curves::{Look, falls, reached, rises};
pub use page::{picture, to_html};
pub use table::{to_markdown, to_text};

use crate::report::{Machine, Report};
use serde::Serialize;

/// Everything a comparison came to; its figures that are not finite are written as `null`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Comparison {
    /// Version of the program.
    pub version: String,
    /// What was the same for all runs, in words, such as `150 steps`.
    pub conditions: Vec<String>,
    /// What computed, such as `CPU, 2 threads, avx512`.
    pub device: String,
    /// Where it ran.
    pub machine: Machine,
    /// The datasets.
    pub scenes: Vec<Scene>,
    /// The recipes' means over the scenes, in the order of [`Scene::entries`].
    pub overall: Vec<Overall>,
}

/// One dataset.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scene {
    /// What to call it.
    pub name: String,
    /// Where it lies, as the user said.
    pub data: String,
    /// The recipes, in the order of the command line.
    pub entries: Vec<Entry>,
    /// What the first recipe's whole runs end with, mean over seeds: the mark that [`Entry::to_mark`] is about.
    pub mark: Option<Mark>,
    /// A held-out view as the recipes show it.
    pub view: Option<PictureRow>,
}

/// What the first recipe of a scene ends with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Mark {
    /// Held-out PSNR, dB.
    pub psnr: f64,
    /// Seconds of training that it takes for that.
    pub seconds: f64,
}

/// A recipe on one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Entry {
    /// The recipe with its changes, as the user wrote it.
    pub recipe: String,
    /// One a seed.
    pub runs: Vec<Run>,
    /// Held-out PSNR, dB.
    pub psnr: Option<Spread>,
    /// Held-out SSIM.
    pub ssim: Option<Spread>,
    /// Held-out LPIPS, where there were weights.
    pub lpips: Option<Spread>,
    /// Wall-clock seconds of the training loop.
    pub seconds: Option<Spread>,
    /// Processor seconds of the training loop.
    pub cpu_seconds: Option<Spread>,
    /// Gaussians at the end; `None` for fields.
    pub splats: Option<Spread>,
    /// Numbers of the field; `None` for splats.
    pub parameters: Option<Spread>,
    /// Most memory the process held, bytes.
    pub peak_memory: Option<Spread>,
    /// Share of blocks of steps whose mean training loss is above that of the block before; see [`rises`].
    pub loss_rises: Option<Spread>,
    /// Likewise of the mean squared error of the training views, which is the same measure for all recipes and stages.
    pub error_rises: Option<Spread>,
    /// Share of evaluations whose held-out PSNR is below that of the one before; see [`falls`].
    pub psnr_falls: Option<Spread>,
    /// When each half dB was reached.
    pub reached: Vec<Reached>,
    /// When the scene's mark was.
    pub to_mark: Option<Reached>,
    /// Seconds to the mark over those of the first recipe's whole run; `None` unless every finished run got there.
    pub mark_share: Option<f64>,
}

/// One training.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Run {
    /// Its seed.
    pub seed: u64,
    /// Its folder, relative to the comparison's, with forward slashes.
    pub folder: String,
    /// Why there are no figures, one line.
    pub error: Option<String>,
    /// The figures.
    pub figures: Option<Figures>,
}

/// What a run came to.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figures {
    /// Steps made.
    pub steps: u64,
    /// Wall-clock seconds of the training loop.
    pub seconds: f64,
    /// Processor seconds of the training loop.
    pub cpu_seconds: f64,
    /// Wall-clock seconds of everything.
    pub total_seconds: f64,
    /// Gaussians at the end.
    pub splats: u64,
    /// Numbers of the field, where that is what was made.
    pub parameters: Option<u64>,
    /// Bytes.
    pub peak_memory: u64,
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// Perceptual distance.
    pub lpips: Option<f64>,
    /// Its network.
    pub lpips_net: Option<String>,
    /// Held-out PSNR as it grew, the final one included.
    pub looks: Vec<Look>,
    /// See [`rises`].
    pub loss_rises: Option<f64>,
    /// See [`rises`].
    pub error_rises: Option<f64>,
    /// See [`falls`].
    pub psnr_falls: Option<f64>,
}

/// A figure over several runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Arithmetic mean.
    pub mean: f64,
    /// Sample standard deviation (divided by n - 1); `None` for one run.
    pub deviation: Option<f64>,
    /// Runs.
    pub runs: usize,
}

/// When a PSNR was first reached; the means are over the runs that did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reached {
    /// dB.
    pub psnr: f64,
    /// Seconds of training.
    pub seconds: Option<Spread>,
    /// Steps.
    pub steps: Option<Spread>,
}

/// A recipe over all scenes on which every recipe has figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Overall {
    /// As [`Entry::recipe`].
    pub recipe: String,
    /// How many scenes that is.
    pub scenes: usize,
    /// Mean over the scenes of the means over seeds, dB.
    pub psnr: f64,
    /// Likewise.
    pub ssim: f64,
    /// Likewise, where there were weights.
    pub lpips: Option<f64>,
    /// Likewise.
    pub seconds: f64,
    /// Likewise; `None` where the recipe makes fields.
    pub splats: Option<f64>,
    /// Likewise, where it makes fields.
    pub parameters: Option<f64>,
    /// On how many of the scenes all runs reach what the first recipe ends with.
    pub marks: usize,
    /// And on how many in a third of the first recipe's time, or less.
    pub marks_in_a_third: usize,
}

/// One held-out view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PictureRow {
    /// Name within the dataset.
    pub name: String,
    /// The photograph, a `data:` address.
    pub truth: String,
    /// What each recipe's first run shows; `None` where there is none.
    pub renders: Vec<Option<Render>>,
}

/// A rendering of the held-out view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Render {
    /// Seed of the run.
    pub seed: u64,
    /// dB, of this view.
    pub psnr: f64,
    /// A `data:` address.
    pub picture: String,
}

impl Comparison {
    /// Heading of LPIPS with its network, or with all where the runs do not have one in common.
    pub fn lpips_head(&self) -> String {
        let entries = self.scenes.iter().flat_map(|scene| &scene.entries);
        let figures = entries
            .flat_map(|entry| &entry.runs)
            .filter_map(|run| run.figures.as_ref());
        let mut nets: Vec<&str> = figures.filter_map(|figures| figures.lpips_net.as_deref()).collect();
        nets.sort_unstable();
        nets.dedup();
        match nets[..] {
            [] => "LPIPS".to_owned(),
            _ => format!("LPIPS ({})", nets.join(", ")),
        }
    }
}

impl Spread {
    /// Of values that are finite; `None` where there are none.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let values: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
        let n = values.len() as f64;
        if values.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        Some(Self {
            mean,
            deviation: (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt()),
            runs: values.len(),
        })
    }
}

impl Figures {
    /// From a run's report and the mean squared errors of the training views that it logged, in order.
    pub fn of(report: &Report, errors: &[f64]) -> Self {
        let looks = curves::looks(report);
        Self {
            steps: report.steps,
            seconds: report.training_seconds,
            cpu_seconds: report.cpu_seconds,
            total_seconds: report.total_seconds,
            splats: report.splats,
            parameters: report.parameters,
            peak_memory: report.peak_rss_bytes,
            psnr: report.psnr,
            ssim: report.ssim,
            lpips: report.lpips,
            lpips_net: report.lpips_net.clone(),
            loss_rises: rises(&report.curve.iter().map(|point| point.loss).collect::<Vec<_>>()),
            error_rises: rises(errors),
            psnr_falls: falls(&looks),
            looks,
        }
    }
}

impl Scene {
    /// Sums up the runs of each recipe.
    pub fn new(name: String, data: String, runs: Vec<(String, Vec<Run>)>, view: Option<PictureRow>) -> Self {
        let figures = |runs: &[Run]| runs.iter().filter_map(|run| run.figures.clone()).collect::<Vec<_>>();
        let all: Vec<Vec<Look>> = runs
            .iter()
            .flat_map(|(_, runs)| figures(runs))
            .map(|f| f.looks)
            .collect();
        let levels = curves::levels(&all);
        let mark = runs.first().and_then(|(_, runs)| {
            let first = figures(runs);
            Some(Mark {
                psnr: Spread::of(first.iter().map(|f| f.psnr))?.mean,
                seconds: Spread::of(first.iter().map(|f| f.seconds))?.mean,
            })
        });
        let entries = runs
            .into_iter()
            .map(|(recipe, runs)| {
                let figures = figures(&runs);
                let spread = |of: &dyn Fn(&Figures) -> Option<f64>| Spread::of(figures.iter().filter_map(of));
                let times = |psnr: f64| {
                    let [seconds, steps] =
                        [|l: &Look| l.seconds, |l: &Look| l.step as f64].map(|axis: fn(&Look) -> f64| {
                            Spread::of(figures.iter().filter_map(|f| reached(&f.looks, psnr, axis)))
                        });
                    Reached { psnr, seconds, steps }
                };
                let to_mark = mark.map(|mark| times(mark.psnr));
                let mark_share = mark.zip(to_mark.as_ref()).and_then(|(mark, reached)| {
                    let all = reached.seconds.filter(|seconds| seconds.runs == figures.len())?;
                    Some(all.mean / mark.seconds)
                });
                Entry {
                    to_mark,
                    mark_share,
                    psnr: spread(&|f| Some(f.psnr)),
                    ssim: spread(&|f| Some(f.ssim)),
                    lpips: spread(&|f| f.lpips),
                    seconds: spread(&|f| Some(f.seconds)),
                    cpu_seconds: spread(&|f| Some(f.cpu_seconds)),
                    splats: spread(&|f| f.parameters.is_none().then_some(f.splats as f64)),
                    parameters: spread(&|f| f.parameters.map(|n| n as f64)),
                    peak_memory: spread(&|f| (f.peak_memory > 0).then_some(f.peak_memory as f64)),
                    loss_rises: spread(&|f| f.loss_rises),
                    error_rises: spread(&|f| f.error_rises),
                    psnr_falls: spread(&|f| f.psnr_falls),
                    reached: levels.iter().copied().map(times).collect(),
                    recipe,
                    runs,
                }
            })
            .collect();
        Self {
            name,
            data,
            entries,
            mark,
            view,
        }
    }
}

/// The recipes' means over the scenes on which all of them have figures; empty where there is no such scene.
pub fn overall(scenes: &[Scene]) -> Vec<Overall> {
    let whole: Vec<&Scene> = scenes
        .iter()
        .filter(|scene| scene.entries.iter().all(|entry| entry.psnr.is_some()))
        .collect();
    let Some(first) = whole.first() else { return Vec::new() };
    let recipes = first.entries.iter().map(|entry| entry.recipe.clone()).enumerate();
    recipes
        .map(|(i, recipe)| {
            let values = |of: &dyn Fn(&Entry) -> Option<Spread>| -> Vec<f64> {
                whole
                    .iter()
                    .filter_map(|scene| of(&scene.entries[i]).map(|s| s.mean))
                    .collect()
            };
            let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
            // Where every scene has one.
            let all = |values: Vec<f64>| (values.len() == whole.len()).then(|| mean(values));
            let shares = || whole.iter().filter_map(|scene| scene.entries[i].mark_share);
            Overall {
                marks: shares().count(),
                marks_in_a_third: shares().filter(|share| *share <= 1.0 / 3.0).count(),
                recipe,
                scenes: whole.len(),
                psnr: mean(values(&|e| e.psnr)),
                ssim: mean(values(&|e| e.ssim)),
                lpips: all(values(&|e| e.lpips)),
                seconds: mean(values(&|e| e.seconds)),
                splats: all(values(&|e| e.splats)),
                parameters: all(values(&|e| e.parameters)),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests;
