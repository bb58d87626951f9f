//! Densification to an exact number by score: "Taming 3DGS" (Mallick et al. 2024), on the statistics accumulated during
//! training. Each round adds the number of splats that the count curve prescribes, where the scores are high.

use super::DensityChange;
use super::split::{draw_distinct, indices, is_finite, largest_scale, random_halves, without};
use crate::SplatState;
use irradia_scene::Rng;
use rayon::prelude::*;

/// Options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TamingOptions {
    /// Number of splats after this round, before it removes any.
    pub target: usize,
    /// Minimum mean screen gradient (normalised device coordinates) for a splat to be densified; 0.0002.
    pub gradient_threshold: f32,
    /// World size that separates splats to clone from splats to split.
    pub small: f32,
    /// Opacity below which a splat may be removed; 0.005.
    pub min_opacity: f32,
    /// World size above which a splat may be removed; `None` until opacities have been reset once; 0.1 times the scene's extent.
    pub max_scale: Option<f32>,
    /// Whether the round removes splats; the authors' first 27 rounds do.
    pub prunes: bool,
    /// Weights of the score.
    pub weights: ScoreWeights,
}

/// Weights of the terms of a splat's score, each term relative to its median over the splats that have it. The authors'
/// depth, distance and number of pixels are omitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScoreWeights {
    /// Mean screen gradient; 25.
    pub gradient: f32,
    /// Mean error shown; 10, their "loss".
    pub error: f32,
    /// Mean blending weight; 50.
    pub weight: f32,
    /// Opacity; 100.
    pub opacity: f32,
    /// Half size on screen; 10, their "radii".
    pub extent: f32,
    /// Product of the standard deviations; 25, their "scale".
    pub volume: f32,
}

/// Added to scores before inversion, to avoid division by zero.
const SCORE_EPSILON: f32 = 1e-6;

/// Number of splats after a round, starting from `now`: on the parabola that rises fastest at first and has its vertex at `last`
/// when the stage ends (eq. 2). `completed` is the fraction of the stage completed, now and at the previous round.
pub fn next_count(now: usize, last: usize, completed: [f64; 2]) -> usize {
    let [left, left_before] = completed.map(|s| (1.0 - s.clamp(0.0, 1.0)).powi(2));
    let room = last as f64 - now as f64;
    (last as f64 - room * (left / left_before.max(1e-9)).min(1.0)).round() as usize
}

/// Adds splats up to the target by score, then removes some of the faint or oversized ones; clears the statistics and restores
/// Morton order. Splats that are not finite are always removed.
pub fn densify(state: &mut SplatState, options: &TamingOptions, rng: &mut Rng) -> DensityChange {
    let n = state.len();
    let finite = indices(n, |i| is_finite(&state.splats, i));
    if finite.len() < n {
        state.gather(&finite);
    }
    let scores = scores(state, &options.weights);
    let [clone, split] = select(state, options, &scores, rng);
    let mut pruned = select_pruned(state, options, &scores, rng);
    // Splats that were split are already gone.
    pruned.retain(|i| split.binary_search(i).is_err());
    let halves = random_halves(&state.splats, &split, rng);
    let clones = state.splats.gather(&clone);
    let mut gone = [&split[..], &pruned[..]].concat();
    gone.sort_unstable();
    let left = without((0..state.len() as u32).collect(), &gone);
    state.rebuild(left, &[&clones, &halves], &[], |_, _| false);
    DensityChange {
        cloned: clone.len(),
        split: split.len(),
        pruned: n - finite.len() + pruned.len(),
    }
}

/// Splats to clone and to split, ascending: the same fraction of the small and of the large candidates, drawn by score.
fn select(state: &SplatState, options: &TamingOptions, scores: &[f32], rng: &mut Rng) -> [Vec<u32>; 2] {
    let qualifies = |i: usize| state.mean_statistic(SplatState::GRADIENT, i) >= options.gradient_threshold;
    let is_small = |i: usize| largest_scale(&state.splats, i) <= options.small;
    let qualified: Vec<usize> = (0..state.len()).filter(|i| qualifies(*i)).collect();
    let room = options.target.saturating_sub(state.len()).min(qualified.len());
    [true, false].map(|small| {
        let mut weights = vec![0.0; state.len()];
        let mut count = 0;
        for i in qualified.iter().filter(|i| is_small(**i) == small) {
            weights[*i] = scores[*i];
            count += 1;
        }
        draw_distinct(&weights, room * count / qualified.len().max(1), rng)
    })
}

/// Splats to remove, ascending: half as many splats as are faint or oversized are drawn from all, preferably those with low scores;
/// of those drawn, the faint or oversized ones are removed.
fn select_pruned(state: &SplatState, options: &TamingOptions, scores: &[f32], rng: &mut Rng) -> Vec<u32> {
    if !options.prunes {
        return Vec::new();
    }
    let splats = &state.splats;
    let useless = |i: usize| {
        splats.opacity(i) < options.min_opacity
            || options.max_scale.is_some_and(|limit| largest_scale(splats, i) > limit)
    };
    let count = (0..state.len()).filter(|i| useless(*i)).count() / 2;
    let weights: Vec<f32> = scores.iter().map(|score| 1.0 / (SCORE_EPSILON + score)).collect();
    let mut drawn = draw_distinct(&weights, count, rng);
    drawn.retain(|i| useless(*i as usize));
    drawn
}

