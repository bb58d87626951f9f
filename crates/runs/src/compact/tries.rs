//! Tries: scenes with a given number of splats, trained for the format and measured.

use super::{CompactEvent, CompactInput};
use crate::convert::in_world;
use crate::{Background, RunError, Scene, evaluate};
use irradia_compute::Device;
use irradia_formats::{SogDetail, SplatFormat, WriteOptions, round_trip};
use irradia_scene::{Camera, Dataset, GaussianCloud, Similarity};
use irradia_splat::contribution::{Contributions, contributions};
use irradia_splat::{SplatState, Splats};
use irradia_train::eval::EvalOptions;
use irradia_train::memory::default_limit;
use irradia_train::model::{Model, RenderOptions};
use irradia_train::recipe::Param;
use irradia_train::socket::Vignette;
use irradia_train::{Recipe, TrainOptions, Trainer};
use std::sync::Arc;

/// The recipe for training the splats further.
const RECIPE: &str = include_str!("recipe.toml");
/// Number of rounds in which splats are removed.
const REMOVAL_ROUNDS: u32 = 6;
/// Maximum number of training views on which PSNR is measured.
const MAX_MEASURED_VIEWS: usize = 32;
/// Maximum number of views from which contributions are computed.
const MAX_CONTRIBUTION_VIEWS: usize = 160;

/// How finely the file represents a scene.
#[derive(Clone, Copy)]
struct Quality {
    /// Share of the splats that keep their harmonics: those where harmonics are most visible.
    harmonics_share: f64,
    /// Entries of the palette of harmonics per splat.
    palette: f64,
    /// Quantisation of SOG; its number of palette entries is replaced according to `palette`.
    detail: SogDetail,
}

/// The fewest bytes per splat: quantisation that is invisible after training for it. With only half of the harmonics kept, fox_colmap
/// loses 0.1 dB for 3 % of the bytes, more than removing splats would cost; on lund_door with 34,000 splats a palette of 0.1 takes 713 kB
/// instead of 612 and gains 0.02 dB.
const COARSE_QUALITY: Quality = Quality {
    harmonics_share: 0.8,
    palette: 0.03,
    detail: SogDetail {
        palette: 0,
        position_bits: 14,
        rotation_bits: 7,
        codebook: 128,
    },
};
/// If all splats fit with bytes to spare, the finest of these that fits is used. At a target of a tenth of the bytes of fox_colmap and
/// lund_door, [`COARSE_QUALITY`] (6.3 and 6.1 % of the bytes) loses 0.15 and 0.21 dB of held-out PSNR.
const FINER_QUALITIES: [Quality; 2] = [
    Quality {
        harmonics_share: 1.0,
        palette: 0.1,
        detail: FINEST_DETAIL,
    },
    Quality {
        harmonics_share: 1.0,
        palette: 0.03,
        detail: FINEST_DETAIL,
    },
];
const FINEST_DETAIL: SogDetail = SogDetail {
    palette: 0,
    position_bits: 16,
    rotation_bits: 8,
    codebook: 256,
};
/// All splats fit with bytes to spare if they take at most this share of the target before their training.
const MAX_TARGET_SHARE: f64 = 0.97;
/// Maximum number of tries to meet a target in bytes: if the first three miss it, harmonics or rounding cost more than the linear model of
/// bytes by splats predicts.
const MAX_SIZE_TRIES: u32 = 6;
/// Maximum number of tries in the search for the smallest scene.
const MAX_SEARCH_TRIES: u32 = 6;
/// The search ends when its bounds differ by less than this factor.
const SEARCH_TOLERANCE: f64 = 1.1;

/// Measures the PSNR of splats against the photographs.
pub(super) struct Measure {
    dataset: Dataset,
    options: RenderOptions,
    vignette: Option<Vignette>,
}

impl Measure {
    /// Measures against the photographs of `dataset`, whose lenses have this vignette.
    pub fn new(dataset: &Dataset, options: RenderOptions, vignette: Option<Vignette>) -> Self {
        Self {
            dataset: dataset.clone(),
            options,
            vignette,
        }
    }

    /// The vignette of the lenses.
    pub fn vignette(&self) -> Option<&Vignette> {
        self.vignette.as_ref()
    }

