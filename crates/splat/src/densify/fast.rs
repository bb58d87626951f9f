//! Densification by image error, to a planned number: splats that show errors in several views are split in two across their
//! longest axis, splats that contribute almost nothing are removed.
//!
//! It combines what made the fastest trainers fast. Error decides, not the gradient alone, and it is accumulated over all
//! views since the last round (FastGS, Ren et al. 2025; Rota Bulo et al. 2024); this is free here, since the backward pass
//! accumulates it beside the gradients. The number of splats follows a plan, with few splats while images are small
//! (DashGaussian, Chen et al. 2025). Halves preserve the image, so that no step is spent on recovery, and opacities are never reset.

use super::DensityChange;
use super::split::{indices, is_finite, long_axis_halves, without};
use crate::SplatState;
use irradia_compute::Planes;
use rayon::prelude::*;

/// Options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FastOptions {
    /// Maximum number of splats after the round.
    pub target: usize,
    /// Minimum number of finite splats that a round leaves: where photographs disagree, all splats fade.
    pub floor: usize,
    /// Opacity below which a splat is removed.
    pub min_opacity: f32,
    /// Mean weight per frame, in pixels, below which a splat is removed.
    pub min_weight: f32,
    /// Minimum number of frames in which a splat must have been in view to be removed for its weight.
    pub min_frames: f32,
    /// Minimum mean error per frame, mean absolute colour difference times pixels, for a splat to be split.
    pub error_threshold: f32,
    /// Minimum half size on screen, pixels, for a splat to be worth splitting.
    pub min_extent: f32,
}

/// Frames in which a splat must have been in view before it is split.
const MIN_FRAMES: f32 = 2.0;

