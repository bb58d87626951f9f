//! The training state of a field.

use crate::config::FieldConfig;
use crate::field::{Field, FieldError};
use crate::net::NetParameters;
use crate::space::Space;
use crate::tensors::{Tensors, fill, named};
use crate::train::MAX_RAYS;

/// A field in training, with both moments of Adam.
#[derive(Clone, Debug)]
pub struct FieldState {
    /// The field.
    pub field: Field,
    /// First and second moments of the networks.
    pub moments: [Vec<NetParameters<f32>>; 2],
    /// First and second moments of the codes.
    pub code_moments: [Vec<f32>; 2],
    /// First and second moments of the background.
    pub background_moments: [Vec<f32>; 2],
    /// Steps taken.
    pub step: u64,
    /// Rays in the next batch of [`crate::train_views`].
    pub rays: usize,
    /// Gradients and buffers, which carry no state from one step to the next.
    pub(crate) scratch: crate::train::Scratch,
}

impl FieldState {
    /// The state before the first step.
    pub fn new(field: Field) -> Self {
        let zeros: Vec<_> = field.parameters.iter().map(NetParameters::zeros_like).collect();
        let no_moments = |list: &[f32]| [0, 1].map(|_| vec![0.0; list.len()]);
        Self {
            moments: [zeros.clone(), zeros],
            code_moments: no_moments(&field.codes),
            background_moments: no_moments(&field.background),
            step: 0,
            rays: INITIAL_RAYS,
            scratch: crate::train::Scratch::default(),
            field,
        }
    }

    /// The tensors of the field and of the moments: together with [`Self::step`] and [`Self::rays`] a complete checkpoint, since random
    /// numbers depend only on the seed and the step.
    pub fn tensors(&self) -> Tensors<'_> {
        let mut list = self.field.tensors();
        for (k, prefix) in MOMENT_PREFIXES.into_iter().enumerate() {
            let lists = [&self.code_moments[k][..], &self.background_moments[k]];
            list.extend(named(prefix, &self.moments[k], lists));
        }
        list
    }

    /// Restores the state of [`Self::tensors`] after `step` steps, with `rays` in the next batch, at most as many as a batch may have.
    ///
    /// # Errors
    /// As [`Field::from_tensors`].
    pub fn from_tensors(
        config: FieldConfig,
        space: Space,
        step: u64,
        rays: usize,
        mut get: impl FnMut(&str) -> Option<Vec<f32>>,
    ) -> Result<Self, FieldError> {
        let mut state = Self::new(Field::from_tensors(config, space, &mut get)?);
        for (k, prefix) in MOMENT_PREFIXES.into_iter().enumerate() {
            let lists = [&mut state.code_moments[k][..], &mut state.background_moments[k]];
            fill(prefix, &mut state.moments[k], lists, &mut get)?;
        }
        (state.step, state.rays) = (step, rays.min(MAX_RAYS));
        Ok(state)
    }
}

/// An untrained field is dense everywhere, so that few rays yield many samples.
const INITIAL_RAYS: usize = 128;

const MOMENT_PREFIXES: [&str; 2] = ["first.", "second."];
