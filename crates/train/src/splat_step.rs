//! A step on splats: batch, render, loss, gradients, update, density.

use crate::event::{Event, StepReport};
use crate::first_splats::first_count;
use crate::objective::{ObjectiveValues, Reference};
use crate::photos::Prepared;
use crate::recipe::{AdamKind, DensityControl, LengthUnit, Param};
use crate::schedule::{self, Round, StepMetrics, StepPlan, upcoming_views};
use crate::stream::Stream;
use crate::trainer::{TrainError, Trainer};
use cpu_time::ProcessTime;
use irradia_compute::adam::AdamStep;
use irradia_measure::{DepthKind, DepthSample, NormalSample};
use irradia_scene::{Camera, Rng};
use irradia_splat::densify::{DensityChange, classic, fast, mcmc, merge, taming};
use irradia_splat::regularize::AngleCap;
use irradia_splat::{FramePlanes, Gather, Noise, Optimizer, RenderOptions, Statistics, Update, ViewParams, filter};
use std::sync::Arc;
use std::time::Instant;

/// Training views over which the convergence error is measured.
const MAX_MEASURED_VIEWS: usize = 8;

/// Samples of the maps given with a photograph, where it is not masked: depths with their kind, normals with half of their spacing in pixels.
struct GivenMaps {
    depths: Option<(Vec<DepthSample>, DepthKind)>,
    normals: Option<(Vec<NormalSample>, u32)>,
}

impl Trainer {
    /// One step on splats; events are appended to `events`.
    pub(crate) fn splat_step(&mut self, events: &mut Vec<Event>) -> Result<(StepReport, StepMetrics), TrainError> {
        let plan = schedule::plan(&self.recipe, &self.clock);
        let upcoming = upcoming_views(&self.trained, self.options.seed, &self.clock);
        let view = upcoming[0];
        let whole_photo = self.photos.get(&upcoming, plan.image_scale)?;
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let hidden = self.hidden.apply(view, &self.dataset.views[view].camera, &whole_photo);
        let photo = hidden.map_or_else(|| whole_photo.clone(), Arc::new);
        let mut rng = Stream::SplatStep.step_rng(self.options.seed, self.clock.step);
        let placement = self.sockets.place(view, &self.scaled_camera(view, plan.image_scale));
        let camera = placement.camera;
        if plan.refilter {
            self.update_filter();
        }

        let background = plan
            .is_on(Param::RandomBackground)
            .then(|| std::array::from_fn(|_| rng.uniform()))
            .filter(|_| photo.alpha.is_some());
        let maps = self.given_maps(view, &photo, &camera, &plan);
        let reference = Reference {
            photo: &photo,
            left_out: whole_photo.mask.as_deref(),
            background,
            depths: &self.known_depths(view, &camera, &plan),
            depth_map: maps.depths.as_ref().map(|(samples, kind)| (&samples[..], *kind)),
            normal_map: maps
                .normals
                .as_ref()
                .map(|(samples, reach)| (&samples[..], *reach, &camera.intrinsics)),
        };
        let base = self.render_options(plan.sh_degree);
        let options = RenderOptions {
            background: background.unwrap_or(base.background),
            depth: reference.compares_depth(&plan),
            ..base
        };
        let (update, has_lpips) = (self.update(&plan, view, &camera), self.options.lpips.is_some());
        let on_device = self.sockets.is_empty().then(|| {
            let frame = (&camera, &options);
            self.device_loss
                .whole_step(&mut self.engine, frame, &reference, &plan, &update, has_lpips)
        });
        let loss = match on_device.flatten() {
            Some(loss) => loss,
            None => {
                self.sockets.render(&mut self.engine, view, placement, &options, &plan);
                let loss = self.step_losses(&reference, (view, &camera), &plan, &mut rng);
                self.sockets
                    .step_before_blending(&mut self.engine, view, &camera, self.length_unit, &plan);
                self.engine.update(&update);
                loss
            }
        };
        let density_started = Instant::now();
        if let Some(change) = self.control_density(&plan) {
            events.push(Event::densified(self.clock.step + 1, change, self.engine.len()));
        }
        self.times.density += density_started.elapsed().as_secs_f64();
        self.seconds += started.elapsed().as_secs_f64();
        self.cpu_seconds += cpu_started.elapsed().as_secs_f64();

        let metrics = StepMetrics {
            error: loss.l1,
            measured: if plan.measure {
                Some(self.measure_error(&plan)?)
            } else {
                None
            },
            views: self.dataset.train.len() as u64,
        };
        let report = StepReport {
            splats: self.engine.len(),
            visible: self.engine.visible(),
            non_finite: self.engine.non_finite(),
            ..self.step_report(view, loss.total, loss.mse)
        };
        Ok((report, metrics))
    }

