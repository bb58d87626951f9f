//! Read this first: [`Trainer::step`] is one step from batch to update.

use crate::event::{Event, StepReport};
use crate::photos::{PhotoCache, Prepared};
use crate::recipe::{Density, Recipe};
use crate::schedule::{Clock, StepPlan, coming_views, plan};
use cpu_time::ProcessTime;
use irradia_compute::adam::AdamStep;
use irradia_measure::{LossWeights, PhotometricLoss, Target, Truth};
use irradia_scene::{Camera, Dataset, LoadError, Rng, sh};
use irradia_splat::densify::{DensityChange, classic};
use irradia_splat::init::{self, InitOptions, Look};
use irradia_splat::{OutputGradient, RenderOptions, Renderer, SplatGradients, SplatState, ViewParams};
use std::sync::Arc;
use std::time::Instant;

/// Why training could not go on: one line.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A photograph could not be read.
    #[error(transparent)]
    Photo(#[from] LoadError),
    /// There is nothing to train on.
    #[error("the dataset has {0} training views; at least 1 is needed after holding some out")]
    NoViews(usize),
    /// There is nothing to start from.
    #[error(
        "there is nothing to start from: no points, and no space that the cameras share and the masks leave; check poses and masks"
    )]
    NoPoints,
    /// A checkpoint does not fit.
    #[error("{0}")]
    Checkpoint(String),
}

/// What a run is asked for beside its recipe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainOptions {
    /// Everything random follows from it.
    pub seed: u64,
    /// Steps of the run; the recipe's own number when `None`.
    pub steps: Option<u64>,
    /// Bytes that photographs may take.
    pub photo_budget: usize,
}

impl Default for TrainOptions {
    /// Seed 0, the recipe's steps, 2 GiB of photographs (5,500 of 360 x 360: what fits beside the rest on an 8 GiB machine).
    fn default() -> Self {
        Self {
            seed: 0,
            steps: None,
            photo_budget: 2 << 30,
        }
    }
}

/// Streams of the run's seed; each use of chance has its own.
const STREAM_INIT: u64 = 1;
const STREAM_DENSIFY: u64 = 2;

/// A run in the making.
pub struct Trainer {
    /// The recipe, resolved.
    pub recipe: Recipe,
    /// The data.
    pub dataset: Arc<Dataset>,
    /// What is being trained.
    pub state: SplatState,
    /// Where the run stands.
    pub clock: Clock,
    /// As given.
    pub options: TrainOptions,
    /// Recipe steps that go by in one step.
    pub pace: f64,
    /// Size of the scene, world units: 1.1 times the largest distance of a camera from their mean (3DGS).
    pub extent: f32,
    /// Wall time of all steps so far; loading photographs and looking at held-out views are not in it.
    pub seconds: f64,
    /// Processor time likewise, over all threads.
    pub cpu_seconds: f64,
    photos: PhotoCache,
    renderer: Renderer,
    loss: PhotometricLoss,
    gradients: SplatGradients,
    v_color: Vec<f32>,
    v_alpha: Vec<f32>,
}

impl Trainer {
    /// Makes the first splats.
    ///
    /// # Errors
    /// When there is nothing to train on or to start from, or photographs needed for colours cannot be read.
    pub fn new(dataset: Arc<Dataset>, recipe: Recipe, options: TrainOptions) -> Result<Self, TrainError> {
        let mut trainer = Self::without_splats(dataset, recipe, options)?;
        let splats = trainer.first_splats()?;
        trainer.state = SplatState::new(splats);
        Ok(trainer)
    }

