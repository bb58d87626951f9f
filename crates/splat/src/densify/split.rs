//! Shared by the strategies: drawing splats by weight, and replacing one splat by two.

use crate::{Splats, logit};
use glam::{Quat, Vec3};
use irradia_scene::Rng;
use rayon::prelude::*;

/// Factor by which the two halves of a split splat are smaller: 0.8 times 2 (Inria code).
const RANDOM_SHRINK: f32 = 1.6;
/// Standard deviation of a half along the split axis, relative to the original's. Two halves at distance sqrt(1 - k^2) from the centre have
/// the original's variance for any k. Smaller halves change the image more (the sum at the centre is 0.69 of the original's with 0.6, 0.94
/// with 0.8), but show details sooner and cost less. Held-out PSNR at 320 pixels, 1,200 steps, with 0.5, 0.6 and 0.8: fox 33.02, 32.95,
/// 32.94 dB; cup 30.63, 30.63, 30.76; lund_door 35.56, 35.65, 35.38; maryRose 25.33, 25.48; with 0.6 and 0.8 the mean of four captures of 7
/// to 14 photographs 29.50, 29.67. With 0.8, steps take 1.25 times as long.
const HALF_DEVIATION: f32 = 0.6;

/// The largest standard deviation, world units.
pub(super) fn largest_scale(splats: &Splats, i: usize) -> f32 {
    (0..3)
        .map(|c| splats.log_scales.get(c, i))
        .fold(f32::MIN, f32::max)
        .exp()
}

/// Whether position, rotation and size are finite.
pub(crate) fn is_finite(splats: &Splats, i: usize) -> bool {
    let columns = [&splats.means, &splats.quats, &splats.log_scales];
    columns
        .iter()
        .all(|column| (0..column.count()).all(|c| column.get(c, i).is_finite()))
}

fn rotation(splats: &Splats, i: usize) -> Quat {
    let q = |c: usize| splats.quats.get(c, i);
    Quat::from_xyzw(q(1), q(2), q(3), q(0)).normalize()
}

/// The indices below `count` for which `keep` holds, ascending.
pub(super) fn indices(count: usize, keep: impl Fn(usize) -> bool + Sync) -> Vec<u32> {
    (0..count as u32)
        .into_par_iter()
        .filter(|i| keep(*i as usize))
        .collect()
}

/// All of `kept` except `gone` (ascending).
pub(super) fn without(kept: Vec<u32>, gone: &[u32]) -> Vec<u32> {
    if gone.is_empty() {
        return kept;
    }
    kept.into_par_iter()
        .filter(|i| gone.binary_search(i).is_err())
        .collect()
}

/// The parameters of a splat that splitting changes: offset of the mean, ln scales, opacity logit.
type Half = (Vec3, [f32; 3], f32);

/// Splats of a parallel task.
const SPLATS_PER_TASK: usize = 4096;

/// Each of `indices` twice, adjacent, with the changes that `half` returns. The result does not depend on the number of threads.
fn halves(splats: &Splats, indices: &[u32], half: impl Fn(&Splats, usize, usize) -> Half + Sync) -> Splats {
    let mut halves = duplicate(splats, indices);
    let changes: Vec<Half> = (0..halves.len())
        .into_par_iter()
        .with_min_len(SPLATS_PER_TASK)
        .map(|i| half(splats, indices[i / 2] as usize, i))
        .collect();
    for c in 0..3 {
        let planes = [halves.means.plane_mut(c), halves.log_scales.plane_mut(c)];
        let [means, log_scales] = planes;
        means
            .par_iter_mut()
            .zip(log_scales)
            .zip(&changes)
            .with_min_len(SPLATS_PER_TASK)
            .for_each(|((mean, log_scale), (offset, log_scales, _))| {
                *mean += offset[c];
                *log_scale = log_scales[c];
            });
    }
    let logits = halves.opacity_logits.plane_mut(0);
    logits
        .iter_mut()
        .zip(&changes)
        .for_each(|(to, (.., logit))| *to = *logit);
    halves
}

/// Two random samples of each of `indices`, smaller, adjacent in the result (3DGS).
pub(super) fn random_halves(splats: &Splats, indices: &[u32], rng: &mut Rng) -> Splats {
    /// Draws of 32 bits per half: three normal variates of two draws each.
    const DRAWS: u64 = 6;
    let start = *rng;
    rng.advance(DRAWS * 2 * indices.len() as u64);
    halves(splats, indices, |splats, i, half| {
        let mut rng = start;
        rng.advance(DRAWS * half as u64);
        let log_scales = log_scales(splats, i);
        let offset = Vec3::from_array(log_scales.map(|s| s.exp() * rng.normal()));
        let smaller = log_scales.map(|s| s - RANDOM_SHRINK.ln());
        (rotation(splats, i) * offset, smaller, splats.opacity_logits.get(0, i))
    })
}

