//! Comparisons of recipes: a summary of the runs of `irradia compare`.
//!
//! For every scene and recipe there is one run per seed. A figure over runs is a mean with the sample standard deviation
//! ([`Spread`]); failed runs are excluded from it and counted.

mod curves;
mod page;
mod published;
mod table;

pub use curves::{EvaluationPoint, fall_fraction, position_at_psnr, rise_fraction};
pub use page::{picture, to_html};
pub use published::{Published, PublishedFigures, published};
pub use table::{to_markdown, to_text};

use crate::report::{Machine, Report};
use serde::Serialize;
use std::collections::BTreeSet;

/// The results of a comparison; figures that are not finite are written as `null`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Comparison {
    /// Version of the program.
    pub version: String,
    /// The conditions common to all runs, in words, such as `150 steps`.
    pub conditions: Vec<String>,
    /// The device, such as `CPU, 2 threads, avx512`.
    pub device: String,
    /// The machine.
    pub machine: Machine,
    /// The datasets.
    pub scenes: Vec<Scene>,
    /// The recipes' means over scenes, in the order of [`Scene::entries`].
    pub overall: Vec<Overall>,
    /// Published figures of the scenes, if the comparison follows their protocol.
    pub published: Vec<Published>,
    /// Limitations of the figures, one line each.
    pub notes: Vec<String>,
}

/// One dataset.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scene {
    /// Display name.
    pub name: String,
    /// Its path, as the user gave it.
    pub data: String,
    /// The recipes, in the order of the command line.
    pub entries: Vec<Entry>,
    /// The final result of the first recipe, mean over seeds of its finished runs: the target of [`Entry::to_mark`].
    pub mark: Option<Mark>,
    /// A held-out view, rendered by each recipe.
    pub view: Option<PictureRow>,
}

/// The final result of a scene's first recipe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Mark {
    /// Held-out PSNR, dB.
    pub psnr: f64,
    /// Seconds of training to reach it.
    pub seconds: f64,
}

/// A recipe on one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Entry {
    /// The recipe with its overrides, as the user wrote it.
    pub recipe: String,
    /// One per seed.
    pub runs: Vec<Run>,
    /// Held-out PSNR, dB.
    pub psnr: Option<Spread>,
    /// Held-out SSIM.
    pub ssim: Option<Spread>,
    /// Held-out LPIPS, if network weights are available.
    pub lpips: Option<Spread>,
    /// Held-out LPIPS of a network that training does not see, if its weights are available.
    pub unseen_lpips: Option<Spread>,
    /// Wall-clock seconds of the training loop.
    pub seconds: Option<Spread>,
    /// CPU seconds of the training loop.
    pub cpu_seconds: Option<Spread>,
    /// Gaussians at the end; `None` for fields.
    pub splats: Option<Spread>,
    /// Number of parameters of the field; `None` for splats.
    pub parameters: Option<Spread>,
    /// Peak memory of the process, bytes.
    pub peak_memory: Option<Spread>,
    /// Fraction of blocks of steps whose mean training loss is above that of the previous block; see [`rise_fraction`].
    pub loss_rises: Option<Spread>,
    /// The same for the mean squared error of the training views, which is comparable between recipes and stages.
    pub error_rises: Option<Spread>,
    /// Fraction of evaluations whose held-out PSNR is below the previous one; see [`fall_fraction`].
    pub psnr_falls: Option<Spread>,
    /// When each half dB was reached.
    pub reached: Vec<Milestone>,
    /// When the scene's mark was reached.
    pub to_mark: Option<Milestone>,
    /// Seconds to the mark divided by those of the first recipe's whole run; `None` unless every finished run reached it.
    pub mark_share: Option<f64>,
}

/// One training run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Run {
    /// Random seed.
    pub seed: u64,
    /// Its folder, relative to the comparison's, with forward slashes.
    pub folder: String,
    /// Why it has no figures, one line.
    pub error: Option<String>,
    /// The figures.
    pub figures: Option<Figures>,
}