    /// The samples of the maps given with the photograph of `view`, at the pixels of `camera`.
    fn given_maps(&mut self, view: usize, photo: &Prepared, camera: &Camera, plan: &StepPlan) -> GivenMaps {
        let mut depths = self.given_depths(view, camera, plan);
        let mut normals = self.given_normals(view, camera, plan);
        if let Some(mask) = &photo.mask {
            // Maps also show what is masked, such as people in front of the scene.
            if let Some((samples, _)) = &mut depths {
                samples.retain(|sample| mask[sample.pixel as usize] > 0);
            }
            if let Some((samples, _)) = &mut normals {
                samples.retain(|sample| mask[(sample.pixel[1] * photo.width + sample.pixel[0]) as usize] > 0);
            }
        }
        GivenMaps { depths, normals }
    }

    /// The losses of the last frame, and its backward pass.
    fn step_losses(
        &mut self,
        reference: &Reference,
        (view, camera): (usize, &Camera),
        plan: &StepPlan,
        rng: &mut Rng,
    ) -> ObjectiveValues {
        let camera_gradient = self.sockets.needs_camera_gradient();
        let on_device = (!self.sockets.any_after_blending()).then(|| {
            let has_lpips = self.options.lpips.is_some();
            self.device_loss
                .step(&mut self.engine, reference, plan, camera_gradient, has_lpips)
        });
        if let Some(loss) = on_device.flatten() {
            return loss;
        }
        self.cpu_loss_steps += u64::from(self.engine.is_on_gpu());
        let frame = FramePlanes {
            color: self.sockets.frame_color(&self.engine),
            ..self.engine.frame()
        };
        let loss = self.objective.evaluate(frame, reference, plan, rng);
        if plan.gathers == Some(Statistics::Error) {
            self.objective
                .error(frame.color, reference.photo, reference.background.is_some());
            if plan.edge_share > 0.0 {
                self.objective.add_edges(reference.photo, plan.edge_share);
            }
        }
        self.sockets
            .step_after_blending(&self.engine, view, camera, &mut self.objective, plan);
        let mut v_out = self.objective.gradient();
        v_out.camera = camera_gradient;
        v_out.gather = match plan.gathers {
            Some(Statistics::AbsoluteGradient) => Gather::Absolute,
            Some(Statistics::Error) => self.objective.gather_error(),
            Some(Statistics::Gradient) | None => Gather::Nothing,
        };
        self.engine.backward(&v_out);
        loss
    }

    /// The splat update of this step, whose view `view` is seen by `camera`.
    fn update(&self, plan: &StepPlan, view: usize, camera: &Camera) -> Update {
        let rate_factor = self.pace.min(1.0).powf(f64::from(self.recipe.length_exponent)) as f32;
        let mut rates = plan.rates().scaled(rate_factor);
        // The rate at the depth of most of the scene.
        let typical_rate = rates.means * self.rate_extent;
        if self.recipe.extent_pixels > 0.0 {
            let k = &self.dataset.views[view].camera.intrinsics;
            rates.means *= self.recipe.extent_pixels / k.fx.max(k.fy);
            rates.means_from = Some(camera.pose.position.to_array());
        } else {
            rates.means = typical_rate;
        }
        let adam = &self.recipe.adam;
        let (noise, limit) = (plan.value(Param::Noise), plan.value(Param::ConditionCap));
        let regularizer_unit = match self.recipe.regularizers.unit {
            LengthUnit::Extent => self.length_unit,
            LengthUnit::World => 1.0,
        };
        Update {
            statistics: plan.gathers,
            regularizers: plan.regularizers(),
            regularized: self.recipe.regularizers.of.into(),
            regularizer_unit,
            trained_fraction: plan.value(Param::TrainedShare),
            rates,
            sh_degree: plan.sh_degree,
            optimizer: Optimizer {
                step: AdamStep {
                    beta1: adam.beta1,
                    beta2: adam.beta2,
                    epsilon: adam.epsilon,
                    step: self.clock.step + 1,
                },
                dense: adam.kind == AdamKind::Dense,
            },
            noise: (noise > 0.0).then_some(Noise {
                amount: noise * typical_rate / regularizer_unit.powi(2),
                seed: self.options.seed,
                step: self.clock.step,
            }),
            condition_cap: (limit > 0.0).then_some(limit),
            angle_cap: AngleCap::of(camera, plan.value(Param::AngleCap)),
        }
    }

    /// Mean L1 error over some training views, evenly spaced, as the plan renders them.
    fn measure_error(&mut self, plan: &StepPlan) -> Result<f64, TrainError> {
        let stride = self.trained.len().div_ceil(MAX_MEASURED_VIEWS).max(1);
        let views: Vec<usize> = self.trained.iter().copied().step_by(stride).collect();
        let (mut sum, mut count) = (0.0, 0);
        self.render_training_views(&views, plan, false, |trainer, view, photo| {
            let masked = trainer.hidden.apply(view, &trainer.dataset.views[view].camera, photo);
            sum += trainer.frame_errors(masked.as_ref().unwrap_or(photo))[0];
            count += 1;
        })?;
        Ok(sum / f64::from(count.max(1)))
    }

