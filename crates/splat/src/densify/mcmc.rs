//! Splats as samples of a distribution: "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024). Dead
//! splats are relocated to live ones, the number grows to a fixed budget, and noise explores.

use super::DensityChange;
use super::split::{draw, indices, is_finite};
use crate::{SplatState, Splats, logit, sigmoid};
use irradia_scene::Rng;
use rayon::prelude::*;

/// Options, with the authors' names and defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct McmcOptions {
    /// Opacity up to which a splat is dead; 0.005.
    pub min_opacity: f32,
    /// Growth factor of the number of splats per round; 1.05.
    pub growth: f32,
    /// Maximum number of splats; `cap_max`.
    pub max_splats: usize,
}

/// Relocates dead splats and adds new ones; restores Morton order and clears the statistics.
pub fn densify(state: &mut SplatState, options: &McmcOptions, rng: &mut Rng) -> DensityChange {
    let n = state.len();
    let opacities: Vec<f32> = (0..n)
        .into_par_iter()
        .map(|i| {
            let opacity = state.splats.opacity(i);
            let alive = opacity > options.min_opacity && is_finite(&state.splats, i);
            if alive { opacity } else { 0.0 }
        })
        .collect();
    let alive = indices(n, |i| opacities[i] > 0.0);
    if alive.is_empty() {
        return DensityChange::default(); // No live splat to relocate to.
    }
    let dead = n - alive.len();
    // At least one more: the authors' truncation keeps up to 19 splats at a growth of 1.05.
    let least = n + usize::from(options.growth > 1.0);
    let target = ((n as f32 * options.growth) as usize)
        .max(least)
        .min(options.max_splats.max(n));
    let sources = draw(&opacities, target - alive.len(), rng);
    let replicated = replicate(&mut state.splats, &sources);
    let copies = state.splats.gather(&sources);
    state.rebuild(alive, &[&copies], &replicated, |_, _| false);
    DensityChange {
        cloned: sources.len(),
        split: 0,
        pruned: dead,
    }
}

/// Reduces opacity and size of each splat that occurs k times in `sources` (ascending) so that it and k copies of it together
/// render like the original (eq. 9). Returns these splats, whose moments are to be reset.
fn replicate(splats: &mut Splats, sources: &[u32]) -> Vec<u32> {
    let groups: Vec<&[u32]> = sources.chunk_by(|a, b| a == b).collect();
    let replicas: Vec<(f32, f32)> = groups
        .par_iter()
        .map(|group| replica(splats.opacity(group[0] as usize), group.len() + 1))
        .collect();
    for (group, (opacity, factor)) in groups.iter().zip(replicas) {
        let i = group[0] as usize;
        splats.opacity_logits.set(0, i, logit(opacity));
        for c in 0..3 {
            let log_scale = splats.log_scales.get(c, i);
            splats.log_scales.set(c, i, log_scale + factor.ln());
        }
    }
    groups.iter().map(|group| group[0]).collect()
}

/// Maximum number of copies for which eq. 9 is evaluated: its alternating sum loses precision beyond.
const MAX_COPIES: usize = 51;

