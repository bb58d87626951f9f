//! The adaptive density control of 3DGS (Kerbl et al. 2023, section 5). A large screen gradient of a splat's centre indicates
//! an insufficiently covered region: small splats are cloned there, large ones split; faint and oversized ones are removed.

use super::DensityChange;
use super::split::{indices, is_finite, largest_scale, random_halves, without};
use crate::{SplatState, logit};
use irradia_scene::Rng;
use rayon::prelude::*;

/// Options; docs give the Inria code's names and defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassicOptions {
    /// Minimum mean screen gradient (normalised device coordinates) for a splat to be densified; `densify_grad_threshold` 0.0002.
    pub gradient_threshold: f32,
    /// World size that separates small splats from large ones; `percent_dense` 0.01 times the scene's extent.
    pub small: f32,
    /// Opacity below which a splat is removed; 0.005.
    pub min_opacity: f32,
    /// World size above which a splat is removed; `None` until opacities have been reset once; 0.1 times the scene's extent. The
    /// Inria code also intends to prune by size on screen, but zeroes those sizes before it compares them.
    pub max_scale: Option<f32>,
    /// Maximum number of splats; the largest gradients come first.
    pub max_splats: usize,
    /// Give both splats of a clone the opacity 1 - sqrt(1 - o), so that together they are as opaque as the original (Rota Bulo et
    /// al. 2024, eq. 9); 3DGS keeps o, which makes clones more opaque than the original.
    pub revised_opacity: bool,
}

/// Clones, splits and prunes; clears the statistics and restores Morton order.
pub fn densify(state: &mut SplatState, options: &ClassicOptions, rng: &mut Rng) -> DensityChange {
    let n = state.len();
    let splats = &state.splats;
    let mean_gradient = |i: usize| state.mean_statistic(SplatState::GRADIENT, i);

    let mut wanted: Vec<(f32, u32)> = (0..n)
        .into_par_iter()
        .map(|i| (mean_gradient(i), i as u32))
        .filter(|(g, _)| *g >= options.gradient_threshold)
        .collect();
    let room = options.max_splats.saturating_sub(n);
    if wanted.len() > room {
        wanted.par_sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        wanted.truncate(room);
        wanted.par_sort_unstable_by_key(|(_, i)| *i);
    }
    let (clone, split): (Vec<u32>, Vec<u32>) = wanted
        .iter()
        .map(|(_, i)| *i)
        .partition(|i| largest_scale(splats, *i as usize) <= options.small);

    let halves = random_halves(splats, &split, rng);
    let mut clones = splats.gather(&clone);
    if options.revised_opacity {
        for (copy, i) in clone.iter().enumerate() {
            let opacity = state.splats.opacity(*i as usize);
            // Below 1, where the logit is infinite.
            let shared = logit((1.0 - (1.0 - opacity).sqrt()).clamp(1e-4, 1.0 - f32::EPSILON));
            clones.opacity_logits.set(0, copy, shared);
            state.splats.opacity_logits.set(0, *i as usize, shared);
        }
    }
    let left = without((0..n as u32).collect(), &split);
    state.rebuild(left, &[&clones, &halves], &[], |_, _| false);
    DensityChange {
        cloned: clone.len(),
        split: split.len(),
        pruned: prune(state, options),
    }
}

/// Removes faint or oversized splats, including new ones; returns their number.
fn prune(state: &mut SplatState, options: &ClassicOptions) -> usize {
    let (n, splats) = (state.len(), &state.splats);
    let stays = |i: usize| {
        let oversized = options.max_scale.is_some_and(|limit| largest_scale(splats, i) > limit);
        splats.opacity(i) >= options.min_opacity && !oversized && is_finite(splats, i)
    };
    let kept = indices(n, stays);
    if kept.len() < n {
        state.gather(&kept);
    }
    n - kept.len()
}