    /// A trainer whose state is still to be filled, as a checkpoint does.
    pub(crate) fn without_splats(
        dataset: Arc<Dataset>,
        recipe: Recipe,
        options: TrainOptions,
    ) -> Result<Self, TrainError> {
        if dataset.train.is_empty() {
            return Err(TrainError::NoViews(0));
        }
        let cameras: Vec<Camera> = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
        let total = recipe.total_steps() as f64;
        Ok(Self {
            clock: Clock::new(&recipe),
            pace: options.steps.map_or(1.0, |steps| total / steps.max(1) as f64),
            seconds: 0.0,
            cpu_seconds: 0.0,
            extent: init::camera_extent(&cameras),
            photos: PhotoCache::new(dataset.clone(), recipe.render.background, options.photo_budget),
            renderer: Renderer::new(),
            loss: PhotometricLoss::new(),
            gradients: SplatGradients::default(),
            v_color: Vec::new(),
            v_alpha: Vec::new(),
            state: SplatState::default(),
            recipe,
            dataset,
            options,
        })
    }

    fn first_splats(&mut self) -> Result<irradia_splat::Splats, TrainError> {
        let knobs = &self.recipe.init;
        let options = InitOptions {
            opacity: knobs.opacity,
            scale: knobs.scale,
            sh_degree: sh::MAX_DEGREE,
        };
        let dataset = self.dataset.clone();
        let splats = match dataset.points.as_ref().filter(|points| points.len() >= 10) {
            Some(points) => init::from_points(points, &options),
            None => {
                let views: Vec<&irradia_scene::View> = dataset.train.iter().map(|i| &dataset.views[*i]).collect();
                let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
                let bounds: Vec<Option<[f32; 2]>> = views.iter().map(|v| v.depth_bounds).collect();
                let mut photos: Vec<Option<Arc<Prepared>>> = vec![None; views.len()];
                for (i, photo) in photos.iter_mut().enumerate() {
                    let coming: Vec<usize> = dataset.train[i..].to_vec();
                    *photo = Some(self.photos.get(&coming, 1.0)?);
                }
                let mut rng = Rng::new(self.options.seed, STREAM_INIT);
                let points = init::random_points(&cameras, &bounds, knobs.random_points, &mut rng, |view, pixel| {
                    let photo = photos[view].as_ref().expect("loaded above");
                    let at = pixel.y as usize * photo.width as usize + pixel.x as usize;
                    let zero = |plane: &Option<Vec<u8>>| plane.as_ref().is_some_and(|plane| plane[at] == 0);
                    if zero(&photo.mask) {
                        Look::Masked
                    } else if zero(&photo.alpha) {
                        Look::Empty
                    } else {
                        Look::Color([0, 1, 2].map(|c| photo.rgb[3 * at + c]))
                    }
                });
                init::from_points(&points, &options)
            }
        };
        if splats.is_empty() {
            return Err(TrainError::NoPoints);
        }
        Ok(splats)
    }

    /// Steps this run will make, as far as is known.
    pub fn total_steps(&self) -> u64 {
        let left = (self.recipe.total_steps() as f64 - self.clock.time).max(0.0);
        self.clock.step + (left / self.pace - 1e-6).ceil().max(0.0) as u64
    }

    /// Whether the recipe is over.
    pub fn finished(&self) -> bool {
        self.clock.finished(&self.recipe)
    }

    /// Name of the present stage.
    pub fn stage_name(&self) -> &str {
        let stages = &self.recipe.stage;
        &stages[self.clock.stage.min(stages.len() - 1)].name
    }