/// Prunes and splits; restores Morton order, and clears the statistics of all splats but those in view too rarely to be split, which are
/// judged by those of several rounds.
pub fn densify(state: &mut SplatState, options: &FastOptions) -> DensityChange {
    let n = state.len();
    let stays = |i: usize| {
        let seen = state.statistics.get(SplatState::SEEN, i);
        let shows = seen < options.min_frames || state.mean_statistic(SplatState::WEIGHT, i) >= options.min_weight;
        shows && state.splats.opacity(i) >= options.min_opacity && is_finite(&state.splats, i)
    };
    let mut kept = indices(n, stays);
    if kept.len() < options.floor.min(n) {
        kept = top_by_weight(state, options.floor);
    }
    let left = kept.len();

    let room = options.target.saturating_sub(left);
    let mut wanted: Vec<(f32, u32)> = kept
        .par_iter()
        .filter(|i| {
            let i = **i as usize;
            state.statistics.get(SplatState::SEEN, i) >= MIN_FRAMES
                && state.statistics.get(SplatState::EXTENT, i) >= options.min_extent
        })
        .map(|i| (state.mean_statistic(SplatState::ERROR, *i as usize), *i))
        .filter(|(error, _)| *error >= options.error_threshold)
        .collect();
    if wanted.len() > room {
        wanted.select_nth_unstable_by(room, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        wanted.truncate(room);
    }
    let mut split: Vec<u32> = wanted.into_iter().map(|(_, i)| i).collect();
    split.par_sort_unstable();
    let halves = long_axis_halves(&state.splats, &split);
    let is_rare = |statistics: &Planes, i: u32| statistics.get(SplatState::SEEN, i as usize) < MIN_FRAMES;
    state.rebuild(without(kept, &split), &[&halves], &[], is_rare);
    DensityChange {
        cloned: 0,
        split: split.len(),
        pruned: n - left,
    }
}

/// The `count` finite splats with the largest mean weight, in ascending order of index.
fn top_by_weight(state: &SplatState, count: usize) -> Vec<u32> {
    let finite = (0..state.len()).filter(|i| is_finite(&state.splats, *i));
    let mut ranked: Vec<(f32, u32)> = finite
        .map(|i| (state.mean_statistic(SplatState::WEIGHT, i), i as u32))
        .collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ranked.truncate(count);
    let mut kept: Vec<u32> = ranked.into_iter().map(|(_, i)| i).collect();
    kept.sort_unstable();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Splats, logit};

    const OPTIONS: FastOptions = FastOptions {
        target: 4,
        floor: 0,
        min_opacity: 0.01,
        min_weight: 0.1,
        min_frames: 2.0,
        error_threshold: 1.0,
        min_extent: 2.0,
    };

    /// Splats of this opacity along the first axis.
    fn row(count: usize, spacing: f32, opacity: f32) -> Splats {
        let mut splats = Splats::zeros(count, 0);
        for i in 0..count {
            splats.means.set(0, i, spacing * i as f32);
            splats.quats.set(0, i, 1.0);
            splats.opacity_logits.set(0, i, logit(opacity));
        }
        splats
    }

    #[test]
    fn splats_with_errors_are_split_and_invisible_ones_removed() {
        let mut state = SplatState::new(row(4, 10.0, 0.5));
        for (i, (error, weight)) in [(5.0, 9.0), (0.1, 9.0), (3.0, 9.0), (0.0, 0.01)]
            .into_iter()
            .enumerate()
        {
            let at = (0..4)
                .find(|k| state.splats.means.get(0, *k) == 10.0 * i as f32)
                .unwrap();
            for (plane, value) in [
                (SplatState::SEEN, 4.0),
                (SplatState::EXTENT, 8.0),
                (SplatState::ERROR, 4.0 * error),
                (SplatState::WEIGHT, 4.0 * weight),
            ] {
                state.statistics.set(plane, at, value);
            }
        }
        let change = densify(&mut state, &OPTIONS);
        assert_eq!(
            (change.split, change.pruned, state.len()),
            (1, 1, 4),
            "the target leaves room for the splat of the largest error"
        );
        let near_zero = (0..4).filter(|i| state.splats.means.get(0, *i).abs() < 5.0).count();
        assert_eq!(near_zero, 2);
    }

    #[test]
    fn splats_that_are_rarely_in_view_are_judged_by_several_rounds() {
        let mut state = SplatState::new(row(2, 10.0, 0.5));
        let options = FastOptions {
            min_frames: 5.0,
            ..OPTIONS
        };
        // In one frame of each round, and in four of the other's, which hide it.
        for split in [0, 1] {
            for i in 0..2 {
                let first = state.splats.means.get(0, i) < 5.0;
                for (plane, value) in [
                    (SplatState::SEEN, if first { 1.0 } else { 4.0 }),
                    (SplatState::EXTENT, 8.0),
                    (SplatState::ERROR, if first { 3.0 } else { 0.0 }),
                ] {
                    let sum = state.statistics.get(plane, i) + value;
                    state.statistics.set(plane, i, sum);
                }
            }
            let change = densify(&mut state, &options);
            assert_eq!((change.split, change.pruned), (split, 0));
        }
    }

    #[test]
    fn splats_that_all_fade_are_kept_down_to_the_floor() {
        let mut splats = row(5, 1.0, 0.001);
        splats.means.set(1, 4, f32::NAN);
        let mut state = SplatState::new(splats);
        for (i, weight) in [3.0, 1.0, 4.0, 2.0, 9.0].into_iter().enumerate() {
            state.statistics.set(SplatState::SEEN, i, 2.0);
            state.statistics.set(SplatState::WEIGHT, i, weight);
        }
        let options = FastOptions {
            target: 9,
            floor: 2,
            min_opacity: 0.005,
            ..OPTIONS
        };
        assert_eq!(densify(&mut state, &options).pruned, 3);
        let mut left: Vec<f32> = (0..2).map(|i| state.splats.means.get(0, i)).collect();
        left.sort_by(f32::total_cmp);
        assert_eq!(left, [0.0, 2.0], "those of the largest weight");
        let none = FastOptions { floor: 0, ..options };
        assert_eq!(densify(&mut state, &none).pruned, 2, "faded");
    }
}
