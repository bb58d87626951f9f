//! Encodings of positions and directions as features for a small network.

use serde::{Deserialize, Serialize};

pub mod direction;
pub mod frequency;
pub mod hash_grid;

pub use direction::DirectionEncoding;
pub use frequency::Frequency;
pub use hash_grid::HashGrid;

/// How positions are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum PositionEncoding {
    /// Sines and cosines (NeRF).
    Frequency(Frequency),
    /// Interpolated tables (Instant-NGP).
    HashGrid(HashGrid),
}

impl PositionEncoding {
    /// Number of features, unpadded.
    pub fn features(&self) -> usize {
        match self {
            Self::Frequency(f) => f.features(),
            Self::HashGrid(g) => g.levels * g.features,
        }
    }

    /// Number of trained parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Frequency(_) => 0,
            Self::HashGrid(g) => g.parameters(),
        }
    }
}