    /// Mean PSNR over evenly spaced training views, dB.
    pub fn train_psnr(&self, model: &Model) -> Result<f64, RunError> {
        let train = &self.dataset.train;
        let step = train.len().div_ceil(MAX_MEASURED_VIEWS).max(1);
        self.mean_psnr(model, &train.iter().copied().step_by(step).collect::<Vec<_>>())
    }

    /// Mean PSNR over held-out views, dB; `None` if there are none.
    pub fn held_out_psnr(&self, model: &Model) -> Result<Option<f64>, RunError> {
        let psnr = self.mean_psnr(model, &self.dataset.test)?;
        Ok(Some(psnr).filter(|psnr| !psnr.is_nan()))
    }

    fn mean_psnr(&self, model: &Model, views: &[usize]) -> Result<f64, RunError> {
        let options = EvalOptions::psnr(self.options, self.vignette.as_ref(), &Device::Cpu);
        Ok(evaluate::<RunError>(model, &self.dataset, views, &options, |_| Ok(()))?.psnr)
    }
}

/// A scene as decoded from its file.
pub(super) struct DecodedScene {
    pub splats: Splats,
    pub bytes: u64,
    pub psnr: f64,
    pub write: WriteOptions,
}

impl DecodedScene {
    /// Number of splats with harmonics above degree 0.
    pub fn count_with_harmonics(&self) -> usize {
        let sh = &self.splats.sh;
        let shows = |i: &usize| (3..sh.count()).any(|c| sh.get(c, *i) != 0.0);
        (0..self.splats.len()).filter(shows).count()
    }
}

/// The parameters that all tries share.
pub(super) struct Tries<'a> {
    input: &'a CompactInput,
    format: SplatFormat,
    measure: &'a Measure,
    dataset: Arc<Dataset>,
    recipe: Recipe,
    options: RenderOptions,
    world_from_dataset: Similarity,
    /// The splats with which the next try begins: those of the smallest scene so far that was good enough.
    initial: Splats,
    quality: Quality,
}

impl<'a> Tries<'a> {
    /// Tries that begin with `splats`, those of `scene`, and train on `dataset`.
    pub fn new(
        input: &'a CompactInput,
        format: SplatFormat,
        scene: &Scene,
        splats: Splats,
        dataset: Dataset,
        measure: &'a Measure,
    ) -> Result<Self, RunError> {
        let mut recipe = Recipe::parse("compact", RECIPE, &[])?;
        recipe.render.background = scene.options.background;
        if scene.options.background != Background::Grey.color() {
            recipe.unset(Param::CoverWeight);
        }
        recipe.render.antialias = scene.options.antialias;
        Ok(Self {
            input,
            format,
            measure,
            dataset: Arc::new(dataset),
            recipe,
            options: scene.options,
            world_from_dataset: scene.world_from_dataset,
            initial: splats,
            quality: COARSE_QUALITY,
        })
    }

    /// Makes the next try begin with all splats of `scene`, like the first one.
    pub fn reset(&mut self, scene: &Scene) {
        if let Some(splats) = scene.model.splats() {
            self.initial = splats.clone();
        }
        self.quality = COARSE_QUALITY;
    }

    /// `splats` for writing.
    pub fn cloud(&self, splats: &Splats) -> GaussianCloud {
        GaussianCloud {
            antialiased: self.options.antialias,
            world_from_dataset: self.world_from_dataset,
            ..splats.to_cloud()
        }
    }

    /// The options for writing `count` splats.
    fn write_options(&self, count: usize) -> WriteOptions {
        let detail = SogDetail {
            palette: ((count as f64 * self.quality.palette) as usize).clamp(64, 65_536),
            ..self.quality.detail
        };
        WriteOptions {
            sog: self.input.write.sog.or(Some(detail)),
            ..self.input.write
        }
    }

    /// Encodes and decodes `splats`; returns the decoded splats and the size of the file in bytes.
    fn round_trip(&self, splats: &Splats) -> Result<(Splats, u64), RunError> {
        let options = self.write_options(splats.len());
        let (cloud, bytes) = round_trip(self.format, &self.cloud(splats), &options)?;
        let cloud = in_world(cloud, &self.world_from_dataset);
        Ok((Splats::from_cloud(&cloud), bytes as u64))
    }