    fn control_density(&mut self, plan: &StepPlan) -> Option<DensityChange> {
        let change = plan.densify.as_ref().map(|round| self.densify(round));
        let merged = plan
            .merge
            .map(|settings| merge::merge(self.engine.state_mut(), &settings.options()));
        if let Some(ceiling) = plan.reset_opacity {
            self.engine.edit_density(|state| classic::reset_opacity(state, ceiling));
        }
        if (change.is_some() || merged.is_some()) && self.recipe.render.smoothing_filter {
            self.update_filter();
        }
        match (change, merged) {
            (Some(change), Some(merged)) => Some(DensityChange {
                pruned: change.pruned + merged.pruned,
                ..change
            }),
            (change, merged) => change.or(merged),
        }
    }

    fn densify(&mut self, round: &Round) -> DensityChange {
        let (intersections, pixels) = (self.engine.intersections(), self.engine.pixels());
        let limit = self
            .limit(self.clock.stage, round.count_share)
            .min(self.engine.max_splats());
        let (first, views) = (first_count(&self.dataset, &self.recipe), self.trained.len());
        let mut rng = Stream::Density.step_rng(self.options.seed, self.clock.step);
        self.engine.edit_density(|state| {
            let cleared = self.free_space.clear(state);
            if let Some(surroundings) = &self.surroundings {
                surroundings.move_away(state);
            }
            let limit = limit.min(self.memory.splats_at(intersections, state.len(), pixels));
            let change = match round.density {
                DensityControl::Classic(settings) => {
                    let options = settings.options(self.extent, round.prune_large, limit);
                    classic::densify(state, &options, &mut rng)
                }
                DensityControl::Mcmc(settings) => mcmc::densify(state, &settings.options(self.pace, limit), &mut rng),
                DensityControl::Taming(settings) => {
                    let target = taming::next_count(state.len(), limit, round.completed);
                    let options = settings.options(self.extent, round.prune_large, round.number, target);
                    taming::densify(state, &options, &mut rng)
                }
                DensityControl::Fast(settings) => {
                    let floor = ((f64::from(settings.floor) * self.pixels) as usize)
                        .min(first)
                        .min(limit);
                    fast::densify(state, &settings.options(self.pace, views, floor, limit))
                }
            };
            DensityChange {
                pruned: change.pruned + cleared,
                ..change
            }
        })
    }

    fn update_filter(&mut self) {
        let views: Vec<ViewParams> = self
            .dataset
            .train
            .iter()
            .map(|i| ViewParams::new(&self.dataset.views[*i].camera))
            .collect();
        self.engine.edit_density(|state| filter::update(state, &views));
        self.restore_filter();
    }

    /// Passes the state's filter to the renderer.
    pub(crate) fn restore_filter(&mut self) {
        self.engine.use_filter(self.recipe.render.smoothing_filter);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::tests::dataset;
    use crate::{Recipe, TrainOptions};
    use irradia_scene::Similarity;
    use irradia_splat::{SplatState, Splats, logit};

    /// The first noise on a faint splat in a world of `scale` units.
    fn noise(recipe: &str, scale: f64) -> f32 {
        let world = Similarity {
            scale,
            ..Similarity::IDENTITY
        };
        let recipe = Recipe::parse(recipe, Recipe::built_in(recipe).unwrap(), &[]).unwrap();
        let data = Arc::new((*dataset()).clone().in_world(world));
        let trainer = Trainer::new(data, recipe, TrainOptions::default()).unwrap();
        let plan = schedule::plan(&trainer.recipe, &trainer.clock);
        let update = trainer.update(&plan, 0, &trainer.dataset.views[0].camera);
        let Noise { amount, seed, step } = update.noise.expect("a recipe with noise");
        let mut splats = Splats::zeros(1, 0);
        splats.quats.set(0, 0, 1.0);
        (0..3).for_each(|c| splats.log_scales.set(c, 0, (0.1 * scale as f32).ln()));
        splats.opacity_logits.set(0, 0, logit(0.003));
        let mut state = SplatState::new(splats);
        mcmc::add_noise(&mut state, amount, seed, step);
        state.splats.means.get(0, 0)
    }

    #[test]
    fn noise_follows_the_size_of_the_scene_except_as_published() {
        let ratio = |recipe| noise(recipe, 10.0) / noise(recipe, 1.0);
        let (tuned, published) = (ratio("mcmc-tuned"), ratio("mcmc"));
        assert!((tuned / 10.0 - 1.0).abs() < 1e-3, "{tuned}");
        assert!((published / 1000.0 - 1.0).abs() < 1e-3, "{published}");
    }
}
