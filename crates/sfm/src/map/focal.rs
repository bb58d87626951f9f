//! Focal lengths before any adjustment: from metadata, from pairs, or a common value.

use super::Unverified;
use super::types::{GroupCamera, PhotoInfo};
use super::verify::{Cameras, UncalibratedPair, centered_points, essential_from, select};
use crate::geometry::correspondences::Correspondences;
use crate::geometry::essential::{motions, refine_motion};
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Where a focal length comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FocalSource {
    /// The photographs' metadata.
    Prior,
    /// The pairs: the focal length that fits their matches best.
    Pairs,
    /// Neither: a common value, 1.2 times the long side unless another is tried.
    Guess,
}

/// The guess, relative to the long side (COLMAP's default).
pub(super) const DEFAULT_FOCAL: f64 = 1.2;
/// Candidates, relative to the long side: fields of view from 90 down to 8 degrees, in steps of 7 %.
const MIN_CANDIDATE: f64 = 0.5;
const CANDIDATE_STEP: f64 = 1.07;
const CANDIDATE_COUNT: i32 = 40;
/// Number of further candidates, up to a field of view of 126 degrees, that are tried if the first of those above is the best: 30
/// photographs of a white tree on a table by a webcam with a field of view of 116 degrees led to an entirely wrong model at 1.1 long
/// sides instead of 0.31. They are not tried otherwise, since wrong matches fit them as well: in a second attempt, those of a box fit
/// 0.4 % better at 0.29 than at the correct 0.8.
const WIDE_CANDIDATE_COUNT: i32 = 10;
/// Minimum ratio of the cost at the shortest candidate to the lowest cost for the further candidates to count: 1.09 to 2.2 where they are
/// right, 1.01 to 1.07 for turntables and few photographs, which any short focal length fits.
const MIN_WIDE_COST_RATIO: f64 = 1.1;
/// Maximum ratio of the cost at the metadata's focal length to the lowest cost for the metadata to be trusted.
const MAX_PRIOR_COST_RATIO: f64 = 1.25;
/// Ratio up to which the focal lengths of one camera in two models are the same. Two films of a brick car, with models of 507 and 218
/// frames: 1.0001 and 1.009.
const MAX_SIMILAR_RATIO: f64 = 1.02;
/// Ratio between a focal length and its initial value above which they are far apart. For frames of a brick car, the pairs say 0.6 long
/// sides; correct models end at 1.0, wrong ones, flat and far away, at 3 to 8.
const MAX_ADJUSTMENT_RATIO: f64 = 3.0;
/// Maximum number of pairs that vote, those with most inliers.
const MAX_VOTING_PAIRS: usize = 40;
/// Maximum number of pairs of known focal lengths whose fundamental matrices are estimated, to check these.
pub(super) const MAX_CHECKED_PAIRS: usize = 120;
/// Maximum number of points of each pair that votes.
const MAX_VOTING_POINTS: usize = 300;

/// Whether two models found the same focal length for a camera, px.
pub(super) fn are_similar(a: f64, b: f64) -> bool {
    a.max(b) < MAX_SIMILAR_RATIO * a.min(b)
}

/// Whether a focal length ended far from where it began, px.
pub(super) fn are_far_apart(a: f64, b: f64) -> bool {
    a.max(b) > MAX_ADJUSTMENT_RATIO * a.min(b)
}

/// The camera of each group.
pub(super) fn cameras(unverified: &Unverified, uncalibrated: &[&UncalibratedPair]) -> Cameras {
    let photos = unverified.photos;
    let groups = photos.iter().map(|p| p.group + 1).max().unwrap_or(0);
    (0..groups)
        .map(|group| {
            let members: Vec<&PhotoInfo> = photos.iter().filter(|p| p.group == group).collect();
            let Some(first) = members.first() else {
                return GroupCamera::centered(1, 1, 1.0, FocalSource::Guess);
            };
            let long_side = first.long_side();
            let mut priors: Vec<f64> = members.iter().filter_map(|p| p.focal_prior_px).collect();
            priors.sort_by(f64::total_cmp);
            let prior = priors.get(priors.len() / 2).map(|prior| prior / long_side);
            let (focal, source) = match (prior, estimate_focal(group, unverified, uncalibrated, prior)) {
                (Some(prior), None) => (prior, FocalSource::Prior),
                // The metadata of a photograph that was cropped or scaled later are wrong.
                (_, Some(focal)) => (focal, FocalSource::Pairs),
                (None, None) => (DEFAULT_FOCAL, FocalSource::Guess),
            };
            GroupCamera::centered(first.width, first.height, focal * long_side, source)
        })
        .collect()
}