    fn measure_contributions(&self, splats: &Splats, seed: u64) -> Contributions {
        let train = &self.dataset.train;
        let step = train.len().div_ceil(MAX_CONTRIBUTION_VIEWS).max(1);
        let views = train.iter().step_by(step);
        let cameras: Vec<Camera> = views.map(|i| self.dataset.views[*i].camera).collect();
        contributions(splats, &cameras, &self.options, seed)
    }

    /// A scene of `count` splats, trained.
    pub fn train(&self, count: usize, on_event: &mut dyn FnMut(CompactEvent)) -> Result<DecodedScene, RunError> {
        let options = TrainOptions {
            seed: self.input.seed,
            steps: Some(self.input.steps),
            memory: default_limit(),
            ..TrainOptions::default()
        };
        let first = self.initial.len();
        let mut trainer =
            Trainer::from_splats(self.dataset.clone(), self.recipe.clone(), options, self.initial.clone())?;
        trainer.sockets.vignette.clone_from(&self.measure.vignette);
        let (mut rounds, mut stage, mut events) = (0, 0, Vec::new());
        while !trainer.finished() {
            let elapsed_share = trainer.clock.time / self.recipe.stage[0].steps as f64;
            if rounds < REMOVAL_ROUNDS
                && elapsed_share >= f64::from(rounds) / f64::from(REMOVAL_ROUNDS)
                && count < first
            {
                rounds += 1;
                // The number decreases by the same factor in each round.
                let share = (count as f64 / first as f64).powf(f64::from(rounds) / f64::from(REMOVAL_ROUNDS));
                let max_splats = ((first as f64 * share).round() as usize).max(count);
                let change = self
                    .measure_contributions(&trainer.engine.state().splats, self.input.seed + u64::from(rounds))
                    .change;
                keep_highest(trainer.engine.state_mut(), &change, max_splats);
            }
            if trainer.clock.stage > stage {
                if stage == 0 {
                    let weight = self
                        .measure_contributions(&trainer.engine.state().splats, self.input.seed)
                        .weight;
                    drop_harmonics(
                        &mut trainer.engine.state_mut().splats,
                        &weight,
                        self.quality.harmonics_share,
                    );
                }
                stage = trainer.clock.stage;
                let decoded = self.round_trip(&trainer.engine.state().splats)?.0;
                *trainer.engine.state_mut() = SplatState::new(decoded);
            }
            let report = trainer.step(&mut events)?;
            events.clear();
            on_event(CompactEvent::Step {
                steps: [report.step, trainer.total_steps()],
                splats: [trainer.engine.len(), count],
            });
        }
        let (splats, bytes) = self.round_trip(&trainer.engine.state().splats)?;
        let found = DecodedScene {
            bytes,
            psnr: self.measure.train_psnr(&Model::of_splats(&splats))?,
            write: self.write_options(splats.len()),
            splats,
        };
        on_event(CompactEvent::Tried {
            splats: found.splats.len(),
            bytes,
            psnr: found.psnr,
        });
        Ok(found)
    }

    /// A scene of as many splats as fit into `max_bytes` bytes, trained.
    ///
    /// # Errors
    /// When not even a few splats fit.
    pub fn fit_bytes(
        &mut self,
        max_bytes: u64,
        on_event: &mut dyn FnMut(CompactEvent),
    ) -> Result<DecodedScene, RunError> {
        let first = self.initial.len();
        let mut order = SplatState::new(self.initial.clone());
        let measured = self.measure_contributions(&order.splats, self.input.seed);
        drop_harmonics(&mut order.splats, &measured.weight, self.quality.harmonics_share);
        // Bytes are nearly linear in the number of splats: a line through two points predicts the number at the limit.
        let bytes_with = |tries: &Self, count: usize| -> Result<f64, RunError> {
            let mut state = order.clone();
            keep_highest(&mut state, &measured.change, count);
            Ok(tries.round_trip(&state.splats)?.1 as f64)
        };
        let half_count = (first / 2).max(1);
        let (all, half) = (bytes_with(self, first)?, bytes_with(self, half_count)?);
        if all <= max_bytes as f64 {
            for quality in FINER_QUALITIES {
                self.quality = quality;
                if self.round_trip(&self.initial)?.1 as f64 <= MAX_TARGET_SHARE * max_bytes as f64 {
                    let found = self.train(first, on_event)?;
                    if found.bytes <= max_bytes {
                        return Ok(found);
                    }
                }
            }
            self.quality = COARSE_QUALITY;
        }
        let slope = ((all - half) / (first - half_count).max(1) as f64).max(1.0);
        let mut count = first;
        if all > max_bytes as f64 {
            count = (first as f64 - (all - max_bytes as f64) / slope) as usize;
            let near = bytes_with(self, count.clamp(1, first))?;
            count = (count as f64 + (max_bytes as f64 - near) / slope).max(0.0) as usize;
        }
        for miss in 0..MAX_SIZE_TRIES {
            if count == 0 {
                break;
            }
            let found = self.train(count.min(first), on_event)?;
            if found.bytes <= max_bytes {
                return Ok(found);
            }
            // The remaining splats are trained further, minus a few, and minus more after each miss; the part of a file that does not
            // depend on the number of splats stays.
            let excess = 1.1 * f64::from(1 << miss) * (found.bytes - max_bytes) as f64 / slope;
            let had = found.splats.len() as f64;
            count = (had - excess.max(1.0)).max(0.5 * had) as usize;
            self.initial = found.splats;
        }
        Err(RunError::setting(
            "target",
            format!("{max_bytes} bytes"),
            format!("the scene cannot be made this small as {}", self.format),
        ))
    }

