//! A field while it is trained.

use crate::config::FieldConfig;
use crate::field::{Field, FieldError};
use crate::net::NetParameters;
use crate::space::Space;
use crate::tensors::{Tensors, fill, named};

/// A field while it is trained: with both moments of Adam.
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
    /// Steps made.
    pub step: u64,
    /// Rays of the next batch that [`crate::train_views`] draws.
    pub rays: usize,
    /// Gradients and buffers, which carry nothing from one step to the next.
    pub(crate) scratch: crate::train::Scratch,
}

impl FieldState {
    /// Nothing trained yet.
    pub fn new(field: Field) -> Self {
        let zeros: Vec<_> = field.parameters.iter().map(NetParameters::zeros_like).collect();
        let nothing = |list: &[f32]| [0, 1].map(|_| vec![0.0; list.len()]);
        Self {
            moments: [zeros.clone(), zeros],
            code_moments: nothing(&field.codes),
            background_moments: nothing(&field.background),
            step: 0,
            rays: FIRST_RAYS,
            scratch: crate::train::Scratch::default(),
            field,
        }
    }

    /// The field's tensors and the moments': a checkpoint, with [`Self::step`] and [`Self::rays`]. Nothing else is carried
    /// from one step to the next: whatever is random follows from the seed and the step.
    pub fn tensors(&self) -> Tensors<'_> {
        let mut list = self.field.tensors();
        for (k, prefix) in PREFIXES.into_iter().enumerate() {
            let lists = [&self.code_moments[k][..], &self.background_moments[k]];
            list.extend(named(prefix, &self.moments[k], lists));
        }
        list
    }

    /// The state of [`Self::tensors`] after `step` steps, with `rays` in the next batch.
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
        for (k, prefix) in PREFIXES.into_iter().enumerate() {
            let lists = [&mut state.code_moments[k][..], &mut state.background_moments[k]];
            fill(prefix, &mut state.moments[k], lists, &mut get)?;
        }
        (state.step, state.rays) = (step, rays);
        Ok(state)
    }
}

/// A field that knows nothing yet is full of fog: few rays are many samples.
const FIRST_RAYS: usize = 128;

const PREFIXES: [&str; 2] = ["first.", "second."];
