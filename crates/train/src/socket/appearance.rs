//! At colour: what the light of each photograph adds to the splats' colours, by position. A small field, whose network takes the photograph's
//! appearance code (Martin-Brualla et al. 2021; WildGaussians, Kulhanek et al. 2024), less what it outputs for the mean code: in the mean light, which
//! held-out views and exported scenes have, it adds nothing.

use super::Occupant;
use super::residual::queries;
use crate::field_file;
use crate::recipe::{Param, ResidualKnobs};
use crate::schedule::StepPlan;
use crate::tensor_file::{NamedTensor, TensorSource};
use crate::trainer::TrainError;
use glam::Vec3;
use irradia_field::{Field, FieldState, Space, StepOptions, residual_at, train_residual};
use irradia_splat::Surface;

/// Random stream, derived from the run's seed.
const STREAM_APPEARANCE: u64 = 9;

/// A field of light in training.
#[derive(Clone)]
pub struct Appearance {
    state: FieldState,
    beta2: f32,
}

impl Appearance {
    /// A field in `space`, with a code for each of `views`, that adds nothing yet.
    ///
    /// # Errors
    /// When the field's configuration is invalid.
    pub fn new(knobs: &ResidualKnobs, views: usize, space: Space, seed: u64) -> Result<Self, TrainError> {
        let seed = seed ^ STREAM_APPEARANCE << 40;
        let field = Field::residual(knobs.net, knobs.mirrored, views, space, seed)?;
        Ok(Self {
            state: FieldState::new(field),
            beta2: knobs.beta2,
        })
    }

    /// Whether it adds to the frame of `plan`. Once it has begun it stays active.
    pub fn acts(&self, plan: &StepPlan) -> bool {
        plan.value(Param::RateCodes) > 0.0 || self.state.step > 0
    }

    /// The terms of what `view` adds: images of the field and their factors.
    fn terms(view: usize) -> [(Option<u32>, f32); 2] {
        [(Some(view as u32), 1.0), (None, -1.0)]
    }

    /// Forward: the colours to add to `surfaces` seen from `center` in the light of `view`.
    pub fn colors(&self, view: usize, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
        let field = &self.state.field;
        let queries = queries(field, center, surfaces);
        let mut sum = vec![[0.0; 3]; surfaces.len()];
        for (image, factor) in Self::terms(view) {
            for (sum, added) in sum.iter_mut().zip(residual_at(field, &queries, image)) {
                *sum = std::array::from_fn(|c| sum[c] + factor * added[c]);
            }
        }
        sum
    }

    /// The vector-Jacobian product of [`Self::colors`] and a step of Adam, given the gradients of the colours.
    pub fn step(&mut self, view: usize, center: Vec3, surfaces: &[Surface], v_colors: &[[f32; 3]], plan: &StepPlan) {
        let options = StepOptions {
            table_rate: plan.value(Param::RateTables),
            net_rate: plan.value(Param::RateNets),
            code_rate: plan.value(Param::RateCodes),
            beta2: self.beta2,
            ..StepOptions::default()
        };
        let queries = queries(&self.state.field, center, surfaces);
        train_residual(&mut self.state, &queries, &Self::terms(view), v_colors, &options);
    }
}

impl Occupant for Appearance {
    fn name(&self) -> &'static str {
        "appearance"
    }

    fn tensors(&self) -> Vec<NamedTensor> {
        field_file::state_tensors(&self.state)
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        let Field { config, space, .. } = &self.state.field;
        self.state = field_file::state_from(config.clone(), *space, tensors)?;
        Ok(())
    }

    fn export(&self) -> Option<Vec<u8>> {
        (self.state.step > 0).then(|| field_file::to_bytes(&self.state.field))
    }
}