/// The results of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figures {
    /// Steps completed.
    pub steps: u64,
    /// Wall-clock seconds of the training loop.
    pub seconds: f64,
    /// CPU seconds of the training loop.
    pub cpu_seconds: f64,
    /// Wall-clock seconds in total.
    pub total_seconds: f64,
    /// Gaussians at the end.
    pub splats: u64,
    /// Number of parameters of the field, if the result is one.
    pub parameters: Option<u64>,
    /// Peak memory, bytes.
    pub peak_memory: u64,
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// Perceptual distance.
    pub lpips: Option<f64>,
    /// Network of LPIPS.
    pub lpips_net: Option<String>,
    /// Perceptual distance by a network that training does not see.
    pub unseen_lpips: Option<f64>,
    /// That network.
    pub unseen_lpips_net: Option<String>,
    /// The network whose LPIPS was part of the training loss.
    pub trained_on_lpips: Option<String>,
    /// Evaluations of held-out PSNR, including the final one.
    #[serde(rename = "looks")]
    pub evaluations: Vec<EvaluationPoint>,
    /// See [`rise_fraction`].
    pub loss_rises: Option<f64>,
    /// See [`rise_fraction`].
    pub error_rises: Option<f64>,
    /// See [`fall_fraction`].
    pub psnr_falls: Option<f64>,
}

/// A figure over several runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Arithmetic mean.
    pub mean: f64,
    /// Sample standard deviation (divided by n - 1); `None` for one run.
    pub deviation: Option<f64>,
    /// Number of runs.
    pub runs: usize,
}

/// When a PSNR was first reached; means over the runs that reached it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Milestone {
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
    /// Number of those scenes.
    pub scenes: usize,
    /// Mean over scenes of the means over seeds, dB.
    pub psnr: f64,
    /// Mean over scenes of the means over seeds.
    pub ssim: f64,
    /// Likewise, if network weights are available.
    pub lpips: Option<f64>,
    /// Likewise, by a network that training does not see.
    pub unseen_lpips: Option<f64>,
    /// Likewise.
    pub seconds: f64,
    /// Likewise; `None` if the recipe trains fields.
    pub splats: Option<f64>,
    /// Likewise, if it trains fields.
    pub parameters: Option<f64>,
    /// Number of scenes on which all runs reach the final result of the first recipe.
    pub marks: usize,
    /// Number of those on which they do so in at most a third of the first recipe's time.
    pub marks_in_a_third: usize,
}

/// One held-out view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PictureRow {
    /// Name within the dataset.
    pub name: String,
    /// The photograph, a `data:` URL.
    pub truth: String,
    /// The rendering of each recipe's first run; `None` if there is none.
    pub renders: Vec<Option<Render>>,
}

/// A rendering of the held-out view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Render {
    /// Random seed of the run.
    pub seed: u64,
    /// PSNR of this view, dB.
    pub psnr: f64,
    /// A `data:` URL.
    pub picture: String,
}

impl Comparison {
    /// Heading of LPIPS with its network, or with all networks if the runs differ.
    pub fn lpips_heading(&self) -> String {
        self.heading_for(|figures| figures.lpips_net.as_deref())
            .unwrap_or("LPIPS".to_owned())
    }

    /// Heading of the LPIPS of a network that training does not see; `None` if no run has one.
    pub fn unseen_lpips_heading(&self) -> Option<String> {
        self.heading_for(|figures| figures.unseen_lpips_net.as_deref())
    }

    fn heading_for<'a>(&'a self, net: impl Fn(&'a Figures) -> Option<&'a str>) -> Option<String> {
        let mut nets: Vec<&str> = all_figures(&self.scenes)
            .filter_map(|(_, figures)| net(figures))
            .collect();
        nets.sort_unstable();
        nets.dedup();
        (!nets.is_empty()).then(|| format!("LPIPS ({})", nets.join(", ")))
    }
}