    /// One step: batch, render, loss, gradients, update, density. Events are appended to `events`.
    ///
    /// # Errors
    /// When a photograph cannot be read.
    pub fn step(&mut self, events: &mut Vec<Event>) -> Result<StepReport, TrainError> {
        let plan = plan(&self.recipe, &self.clock);
        let coming = coming_views(&self.dataset.train, self.options.seed, &self.clock);
        let photo = self.photos.get(&coming, plan.image_scale)?;
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let mut camera = self.dataset.views[coming[0]].camera;
        camera.intrinsics = camera.intrinsics.scaled(plan.image_scale);
        let view = ViewParams::new(&camera);

        self.renderer
            .render(&self.state.splats, &view, &self.render_options(plan.sh_degree));
        let (loss, mse) = self.evaluate_loss(&photo, &plan);
        let alpha = (plan.alpha_weight > 0.0 && photo.alpha.is_some()).then_some(&self.v_alpha[..]);
        let v_out = OutputGradient {
            alpha,
            ..OutputGradient::of_color(&self.v_color)
        };
        self.renderer.backward(&self.state.splats, &v_out, &mut self.gradients);

        let mut rates = plan.rates;
        rates.means *= self.extent;
        let adam = &self.recipe.adam;
        let step = AdamStep {
            beta1: adam.beta1,
            beta2: adam.beta2,
            epsilon: adam.epsilon,
            step: self.clock.step + 1,
        };
        self.state
            .step(self.renderer.level, &self.gradients, &rates, plan.sh_degree, step);
        if plan.gathers {
            let renderer = &self.renderer;
            let extent = |i: usize| renderer.screen_extent(i).map_or(0.0, |e| e[0].max(e[1]));
            self.state
                .gather_statistics(&self.gradients, view.width, view.height, extent);
        }
        let visible = self.renderer.visible();
        if let Some(change) = self.control_density(&plan) {
            events.push(Event::densified(self.clock.step + 1, change, self.state.len()));
        }
        self.seconds += started.elapsed().as_secs_f64();
        self.cpu_seconds += cpu_started.elapsed().as_secs_f64();
        let stage_ended = self.clock.tick(&self.recipe, self.pace);
        if stage_ended && !self.finished() {
            events.push(Event::StageEntered {
                stage: self.stage_name().to_owned(),
                step: self.clock.step,
                seconds: self.seconds,
            });
        }
        Ok(StepReport {
            step: self.clock.step,
            seconds: self.seconds,
            view: coming[0],
            loss,
            mse,
            splats: self.state.len(),
            visible,
            non_finite: self.gradients.non_finite,
        })
    }

    /// How this run's frames are rendered, with SH up to `sh_degree`.
    pub fn render_options(&self, sh_degree: u32) -> RenderOptions {
        RenderOptions {
            background: self.recipe.render.background,
            sh_degree,
            antialias: self.recipe.render.antialias,
            depth: false,
        }
    }

    /// Loss and mean squared error; leaves the gradients in `v_color` and `v_alpha`.
    fn evaluate_loss(&mut self, photo: &Prepared, plan: &StepPlan) -> (f64, f64) {
        let (width, height) = (photo.width as usize, photo.height as usize);
        self.v_color.resize(3 * width * height, 0.0);
        let target = Target {
            width,
            height,
            truth: Truth::Rgb8(&photo.rgb),
            mask: photo.mask.as_deref(),
        };
        let weights = LossWeights::photometric(plan.ssim_weight);
        let values = self
            .loss
            .evaluate(self.renderer.color(), &target, &weights, &mut self.v_color);
        let mut total = values.total;
        if let Some(alpha) = photo.alpha.as_ref().filter(|_| plan.alpha_weight > 0.0) {
            let weight = plan.alpha_weight / (width * height) as f32;
            let mut sum = 0.0f64;
            self.v_alpha.clear();
            self.v_alpha
                .extend(self.renderer.alpha().iter().zip(alpha).map(|(got, want)| {
                    let difference = got - f32::from(*want) / 255.0;
                    sum += f64::from(difference.abs());
                    if difference == 0.0 {
                        0.0
                    } else {
                        weight * difference.signum()
                    }
                }));
            total += f64::from(weight) * sum;
        }
        (total, values.mse)
    }

    fn control_density(&mut self, plan: &StepPlan) -> Option<DensityChange> {
        let change = plan.densify.as_ref().map(|(density, prune_large)| match density {
            Density::Classic(knobs) => {
                let options = knobs.options(self.extent, *prune_large, self.recipe.max_splats);
                let mut rng = Rng::new(self.options.seed ^ self.clock.step << 20, STREAM_DENSIFY);
                classic::densify(&mut self.state, &options, &mut rng)
            }
        });
        if let Some(ceiling) = plan.reset_opacity {
            classic::reset_opacity(&mut self.state, ceiling);
        }
        change
    }
}
