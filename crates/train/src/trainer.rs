//! Start here: [`Trainer::step`] is one step from batch to update.

use crate::depth_maps::DepthMaps;
use crate::device::{DeviceLoss, use_device};
use crate::event::{Event, StepReport};
use crate::exposure_probe;
use crate::field_step::{first_field, is_field};
use crate::first_splats::first_count;
use crate::free_space::FreeSpace;
use crate::half_fit::HalfFit;
use crate::lights::Lights;
use crate::memory::{MemoryPlan, Needs};
use crate::model::Model;
use crate::normal_maps::NormalMaps;
use crate::objective::{Objective, ObjectiveValues, Reference};
use crate::photos::{PhotoCache, Prepared};
use crate::pixel_size::pixel_size;
use crate::recipe::{AdamKind, Choice, DensityControl, LengthUnit, Param, Recipe};
use crate::schedule::{Clock, Round, StepMetrics, StepPlan, plan, upcoming_views};
use crate::socket::{Residual, Sky, Sockets};
use crate::times::Times;
use crate::transients::Hidden;
use cpu_time::ProcessTime;
use irradia_compute::adam::AdamStep;
use irradia_compute::{Device, DeviceError};
use irradia_field::{FieldEngine, FieldError, FieldState, KnownDepth};
use irradia_measure::Lpips;
use irradia_scene::{Camera, Dataset, LoadError, Rng, sh};
use irradia_splat::densify::{DensityChange, classic, fast, mcmc, merge, taming};
use irradia_splat::init;
use irradia_splat::regularize::AngleCap;
use irradia_splat::{
    Engine, FramePlanes, Gather, Noise, Optimizer, RenderOptions, SplatState, Splats, Statistics, Update, ViewParams,
    filter,
};
use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

/// Why training failed: one line.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A photograph could not be read.
    #[error(transparent)]
    Photo(#[from] LoadError),
    /// There are no training views.
    #[error("the dataset has {0} training views; at least 1 is needed after holding some out")]
    NoViews(usize),
    /// There are no initial points.
    #[error(
        "no initial points: the dataset has none, and the unmasked camera frusta do not overlap; check poses and masks"
    )]
    NoPoints,
    /// There are no splats to begin with.
    #[error("the scene to begin with has no splats")]
    NoSplats,
    /// The cameras determine no space for a field.
    #[error("the cameras determine no space for a field: they do not look at a common region; check poses")]
    NoSpace,
    /// A field has no surface.
    #[error("the field has no surface on which splats could be initialised: give its stage more steps")]
    NoSurface,
    /// The field configuration is invalid.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// The first splats and a few photographs do not fit into memory.
    #[error(
        "{limit} of memory are too little for {splats} splats and a few photographs; --memory {needed} would do{otherwise}"
    )]
    Memory {
        /// All memory of the process, with its unit.
        limit: String,
        /// What would suffice, with its unit.
        needed: String,
        /// Splats to begin with.
        splats: usize,
        /// What else would do.
        otherwise: String,
    },
    /// The device cannot be used, or failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// A checkpoint does not fit.
    #[error("{0}")]
    Checkpoint(String),
}

/// Options of a run beside its recipe.
#[derive(Clone)]
pub struct TrainOptions {
    /// Random seed.
    pub seed: u64,
    /// Steps of the run; the recipe's own number when `None`.
    pub steps: Option<u64>,
    /// Memory of the whole process, bytes; `None`: photographs get 2 GiB, and splats have the recipe's limit only.
    pub memory: Option<usize>,
    /// Weights of the perceptual loss; without them a recipe's perceptual loss is skipped.
    pub lpips: Option<Arc<Lpips>>,
    /// Where the scene is trained.
    pub device: Device,
}

impl Default for TrainOptions {
    /// Seed 0, the recipe's steps, no limit on memory, on the CPU.
    fn default() -> Self {
        Self {
            seed: 0,
            steps: None,
            memory: None,
            lpips: None,
            device: Device::Cpu,
        }
    }
}

