//! Loops of three pairs: the rotations of pairs that are right close.

use super::types::VerifiedPair;
use glam::DQuat;
use std::collections::BTreeMap;

/// Maximum angle of a loop of three pairs that agree, radians: the error of two-view rotations with a guessed focal length
/// (Zach, Klopschitz and Pollefeys, "Disambiguating visual relations using loop constraints", 2010, allow 2 to 5 degrees per pair).
pub(super) const MAX_LOOP_ERROR_RADIANS: f64 = 0.17;

/// `[pairs]` the weighted fraction, in \[0, 1\], of the loops of three pairs through each pair that close; 0.5 without any loop.
pub(crate) fn closed_loop_fractions(photos: usize, pairs: &[VerifiedPair], measured: &[DQuat]) -> Vec<f64> {
    let mut pairs_of: Vec<BTreeMap<usize, usize>> = vec![BTreeMap::new(); photos];
    for (i, pair) in pairs.iter().enumerate() {
        let [a, b] = pair.photos.map(|p| p as usize);
        pairs_of[a].insert(b, i);
    }
    let mut counts = vec![[0.0f64; 2]; pairs.len()];
    for (a, partners) in pairs_of.iter().enumerate() {
        for (b, ab) in partners {
            for (c, bc) in &pairs_of[*b] {
                let Some(ac) = pairs_of[a].get(c) else { continue };
                let closes = (measured[*bc] * measured[*ab]).angle_between(measured[*ac]) < MAX_LOOP_ERROR_RADIANS;
                for (pair, others) in [(*ab, [*bc, *ac]), (*bc, [*ab, *ac]), (*ac, [*ab, *bc])] {
                    let weight = others.map(|o| pairs[o].matches.len()).into_iter().min().unwrap_or(0) as f64;
                    counts[pair][0] += if closes { weight } else { 0.0 };
                    counts[pair][1] += weight;
                }
            }
        }
    }
    counts
        .iter()
        .map(|[closed, all]| if *all > 0.0 { closed / all } else { 0.5 })
        .collect()
}