/// The focal length, relative to the long side, at which essential matrices fit the pairs of a group best; `None` if all fit equally
/// well, or if `prior` fits nearly as well.
///
/// Each pair's fundamental matrix gives an essential matrix for each candidate, which is refined on the pair's inliers; the
/// candidate with the lowest sum of MSAC costs wins. Pairs that any focal length fits (planes, turns) add the same cost to all.
fn estimate_focal(
    group: usize,
    unverified: &Unverified,
    uncalibrated: &[&UncalibratedPair],
    prior: Option<f64>,
) -> Option<f64> {
    let Unverified { photos, pairs, .. } = *unverified;
    let mut voting_pairs: Vec<&UncalibratedPair> = uncalibrated
        .iter()
        .copied()
        .filter(|u| u.count >= 30 && pairs[u.pair].photos.iter().all(|p| photos[*p as usize].group == group))
        .collect();
    voting_pairs.sort_by_key(|u| (std::cmp::Reverse(u.count), u.pair));
    // Neighbours have the most inliers but the least parallax, so the voting pairs are spread evenly over the better half.
    let step = (voting_pairs.len() / 2 / MAX_VOTING_PAIRS).max(1);
    let voting_pairs: Vec<VotingPair> = voting_pairs
        .into_iter()
        .step_by(step)
        .take(MAX_VOTING_PAIRS)
        .map(|pair| VotingPair::new(pair, unverified))
        .collect();
    if voting_pairs.is_empty() {
        return None;
    }
    let totals = |focals: &[f64]| -> Vec<f64> {
        let of_pair = |pair: &VotingPair| focals.iter().map(|focal| pair.cost(*focal)).collect();
        let costs: Vec<Vec<f64>> = voting_pairs.par_iter().map(of_pair).collect();
        (0..focals.len()).map(|i| costs.iter().map(|c| c[i]).sum()).collect()
    };
    let lowest = |total: &[f64]| (0..total.len()).min_by(|a, b| total[*a].total_cmp(&total[*b]));
    let mut focals: Vec<f64> = (0..CANDIDATE_COUNT)
        .map(|i| MIN_CANDIDATE * CANDIDATE_STEP.powi(i))
        .collect();
    let mut total = totals(&focals);
    if lowest(&total) == Some(0) {
        let wider: Vec<f64> = (1..=WIDE_CANDIDATE_COUNT)
            .rev()
            .map(|i| MIN_CANDIDATE * CANDIDATE_STEP.powi(-i))
            .collect();
        total.splice(0..0, totals(&wider));
        focals.splice(0..0, wider);
        if total[0] < MIN_WIDE_COST_RATIO * total[lowest(&total)?] {
            return None;
        }
    }
    let best = lowest(&total)?;
    if prior.is_some_and(|prior| totals(&[prior])[0] < MAX_PRIOR_COST_RATIO * total[best]) {
        return None;
    }
    let worst = total.iter().fold(0.0f64, |m, x| m.max(*x));
    if best == 0 || best == total.len() - 1 || total[best] > 0.98 * worst {
        return None;
    }
    // The vertex of the parabola through the best candidate and its neighbours.
    let (before, at, after) = (total[best - 1], total[best], total[best + 1]);
    let offset = 0.5 * (before - after) / (before - 2.0 * at + after);
    Some(focals[best] * CANDIDATE_STEP.powf(if offset.is_finite() { offset } else { 0.0 }))
}

/// A pair that votes.
struct VotingPair {
    /// Its fundamental matrix.
    matrix: DMat3,
    /// Some of its inliers, centred and divided by the long side.
    points: Vec<[DVec2; 2]>,
    /// Maximum error of an inlier, relative to the long side.
    threshold: f64,
}

impl VotingPair {
    fn new(uncalibrated: &UncalibratedPair, unverified: &Unverified) -> Self {
        let Unverified {
            photos,
            features,
            pairs,
            options,
            ..
        } = *unverified;
        let pair = &pairs[uncalibrated.pair];
        let points = select(&centered_points(photos, features, pair), &uncalibrated.inliers);
        let step = points.len().div_ceil(MAX_VOTING_POINTS).max(1);
        let first = &photos[pair.photos[0] as usize];
        Self {
            matrix: uncalibrated.matrix,
            points: points.into_iter().step_by(step).collect(),
            // A quarter of the threshold: the remaining errors are those of the model, not wrong matches.
            threshold: 0.25 * options.max_epipolar_error / first.long_side(),
        }
    }

    /// The MSAC cost at a focal length relative to the long side.
    fn cost(&self, focal: f64) -> f64 {
        let start = motions(essential_from(self.matrix, focal, focal))[0];
        let scaled: Vec<[DVec2; 2]> = self.points.iter().map(|p| p.map(|x| x / focal)).collect();
        let threshold = self.threshold / focal;
        let motion = refine_motion(start, &scaled, 8.0 * threshold, 3).unwrap_or(start);
        let motion = refine_motion(motion, &scaled, 2.0 * threshold, 2).unwrap_or(motion);
        let (cost, _) = Correspondences::new(scaled).epipolar_cost(&motion.essential(), threshold);
        cost
    }
}