/// Random streams derived from the run's seed, one per use.
pub(crate) const STREAM_INIT: u64 = 1;
const STREAM_DENSIFY: u64 = 2;
const STREAM_STEP: u64 = 5;

/// A run of sparse photographs has at least one part in this many of the recipe's own steps.
const LEAST_SPARSE: u64 = 5;
/// Training views over which the convergence error is measured.
const MEASURED_VIEWS: usize = 8;

/// A run's whole state.
pub struct Trainer {
    /// The resolved recipe.
    pub recipe: Recipe,
    /// The dataset.
    pub dataset: Arc<Dataset>,
    /// Indices of the views to train on: those of the dataset without misfits.
    pub(crate) trained: Vec<usize>,
    /// What is hidden of the training views.
    pub(crate) hidden: Hidden,
    /// The splats; none while a field is trained.
    pub engine: Engine,
    /// The field, in stages that train one.
    pub field: Option<FieldEngine>,
    /// The trained components beside the splats.
    pub sockets: Sockets,
    /// Position in the schedule.
    pub clock: Clock,
    /// The options of the run.
    pub options: TrainOptions,
    /// Recipe steps per step.
    pub pace: f64,
    /// Extent of the scene, world units: 1.1 times the largest distance of a camera from their mean (3DGS).
    pub extent: f32,
    /// What the rate of the means is relative to, world units: the extent, or a number of pixels.
    extent_of_rate: f32,
    /// Wall time of all steps so far, excluding the loading of photographs and the evaluation of held-out views.
    pub seconds: f64,
    /// CPU time of all steps so far, over all threads.
    pub cpu_seconds: f64,
    /// Wall time between the first step and the last, and its breakdown.
    pub times: Times,
    /// Maximum number of splats: the recipe's limits for this dataset, and those of the memory and the device.
    pub cap: usize,
    /// Pixels of a training image, averaged over views.
    pub(crate) pixels: f64,
    /// What was decided from the data before the first step, one line each.
    pub(crate) decisions: Vec<String>,
    /// The distribution of the memory.
    pub memory: MemoryPlan,
    pub(crate) photos: PhotoCache,
    /// The maps of depth given beside photographs, once they are needed.
    pub(crate) depth_maps: Option<DepthMaps>,
    /// Those of normals.
    pub(crate) normal_maps: Option<NormalMaps>,
    /// Known depths of the views on which a field is trained, by view, width and height.
    pub(crate) depths: HashMap<(usize, u32, u32), Arc<[KnownDepth]>>,
    objective: Objective,
    device_loss: DeviceLoss,
    /// Steps of this process whose frames were read back from a GPU for their losses.
    pub(crate) read_for_losses: u64,
    free_space: FreeSpace,
}

impl Trainer {
    /// Creates the first splats.
    ///
    /// # Errors
    /// When there are no training views or no initial points, or photographs needed for colours cannot be read.
    pub fn new(dataset: Arc<Dataset>, recipe: Recipe, options: TrainOptions) -> Result<Self, TrainError> {
        let first = first_count(&dataset, &recipe);
        let mut trainer = Self::unfilled(dataset, recipe, options, first)?;
        if trainer.memory.splats < trainer.memory.wanted_splats {
            // In the recipe, so that a resumed run has the same limit.
            trainer.recipe.max_splats = trainer.memory.splats;
        }
        trainer.settle_conditions()?;
        if is_field(&trainer.recipe, 0) {
            let state = trainer.first_field()?;
            trainer.set_field(state)?;
        } else {
            let splats = trainer.first_splats()?;
            *trainer.engine.state_mut() = SplatState::new(splats);
        }
        trainer.sockets = trainer.first_sockets()?;
        Ok(trainer)
    }

