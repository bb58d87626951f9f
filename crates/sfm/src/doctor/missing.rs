//! Matches that should be there and are not ([`crate::map::absent`]).

use super::motion::most_named;
use super::{Diagnosis, Evidence};
use crate::map::{ABSENT_PAIRS, absent};

/// Photographs that share nothing with others from nearly the same place: in the model, or in the one from which its parts were taken apart.
pub(super) fn missing(evidence: &Evidence) -> Vec<Diagnosis> {
    let Some(model) = evidence.model else { return Vec::new() };
    let (found, models) = match evidence.apart {
        Some(apart) => (apart.absent.clone(), apart.models),
        None => (absent(evidence.photos, model), 1),
    };
    if found.len() < ABSENT_PAIRS {
        return Vec::new();
    }
    let pairs: Vec<[u32; 2]> = found.iter().map(|pair| pair.photos.map(|p| p as u32)).collect();
    vec![Diagnosis::Missing {
        first: found[0].photos,
        photos: most_named(&pairs),
        expected: found[0].expected,
        models,
    }]
}
