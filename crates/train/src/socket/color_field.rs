//! A small field that adds to the splats' colours, by position and viewing direction. Both occupants of the socket at colour are such
//! fields.

use super::Occupant;
use crate::field_file;
use crate::recipe::{Param, ResidualSettings};
use crate::schedule::StepPlan;
use crate::tensor_file::{NamedTensor, TensorSource};
use crate::trainer::TrainError;
use glam::Vec3;
use irradia_field::{Field, FieldState, ResidualQuery, Sampler, Space, StepOptions, residual_at, train_residual};
use irradia_splat::Surface;

/// What is added: the field's outputs for images, or for the mean code, each times its factor.
pub(super) type Terms<'a> = &'a [(Option<u32>, f32)];

/// A field in training.
#[derive(Clone)]
pub(super) struct ColorField {
    name: &'static str,
    state: FieldState,
    beta2: f32,
}

impl ColorField {
    /// A field in `space` with codes for `images` photographs, if its network takes codes, that adds nothing yet; `name` is the occupant's.
    pub fn new(
        name: &'static str,
        settings: &ResidualSettings,
        images: usize,
        space: Space,
        seed: u64,
    ) -> Result<Self, TrainError> {
        let field = Field::residual(settings.net, settings.mirrored, images, space, seed)?;
        Ok(Self {
            name,
            state: FieldState::new(field),
            beta2: settings.beta2,
        })
    }

    /// The field, once trained.
    pub fn trained_field(&self) -> Option<&Field> {
        (self.state.step > 0).then_some(&self.state.field)
    }

    /// Forward: the colours to add to `surfaces` seen from `center`.
    pub fn colors(&self, terms: Terms, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
        added_colors(&self.state.field, terms, center, surfaces)
    }

    /// The vector-Jacobian product of [`Self::colors`] and a step of Adam, given the gradients of the colours.
    pub fn step(&mut self, terms: Terms, center: Vec3, surfaces: &[Surface], v_colors: &[[f32; 3]], plan: &StepPlan) {
        let options = StepOptions {
            table_rate: plan.value(Param::RateTables),
            net_rate: plan.value(Param::RateNets),
            code_rate: plan.value(Param::RateCodes),
            beta2: self.beta2,
            ..StepOptions::default()
        };
        let queries = queries(&self.state.field, center, surfaces);
        train_residual(&mut self.state, &queries, terms, v_colors, &options);
    }
}

impl Occupant for ColorField {
    fn name(&self) -> &'static str {
        self.name
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
        self.trained_field().map(field_file::to_bytes)
    }
}

/// The colours that `terms` of `field` add to `surfaces` seen from `center`, world.
pub(super) fn added_colors(field: &Field, terms: Terms, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
    let queries = queries(field, center, surfaces);
    let mut sum = vec![[0.0; 3]; surfaces.len()];
    for (image, factor) in terms {
        for (sum, added) in sum.iter_mut().zip(residual_at(field, &queries, *image)) {
            *sum = std::array::from_fn(|c| sum[c] + factor * added[c]);
        }
    }
    sum
}

/// Queries of `field` for `surfaces` seen from `center`.
fn queries(field: &Field, center: Vec3, surfaces: &[Surface]) -> Vec<ResidualQuery> {
    let mirrored = matches!(field.config.sampler, Sampler::Given { mirrored: true });
    let query = |surface: &Surface| {
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
    surfaces.iter().map(query).collect()
}
