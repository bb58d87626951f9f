//! Densification to an exact number by score: "Taming 3DGS" (Mallick et al. 2024), on the statistics that training
//! gathers. Each round adds what the count's curve asks for, where the scores are high.

use super::DensityChange;
use super::split::{draw_distinct, is_finite, largest_scale, random_halves, rebuild, without};
use crate::SplatState;
use irradia_scene::Rng;

/// Knobs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TamingOptions {
    /// How many splats there shall be after this round.
    pub target: usize,
    /// World size that divides what is cloned from what is split.
    pub small: f32,
    /// Opacity below which a splat is removed; 0.005.
    pub min_opacity: f32,
    /// Weights of the score.
    pub weights: ScoreWeights,
}

/// How much each part of a splat's score counts, each part relative to its median over all splats. Defaults are the
/// authors' for the parts that exist here; their saliency maps and view-space depth spread are left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScoreWeights {
    /// Mean screen gradient; 50.
    pub gradient: f32,
    /// Mean error shown; 50, their "loss".
    pub error: f32,
    /// Pixels covered, weighted; 0.1.
    pub pixels: f32,
    /// Opacity; 100.
    pub opacity: f32,
    /// Half size on screen; 10.
    pub extent: f32,
    /// World size; 25.
    pub scale: f32,
}

/// How many splats there shall be after a round: on the parabola that rises fastest at first and has its vertex at `last`
/// when the stage ends (eq. 2), from `now` on. `share` is how much of the stage lies behind, now and at the round before.
pub fn next_count(now: usize, last: usize, share: [f64; 2]) -> usize {
    let [left, left_before] = share.map(|s| (1.0 - s.clamp(0.0, 1.0)).powi(2));
    let room = last as f64 - now as f64;
    (last as f64 - room * (left / left_before.max(1e-9)).min(1.0)).round() as usize
}

/// Removes what is faint, then adds up to the target by score; clears the statistics and restores Morton order.
pub fn densify(state: &mut SplatState, options: &TamingOptions, rng: &mut Rng) -> DensityChange {
    let n = state.len();
    let kept: Vec<u32> = (0..n as u32)
        .filter(|i| state.splats.opacity(*i as usize) >= options.min_opacity && is_finite(&state.splats, *i as usize))
        .collect();
    state.gather(&kept);
    let scores = scores(state, &options.weights);
    let wanted = options.target.saturating_sub(state.len());
    let chosen = draw_distinct(&scores, wanted, rng);
    let (clone, split): (Vec<u32>, Vec<u32>) = chosen
        .iter()
        .partition(|i| largest_scale(&state.splats, **i as usize) <= options.small);
    let halves = random_halves(&state.splats, &split, rng);
    let clones = state.splats.gather(&clone);
    let left = without(state.len(), &split);
    rebuild(state, &left, &[&clones, &halves]);
    DensityChange {
        cloned: clone.len(),
        split: split.len(),
        pruned: n - kept.len(),
    }
}

/// The weighted sum of the parts, each over its median; zero for what no frame has seen.
fn scores(state: &SplatState, weights: &ScoreWeights) -> Vec<f32> {
    let n = state.len();
    let mut scores = vec![0.0f32; n];
    let mut add = |weight: f32, part: &dyn Fn(usize) -> f32| {
        let values: Vec<f32> = (0..n).map(part).collect();
        let mut positive: Vec<f32> = values.iter().copied().filter(|v| *v > 0.0 && v.is_finite()).collect();
        if weight == 0.0 || positive.is_empty() {
            return;
        }
        let middle = positive.len() / 2;
        let median = *positive.select_nth_unstable_by(middle, f32::total_cmp).1;
        for (score, value) in scores.iter_mut().zip(values) {
            *score += weight * value / median;
        }
    };
    add(weights.gradient, &|i| state.mean_statistic(SplatState::GRADIENT, i));
    add(weights.error, &|i| state.mean_statistic(SplatState::ERROR, i));
    add(weights.pixels, &|i| state.mean_statistic(SplatState::WEIGHT, i));
    add(weights.opacity, &|i| state.splats.opacity(i));
    add(weights.extent, &|i| state.statistics.get(SplatState::EXTENT, i));
    add(weights.scale, &|i| largest_scale(&state.splats, i));
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

    #[test]
    fn the_count_is_exact_and_the_unseen_are_not_copied() {
        let mut splats = Splats::zeros(40, 0);
        for i in 0..40 {
            splats.means.set(0, i, i as f32);
            splats.quats.set(0, i, 1.0);
            splats.opacity_logits.set(0, i, logit(if i < 4 { 0.001 } else { 0.5 }));
        }
        let mut s = SplatState::new(splats);
        for i in 0..40 {
            let x = s.splats.means.get(0, i);
            if x < 30.0 {
                s.statistics.set(SplatState::SEEN, i, 2.0);
                s.statistics.set(SplatState::GRADIENT, i, x);
            }
        }
        let options = TamingOptions {
            target: 50,
            small: 0.5,
            min_opacity: 0.005,
            weights: ScoreWeights {
                gradient: 50.0,
                error: 50.0,
                pixels: 0.1,
                opacity: 100.0,
                extent: 10.0,
                scale: 25.0,
            },
        };
        let change = densify(&mut s, &options, &mut Rng::new(1, 1));
        assert_eq!((s.len(), change.pruned, change.cloned + change.split), (50, 4, 14));
        let unseen = (0..50).filter(|i| s.splats.means.get(0, *i) > 33.5).count();
        assert_eq!(unseen, 6, "those that no frame saw are left as they are");
    }

    #[test]
    fn the_count_follows_its_parabola_whatever_the_rounds() {
        assert_eq!(next_count(100, 500, [0.5, 0.0]), 400);
        assert_eq!(next_count(400, 500, [1.0, 0.5]), 500);
        let halfway = next_count(next_count(100, 500, [0.25, 0.0]), 500, [0.5, 0.25]);
        assert_eq!(halfway, 400);
    }
}
