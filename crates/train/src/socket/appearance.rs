//! At colour: what the light of each photograph adds to the splats' colours, by position. This is the output of a small field, whose
//! network takes the photograph's appearance code (NeRF-W, Martin-Brualla et al. 2021; for splats WildGaussians, Kulhanek et al. 2024),
//! minus its output for the mean code: in the mean light, which held-out views and exported scenes have, it adds nothing.

use super::color_field::{self, ColorField};
use crate::recipe::{Param, ResidualSettings};
use crate::schedule::StepPlan;
use crate::stream::Stream;
use crate::trainer::TrainError;
use glam::Vec3;
use irradia_field::{Field, Space};
use irradia_splat::Surface;

/// The colours that `field` adds to `surfaces` seen from `center`, world, in the light of `view`.
pub(crate) fn lit_colors(field: &Field, view: usize, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
    color_field::added_colors(field, &terms(view), center, surfaces)
}

/// The light of photographs in training.
#[derive(Clone)]
pub struct Appearance(pub(super) ColorField);

/// The terms that are added in the light of `view`.
fn terms(view: usize) -> [(Option<u32>, f32); 2] {
    [(Some(view as u32), 1.0), (None, -1.0)]
}

impl Appearance {
    /// Name of the file beside the scene.
    pub const FILE: &str = "appearance.safetensors";

    /// A field in `space`, with a code for each of `views`, that adds nothing yet.
    ///
    /// # Errors
    /// When the field's configuration is invalid.
    pub fn new(settings: &ResidualSettings, views: usize, space: Space, seed: u64) -> Result<Self, TrainError> {
        ColorField::new(
            "appearance",
            settings,
            views,
            space,
            Stream::Appearance.derived_seed(seed),
        )
        .map(Self)
    }

    /// Whether it adds to the frame of `plan`. Once it has begun it stays active.
    pub fn is_active(&self, plan: &StepPlan) -> bool {
        plan.value(Param::RateCodes) > 0.0 || self.trained_field().is_some()
    }

    /// The field, once trained.
    pub fn trained_field(&self) -> Option<&Field> {
        self.0.trained_field()
    }

    /// Forward: the colours to add to `surfaces` seen from `center` in the light of `view`.
    pub fn colors(&self, view: usize, center: Vec3, surfaces: &[Surface]) -> Vec<[f32; 3]> {
        self.0.colors(&terms(view), center, surfaces)
    }

    /// The vector-Jacobian product of [`Self::colors`] and a step of Adam, given the gradients of the colours.
    pub fn step(&mut self, view: usize, center: Vec3, surfaces: &[Surface], v_colors: &[[f32; 3]], plan: &StepPlan) {
        self.0.step(&terms(view), center, surfaces, v_colors, plan);
    }
}
