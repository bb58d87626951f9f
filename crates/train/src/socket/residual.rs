//! At colour: a small field that adds to the splats' colours, by position and viewing direction.

use super::Occupant;
use crate::field_file;
use crate::recipe::{Param, ResidualKnobs};
use crate::schedule::StepPlan;
use crate::tensor_file::{NamedTensor, TensorSource};
use crate::trainer::TrainError;
use glam::Vec3;
use irradia_field::{Field, FieldState, ResidualQuery, Sampler, Space, StepOptions, residual_at, train_residual};
use irradia_splat::Surface;

/// Random stream, derived from the run's seed.
const STREAM_RESIDUAL: u64 = 8;

/// A residual field in training.
#[derive(Clone)]
pub struct Residual {
    state: FieldState,
    beta2: f32,
}

/// The colours that `field` adds to `surfaces` seen from `center`, world.
pub fn added_colors(field: &Field, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
    residual_at(field, &queries(field, center, surfaces), None)
}

/// Queries of `field` for `surfaces` seen from `center`.
pub(super) fn queries(field: &Field, center: Vec3, surfaces: &[Surface]) -> Vec<ResidualQuery> {
    let mirrored = matches!(field.config.sampler, Sampler::Given { mirrored: true });
    let sight = |surface: &Surface| {
        let view = (Vec3::from(surface.mean) - center).normalize_or_zero();
        let direction = if mirrored {
            let normal = Vec3::from(surface.normal);
            view - 2.0 * view.dot(normal) * normal
        } else {
            view
        };
        ResidualQuery {
            point: surface.mean,
            direction: direction.to_array(),
        }
    };
    surfaces.iter().map(sight).collect()
}

impl Residual {
    /// A field in `space` that adds nothing yet.
    ///
    /// # Errors
    /// When the field's configuration is invalid.
    pub fn new(knobs: &ResidualKnobs, space: Space, seed: u64) -> Result<Self, TrainError> {
        let field = Field::residual(knobs.net, knobs.mirrored, 0, space, seed ^ STREAM_RESIDUAL << 40)?;
        Ok(Self {
            state: FieldState::new(field),
            beta2: knobs.beta2,
        })
    }

    /// Whether it adds to the frame of `plan`. Once it has begun it stays active.
    pub fn acts(&self, plan: &StepPlan) -> bool {
        plan.is_on(Param::Residual) || self.state.step > 0
    }

    /// The field, once trained.
    pub fn learnt(&self) -> Option<&Field> {
        (self.state.step > 0).then_some(&self.state.field)
    }

    /// Forward: the colours to add to `surfaces` seen from `center`.
    pub fn colors(&self, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
        added_colors(&self.state.field, center, surfaces)
    }

    /// The vector-Jacobian product of [`Self::colors`] and a step of Adam, given the gradients of the colours.
    pub fn step(&mut self, center: Vec3, surfaces: &[Surface], v_colors: &[[f32; 3]], plan: &StepPlan) {
        let options = StepOptions {
            table_rate: plan.value(Param::RateTables),
            net_rate: plan.value(Param::RateNets),
            beta2: self.beta2,
            ..StepOptions::default()
        };
        let queries = queries(&self.state.field, center, surfaces);
        train_residual(&mut self.state, &queries, &[(None, 1.0)], v_colors, &options);
    }
}

impl Occupant for Residual {
    fn name(&self) -> &'static str {
        "residual"
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
        self.learnt().map(field_file::to_bytes)
    }
}
