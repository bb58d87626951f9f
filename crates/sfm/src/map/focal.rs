//! Focal lengths before any adjustment: from metadata, from the pairs, or a common value.

use super::types::{MapOptions, PhotoInfo};
use super::verify::{Cameras, Uncalibrated, centered_points, essential_from, select};
use crate::geometry::camera::DCamera;
use crate::geometry::correspondences::Correspondences;
use crate::geometry::essential::{motions, refine_motion};
use crate::{Features, PairMatches};
use glam::DVec2;
use rayon::prelude::*;

/// Where a focal length comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The photographs' metadata.
    Prior,
    /// The pairs: it fits their matches best.
    Pairs,
    /// A common value, 1.2 times the long side.
    Guess,
}

/// The guess, in long sides (COLMAP's default).
pub(super) const GUESS: f64 = 1.2;
/// Candidates, in long sides: a field of view of 90 to 8 degrees, in steps of 7 %.
const FIRST: f64 = 0.5;
const STEP: f64 = 1.07;
const CANDIDATES: usize = 40;
/// The cost at which metadata are still believed, by the lowest.
const PRIOR: f64 = 1.25;
/// Ratio up to which focal lengths of one camera in two models are alike. Two films of a car of bricks, models of 507 and 218 frames: 1.0001 and 1.009.
const ALIKE: f64 = 1.02;
/// Ratio between a focal length and its first value from which on they are far apart. Frames of a car of bricks: the pairs say 0.6 long sides; right models end at 1.0, wrong
/// ones, flat and far away, at 3 to 8.
const FAR: f64 = 3.0;
/// Pairs that vote, those with most inliers, and points of each.
const VOTERS: usize = 40;
/// Pairs among which voters are found when all photographs have metadata.
pub(super) const ENOUGH: usize = 120;
const POINTS: usize = 300;

/// Whether two models found one focal length, px, for a camera.
pub(super) fn are_alike(a: f64, b: f64) -> bool {
    a.max(b) < ALIKE * a.min(b)
}

/// Whether a focal length, px, ended far from where it began.
pub(super) fn are_far(a: f64, b: f64) -> bool {
    a.max(b) > FAR * a.min(b)
}

/// The camera of each group.
pub(super) fn cameras(
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    uncalibrated: &[&Uncalibrated],
    options: &MapOptions,
) -> Cameras {
    let groups = photos.iter().map(|p| p.group + 1).max().unwrap_or(0);
    (0..groups)
        .map(|group| {
            let members: Vec<&PhotoInfo> = photos.iter().filter(|p| p.group == group).collect();
            let Some(first) = members.first() else {
                return (DCamera::centered(1, 1, 1.0), Source::Guess);
            };
            let long_side = f64::from(first.width.max(first.height));
            let mut priors: Vec<f64> = members.iter().filter_map(|p| p.focal_prior_px).collect();
            priors.sort_by(f64::total_cmp);
            let prior = priors.get(priors.len() / 2).map(|prior| prior / long_side);
            let (focal, source) = match (
                prior,
                vote(group, photos, features, pairs, uncalibrated, prior, options),
            ) {
                (Some(prior), None) => (prior, Source::Prior),
                // Metadata of a picture that was cropped or scaled later are wrong.
                (_, Some(focal)) => (focal, Source::Pairs),
                (None, None) => (GUESS, Source::Guess),
            };
            let focal = focal * long_side;
            (DCamera::centered(first.width, first.height, focal), source)
        })
        .collect()
}

/// The focal length, in long sides, at which essential matrices fit the pairs of a group best; `None` if all fit alike, or if
/// `prior` fits nearly as well.
///
/// Each pair's fundamental matrix gives an essential matrix for each candidate, which is refined on the pair's inliers; the
/// candidate with the lowest sum of MSAC costs wins. Pairs that any focal length fits (planes, turns) add the same to all.
fn vote(
    group: usize,
    photos: &[PhotoInfo],
    features: &[Features],
    pairs: &[PairMatches],
    uncalibrated: &[&Uncalibrated],
    prior: Option<f64>,
    options: &MapOptions,
) -> Option<f64> {
    let mut voters: Vec<&Uncalibrated> = uncalibrated
        .iter()
        .copied()
        .filter(|u| u.count >= 30 && pairs[u.pair].photos.iter().all(|p| photos[*p as usize].group == group))
        .collect();
    voters.sort_by_key(|u| (std::cmp::Reverse(u.count), u.pair));
    // Neighbours have most inliers but the least parallax: every third of the better half.
    let step = (voters.len() / 2 / VOTERS).max(1);
    let candidates: [f64; CANDIDATES + 1] = std::array::from_fn(|i| match (i, prior) {
        (CANDIDATES, Some(prior)) => prior,
        _ => FIRST * STEP.powi(i as i32),
    });
    let costs: Vec<[f64; CANDIDATES + 1]> = voters
        .into_iter()
        .step_by(step)
        .take(VOTERS)
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|voter| {
            let pair = &pairs[voter.pair];
            let mut points = select(&centered_points(photos, features, pair), &voter.inliers);
            let thin = points.len().div_ceil(POINTS).max(1);
            points = points.into_iter().step_by(thin).collect();
            let side = f64::from(
                photos[pair.photos[0] as usize]
                    .width
                    .max(photos[pair.photos[0] as usize].height),
            );
            // A quarter of the threshold: what is left are errors of the model, not wrong matches.
            let threshold = 0.25 * options.max_epipolar_error / side;
            candidates.map(|focal| cost(voter, &points, focal, threshold))
        })
        .collect();
    if costs.is_empty() {
        return None;
    }
    let total: [f64; CANDIDATES + 1] = std::array::from_fn(|i| costs.iter().map(|c| c[i]).sum::<f64>());
    let best = (0..CANDIDATES).reduce(|best, i| if total[i] < total[best] { i } else { best })?;
    if prior.is_some() && total[CANDIDATES] < PRIOR * total[best] {
        return None;
    }
    let worst = total[..CANDIDATES].iter().fold(0.0f64, |m, x| m.max(*x));
    if best == 0 || best == CANDIDATES - 1 || total[best] > 0.98 * worst {
        return None;
    }
    // The vertex of the parabola through the best candidate and its neighbours.
    let (before, at, after) = (total[best - 1], total[best], total[best + 1]);
    let offset = 0.5 * (before - after) / (before - 2.0 * at + after);
    Some(FIRST * STEP.powf(best as f64 + if offset.is_finite() { offset } else { 0.0 }))
}

/// The mean MSAC cost of a pair at a focal length.
fn cost(voter: &Uncalibrated, points: &[[DVec2; 2]], focal: f64, threshold: f64) -> f64 {
    let start = motions(essential_from(voter.matrix, focal, focal))[0];
    let scaled: Vec<[DVec2; 2]> = points.iter().map(|p| p.map(|x| x / focal)).collect();
    let motion = refine_motion(start, &scaled, 8.0 * threshold / focal, 3).unwrap_or(start);
    let motion = refine_motion(motion, &scaled, 2.0 * threshold / focal, 2).unwrap_or(motion);
    let (cost, _) = Correspondences::new(scaled).epipolar_cost(&motion.essential(), threshold / focal);
    cost
}
