//! Start here: the whole state of a run, and [`Trainer::step`], which advances it; what a step does is in `splat_step.rs` and
//! `field_step.rs`.

use crate::depth_maps::DepthMaps;
use crate::device::{DeviceLoss, use_device};
use crate::event::{Event, StepReport};
use crate::field_step::{first_field, is_field};
use crate::first_splats::first_count;
use crate::free_space::FreeSpace;
use crate::half_fit::HalfFit;
use crate::lights::Lights;
use crate::memory::{MemoryPlan, Needs};
use crate::model::Model;
use crate::normal_maps::NormalMaps;
use crate::objective::Objective;
use crate::photos::{PhotoCache, Prepared};
use crate::pixel_size::{content_depth, pixel_size};
use crate::recipe::Recipe;
use crate::schedule::{Clock, StepMetrics, StepPlan, upcoming_views};
use crate::socket::{Residual, Sky, Sockets};
use crate::spacing::spacing;
use crate::surroundings::Surroundings;
use crate::times::Times;
use crate::transients::Hidden;
use cpu_time::ProcessTime;
use irradia_compute::{Device, DeviceError};
use irradia_field::{FieldEngine, FieldError, FieldState, KnownDepth};
use irradia_measure::Lpips;
use irradia_scene::{Camera, Dataset, LoadError, sh};
use irradia_splat::{Engine, RenderOptions, SplatState, Splats, filter, init};
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
        "{limit} of memory is too little for {splats} splats and a few photographs; --memory {needed} would be enough{otherwise}"
    )]
    Memory {
        /// All memory of the process, with its unit.
        limit: String,
        /// What would suffice, with its unit.
        needed: String,
        /// Splats to begin with.
        splats: usize,
        /// An alternative, as the end of the sentence.
        otherwise: String,
    },
    /// The device cannot be used, or failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// A checkpoint does not fit.
    #[error("{0}")]
    Checkpoint(String),
}

