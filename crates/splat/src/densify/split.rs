//! Shared by the strategies: drawing splats by weight, and replacing one splat by two.

use crate::{SplatState, Splats, logit, sigmoid};
use glam::{Quat, Vec3};
use irradia_scene::Rng;

/// Factor by which the two halves of a split splat are smaller: 0.8 times 2 (Inria code).
const RANDOM_SHRINK: f32 = 1.6;
/// Standard deviation of a half along the split axis, relative to the original's. Two halves at distance sqrt(1 - k^2) from
/// the centre have the original's variance for any k; at 0.6 their sum is within 5 % of the original's curve inside 2 sigma.
const HALF: f32 = 0.6;

/// The largest standard deviation, world units.
pub(super) fn largest_scale(splats: &Splats, i: usize) -> f32 {
    (0..3)
        .map(|c| splats.log_scales.get(c, i))
        .fold(f32::MIN, f32::max)
        .exp()
}

/// Whether position and size are finite.
pub(super) fn is_finite(splats: &Splats, i: usize) -> bool {
    (0..3).all(|c| splats.means.get(c, i).is_finite() && splats.log_scales.get(c, i).is_finite())
}

fn rotation(splats: &Splats, i: usize) -> Quat {
    let q = |c: usize| splats.quats.get(c, i);
    Quat::from_xyzw(q(1), q(2), q(3), q(0)).normalize()
}

fn shift(splats: &mut Splats, i: usize, offset: Vec3) {
    for c in 0..3 {
        splats.means.set(c, i, splats.means.get(c, i) + offset[c]);
    }
}

/// All indices below `count` except `gone` (ascending).
pub(super) fn without(count: usize, gone: &[u32]) -> Vec<u32> {
    (0..count as u32).filter(|i| gone.binary_search(i).is_err()).collect()
}

/// Ends a round: keeps `kept`, appends `added`, clears the statistics and restores Morton order.
pub(super) fn rebuild(state: &mut SplatState, kept: &[u32], added: &[&Splats]) {
    state.gather(kept);
    for splats in added {
        state.append(splats);
    }
    state.statistics.clear();
    state.sort_morton();
}

/// Two random samples of each of `indices`, smaller, adjacent in the result (3DGS).
pub(super) fn random_halves(splats: &Splats, indices: &[u32], rng: &mut Rng) -> Splats {
    let mut halves = twice(splats, indices);
    for i in 0..halves.len() {
        let offset = Vec3::from_array(std::array::from_fn(|c| {
            halves.log_scales.get(c, i).exp() * rng.normal()
        }));
        let offset = rotation(&halves, i) * offset;
        shift(&mut halves, i, offset);
        for c in 0..3 {
            halves
                .log_scales
                .set(c, i, halves.log_scales.get(c, i) - RANDOM_SHRINK.ln());
        }
    }
    halves
}

/// Splits each of `indices` in two across its longest axis, adjacent in the result: together they have its mass, mean and
/// covariance, so that the image hardly changes when they replace it.
pub(super) fn long_axis_halves(splats: &Splats, indices: &[u32]) -> Splats {
    let mut halves = twice(splats, indices);
    for i in 0..halves.len() {
        let axis = (0..3)
            .max_by(|a, b| halves.log_scales.get(*a, i).total_cmp(&halves.log_scales.get(*b, i)))
            .expect("three axes");
        let log_scale = halves.log_scales.get(axis, i);
        let distance = log_scale.exp() * (1.0 - HALF * HALF).sqrt();
        let mut offset = Vec3::ZERO;
        offset[axis] = if i % 2 == 0 { distance } else { -distance };
        let offset = rotation(&halves, i) * offset;
        shift(&mut halves, i, offset);
        halves.log_scales.set(axis, i, log_scale + HALF.ln());
        let opacity = sigmoid(halves.opacity_logits.get(0, i)) / (2.0 * HALF);
        halves.opacity_logits.set(0, i, logit(opacity.clamp(1e-4, 0.999)));
    }
    halves
}

fn twice(splats: &Splats, indices: &[u32]) -> Splats {
    let doubled: Vec<u32> = indices.iter().flat_map(|i| [*i, *i]).collect();
    splats.gather(&doubled)
}

