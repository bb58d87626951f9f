//! The adaptive density control of 3DGS (Kerbl et al. 2023, section 5): where the image pulls hard on a splat's centre the
//! scene is not covered well; small splats there are cloned, large ones split; faint and oversized ones go.

use super::DensityChange;
use crate::{SplatState, Splats, logit, sigmoid};
use irradia_scene::Rng;

/// Knobs, with the Inria code's names and defaults in the docs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassicOptions {
    /// Mean screen gradient (normalised device coordinates) from which a splat is densified; `densify_grad_threshold` 0.0002.
    pub gradient_threshold: f32,
    /// World size that divides small from large; `percent_dense` 0.01 times the scene's extent.
    pub small: f32,
    /// Opacity below which a splat is removed; 0.005.
    pub min_opacity: f32,
    /// Half size on screen in pixels above which a splat is removed; `None` until opacities were reset once; 20 (pixels of radius).
    pub max_extent: Option<f32>,
    /// World size above which a splat is removed when `max_extent` acts; 0.1 times the scene's extent.
    pub max_scale: f32,
    /// Never more splats than this; the strongest gradients are served first.
    pub max_splats: usize,
}

/// Factor by which the two halves of a split splat are smaller: 0.8 times 2 (Inria code).
const SPLIT_SHRINK: f32 = 1.6;

/// Clones, splits and prunes; clears the statistics and restores Morton order.
pub fn densify(state: &mut SplatState, options: &ClassicOptions, rng: &mut Rng) -> DensityChange {
    let n = state.len();
    let splats = &state.splats;
    let largest_scale = |s: &Splats, i: usize| (0..3).map(|c| s.log_scales.get(c, i)).fold(f32::MIN, f32::max).exp();
    let mean_gradient =
        |i: usize| state.statistics.get(SplatState::GRADIENT, i) / state.statistics.get(SplatState::SEEN, i).max(1.0);

    let mut wanted: Vec<(f32, u32)> = (0..n)
        .map(|i| (mean_gradient(i), i as u32))
        .filter(|(g, _)| *g >= options.gradient_threshold)
        .collect();
    let room = options.max_splats.saturating_sub(n);
    if wanted.len() > room {
        wanted.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        wanted.truncate(room);
        wanted.sort_unstable_by_key(|(_, i)| *i);
    }
    let (clone, split): (Vec<u32>, Vec<u32>) = wanted
        .iter()
        .map(|(_, i)| *i)
        .partition(|i| largest_scale(splats, *i as usize) <= options.small);

    // Two draws from each split splat, smaller, in its place.
    let halves: Vec<u32> = split.iter().flat_map(|i| [*i, *i]).collect();
    let mut halves = splats.gather(&halves);
    for i in 0..halves.len() {
        let quat = glam::Quat::from_xyzw(
            halves.quats.get(1, i),
            halves.quats.get(2, i),
            halves.quats.get(3, i),
            halves.quats.get(0, i),
        );
        let offset = glam::Vec3::from_array(std::array::from_fn(|c| {
            halves.log_scales.get(c, i).exp() * rng.normal()
        }));
        let offset = quat.normalize() * offset;
        for c in 0..3 {
            halves.means.set(c, i, halves.means.get(c, i) + offset[c]);
            halves
                .log_scales
                .set(c, i, halves.log_scales.get(c, i) - SPLIT_SHRINK.ln());
        }
    }
    let clones = splats.gather(&clone);

    let mut removed = vec![false; n];
    for i in &split {
        removed[*i as usize] = true;
    }
    let mut pruned = 0;
    for (i, removed) in removed.iter_mut().enumerate().filter(|(_, removed)| !**removed) {
        let faint = sigmoid(splats.opacity_logits.get(0, i)) < options.min_opacity;
        let huge = options.max_extent.is_some_and(|limit| {
            state.statistics.get(SplatState::EXTENT, i) > limit || largest_scale(splats, i) > options.max_scale
        });
        let broken = !(0..3).all(|c| splats.means.get(c, i).is_finite() && splats.log_scales.get(c, i).is_finite());
        if faint || huge || broken {
            *removed = true;
            pruned += 1;
        }
    }
    let kept: Vec<u32> = (0..n as u32).filter(|i| !removed[*i as usize]).collect();
    state.gather(&kept);
    state.append(&clones);
    state.append(&halves);
    state.statistics.clear();
    state.sort_by_place();
    DensityChange {
        cloned: clone.len(),
        split: split.len(),
        pruned,
    }
}

/// Lowers every opacity to at most `ceiling` (0.01 in the Inria code) and forgets its moments: what the images need comes
/// back within a few hundred steps, what floats before the cameras does not.
pub fn reset_opacity(state: &mut SplatState, ceiling: f32) {
    let ceiling = logit(ceiling);
    for value in state.splats.opacity_logits.as_mut_slice() {
        *value = value.min(ceiling);
    }
    for moment in &mut state.moments {
        moment.opacity_logits.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> ClassicOptions {
        ClassicOptions {
            gradient_threshold: 1.0,
            small: 0.1,
            min_opacity: 0.005,
            max_extent: None,
            max_scale: 1.0,
            max_splats: 1000,
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
    fn small_ones_are_cloned_large_ones_split_faint_ones_go() {
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
    fn the_cap_holds_and_the_strongest_gradient_wins() {
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
    fn a_reset_lowers_only_what_is_higher() {
        let mut s = state(&[(0.0, 0.0, 3.0), (0.0, 0.0, -7.0)]);
        s.moments[0].opacity_logits.set(0, 0, 5.0);
        reset_opacity(&mut s, 0.01);
        assert!((s.splats.opacity(0) - 0.01).abs() < 1e-6);
        assert_eq!(s.splats.opacity_logits.get(0, 1), -7.0);
        assert_eq!(s.moments[0].opacity_logits.get(0, 0), 0.0);
    }
}
