//! At colour: a small field that adds to the splats' colours, by position and viewing direction.

use super::color_field::{self, ColorField, Terms};
use crate::recipe::{Param, ResidualSettings};
use crate::schedule::StepPlan;
use crate::stream::Stream;
use crate::trainer::TrainError;
use glam::Vec3;
use irradia_field::{Field, Space};
use irradia_splat::Surface;

/// The field's output, which is the same for all photographs.
const TERMS: Terms = &[(None, 1.0)];

/// A residual field in training.
#[derive(Clone)]
pub struct Residual(pub(super) ColorField);

/// The colours that `field` adds to `surfaces` seen from `center`, world.
pub fn added_colors(field: &Field, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
    color_field::added_colors(field, TERMS, center, surfaces)
}

impl Residual {
    /// Name of the file beside the scene.
    pub const FILE: &str = "residual.safetensors";

    /// A field in `space` that adds nothing yet.
    ///
    /// # Errors
    /// When the field's configuration is invalid.
    pub fn new(settings: &ResidualSettings, space: Space, seed: u64) -> Result<Self, TrainError> {
        ColorField::new("residual", settings, 0, space, Stream::Residual.derived_seed(seed)).map(Self)
    }

    /// Whether it adds to the frame of `plan`. Once it has begun it stays active.
    pub fn is_active(&self, plan: &StepPlan) -> bool {
        plan.is_on(Param::Residual) || self.trained_field().is_some()
    }

    /// The field, once trained.
    pub fn trained_field(&self) -> Option<&Field> {
        self.0.trained_field()
    }

    /// Forward: the colours to add to `surfaces` seen from `center`.
    pub fn colors(&self, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
        self.0.colors(TERMS, center, surfaces)
    }

    /// The vector-Jacobian product of [`Self::colors`] and a step of Adam, given the gradients of the colours.
    pub fn step(&mut self, center: Vec3, surfaces: &[Surface], v_colors: &[[f32; 3]], plan: &StepPlan) {
        self.0.step(TERMS, center, surfaces, v_colors, plan);
    }
}