/// Lowers every opacity to at most `ceiling` (0.01 in the Inria code) and resets its moments: opacities that the images need
/// recover within a few hundred steps, those of floaters in front of the cameras do not.
pub fn reset_opacity(state: &mut SplatState, ceiling: f32) {
    let ceiling = logit(ceiling);
    let logits = state.splats.opacity_logits.as_mut_slice();
    logits.par_iter_mut().for_each(|value| *value = value.min(ceiling));
    for moment in &mut state.moments {
        moment.opacity_logits.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Splats;

    fn options() -> ClassicOptions {
        ClassicOptions {
            gradient_threshold: 1.0,
            small: 0.1,
            min_opacity: 0.005,
            max_scale: None,
            max_splats: 1000,
            revised_opacity: false,
        }
    }

    /// Splats on the x axis with a given ln scale, gradient and logit.
    fn state(items: &[(f32, f32, f32)]) -> SplatState {
        let mut splats = Splats::zeros(items.len(), 0);
        for (i, (log_scale, _, logit)) in items.iter().enumerate() {
            splats.means.set(0, i, i as f32);
            splats.quats.set(0, i, 1.0);
            for c in 0..3 {
                splats.log_scales.set(c, i, *log_scale);
            }
            splats.opacity_logits.set(0, i, *logit);
        }
        let mut state = SplatState::new(splats);
        for (i, (_, gradient, _)) in items.iter().enumerate() {
            state.statistics.set(SplatState::GRADIENT, i, 2.0 * gradient);
            state.statistics.set(SplatState::SEEN, i, 2.0);
        }
        state
    }

    #[test]
    fn small_splats_are_cloned_large_ones_split_and_faint_ones_removed() {
        let mut s = state(&[(-5.0, 2.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.5, -9.0)]);
        let change = densify(&mut s, &options(), &mut Rng::new(1, 1));
        assert_eq!(
            change,
            DensityChange {
                cloned: 1,
                split: 1,
                pruned: 1
            }
        );
        assert_eq!(s.len(), 2 + 2 + 1);
        let scales: Vec<f32> = (0..5).map(|i| s.splats.log_scales.get(0, i)).collect();
        let halves = scales.iter().filter(|v| (**v + 1.6f32.ln()).abs() < 1e-6).count();
        assert_eq!((halves, scales.iter().filter(|v| **v == -5.0).count()), (2, 2));
        assert!(s.statistics.as_slice().iter().all(|v| *v == 0.0));
    }

    #[test]
    fn oversized_splats_are_removed_including_new_ones_whatever_their_size_on_screen() {
        let items = [(0.0, 0.5, 0.0), (2.0, 0.5, 0.0), (1.0, 2.0, 0.0), (0.6, 2.0, 0.0)];
        let limit = Some(1.2);
        for (max_scale, pruned, left) in [(None, 0, 6), (limit, 1 + 2, 3)] {
            let mut s = state(&items);
            (0..4).for_each(|i| s.statistics.set(SplatState::EXTENT, i, 1e4));
            let options = ClassicOptions { max_scale, ..options() };
            let change = densify(&mut s, &options, &mut Rng::new(1, 1));
            // Halves are smaller by a factor of 1.6: e becomes 1.70, e^0.6 becomes 1.14.
            assert_eq!((change.split, change.pruned, s.len()), (2, pruned, left));
        }
    }

    #[test]
    fn revised_clones_are_together_as_opaque_as_the_original() {
        let mut s = state(&[(-5.0, 2.0, logit(0.75))]);
        let options = ClassicOptions {
            revised_opacity: true,
            ..options()
        };
        densify(&mut s, &options, &mut Rng::new(1, 1));
        assert_eq!(s.len(), 2);
        let through: f32 = (0..2).map(|i| 1.0 - s.splats.opacity(i)).product();
        assert!((through - 0.25).abs() < 1e-5, "{through}");

        let mut opaque = state(&[(-5.0, 2.0, 400.0)]);
        densify(&mut opaque, &options, &mut Rng::new(1, 1));
        assert!((0..2).all(|i| opaque.splats.opacity_logits.get(0, i).is_finite()));
    }

    #[test]
    fn the_cap_is_respected_and_the_largest_gradient_comes_first() {
        let mut s = state(&[(-5.0, 2.0, 0.0), (-5.0, 3.0, 0.0), (-5.0, 4.0, 0.0)]);
        let change = densify(
            &mut s,
            &ClassicOptions {
                max_splats: 4,
                ..options()
            },
            &mut Rng::new(1, 1),
        );
        assert_eq!((change.cloned, s.len()), (1, 4));
        let at_two = (0..4).filter(|i| s.splats.means.get(0, *i) == 2.0).count();
        assert_eq!(at_two, 2);
    }

    #[test]
    fn a_reset_lowers_only_opacities_above_the_ceiling() {
        let mut s = state(&[(0.0, 0.0, 3.0), (0.0, 0.0, -7.0)]);
        s.moments[0].opacity_logits.set(0, 0, 5.0);
        reset_opacity(&mut s, 0.01);
        assert!((s.splats.opacity(0) - 0.01).abs() < 1e-6);
        assert_eq!(s.splats.opacity_logits.get(0, 1), -7.0);
        assert_eq!(s.moments[0].opacity_logits.get(0, 0), 0.0);
    }
}
