//! Density control: where splats are added and removed. One file a strategy.

pub mod classic;
pub mod fast;
pub mod mcmc;
pub mod merge;
mod split;
pub mod taming;

/// What one round of density control did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DensityChange {
    /// Splats copied where they stand.
    pub cloned: usize,
    /// Splats replaced by two smaller ones.
    pub split: usize,
    /// Splats removed.
    pub pruned: usize,
}
