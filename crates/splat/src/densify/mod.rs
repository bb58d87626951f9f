//! Density control: where splats are added and removed. One file per strategy.

pub mod classic;
pub mod fast;
pub mod mcmc;
pub mod merge;
mod split;
pub mod taming;

pub(crate) use split::is_finite;

/// The outcome of one round of density control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DensityChange {
    /// Splats cloned in place.
    pub cloned: usize,
    /// Splats replaced by two smaller ones.
    pub split: usize,
    /// Splats removed.
    pub pruned: usize,
}