/// Splits each of `indices` in two across its longest axis, adjacent in the result: together they have its mass, mean and
/// covariance, so that the image changes little when they replace it.
pub(super) fn long_axis_halves(splats: &Splats, indices: &[u32]) -> Splats {
    halves(splats, indices, |splats, i, half| {
        let mut log_scales = log_scales(splats, i);
        let axis = (0..3)
            .max_by(|a, b| log_scales[*a].total_cmp(&log_scales[*b]))
            .expect("three axes");
        let distance = log_scales[axis].exp() * (1.0 - HALF_DEVIATION * HALF_DEVIATION).sqrt();
        let mut offset = Vec3::ZERO;
        offset[axis] = if half % 2 == 0 { distance } else { -distance };
        log_scales[axis] += HALF_DEVIATION.ln();
        let opacity = splats.opacity(i) / (2.0 * HALF_DEVIATION);
        (
            rotation(splats, i) * offset,
            log_scales,
            logit(opacity.clamp(1e-4, 0.999)),
        )
    })
}

fn log_scales(splats: &Splats, i: usize) -> [f32; 3] {
    std::array::from_fn(|c| splats.log_scales.get(c, i))
}

fn duplicate(splats: &Splats, indices: &[u32]) -> Splats {
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
    let uniforms: Vec<f32> = (0..count).map(|_| rng.uniform()).collect();
    let mut drawn: Vec<u32> = uniforms
        .into_par_iter()
        .map(|u| {
            let at = f64::from(u) * sum;
            cumulative.partition_point(|c| *c <= at).min(weights.len() - 1) as u32
        })
        .collect();
    drawn.par_sort_unstable();
    drawn
}

/// At most `count` distinct indices, with probability proportional to `weights`, ascending: the largest of `u^(1/w)`
/// (Efraimidis and Spirakis 2006). Weights of zero are never drawn.
pub(super) fn draw_distinct(weights: &[f32], count: usize, rng: &mut Rng) -> Vec<u32> {
    let start = *rng;
    rng.advance(weights.len() as u64);
    let mut keys: Vec<(f32, u32)> = weights
        .par_chunks(SPLATS_PER_TASK)
        .enumerate()
        .flat_map_iter(|(piece, weights)| {
            let mut rng = start;
            rng.advance((piece * SPLATS_PER_TASK) as u64);
            weights.iter().enumerate().filter_map(move |(i, w)| {
                // The logarithm of the key; one random number per item, so that a weight does not affect other items' keys.
                let u = rng.uniform().max(f32::MIN_POSITIVE).ln();
                (*w > 0.0 && w.is_finite()).then(|| (u / w, (piece * SPLATS_PER_TASK + i) as u32))
            })
        })
        .collect();
    if keys.len() > count {
        keys.select_nth_unstable_by(count, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        keys.truncate(count);
    }
    let mut chosen: Vec<u32> = keys.into_iter().map(|(_, i)| i).collect();
    chosen.par_sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sigmoid;

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

    /// Compares with one splat, and one random number, after the other.
    #[test]
    fn random_halves_and_draws_are_those_of_one_thread() {
        let n = 3 * SPLATS_PER_TASK + 7;
        let mut splats = Splats::zeros(n, 0);
        let mut rng = Rng::new(2, 2);
        for i in 0..n {
            (0..4).for_each(|c| splats.quats.set(c, i, rng.normal()));
            (0..3).for_each(|c| splats.log_scales.set(c, i, rng.normal()));
        }
        let indices: Vec<u32> = (0..n as u32).step_by(2).collect();
        let mut serial = Rng::new(7, 3);
        let mut expected = Vec::new();
        for i in indices.iter().flat_map(|i| [*i as usize; 2]) {
            let local = Vec3::from_array(log_scales(&splats, i).map(|s| s.exp() * serial.normal()));
            expected.push((rotation(&splats, i) * local).to_array());
        }
        let weights: Vec<f32> = (0..n).map(|i| (i % 5) as f32).collect();
        let mut keys: Vec<(f32, u32)> = (0..n)
            .map(|i| (serial.uniform().max(f32::MIN_POSITIVE).ln() / weights[i], i as u32))
            .filter(|(_, i)| weights[*i as usize] > 0.0)
            .collect();
        keys.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut drawn: Vec<u32> = keys[..500].iter().map(|(_, i)| *i).collect();
        drawn.sort_unstable();
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut rng = Rng::new(7, 3);
            let halves = pool.install(|| random_halves(&splats, &indices, &mut rng));
            assert!((0..halves.len()).all(|i| halves.mean(i) == expected[i]));
            assert_eq!(pool.install(|| draw_distinct(&weights, 500, &mut rng)), drawn);
            assert_eq!(rng, serial, "as many random numbers are used");
        }
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