/// Opacity of each of the `n` splats that replace one splat, and the factor on their size (eq. 9).
fn replica(opacity: f32, n: usize) -> (f32, f32) {
    let n = n.min(MAX_COPIES);
    let before = f64::from(opacity);
    let after = 1.0 - (1.0 - before).powf(1.0 / n as f64);
    let mut sum = 0.0;
    for i in 1..=n {
        let mut binomial = 1.0;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += binomial * sign * after.powi(k as i32 + 1) / (k as f64 + 1.0).sqrt();
            binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    // The authors' clamp: at least the opacity of a dead splat, never fully opaque.
    (
        after.clamp(0.005, 1.0 - f64::from(f32::EPSILON)) as f32,
        (before / sum) as f32,
    )
}

/// Splats per random stream: one stream per chunk, so that results do not depend on the number of threads.
const SPLATS_PER_STREAM: usize = 4096;
/// Opacity at which the noise has fallen to half, and how steeply it falls (section 3.3).
const NOISE_OPACITY: f32 = 0.005;
const NOISE_STEEPNESS: f32 = 100.0;

/// Moves the means by noise shaped by each splat's covariance: `rate` covariance normal(), faded out for opaque splats (eq. 8).
/// `rate` is the means' learning rate times the authors' 5e5, the offset in world units at a covariance of 1.
pub fn add_noise(state: &mut SplatState, rate: f32, seed: u64, step: u64) {
    let n = state.len();
    let splats = &state.splats;
    let offsets: Vec<Vec<(u32, [f32; 3])>> = (0..n.div_ceil(SPLATS_PER_STREAM))
        .into_par_iter()
        .map(|chunk| {
            let mut rng = Rng::new(seed ^ step << 24 ^ chunk as u64, STREAM_NOISE);
            (chunk * SPLATS_PER_STREAM..n.min((chunk + 1) * SPLATS_PER_STREAM))
                .filter_map(|i| {
                    let opacity = splats.opacity(i);
                    let strength = sigmoid(-NOISE_STEEPNESS * (opacity - NOISE_OPACITY));
                    // Below this the offset is lost in rounding, as for most splats of a scene.
                    (strength > 1e-6).then(|| {
                        let normal = glam::Vec3::new(rng.normal(), rng.normal(), rng.normal());
                        let q = |c: usize| splats.quats.get(c, i);
                        let rotation = glam::Quat::from_xyzw(q(1), q(2), q(3), q(0)).normalize();
                        let mut local = rotation.inverse() * normal;
                        for c in 0..3 {
                            local[c] *= (2.0 * splats.log_scales.get(c, i)).exp();
                        }
                        (i as u32, (rotation * local * (strength * rate)).to_array())
                    })
                })
                .collect()
        })
        .collect();
    let means = &mut state.splats.means;
    let stride = means.stride().max(1);
    means
        .as_mut_slice()
        .par_chunks_mut(stride)
        .enumerate()
        .for_each(|(c, plane)| {
            plane
                .par_chunks_mut(SPLATS_PER_STREAM)
                .zip(&offsets)
                .for_each(|(means, offsets)| {
                    for (i, offset) in offsets {
                        let mean = &mut means[*i as usize % SPLATS_PER_STREAM];
                        let moved = *mean + offset[c];
                        if moved.is_finite() {
                            *mean = moved;
                        }
                    }
                });
        });
}

/// Random stream of the noise, derived from the run's seed.
const STREAM_NOISE: u64 = 4;

#[cfg(test)]
mod tests {
    use super::*;

    fn state(opacities: &[f32]) -> SplatState {
        let mut splats = Splats::zeros(opacities.len(), 0);
        for (i, opacity) in opacities.iter().enumerate() {
            splats.means.set(0, i, i as f32);
            splats.quats.set(0, i, 1.0);
            splats.opacity_logits.set(0, i, logit(*opacity));
        }
        SplatState::new(splats)
    }

    #[test]
    fn copies_are_together_as_opaque_as_the_original() {
        for (opacity, n) in [(0.5f32, 2usize), (0.9, 5), (0.3, 12), (0.99, 30)] {
            let (after, factor) = replica(opacity, n);
            assert!((1.0 - (1.0 - after).powi(n as i32) - opacity).abs() < 1e-4);
            // The integral of n blended copies over their plane equals that of the original (the derivation of eq. 9).
            let integral = |opacity: f64, n: i32, sigma: f64| {
                (-4000..4000)
                    .map(|i| {
                        let x = f64::from(i) * 0.002;
                        (1.0 - (1.0 - opacity * (-0.5 * x * x / (sigma * sigma)).exp()).powi(n)) * 0.002
                    })
                    .sum::<f64>()
            };
            let one = integral(f64::from(opacity), 1, 1.0);
            let many = integral(f64::from(after), n as i32, f64::from(factor));
            assert!((many / one - 1.0).abs() < 0.01, "{opacity} {n}: {many} {one}");
        }
    }

    #[test]
    fn dead_splats_are_relocated_and_the_number_grows_to_the_cap() {
        let mut s = state(&[0.9, 0.001, 0.5, 0.002]);
        let options = McmcOptions {
            min_opacity: 0.005,
            growth: 1.5,
            max_splats: 5,
        };
        let change = densify(&mut s, &options, &mut Rng::new(3, 3));
        assert_eq!((s.len(), change.cloned, change.pruned), (5, 3, 2));
        let places: Vec<f32> = (0..5).map(|i| s.splats.means.get(0, i)).collect();
        assert!(places.iter().all(|x| *x == 0.0 || *x == 2.0), "{places:?}");
    }

    #[test]
    fn few_splats_grow_one_by_one_up_to_the_cap_and_only_if_the_recipe_grows() {
        let mut options = McmcOptions {
            min_opacity: 0.005,
            growth: 1.05,
            max_splats: 4,
        };
        let mut s = state(&[0.9, 0.5]);
        for count in [3, 4, 4] {
            densify(&mut s, &options, &mut Rng::new(3, 3));
            assert_eq!(s.len(), count);
        }
        (options.growth, options.max_splats) = (1.0, 9);
        densify(&mut s, &options, &mut Rng::new(3, 3));
        assert_eq!(s.len(), 4);
    }

    #[test]
    fn noise_moves_faint_splats_and_keeps_opaque_ones() {
        let mut s = state(&[0.9, 0.003]);
        let before = s.splats.clone();
        add_noise(&mut s, 0.1, 7, 1);
        assert_eq!(s.splats.means.get(0, 0), before.means.get(0, 0));
        assert_ne!(s.splats.means.get(0, 1), before.means.get(0, 1));
        let mut again = state(&[0.9, 0.003]);
        add_noise(&mut again, 0.1, 7, 1);
        assert_eq!(again.splats, s.splats);
    }
}
