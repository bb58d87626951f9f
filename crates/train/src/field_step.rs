//! A stage of radiance field: its steps, and how splats begin where it ends.

use crate::photos::Prepared;
use crate::recipe::{FieldKnobs, FieldSpace, Recipe};
use crate::schedule::{Signal, coming_views, plan};
use crate::trainer::{TrainError, Trainer};
use crate::{event::StepReport, recipe::Represents};
use cpu_time::ProcessTime;
use irradia_field::{
    Background, Field, FieldState, PointsOptions, Space, StepOptions, TrainView, to_points, train_views,
};
use irradia_scene::{Camera, Dataset, PointCloud};
use irradia_splat::{SplatState, init};
use std::sync::Arc;
use std::time::Instant;

/// Streams of the run's seed.
const STREAM_FIELD: u64 = 6;
const STREAM_POINTS: u64 = 7;
/// Photographs of a step where all of them do not fit into memory.
const SHARED: usize = 16;
/// Share of the depth bounds' near plane that is left as a margin (NeRF's code: 0.9).
const NEAR_MARGIN: f32 = 0.9;

/// Whether the stage that a run stands in trains a field.
pub fn is_field(recipe: &Recipe, stage: usize) -> bool {
    let stage = &recipe.stage[stage.min(recipe.stage.len() - 1)];
    stage.represents == Represents::Field
}

/// The field that `knobs` ask for around what `cameras` see.
pub fn first_field(
    knobs: &FieldKnobs,
    dataset: &Dataset,
    cameras: &[Camera],
    transparent: bool,
    seed: u64,
) -> Result<FieldState, TrainError> {
    let bounds: Option<Vec<[f32; 2]>> = dataset.train.iter().map(|i| dataset.views[*i].depth_bounds).collect();
    let kind = match (knobs.space, &bounds) {
        (FieldSpace::Auto, Some(bounds)) if !bounds.is_empty() => FieldSpace::Ndc,
        (FieldSpace::Auto, _) if transparent => FieldSpace::Bounded,
        (FieldSpace::Auto, _) => FieldSpace::Unbounded,
        (kind, _) => kind,
    };
    let space = match kind {
        FieldSpace::Ndc => {
            let nearest = bounds.iter().flatten().map(|b| b[0]).fold(f32::INFINITY, f32::min);
            let near = if nearest.is_finite() {
                NEAR_MARGIN * nearest
            } else {
                cameras[0].near
            };
            Space::ndc(cameras, near)
        }
        FieldSpace::Bounded => Space::around(cameras, false),
        FieldSpace::Auto | FieldSpace::Unbounded => Space::around(cameras, true),
    };
    let space = space.ok_or(TrainError::NoSpace)?;
    let config = knobs.config(dataset.train.len(), &space);
    let field = Field::new(config, space, seed ^ STREAM_FIELD << 40)?;
    Ok(FieldState::new(field))
}

impl Trainer {
    /// One step of the field: rays, loss, gradients, update.
    pub(crate) fn field_step(&mut self) -> Result<(StepReport, Signal), TrainError> {
        let plan = plan(&self.recipe, &self.clock);
        let chosen = self.field_views();
        // What comes next is named, so that the photographs load side by side.
        let photos: Vec<Arc<Prepared>> = (0..chosen.len())
            .map(|i| self.photos.get(&chosen[i..], plan.image_scale))
            .collect::<Result<_, _>>()?;
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let cameras: Vec<Camera> = chosen
            .iter()
            .map(|view| self.scaled_camera(*view, plan.image_scale))
            .collect();
        let train = &self.dataset.train;
        let number = |view: &usize| train.iter().position(|v| v == view).unwrap_or(0) as u32;
        let views: Vec<TrainView> = chosen
            .iter()
            .zip(&photos)
            .zip(&cameras)
            .map(|((view, photo), camera)| TrainView {
                camera,
                rgb: &photo.rgb,
                alpha: photo.alpha.as_deref(),
                over: photo.background,
                mask: photo.mask.as_deref(),
                depth: None,
                image: number(view),
            })
            .collect();
        let knobs = self
            .recipe
            .field
            .as_ref()
            .expect("validated: a stage of field has its knobs");
        let options = StepOptions {
            table_rate: plan.field.tables,
            net_rate: plan.field.nets,
            code_rate: plan.field.codes,
            beta2: knobs.beta2,
            interlevel: plan.field.interlevel,
            distortion: plan.field.distortion,
            depth: 0.0,
            background: if plan.random_background {
                Background::Random
            } else {
                Background::Fixed(self.recipe.render.background)
            },
            samples: knobs.samples,
            look: plan.field.look,
            seed: self.options.seed,
        };
        let state = self.field.as_mut().expect("a stage of field has one");
        let loss = train_views(state, &views, &options);
        self.seconds += started.elapsed().as_secs_f64();
        self.cpu_seconds += cpu_started.elapsed().as_secs_f64();
        let signal = Signal {
            error: loss.color.sqrt(),
            measured: None,
            views: train.len() as u64,
        };
        let report = StepReport {
            step: self.clock.step + 1,
            seconds: self.seconds,
            seconds_left: 0.0,
            view: chosen[0],
            loss: loss.total,
            mse: loss.color,
            splats: 0,
            visible: 0,
            non_finite: 0,
        };
        Ok((report, signal))
    }

    /// All training views where their photographs fit into memory, else those that come next.
    fn field_views(&self) -> Vec<usize> {
        let bytes: usize = self
            .dataset
            .train
            .iter()
            .map(|view| {
                let k = &self.dataset.views[*view].camera.intrinsics;
                5 * k.width as usize * k.height as usize
            })
            .sum();
        if bytes <= self.options.photo_budget {
            return self.dataset.train.clone();
        }
        let mut coming = coming_views(&self.dataset.train, self.options.seed, &self.clock);
        coming.truncate(SHARED);
        coming
    }

    /// Begins the splats of the stage that the run stands in with the surfaces of the field that was trained before.
    ///
    /// # Errors
    /// When the field shows no surface.
    pub(crate) fn field_to_splats(&mut self) -> Result<(), TrainError> {
        let (Some(state), Some(knobs)) = (self.field.take(), &self.recipe.field) else {
            return Ok(());
        };
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let cameras = self.train_cameras();
        let options = PointsOptions {
            count: knobs.points.min(self.cap),
            seed: self.options.seed ^ STREAM_POINTS << 40,
            ..PointsOptions::default()
        };
        let found = to_points(&state.field, &cameras, &options);
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let cloud = PointCloud {
            positions: found.positions.iter().map(|p| glam::Vec3::from_array(*p)).collect(),
            colors: found.colors.iter().map(|c| c.map(byte)).collect(),
        };
        if cloud.is_empty() {
            return Err(TrainError::NoSurface);
        }
        self.state = SplatState::new(init::from_points(&cloud, &self.init_options()));
        self.seconds += started.elapsed().as_secs_f64();
        self.cpu_seconds += cpu_started.elapsed().as_secs_f64();
        Ok(())
    }
}
