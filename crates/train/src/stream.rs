//! The random streams of a run, all derived from its seed.

use irradia_scene::Rng;

/// What random numbers are drawn for: streams of the same seed are independent.
///
/// Results depend on the values, so a new use gets a new one. The noise of MCMC, drawn in `splat`, is on stream 4.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stream {
    /// Positions of the first splats if the dataset has no points.
    FirstSplats = 1,
    /// Density control, anew in each round.
    Density = 2,
    /// The order of the training views, anew in each pass over them.
    ViewOrder = 3,
    /// Background and crop of a step on splats, anew in each step.
    SplatStep = 5,
    /// Weights of a radiance field.
    Field = 6,
    /// Points on the surfaces of a field, as which a later stage of splats begins.
    FieldPoints = 7,
    /// Weights of the residual field.
    Residual = 8,
    /// Weights and codes of the field of appearance.
    Appearance = 9,
}

impl Stream {
    /// The generator of a run with `seed`.
    pub fn rng(self, seed: u64) -> Rng {
        Rng::new(seed, self as u64)
    }

    /// The generator of step `step`.
    pub fn step_rng(self, seed: u64, step: u64) -> Rng {
        self.rng(seed ^ (step << 20))
    }

    /// A seed for code that has streams of its own.
    pub fn derived_seed(self, seed: u64) -> u64 {
        seed ^ ((self as u64) << 40)
    }
}