    /// Begins with `splats`, in the world of `dataset`, instead of the dataset's points or a field. Bands that they do not have are not
    /// trained. The recipe's `render.antialias` must be that of the splats.
    ///
    /// # Errors
    /// When there are no training views, no splats, or too little memory for them.
    pub fn from_splats(
        dataset: Arc<Dataset>,
        recipe: Recipe,
        options: TrainOptions,
        splats: Splats,
    ) -> Result<Self, TrainError> {
        if splats.is_empty() {
            return Err(TrainError::NoSplats);
        }
        let mut trainer = Self::unfilled(dataset, recipe, options, splats.len())?;
        trainer.settle_conditions()?;
        *trainer.engine.state_mut() = SplatState::new(splats);
        trainer.sockets = trainer.first_sockets()?;
        Ok(trainer)
    }

    /// A trainer whose state is yet to be filled in with `first_splats` splats, by a checkpoint for example.
    pub(crate) fn unfilled(
        mut dataset: Arc<Dataset>,
        recipe: Recipe,
        options: TrainOptions,
        first_splats: usize,
    ) -> Result<Self, TrainError> {
        if dataset.train.is_empty() {
            return Err(TrainError::NoViews(0));
        }
        let cameras = train_cameras(&dataset);
        let total = recipe.total_steps() as f64;
        let needs = Needs {
            first_splats,
            most_splats: if (0..recipe.stage.len()).all(|stage| is_field(&recipe, stage)) {
                0
            } else {
                cap(&recipe, &cameras).max(first_splats)
            },
            ..Needs::of(&dataset, &recipe, options.lpips.as_ref().map(|lpips| lpips.net()))
        };
        let memory = MemoryPlan::new(&needs, options.memory)?;
        if memory.held_out > 0 {
            Arc::make_mut(&mut dataset).keep_held_out();
        }
        let mut engine = Engine::new(SplatState::new(Splats::zeros(0, sh::MAX_DEGREE)));
        let decisions = use_device(&mut engine, &options.device, &recipe, first_splats, &cameras)?;
        let extent = init::camera_extent(&cameras);
        Ok(Self {
            clock: Clock::new(&recipe),
            pace: options.steps.map_or(1.0, |steps| total / steps.max(1) as f64),
            seconds: 0.0,
            cpu_seconds: 0.0,
            times: Times::default(),
            extent,
            extent_of_rate: match recipe.extent_pixels {
                pixels if pixels > 0.0 => pixels * pixel_size(&dataset),
                _ => extent,
            },
            photos: PhotoCache::new(dataset.clone(), recipe.render.background, memory.photos),
            cap: cap(&recipe, &cameras).min(memory.splats).min(engine.most_splats()),
            memory,
            pixels: mean_pixels(&cameras),
            decisions,
            depth_maps: None,
            normal_maps: None,
            depths: HashMap::new(),
            objective: Objective::new(options.lpips.clone()),
            device_loss: DeviceLoss::new(&options.device)?,
            read_for_losses: 0,
            free_space: FreeSpace::new(&dataset, recipe.free_space),
            engine,
            field: None,
            sockets: Sockets::default(),
            trained: dataset.train.clone(),
            hidden: Hidden::default(),
            recipe,
            dataset,
            options,
        })
    }

    /// The recipe's field, untrained.
    pub(crate) fn first_field(&mut self) -> Result<FieldState, TrainError> {
        let transparent = self.transparent()?;
        let knobs = self
            .recipe
            .field
            .as_ref()
            .expect("validated: a stage of field has its knobs");
        let (field, why) = first_field(knobs, &self.dataset, transparent, self.options.seed)?;
        self.decisions.push(format!("the field's space is {why}"));
        Ok(field)
    }

    /// Continues with this field, on the device of the run.
    pub(crate) fn set_field(&mut self, state: FieldState) -> Result<(), TrainError> {
        self.field = Some(FieldEngine::new(state, &self.options.device)?);
        Ok(())
    }