/// The weighted sum of the terms, each divided by its median; zero for splats that no frame has seen.
fn scores(state: &SplatState, weights: &ScoreWeights) -> Vec<f32> {
    let n = state.len();
    let mut scores = vec![0.0f32; n];
    let mut add = |weight: f32, part: &(dyn Fn(usize) -> f32 + Sync)| {
        let values: Vec<f32> = (0..n).into_par_iter().map(part).collect();
        let mut positive: Vec<f32> = values
            .par_iter()
            .copied()
            .filter(|v| *v > 0.0 && v.is_finite())
            .collect();
        if weight == 0.0 || positive.is_empty() {
            return;
        }
        let middle = positive.len() / 2;
        let median = *positive.select_nth_unstable_by(middle, f32::total_cmp).1;
        let add = |(score, value): (&mut f32, f32)| *score += weight * value / median;
        scores.par_iter_mut().zip(values).for_each(add);
    };
    add(weights.gradient, &|i| state.mean_statistic(SplatState::GRADIENT, i));
    add(weights.error, &|i| state.mean_statistic(SplatState::ERROR, i));
    add(weights.weight, &|i| state.mean_statistic(SplatState::WEIGHT, i));
    add(weights.opacity, &|i| state.splats.opacity(i));
    add(weights.extent, &|i| state.statistics.get(SplatState::EXTENT, i));
    add(weights.volume, &|i| {
        (0..3).map(|c| state.splats.log_scales.get(c, i)).sum::<f32>().exp()
    });
    for (i, score) in scores.iter_mut().enumerate() {
        if state.statistics.get(SplatState::SEEN, i) == 0.0 {
            *score = 0.0;
        }
    }
    scores
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Splats, logit};

    fn options(target: usize) -> TamingOptions {
        TamingOptions {
            target,
            gradient_threshold: 2.0,
            small: 0.5,
            min_opacity: 0.005,
            max_scale: None,
            prunes: false,
            weights: ScoreWeights {
                gradient: 25.0,
                error: 10.0,
                weight: 50.0,
                opacity: 100.0,
                extent: 10.0,
                volume: 25.0,
            },
        }
    }

    /// 40 splats on the x axis, the first four faint, every second one large; a gradient of x; the last ten seen by no frame.
    fn state() -> SplatState {
        let mut splats = Splats::zeros(40, 0);
        for i in 0..40 {
            splats.means.set(0, i, i as f32);
            splats.quats.set(0, i, 1.0);
            let size = if i % 2 == 0 { 1.0f32 } else { 0.1 };
            (0..3).for_each(|c| splats.log_scales.set(c, i, size.ln()));
            splats.opacity_logits.set(0, i, logit(if i < 4 { 0.001 } else { 0.5 }));
        }
        let mut s = SplatState::new(splats);
        for i in 0..40 {
            let x = s.splats.means.get(0, i);
            if x < 30.0 {
                s.statistics.set(SplatState::SEEN, i, 2.0);
                s.statistics.set(SplatState::GRADIENT, i, 2.0 * x);
            }
        }
        s
    }

    #[test]
    fn the_count_is_exact_and_only_large_gradients_are_densified() {
        let mut s = state();
        let change = densify(&mut s, &options(50), &mut Rng::new(1, 1));
        // Of the 28 candidates, x from 2 to 29, half are small and half are large.
        assert_eq!((s.len(), change.cloned, change.split, change.pruned), (50, 5, 5, 0));
        let mut s = state();
        densify(&mut s, &options(500), &mut Rng::new(1, 1));
        assert_eq!(s.len(), 40 + 28, "no more than the candidates");
        let small = |s: &SplatState, x: f32| (0..s.len()).filter(|i| s.splats.means.get(0, *i) == x).count();
        assert_eq!([1.0, 3.0, 29.0, 31.0].map(|x| small(&s, x)), [1, 2, 2, 1]);
    }

    #[test]
    fn half_of_the_removable_are_drawn_lowest_scores_first() {
        let prunes = TamingOptions {
            max_scale: Some(0.5),
            prunes: true,
            ..options(0)
        };
        let mut s = state();
        let change = densify(&mut s, &prunes, &mut Rng::new(1, 1));
        // 22 are faint or large, so 11 are drawn; the ten unseen ones, whose score is 0, come first, and five of them are large.
        assert!((5..=6).contains(&change.pruned), "{change:?}");
        assert_eq!(s.len(), 40 - change.pruned);
        let unseen = (0..s.len()).filter(|i| s.splats.means.get(0, *i) > 29.5).count();
        assert_eq!(unseen, 5);
        let none = densify(
            &mut state(),
            &TamingOptions {
                prunes: false,
                ..prunes
            },
            &mut Rng::new(1, 1),
        );
        assert_eq!(none.pruned, 0);
    }

    #[test]
    fn the_count_follows_the_parabola_for_any_rounds() {
        assert_eq!(next_count(100, 500, [0.5, 0.0]), 400);
        assert_eq!(next_count(400, 500, [1.0, 0.5]), 500);
        let halfway = next_count(next_count(100, 500, [0.25, 0.0]), 500, [0.5, 0.25]);
        assert_eq!(halfway, 400);
    }
}
