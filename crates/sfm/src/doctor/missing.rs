//! Matches that should exist and do not ([`crate::map::absent`]).

use super::motion::most_named;
use super::{Diagnosis, Evidence};
use crate::map::ABSENT_PAIRS;

/// Photographs that share nothing with others from nearly the same place, in the model or in the folded model that was split into
/// parts.
pub(super) fn missing(evidence: &Evidence) -> Vec<Diagnosis> {
    if evidence.absent.len() < ABSENT_PAIRS {
        return Vec::new();
    }
    let first = evidence.absent[0];
    let pairs: Vec<[u32; 2]> = evidence.absent.iter().map(|pair| pair.photos).collect();
    vec![Diagnosis::Missing {
        first: first.photos.map(|p| p as usize),
        photos: most_named(&pairs),
        expected: first.expected,
        models: evidence.apart.unwrap_or(1),
    }]
}