    /// The recipe's components in the sockets of a step, untrained.
    pub(crate) fn first_sockets(&mut self) -> Result<Sockets, TrainError> {
        if self.engine.is_on_gpu() && self.recipe.light().is_some() {
            self.recipe.appearance = None;
            self.decisions
                .push("the light of photographs is trained on the CPU only, and left out".into());
        }
        // Only the spaces of fields depend on transparency; photographs are not read for the others.
        let fields = self.recipe.residual.is_some() || self.recipe.light().is_some();
        let transparent = fields && self.transparent()?;
        let sockets = Sockets::new(&self.recipe, &self.dataset, transparent, self.options.seed)?;
        if self.recipe.vignette && sockets.vignette.is_none() {
            self.decisions
                .push("the photographs are faces of panoramas, which no lens darkens: no vignette is trained".into());
        }
        Ok(sockets)
    }

    /// Whether photographs have alpha, judged by the first one.
    pub(crate) fn transparent(&mut self) -> Result<bool, TrainError> {
        Ok(self.photos.get(&self.dataset.train[..1], 1.0)?.alpha.is_some())
    }

    /// The least pace of a run without a given number of steps: the recipe's limit on visits, where photographs are sparse.
    pub(crate) fn least_pace(&self) -> f64 {
        match self.recipe.sparse_visits {
            0 => 0.0,
            visits => {
                let total = self.recipe.total_steps();
                let most = visits.saturating_mul(self.dataset.train.len() as u64);
                total as f64 / most.max(total / LEAST_SPARSE).max(1) as f64
            }
        }
    }

    /// Number of steps of this run, as far as known.
    pub fn total_steps(&self) -> u64 {
        let left = (self.recipe.total_steps() as f64 - self.clock.time).max(0.0);
        self.clock.step + (left / self.pace - 1e-6).ceil().max(0.0) as u64
    }

    /// Whether the recipe is complete.
    pub fn finished(&self) -> bool {
        self.clock.finished(&self.recipe)
    }

    /// Number of parameters of the field, in stages that train one.
    pub fn parameters(&self) -> Option<usize> {
        self.field.as_ref().map(FieldEngine::len)
    }

    /// Name of the current stage.
    pub fn stage_name(&self) -> &str {
        let stages = &self.recipe.stage;
        &stages[self.clock.stage.min(stages.len() - 1)].name
    }

    /// One step: batch, render, loss, gradients, update, density. Events are appended to `events`.
    ///
    /// # Errors
    /// When a photograph cannot be read.
    pub fn step(&mut self, events: &mut Vec<Event>) -> Result<StepReport, TrainError> {
        let (report, metrics) = if self.field.is_some() {
            self.field_step()?
        } else {
            self.splat_step(events)?
        };
        self.check_device()?;
        let before = self.clock.time;
        let entered = self.tick(metrics) && !self.finished();
        let total = self.recipe.total_steps() as f64;
        let at = exposure_probe::AT * total;
        // A grid contains an exposure: there is nothing to decide.
        let undecided = self.recipe.exposure == Choice::Auto && self.sockets.bilateral.is_none();
        let probes = undecided && self.field.is_none();
        if probes && before < at && self.clock.time >= at {
            events.extend(self.decide_exposure()?);
        }
        if self.field.is_none() {
            events.extend(self.audit(before)?);
        }
        if entered {
            events.push(Event::StageEntered {
                stage: self.stage_name().to_owned(),
                step: self.clock.step,
                seconds: self.seconds,
            });
            if self.field.is_some() && !is_field(&self.recipe, self.clock.stage) {
                self.field_to_splats()?;
            }
        }
        Ok(report)
    }