/// Options of a run in addition to its recipe.
#[derive(Clone)]
pub struct TrainOptions {
    /// Random seed.
    pub seed: u64,
    /// Steps of the run; the recipe's own number when `None`.
    pub steps: Option<u64>,
    /// Memory of the whole process, bytes; `None`: photographs get 2 GiB, and splats have only the recipe's limit.
    pub memory: Option<usize>,
    /// Weights of the perceptual loss; without them a recipe's perceptual loss is skipped.
    pub lpips: Option<Arc<Lpips>>,
    /// The device on which the scene is trained.
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

/// A run of sparse photographs has at least the recipe's own number of steps divided by this.
const MAX_SPARSE_DIVISOR: u64 = 5;

/// A run's whole state.
pub struct Trainer {
    /// The resolved recipe.
    pub recipe: Recipe,
    /// The dataset.
    pub dataset: Arc<Dataset>,
    /// Indices of the views to train on: those of the dataset without misfits.
    pub(crate) trained: Vec<usize>,
    /// The hidden parts of the training views.
    pub(crate) hidden: Hidden,
    /// The splats; none while a field is trained.
    pub engine: Engine,
    /// The field, in stages that train one.
    pub field: Option<FieldEngine>,
    /// The trained components other than the splats.
    pub sockets: Sockets,
    /// Position in the schedule.
    pub clock: Clock,
    /// The options of the run.
    pub options: TrainOptions,
    /// Recipe steps per step.
    pub pace: f64,
    /// Recipe steps skipped before the first step.
    pub skipped: f64,
    /// Whether the first splats are those of a scene.
    pub(crate) continues_scene: bool,
    /// Extent of the scene, world units: 1.1 times the largest distance of a camera from their mean (3DGS).
    pub extent: f32,
    /// The length that counts as much as one radian, or as one unit of a splat's size, world units: the extent, but at most the depth of what
    /// most views show, since the extent of a walk is many times that.
    pub(crate) length_unit: f32,
    /// The length to which the rate of the means is relative, world units: the extent, or a number of pixels at the depth of what most
    /// views show.
    pub(crate) rate_extent: f32,
    /// Wall time of all steps so far, excluding the loading of photographs and the evaluation of held-out views.
    pub seconds: f64,
    /// CPU time of all steps so far, over all threads.
    pub cpu_seconds: f64,
    /// The part of `seconds` in this process that rendered views between steps.
    pub(crate) seconds_between: f64,
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
    /// The depth maps given with photographs; read once they are needed.
    pub(crate) depth_maps: Option<DepthMaps>,
    /// The normal maps, likewise.
    pub(crate) normal_maps: Option<NormalMaps>,
    /// Known depths of the views on which a field is trained, by view, width and height.
    pub(crate) depths: HashMap<(usize, u32, u32), Arc<[KnownDepth]>>,
    pub(crate) objective: Objective,
    pub(crate) device_loss: DeviceLoss,
    /// Steps of this process whose frames were read back from a GPU for their losses.
    pub(crate) cpu_loss_steps: u64,
    pub(crate) free_space: FreeSpace,
    /// Number of splats before the first step, or, if fewer, before the first step since the run was resumed: edits may have removed some.
    pub(crate) initial_splats: usize,
    /// Angle between adjacent training photographs, radians.
    pub(crate) spacing: f64,
    /// The surroundings of sparse photographs; absent if the recipe has no free space.
    pub(crate) surroundings: Option<Surroundings>,
}

impl Trainer {
    /// Creates the first splats.
    ///
    /// # Errors
    /// When there are no training views or no initial points, or photographs needed for colours cannot be read.
    pub fn new(dataset: Arc<Dataset>, recipe: Recipe, options: TrainOptions) -> Result<Self, TrainError> {
        let first = first_count(&dataset, &recipe);
        let mut trainer = Self::with_empty_state(dataset, recipe, options, first)?;
        trainer.keep_memory_limit();
        trainer.apply_data_conditions()?;
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
    /// trained; those that they use are shown from the first step on. The recipe's `render.antialias` must be that of the splats.
    ///
    /// # Errors
    /// When there are no training views, no splats, or too little memory for them.
    pub fn from_splats(
        dataset: Arc<Dataset>,
        mut recipe: Recipe,
        options: TrainOptions,
        splats: Splats,
    ) -> Result<Self, TrainError> {
        if splats.is_empty() {
            return Err(TrainError::NoSplats);
        }
        // In the recipe, so that forecasts, the report and a resumed run have the same bands.
        recipe.keep_sh_bands(splats.used_sh_degree());
        let mut trainer = Self::with_empty_state(dataset, recipe, options, splats.len())?;
        trainer.keep_memory_limit();
        trainer.apply_data_conditions()?;
        *trainer.engine.state_mut() = SplatState::new(splats);
        trainer.sockets = trainer.first_sockets()?;
        trainer.continues_scene = true;
        Ok(trainer)
    }

    /// Skips the first `time` recipe steps; the steps of the run are those that remain.
    pub(crate) fn skip(&mut self, time: f64) {
        self.clock.advance(&self.recipe, time);
        self.skipped = time;
        if let Some(steps) = self.options.steps {
            self.pace = (self.recipe.total_steps() as f64 - time) / steps.max(1) as f64;
        }
    }

    /// A trainer whose state is yet to be filled in with `first_splats` splats, by a checkpoint for example.
    pub(crate) fn with_empty_state(
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
            max_splats: if (0..recipe.stage.len()).all(|stage| is_field(&recipe, stage)) {
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
        let spacing = spacing(&dataset);
        Ok(Self {
            clock: Clock::new(&recipe),
            pace: options.steps.map_or(1.0, |steps| total / steps.max(1) as f64),
            skipped: 0.0,
            continues_scene: false,
            seconds: 0.0,
            cpu_seconds: 0.0,
            seconds_between: 0.0,
            times: Times::default(),
            extent,
            length_unit: extent.min(content_depth(&dataset)),
            rate_extent: match recipe.extent_pixels {
                pixels if pixels > 0.0 => pixels * pixel_size(&dataset),
                _ => extent,
            },
            photos: PhotoCache::new(dataset.clone(), recipe.render.background, memory.photos),
            cap: cap(&recipe, &cameras).min(memory.splats).min(engine.max_splats()),
            memory,
            pixels: mean_pixels(&cameras),
            decisions,
            depth_maps: None,
            normal_maps: None,
            depths: HashMap::new(),
            objective: Objective::new(options.lpips.clone()),
            device_loss: DeviceLoss::new(&options.device)?,
            cpu_loss_steps: 0,
            free_space: FreeSpace::new(&dataset, recipe.free_space),
            initial_splats: first_splats,
            spacing,
            surroundings: (recipe.free_space > 0.0)
                .then(|| Surroundings::new(&dataset, spacing))
                .flatten(),
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

    /// Stores a limit by memory in the recipe, so that a resumed run has the same limit.
    fn keep_memory_limit(&mut self) {
        if self.memory.splats < self.memory.wanted_splats {
            self.recipe.max_splats = self.memory.splats;
        }
    }

    /// The recipe's field, untrained.
    pub(crate) fn first_field(&mut self) -> Result<FieldState, TrainError> {
        let transparent = self.transparent()?;
        let settings = self
            .recipe
            .field
            .as_ref()
            .expect("validated: a stage of field has its settings");
        let (field, why) = first_field(settings, &self.dataset, transparent, self.options.seed)?;
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
                .push("the light of photographs can be trained on the CPU only, and is left out".into());
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

    /// The minimum pace of a run without a given number of steps, by the limit on steps per training photograph.
    pub(crate) fn min_pace(&self) -> f64 {
        match self.max_visits() {
            0 => 0.0,
            visits => {
                let total = self.recipe.total_steps();
                let max_steps = visits.saturating_mul(self.dataset.train.len() as u64);
                total as f64 / max_steps.max(total / MAX_SPARSE_DIVISOR).max(1) as f64
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
        if self.is_exposure_due(before) {
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

    /// Maximum number of splats of stage `stage` at `count_share`, a fraction of the cap.
    pub(crate) fn limit(&self, stage: usize, count_share: f64) -> usize {
        let limit = self.cap as f64 * count_share;
        let stage = &self.recipe.stage[stage.min(self.recipe.stage.len() - 1)];
        let fraction = stage.density.map_or(1.0, |density| density.limit_fraction(self.pace));
        ((limit * fraction) as usize).max(1)
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

    /// The common part of the reports of both kinds of step, for the step just made on `view`; the caller fills in the time left and the
    /// splats.
    pub(crate) fn step_report(&self, view: usize, loss: f64, mse: f64) -> StepReport {
        StepReport {
            step: self.clock.step + 1,
            seconds: self.seconds,
            seconds_left: 0.0,
            seconds_left_range: [0.0; 2],
            pace: self.pace,
            view,
            loss,
            mse,
            splats: 0,
            parameters: self.parameters(),
            visible: 0,
            non_finite: 0,
        }
    }

    /// The mean L1 error of the last frame over the pixels that its photograph shows, and over those of them that fit best.
    pub(crate) fn frame_errors(&mut self, photo: &Prepared) -> [f64; 2] {
        let color = self.sockets.frame_color(&self.engine);
        self.objective.error(color, photo, false);
        self.objective.mean_errors(photo)
    }

    /// Renders `views`, in order, as in `plan`, with depth if `depth`, and passes each with its whole photograph to `visit`.
    pub(crate) fn render_training_views(
        &mut self,
        views: &[usize],
        plan: &StepPlan,
        depth: bool,
        mut visit: impl FnMut(&mut Self, usize, &Prepared),
    ) -> Result<(), TrainError> {
        let upcoming = upcoming_views(&self.trained, self.options.seed, &self.clock);
        for view in views.iter().copied() {
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
            visit(self, view, &photo);
            let seconds = started.elapsed().as_secs_f64();
            self.seconds += seconds;
            self.seconds_between += seconds;
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

    /// The light of each photograph, as learned so far; `None` if none has been learned.
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
                .and_then(Residual::trained_field)
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
