use super::{MatchOptions, match_descriptors};
use crate::Features;
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Which pairs of photographs are matched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairOptions {
    /// Up to this many photographs, all pairs. Default 60.
    pub all_up_to: usize,
    /// Partners of each photograph where there are more photographs, the most promising ones. Default 30.
    pub partners: usize,
    /// Number of the largest features of each photograph that are compared to find partners. Default 400.
    pub compared: usize,
    /// Photographs follow one another in time: each is also paired with this many successors, and with those 1, 2, 4, .. 64
    /// photographs later. Default 0, which pairs none of these.
    pub successors: usize,
}

impl Default for PairOptions {
    fn default() -> Self {
        Self {
            all_up_to: 60,
            partners: 30,
            compared: 400,
            successors: 0,
        }
    }
}

/// Pairs of photographs worth matching, ascending.
///
/// Beyond [`PairOptions::all_up_to`] photographs, the largest features of each pair are matched (Wu, "Towards Linear-time Incremental
/// Structure from Motion", 2013: a few large features show whether photographs overlap), and each photograph is paired with those that
/// have the most matches.
pub fn candidate_pairs(features: &[Features], options: &PairOptions, matching: &MatchOptions) -> Vec<[u32; 2]> {
    let n = features.len() as u32;
    let all: Vec<[u32; 2]> = (0..n).flat_map(|i| (i + 1..n).map(move |j| [i, j])).collect();
    if features.len() <= options.all_up_to {
        return all;
    }
    let counts: Vec<usize> = all
        .par_iter()
        .map(|pair| {
            let [a, b] = pair.map(|i| {
                let descriptors = &features[i as usize].descriptors;
                &descriptors[..descriptors.len().min(options.compared)]
            });
            match_descriptors(a, b, matching).len()
        })
        .collect();
    let mut partners: Vec<Vec<(usize, u32)>> = vec![Vec::new(); features.len()];
    for (&[i, j], &count) in all.iter().zip(&counts) {
        if count > 0 {
            partners[i as usize].push((count, j));
            partners[j as usize].push((count, i));
        }
    }
    let mut chosen = BTreeSet::new();
    for (i, partners) in (0u32..).zip(&mut partners) {
        partners.sort_by_key(|(count, j)| (std::cmp::Reverse(*count), *j));
        partners.truncate(options.partners);
        chosen.extend(partners.iter().map(|(_, j)| [i.min(*j), i.max(*j)]));
        let doubled = (0..).map(|k| 1 << k).take_while(|step| *step <= 64);
        let steps = (1..=options.successors as u32).chain(doubled.filter(|_| options.successors > 0));
        chosen.extend(steps.filter(|step| i + step < n).map(|step| [i, i + step]));
    }
    chosen.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DESCRIPTOR_BYTES;

    /// Photographs on a line: each shares half of its features with the next.
    fn chain(n: usize) -> Vec<Features> {
        let descriptor = |number: usize| -> [u8; DESCRIPTOR_BYTES] {
            std::array::from_fn(|i| {
                if ((number * 2_654_435_761) >> (i % 32)) & 1 == 1 {
                    64
                } else {
                    0
                }
            })
        };
        (0..n)
            .map(|photo| Features {
                descriptors: (photo * 10..photo * 10 + 20).map(descriptor).collect(),
                ..Features::default()
            })
            .collect()
    }

    #[test]
    fn few_photographs_are_all_paired_and_many_with_their_neighbours() {
        let photos = chain(12);
        let (mut options, matching) = (PairOptions::default(), MatchOptions::default());
        assert_eq!(candidate_pairs(&photos, &options, &matching).len(), 66);
        options.all_up_to = 0;
        options.partners = 2;
        let pairs = candidate_pairs(&photos, &options, &matching);
        assert!((0..11).all(|i| pairs.contains(&[i, i + 1])), "{pairs:?}");
        assert!(pairs.len() < 40 && pairs.is_sorted());
        options.partners = 0;
        options.successors = 1;
        let film = candidate_pairs(&photos, &options, &matching);
        assert!(film.contains(&[3, 4]) && film.contains(&[3, 11]) && !film.contains(&[3, 6]));
    }
}