    fn splat_step(&mut self, events: &mut Vec<Event>) -> Result<(StepReport, StepMetrics), TrainError> {
        let plan = plan(&self.recipe, &self.clock);
        let upcoming = upcoming_views(&self.trained, self.options.seed, &self.clock);
        let photo = self.photos.get(&upcoming, plan.image_scale)?;
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let camera = &self.dataset.views[upcoming[0]].camera;
        let photo = self.hidden.apply(upcoming[0], camera, &photo).map_or(photo, Arc::new);
        let mut rng = Rng::new(self.options.seed ^ self.clock.step << 20, STREAM_STEP);
        let view = upcoming[0];
        let placement = self.sockets.place(view, &self.scaled_camera(view, plan.image_scale));
        let camera = placement.camera;
        if plan.refilter {
            self.update_filter();
        }

        let background = plan
            .is_on(Param::RandomBackground)
            .then(|| std::array::from_fn(|_| rng.uniform()))
            .filter(|_| photo.alpha.is_some());
        let usual = self.render_options(plan.sh_degree);
        let options = RenderOptions {
            background: background.unwrap_or(usual.background),
            depth: plan.compares_depth(),
            ..usual
        };
        let depth_map = self.given_depths(view, &camera, &plan);
        let normal_map = self.given_normals(view, &camera, &plan);
        let reference = Reference {
            photo: &photo,
            background,
            depths: &self.known_depths(view, &camera, &plan),
            depth_map: depth_map.as_ref().map(|(samples, kind)| (&samples[..], *kind)),
            normal_map: normal_map
                .as_ref()
                .map(|(samples, reach)| (&samples[..], *reach, &camera.intrinsics)),
        };
        let (update, has_lpips) = (self.update(&plan, &camera), self.options.lpips.is_some());
        let ahead = self.sockets.are_empty().then(|| {
            let frame = (&camera, &options);
            self.device_loss
                .whole_step(&mut self.engine, frame, &reference, &plan, &update, has_lpips)
        });
        let loss = match ahead.flatten() {
            Some(loss) => loss,
            None => {
                self.sockets.render(&mut self.engine, view, placement, &options, &plan);
                let loss = self.step_losses(&reference, (view, &camera), &plan, &mut rng);
                self.sockets
                    .step_before_blending(&mut self.engine, view, &camera, self.extent, &plan);
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
            step: self.clock.step + 1,
            seconds: self.seconds,
            seconds_left: 0.0,
            seconds_left_range: [0.0; 2],
            pace: self.pace,
            view,
            loss: loss.total,
            mse: loss.mse,
            splats: self.engine.len(),
            parameters: None,
            visible: self.engine.visible(),
            non_finite: self.engine.non_finite(),
        };
        Ok((report, metrics))
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
        let on_device = (!self.sockets.are_after_blending()).then(|| {
            let has_lpips = self.options.lpips.is_some();
            self.device_loss
                .step(&mut self.engine, reference, plan, camera_gradient, has_lpips)
        });
        if let Some(loss) = on_device.flatten() {
            return loss;
        }
        self.read_for_losses += u64::from(self.engine.is_on_gpu());
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

    /// The splat update of this step, whose view is that of `camera`.
    fn update(&self, plan: &StepPlan, camera: &Camera) -> Update {
        let longer = self.pace.min(1.0).powf(f64::from(self.recipe.length_exponent)) as f32;
        let mut rates = plan.rates().scaled(longer);
        rates.means *= self.extent_of_rate;
        let adam = &self.recipe.adam;
        let (noise, limit) = (plan.value(Param::Noise), plan.value(Param::ConditionCap));
        Update {
            statistics: plan.gathers,
            regularizers: plan.regularizers(),
            regularized: self.recipe.regularizers.of.into(),
            regularizer_unit: match self.recipe.regularizers.unit {
                LengthUnit::Extent => self.extent,
                LengthUnit::World => 1.0,
            },
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
                amount: noise * rates.means,
                seed: self.options.seed,
                step: self.clock.step,
            }),
            condition_cap: (limit > 0.0).then_some(limit),
            angle_cap: AngleCap::of(camera),
        }
    }