/// A note for each recipe that was trained on the perceptual distance by which it is scored.
pub fn lpips_bias_notes(scenes: &[Scene]) -> Vec<String> {
    let line = |(recipe, figures): (&str, &Figures)| {
        let net = figures.trained_on_lpips.as_deref()?;
        let other = figures.unseen_lpips_net.as_ref();
        let other = other.map(|other| format!("; LPIPS ({other}) is not part of its loss"));
        Some(format!(
            "{recipe} was trained on LPIPS ({net}), which flatters that figure{}",
            other.unwrap_or_default()
        ))
    };
    let lines: BTreeSet<String> = all_figures(scenes).filter_map(line).collect();
    lines.into_iter().collect()
}

/// The recipe and the figures of every finished run.
fn all_figures(scenes: &[Scene]) -> impl Iterator<Item = (&str, &Figures)> {
    scenes.iter().flat_map(|scene| &scene.entries).flat_map(|entry| {
        let figures = entry.runs.iter().filter_map(|run| run.figures.as_ref());
        figures.map(|figures| (entry.recipe.as_str(), figures))
    })
}

impl Spread {
    /// Spread of the finite values; `None` if there are none.
    pub fn from_values(values: impl IntoIterator<Item = f64>) -> Option<Self> {
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
    /// LPIPS of the network `net`, if measured.
    fn lpips_of(&self, net: &str) -> Option<f64> {
        let measured = [
            (&self.lpips_net, self.lpips),
            (&self.unseen_lpips_net, self.unseen_lpips),
        ];
        let found = measured.into_iter().find(|(name, _)| name.as_deref() == Some(net));
        found.and_then(|(_, lpips)| lpips)
    }

    /// From a run's report and the logged mean squared errors of the training views, in order.
    pub fn of(report: &Report, errors: &[f64]) -> Self {
        let evaluations = curves::evaluations(report);
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
            unseen_lpips: report.unseen_lpips,
            unseen_lpips_net: report.unseen_lpips_net.clone(),
            trained_on_lpips: report.trained_on_lpips.clone(),
            loss_rises: rise_fraction(&report.curve.iter().map(|point| point.loss).collect::<Vec<_>>()),
            error_rises: rise_fraction(errors),
            psnr_falls: fall_fraction(&evaluations),
            evaluations,
        }
    }
}

impl Scene {
    /// Summarises the runs of each recipe.
    pub fn new(name: String, data: String, runs: Vec<(String, Vec<Run>)>, view: Option<PictureRow>) -> Self {
        let figures = |runs: &[Run]| runs.iter().filter_map(|run| run.figures.clone()).collect::<Vec<_>>();
        let all: Vec<Vec<EvaluationPoint>> = runs
            .iter()
            .flat_map(|(_, runs)| figures(runs))
            .map(|f| f.evaluations)
            .collect();
        let levels = curves::levels(&all);
        let mark = runs.first().and_then(|(_, runs)| {
            let first = figures(runs);
            Some(Mark {
                psnr: Spread::from_values(first.iter().map(|f| f.psnr))?.mean,
                seconds: Spread::from_values(first.iter().map(|f| f.seconds))?.mean,
            })
        });
        let entries = runs
            .into_iter()
            .map(|(recipe, runs)| {
                let figures = figures(&runs);
                let spread = |of: &dyn Fn(&Figures) -> Option<f64>| Spread::from_values(figures.iter().filter_map(of));
                let times = |psnr: f64| {
                    let at = |axis: fn(&EvaluationPoint) -> f64| {
                        Spread::from_values(
                            figures
                                .iter()
                                .filter_map(|f| position_at_psnr(&f.evaluations, psnr, axis)),
                        )
                    };
                    Milestone {
                        psnr,
                        seconds: at(|point| point.seconds),
                        steps: at(|point| point.step as f64),
                    }
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
                    unseen_lpips: spread(&|f| f.unseen_lpips),
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

/// The recipes' means over the scenes on which all of them have figures; empty if there is no such scene.
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
            // If every scene has one.
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
                unseen_lpips: all(values(&|e| e.unseen_lpips)),
                seconds: mean(values(&|e| e.seconds)),
                splats: all(values(&|e| e.splats)),
                parameters: all(values(&|e| e.parameters)),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests;
