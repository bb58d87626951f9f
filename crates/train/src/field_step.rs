//! A stage that trains a radiance field: its steps, and the initialisation of splats after it.

use crate::field_space::field_space;
use crate::photos::Prepared;
use crate::recipe::{FieldSettings, Param, Recipe};
use crate::schedule::{StepMetrics, StepPlan, plan, upcoming_views};
use crate::stream::Stream;
use crate::trainer::{TrainError, Trainer};
use crate::{event::StepReport, recipe::Represents};
use cpu_time::ProcessTime;
use irradia_field::{Background, Field, FieldState, KnownDepth, PointsOptions, StepOptions, TrainView, to_points};
use irradia_scene::{Camera, Dataset, LoadError};
use irradia_splat::{SplatState, init};
use std::sync::Arc;
use std::time::Instant;

/// Memory of all photographs, bytes, above which a step uses only some of them: 5,500 of 360 x 360.
pub const MAX_PHOTO_BYTES: usize = 2 << 30;
/// Bytes of a pixel of a training photograph: four channels, or three and a mask.
pub const BYTES_PER_PHOTO_PIXEL: usize = 4;
/// Number of photographs per step if all together exceed it.
const PHOTOS_PER_STEP: usize = 16;
/// Whether stage `stage` trains a field.
pub fn is_field(recipe: &Recipe, stage: usize) -> bool {
    let stage = &recipe.stage[stage.min(recipe.stage.len() - 1)];
    stage.represents == Represents::Field
}

/// The field of `settings` in the space determined by the dataset, and the reason for that space.
pub fn first_field(
    settings: &FieldSettings,
    dataset: &Dataset,
    transparent: bool,
    seed: u64,
) -> Result<(FieldState, String), TrainError> {
    let (space, why) = field_space(settings.space, dataset, transparent)?;
    let config = settings.config(dataset.train.len(), &space, transparent);
    let field = Field::new(config, space, Stream::Field.derived_seed(seed))?;
    Ok((FieldState::new(field), why))
}

impl Trainer {
    /// One step of the field: rays, loss, gradients, update.
    pub(crate) fn field_step(&mut self) -> Result<(StepReport, StepMetrics), TrainError> {
        let plan = plan(&self.recipe, &self.clock);
        let chosen = self.field_views();
        // The upcoming views are passed on, so that the photographs load in parallel.
        let photos: Vec<Arc<Prepared>> = (0..chosen.len())
            .map(|i| self.photos.get(&chosen[i..], plan.image_scale))
            .collect::<Result<_, _>>()?;
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let cameras: Vec<Camera> = chosen
            .iter()
            .map(|view| self.scaled_camera(*view, plan.image_scale))
            .collect();
        let depths: Vec<Arc<[KnownDepth]>> = chosen
            .iter()
            .zip(&cameras)
            .map(|(view, camera)| self.field_depths(*view, camera, &plan))
            .collect();
        let train = &self.dataset.train;
        let mut numbers = vec![0; self.dataset.views.len()];
        for (number, view) in train.iter().enumerate() {
            numbers[*view] = number as u32;
        }
        let views: Vec<TrainView> = chosen
            .iter()
            .zip(&photos)
            .zip(&cameras)
            .zip(&depths)
            .map(|(((view, photo), camera), depths)| TrainView {
                camera,
                rgb: &photo.rgb,
                alpha: photo.alpha.as_deref(),
                over: photo.background,
                mask: photo.mask.as_deref(),
                depths,
                image: numbers[*view],
            })
            .collect();
        let settings = self
            .recipe
            .field
            .as_ref()
            .expect("validated: a stage of field has its settings");
        let options = StepOptions {
            table_rate: plan.value(Param::RateTables),
            net_rate: plan.value(Param::RateNets),
            code_rate: plan.value(Param::RateCodes),
            beta2: settings.beta2,
            interlevel: plan.value(Param::InterlevelWeight),
            distortion: plan.value(Param::DistortionWeight),
            depth: plan.value(Param::DepthWeight),
            background: if plan.is_on(Param::RandomBackground) {
                Background::Random
            } else {
                Background::Fixed(self.recipe.render.background)
            },
            samples: settings.samples,
            update_occupancy: plan.update_occupancy,
            seed: self.options.seed,
        };
        let field = self.field.as_mut().expect("a stage of field has one");
        let loss = field.train_views(&views, &options);
        self.seconds += started.elapsed().as_secs_f64();
        self.cpu_seconds += cpu_started.elapsed().as_secs_f64();
        let metrics = StepMetrics {
            error: loss.color.sqrt(),
            measured: None,
            views: train.len() as u64,
        };
        let report = self.step_report(chosen[0], loss.total, loss.color);
        Ok((report, metrics))
    }

    /// [`Trainer::known_depths`] of a view, computed once per size: all views are used in each step.
    fn field_depths(&mut self, view: usize, camera: &Camera, plan: &StepPlan) -> Arc<[KnownDepth]> {
        if plan.value(Param::DepthWeight) <= 0.0 {
            return Arc::default();
        }
        let key = (view, camera.intrinsics.width, camera.intrinsics.height);
        if let Some(found) = self.depths.get(&key) {
            return found.clone();
        }
        let samples = self.known_depths(view, camera, plan).into_iter();
        let known: Arc<[KnownDepth]> = samples
            .map(|sample| KnownDepth {
                pixel: sample.pixel,
                depth: sample.depth,
            })
            .collect();
        self.depths.insert(key, known.clone());
        known
    }

