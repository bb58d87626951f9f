//! Matches that should exist and do not ([`crate::map::missing_matches`]).

use super::motion::photos_by_pair_count;
use super::{Diagnosis, Evidence};
use crate::map::MIN_MISSING_PAIRS;

/// Photographs that share nothing with others from nearly the same place, in the model or in the folded model that was split into
/// parts.
pub(super) fn missing(evidence: &Evidence) -> Vec<Diagnosis> {
    if evidence.missing.len() < MIN_MISSING_PAIRS {
        return Vec::new();
    }
    let first = evidence.missing[0];
    let pairs: Vec<[u32; 2]> = evidence.missing.iter().map(|pair| pair.photos).collect();
    vec![Diagnosis::Missing {
        first: first.photos.map(|p| p as usize),
        photos: photos_by_pair_count(&pairs),
        expected: first.expected,
        models: evidence.split_models.unwrap_or(1),
    }]
}