/// `count` draws of an index with probability proportional to `weights`, with replacement; ascending.
pub(super) fn draw(weights: &[f32], count: usize, rng: &mut Rng) -> Vec<u32> {
    let mut sum = 0.0f64;
    let cumulative: Vec<f64> = weights
        .iter()
        .map(|w| {
            sum += f64::from(w.max(0.0));
            sum
        })
        .collect();
    if !(sum > 0.0 && sum.is_finite()) {
        return Vec::new();
    }
    let mut drawn: Vec<u32> = (0..count)
        .map(|_| {
            let at = f64::from(rng.uniform()) * sum;
            cumulative.partition_point(|c| *c <= at).min(weights.len() - 1) as u32
        })
        .collect();
    drawn.sort_unstable();
    drawn
}

/// At most `count` distinct indices, with probability proportional to `weights`, ascending: the largest of `u^(1/w)`
/// (Efraimidis and Spirakis 2006). Weights of zero are never drawn.
pub(super) fn draw_distinct(weights: &[f32], count: usize, rng: &mut Rng) -> Vec<u32> {
    let mut keys: Vec<(f32, u32)> = weights
        .iter()
        .enumerate()
        .filter_map(|(i, w)| {
            // The logarithm of the key; one random number per item, so that a weight does not affect other items' keys.
            let u = rng.uniform().max(f32::MIN_POSITIVE).ln();
            (*w > 0.0 && w.is_finite()).then(|| (u / w, i as u32))
        })
        .collect();
    if keys.len() > count {
        keys.select_nth_unstable_by(count, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        keys.truncate(count);
    }
    let mut chosen: Vec<u32> = keys.into_iter().map(|(_, i)| i).collect();
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_preserve_mass_mean_and_variance() {
        let mut splats = Splats::zeros(1, 0);
        let q = Quat::from_euler(glam::EulerRot::XYZ, 0.3, -0.8, 0.5);
        for (c, v) in [q.w, q.x, q.y, q.z].into_iter().enumerate() {
            splats.quats.set(c, 0, v);
        }
        for (c, s) in [0.2f32, 2.0, 0.5].into_iter().enumerate() {
            splats.log_scales.set(c, 0, s.ln());
        }
        splats.opacity_logits.set(0, 0, logit(0.6));
        let halves = long_axis_halves(&splats, &[0]);
        let mean = |i: usize| Vec3::from_array(halves.mean(i));
        assert!((mean(0) + mean(1)).length() < 1e-6);
        let axis = q * Vec3::Y;
        let (along, sigma) = (mean(0).dot(axis), halves.log_scales.get(1, 0).exp());
        assert!(
            (along * along + sigma * sigma - 4.0).abs() < 1e-4,
            "the variance along the axis"
        );
        assert!((mean(0) - along * axis).length() < 1e-5);
        let mass: f32 = (0..2)
            .map(|i| sigmoid(halves.opacity_logits.get(0, i)) * halves.log_scales.get(1, i).exp())
            .sum();
        assert!((mass - 0.6 * 2.0).abs() < 1e-4);
        assert_eq!(halves.log_scales.get(0, 0), splats.log_scales.get(0, 0));
    }

    #[test]
    fn draws_are_proportional_to_the_weights() {
        let mut rng = Rng::new(5, 5);
        let weights = [0.0, 1.0, 3.0, 0.0];
        let drawn = draw(&weights, 4000, &mut rng);
        let third = drawn.iter().filter(|i| **i == 2).count();
        assert!(
            drawn.iter().all(|i| [1, 2].contains(i)) && (2800..3200).contains(&third),
            "{third}"
        );
        assert!(draw(&[0.0; 3], 5, &mut rng).is_empty());
        let firsts = (0..2000)
            .filter(|_| draw_distinct(&weights, 1, &mut rng) == [2])
            .count();
        assert!(
            (1400..1600).contains(&firsts),
            "three times as likely: {firsts} of 2000"
        );
        assert_eq!(draw_distinct(&weights, 9, &mut rng), [1, 2]);
    }
}