    /// All training views if their photographs take little memory, else the upcoming ones.
    fn field_views(&self) -> Vec<usize> {
        let bytes: usize = self
            .dataset
            .train
            .iter()
            .map(|view| {
                let k = &self.dataset.views[*view].camera.intrinsics;
                BYTES_PER_PHOTO_PIXEL * k.width as usize * k.height as usize
            })
            .sum();
        if bytes <= MAX_PHOTO_BYTES {
            return self.dataset.train.clone();
        }
        let mut upcoming = upcoming_views(&self.dataset.train, self.options.seed, &self.clock);
        upcoming.truncate(PHOTOS_PER_STEP);
        upcoming
    }

    /// Initialises the splats of the current stage on the surfaces of the field trained before.
    ///
    /// # Errors
    /// When the field has no surface.
    pub(crate) fn field_to_splats(&mut self) -> Result<(), TrainError> {
        let (Some(field), Some(settings)) = (self.field.take(), &self.recipe.field) else {
            return Ok(());
        };
        let options = PointsOptions {
            count: settings.points.min(self.cap),
            seed: Stream::FieldPoints.derived_seed(self.options.seed),
            ..PointsOptions::default()
        };
        let scale = plan(&self.recipe, &self.clock).image_scale;
        let views = self.dataset.train.clone();
        let masks: Vec<Option<Vec<u8>>> = (0..views.len())
            .map(|i| Ok(self.photos.get(&views[i..], scale)?.mask.clone()))
            .collect::<Result<_, LoadError>>()?;
        let (started, cpu_started) = (Instant::now(), ProcessTime::now());
        let cameras: Vec<Camera> = views.iter().map(|view| self.scaled_camera(*view, scale)).collect();
        let cloud = to_points(&field.state().field, &cameras, &options, |view, pixel| {
            let at = pixel.y as usize * cameras[view].intrinsics.width as usize + pixel.x as usize;
            masks[view].as_ref().is_none_or(|mask| mask[at] > 0)
        });
        if cloud.is_empty() {
            return Err(TrainError::NoSurface);
        }
        *self.engine.state_mut() = SplatState::new(init::from_points(&cloud, &self.init_options()));
        self.seconds += started.elapsed().as_secs_f64();
        self.cpu_seconds += cpu_started.elapsed().as_secs_f64();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trainer::TrainOptions;
    use glam::Vec3;
    use irradia_scene::{Intrinsics, Photo, PointCloud, Pose, Rng, View};
    use irradia_splat::Renderer;

    const SIDE: u32 = 32;

    /// A grey wall at z = 0, whose photographs contain no depth cue, seen from an arc in front of it; every second of its points is
    /// known to be visible, the others are held out.
    fn wall() -> Dataset {
        let mut rng = Rng::new(1, 1);
        let positions: Vec<Vec3> = (0..400)
            .map(|_| Vec3::new(rng.range(-0.6, 0.6), rng.range(-0.6, 0.6), 0.0))
            .collect();
        let photo = Arc::new(Photo {
            width: SIDE,
            height: SIDE,
            channels: 3,
            data: vec![128; (3 * SIDE * SIDE) as usize],
            mask: None,
        });
        let views = (0..5).map(|i| {
            let angle = 0.25 * (i as f32 - 2.0);
            let eye = 3.0 * Vec3::new(angle.sin(), 0.0, -angle.cos());
            View {
                points_seen: (0..400).step_by(2).collect(),
                ..View::new(
                    i.to_string(),
                    Camera::new(
                        Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y),
                        Intrinsics::from_fov_x(SIDE, SIDE, 0.5),
                    ),
                    photo.clone(),
                )
            }
        });
        Dataset {
            views: views.collect(),
            train: (0..5).collect(),
            points: Some(PointCloud {
                colors: vec![[128; 3]; positions.len()],
                positions,
            }),
            ..Dataset::default()
        }
    }

    #[test]
    fn a_depth_weight_draws_a_field_to_known_points() {
        let dataset = Arc::new(wall());
        let text = Recipe::built_in("hashgrid").expect("it is");
        let error = |weight: f32| {
            let overrides = [
                "field.samples=4096".to_owned(),
                "field.sampler.side=32".to_owned(),
                "field.net.encoding.log2_table=12".to_owned(),
                "field.space=\"bounded\"".to_owned(),
                // So few steps do not clear a field that is initially dense.
                "field.opaque_density_bias=-1".to_owned(),
                format!("params.depth_weight={weight}"),
            ];
            let recipe = Recipe::parse("hashgrid", text, &overrides).expect("a recipe");
            let options = TrainOptions {
                steps: Some(100),
                ..TrainOptions::default()
            };
            let mut trainer = Trainer::new(dataset.clone(), recipe, options).expect("a trainer");
            while !trainer.finished() {
                trainer.step(&mut Vec::new()).expect("a step");
            }
            let look = irradia_splat::RenderOptions {
                depth: true,
                ..trainer.render_options(0)
            };
            let positions = &dataset.points.as_ref().expect("points").positions;
            let mut errors = Vec::new();
            for view in &dataset.views {
                let frame = trainer.scene().render(&mut Renderer::new(), &view.camera, &look);
                for point in positions.iter().skip(1).step_by(2) {
                    let (pixel, depth) = view.camera.project(*point).expect("in front of the camera");
                    if pixel.min_element() >= 0.0 && pixel.max_element() < SIDE as f32 {
                        let at = pixel.y as usize * SIDE as usize + pixel.x as usize;
                        errors.push((frame.depth[at] / frame.alpha[at].max(1e-6) - depth).abs());
                    }
                }
            }
            assert!(errors.len() > 800);
            errors.iter().sum::<f32>() / errors.len() as f32
        };
        let (with, without) = (error(1.0), error(0.0));
        eprintln!("mean error of depth at held-out points: {with:.3} with their weight, {without:.3} without");
        assert!(with < 0.25 && without > 3.0 * with, "{with} and {without}");
    }
}