    /// The smallest scene of at least `min_splats` splats with a PSNR of at least `min_psnr` dB, by bisection; one of all splats if no try
    /// reaches that PSNR.
    pub fn find_smallest(
        &mut self,
        min_splats: usize,
        min_psnr: f64,
        on_event: &mut dyn FnMut(CompactEvent),
    ) -> Result<DecodedScene, RunError> {
        let all = self.initial.len();
        let (mut low, mut high) = ((all / 100).max(min_splats).max(1) as f64, all as f64);
        let mut best: Option<DecodedScene> = None;
        for _ in 0..MAX_SEARCH_TRIES {
            let count = (low * high).sqrt();
            if high / low < SEARCH_TOLERANCE {
                break;
            }
            let found = self.train(count as usize, on_event)?;
            if found.psnr >= min_psnr {
                high = count;
                self.initial.clone_from(&found.splats);
                best = Some(found);
            } else {
                low = count;
            }
        }
        match best {
            Some(best) => Ok(best),
            None => self.train(all, on_event),
        }
    }
}

/// Keeps the `count` splats with the largest `score`.
fn keep_highest(state: &mut SplatState, score: &[f64], count: usize) {
    let mut order: Vec<u32> = (0..state.len() as u32).collect();
    order.sort_by(|a, b| score[*b as usize].total_cmp(&score[*a as usize]).then(a.cmp(b)));
    order.truncate(count);
    order.sort_unstable();
    state.gather(&order);
}

/// Sets harmonics above degree 0 to zero, except for the `share` of the splats where they are most visible, by the light that they change.
fn drop_harmonics(splats: &mut Splats, weight: &[f64], share: f64) {
    let planes = splats.sh.count();
    let energy = |i: usize| (3..planes).map(|c| f64::from(splats.sh.get(c, i)).powi(2)).sum::<f64>();
    let mut order: Vec<(f64, u32)> = (0..splats.len()).map(|i| (weight[i] * energy(i), i as u32)).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let kept = (share * order.len() as f64).ceil() as usize;
    for (_, i) in &order[kept..] {
        (3..planes).for_each(|c| splats.sh.set(c, *i as usize, 0.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_splats_that_score_least_go_and_harmonics_that_do_not_show() {
        let mut splats = Splats::zeros(4, 1);
        for i in 0..4 {
            splats.means.set(0, i, i as f32);
            splats.sh.set(5, i, 1.0 + i as f32);
        }
        let mut state = SplatState::new(splats);
        keep_highest(&mut state, &[3.0, 1.0, 4.0, 2.0], 3);
        let left: Vec<f32> = (0..3).map(|i| state.splats.means.get(0, i)).collect();
        assert_eq!(left, [0.0, 2.0, 3.0]);
        drop_harmonics(&mut state.splats, &[100.0, 1.0, 1.0], 0.5);
        let harmonics: Vec<f32> = (0..3).map(|i| state.splats.sh.get(5, i)).collect();
        assert_eq!(harmonics, [1.0, 0.0, 4.0], "by weight times energy");
    }
}