    fn control_density(&mut self, plan: &StepPlan) -> Option<DensityChange> {
        let change = plan.densify.as_ref().map(|round| self.densify(round));
        let merged = plan
            .merge
            .map(|knobs| merge::merge(self.engine.state_mut(), &knobs.options()));
        if let Some(ceiling) = plan.reset_opacity {
            self.engine.edit_density(|state| classic::reset_opacity(state, ceiling));
        }
        if change.is_some() && self.recipe.render.smoothing_filter {
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
            .min(self.engine.most_splats());
        let first = first_count(&self.dataset, &self.recipe);
        let mut rng = Rng::new(self.options.seed ^ self.clock.step << 20, STREAM_DENSIFY);
        self.engine.edit_density(|state| {
            let cleared = self.free_space.clear(state);
            let limit = limit.min(self.memory.splats_at(intersections, state.len(), pixels));
            let change = match round.density {
                DensityControl::Classic(knobs) => {
                    let options = knobs.options(self.extent, round.prune_large, limit);
                    classic::densify(state, &options, &mut rng)
                }
                DensityControl::Mcmc(knobs) => mcmc::densify(state, &knobs.options(self.pace, limit), &mut rng),
                DensityControl::Taming(knobs) => {
                    let target = taming::next_count(state.len(), limit, round.completed);
                    let options = knobs.options(self.extent, round.prune_large, round.number, target);
                    taming::densify(state, &options, &mut rng)
                }
                DensityControl::Fast(knobs) => {
                    let floor = ((f64::from(knobs.floor) * self.pixels) as usize).min(first).min(limit);
                    fast::densify(state, &knobs.options(self.pace, floor, limit))
                }
            };
            DensityChange {
                pruned: change.pruned + cleared,
                ..change
            }
        })
    }

    /// Maximum number of splats of stage `stage` at `count_share`, a fraction of the cap.
    pub(crate) fn limit(&self, stage: usize, count_share: f64) -> usize {
        let limit = self.cap as f64 * count_share;
        let stage = &self.recipe.stage[stage.min(self.recipe.stage.len() - 1)];
        let fraction = stage.density.map_or(1.0, |density| density.limit_fraction(self.pace));
        ((limit * fraction) as usize).max(1)
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

    /// The training views' cameras.
    pub(crate) fn train_cameras(&self) -> Vec<Camera> {
        train_cameras(&self.dataset)
    }

    pub(crate) fn scaled_camera(&self, view: usize, scale: f32) -> Camera {
        let mut camera = self.dataset.views[view].camera;
        camera.intrinsics = camera.intrinsics.scaled(scale);
        camera
    }

    /// Mean L1 error over some training views, evenly spaced, as the plan renders them.
    fn measure_error(&mut self, plan: &StepPlan) -> Result<f64, TrainError> {
        let (mut sum, mut count) = (0.0, 0);
        self.show_training_views(MEASURED_VIEWS, plan, false, |trainer, view, photo| {
            let shown = trainer.hidden.apply(view, &trainer.dataset.views[view].camera, photo);
            sum += trainer.error_of_frame(shown.as_ref().unwrap_or(photo));
            count += 1;
        })?;
        Ok(sum / f64::from(count.max(1)))
    }

    /// Mean L1 error of the last frame against its photograph.
    pub(crate) fn error_of_frame(&mut self, photo: &Prepared) -> f64 {
        let color = self.sockets.frame_color(&self.engine);
        self.objective.error(color, photo, false);
        self.objective.mean_error()
    }

    /// As [`Self::error_of_frame`] was last called, of the pixels that fit best.
    pub(crate) fn trimmed_error(&self) -> f64 {
        self.objective.trimmed_error()
    }

    /// Renders at most `most` training views, evenly spaced, as the plan does, with `depth` if asked for, and passes each with its
    /// whole photograph to `see`.
    pub(crate) fn show_training_views(
        &mut self,
        most: usize,
        plan: &StepPlan,
        depth: bool,
        mut see: impl FnMut(&mut Self, usize, &Prepared),
    ) -> Result<(), TrainError> {
        let upcoming = upcoming_views(&self.trained, self.options.seed, &self.clock);
        let train = self.trained.clone();
        let stride = train.len().div_ceil(most).max(1);
        for view in train.into_iter().step_by(stride) {
            let order: Vec<usize> = std::iter::once(view)
                .chain(upcoming.iter().copied().filter(|other| *other != view))
                .collect();
            let photo = self.photos.get(&order, plan.image_scale)?;
            let (started, cpu_started) = (Instant::now(), ProcessTime::now());
            let placement = self.sockets.place(view, &self.scaled_camera(view, plan.image_scale));
            let options = RenderOptions {
                depth,
                ..self.render_options(plan.sh_degree)
            };
            self.sockets.render(&mut self.engine, view, placement, &options, plan);
            see(self, view, &photo);
            self.seconds += started.elapsed().as_secs_f64();
            self.cpu_seconds += cpu_started.elapsed().as_secs_f64();
        }
        Ok(())
    }

    /// Advances the clock; steps saved by an early end of a stage go to the remaining stages.
    fn tick(&mut self, metrics: StepMetrics) -> bool {
        let stretch = self.clock.stretch;
        let ended = self.clock.tick(&self.recipe, self.pace, metrics);
        if let Some(steps) = self.options.steps.filter(|_| self.clock.stretch != stretch)
            && steps > self.clock.step
        {
            self.pace = (self.recipe.total_steps() as f64 - self.clock.time) / (steps - self.clock.step) as f64;
        }
        ended
    }

    /// How this run's frames are rendered, with SH up to `sh_degree`.
    pub fn render_options(&self, sh_degree: u32) -> RenderOptions {
        let sky = self.sockets.sky.as_ref();
        RenderOptions {
            background: sky.map_or(self.recipe.render.background, Sky::background),
            sh_degree,
            antialias: self.recipe.render.antialias,
            ..RenderOptions::default()
        }
    }

    /// Camera `view` of the dataset, at full size, with its refinement.
    pub fn camera(&self, view: usize) -> Camera {
        self.sockets.place(view, &self.dataset.views[view].camera).camera
    }

    /// The per-image parameters to fit on held-out views before comparison.
    pub fn half_fit(&self) -> HalfFit {
        HalfFit {
            exposure: self.sockets.exposure.is_some() || self.sockets.bilateral.is_some(),
            pose: self.sockets.poses.is_some(),
        }
    }

    /// Parts of the dataset that the recipe ignores, and splats for which there is no memory: one line each.
    pub fn warnings(&self) -> Vec<String> {
        let moves = self.dataset.train.iter().any(|i| self.dataset.views[*i].time.is_some());
        let line = format!(
            "the photographs were taken at different times, which recipe {} ignores: moving objects become blurred",
            self.recipe.name
        );
        let by_memory = self.memory.warning(&self.recipe.name);
        moves.then_some(line).into_iter().chain(by_memory).collect()
    }

    /// The light of each photograph, as learned so far; `None` if none is.
    pub fn lights(&self) -> Option<Lights> {
        Lights::of_training(&self.sockets)
    }

    /// The scene as exported and evaluated: with the smoothing filter baked in.
    pub fn scene(&self) -> Model<'_> {
        if let Some(field) = &self.field {
            return Model::Field(Cow::Borrowed(&field.state().field));
        }
        Model::Splats {
            splats: if self.recipe.render.smoothing_filter {
                Cow::Owned(filter::baked(self.engine.state()))
            } else {
                Cow::Borrowed(&self.engine.state().splats)
            },
            residual: self
                .sockets
                .residual
                .as_ref()
                .and_then(Residual::learnt)
                .map(|field| Box::new(field.clone())),
        }
    }
}

pub(crate) fn train_cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.train.iter().map(|i| dataset.views[*i].camera).collect()
}

/// The recipe's limits on the number of splats, for images of these cameras.
fn cap(recipe: &Recipe, cameras: &[Camera]) -> usize {
    let mean = mean_pixels(cameras);
    let by_pixels = recipe
        .splats_per_pixel
        .map_or(usize::MAX, |per_pixel| (f64::from(per_pixel) * mean) as usize);
    recipe.max_splats.min(by_pixels).max(1)
}

fn mean_pixels(cameras: &[Camera]) -> f64 {
    let pixels = |c: &Camera| f64::from(c.intrinsics.width) * f64::from(c.intrinsics.height);
    cameras.iter().map(pixels).sum::<f64>() / cameras.len().max(1) as f64
}
