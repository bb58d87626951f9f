//! Merging of adjacent splats of similar position and colour into one of the same mass, mean and covariance: the CurriculumGS
//! regulariser that reverses excessive densification.

use super::DensityChange;
use super::split::{indices, is_finite, without};
use crate::nearest::Nearest;
use crate::{SplatState, eigen, logit};
use glam::{Mat3, Quat, Vec3};
use rayon::prelude::*;

/// Options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MergeOptions {
    /// Two splats are adjacent when their centres are closer than this many times the smaller one's median axis.
    pub distance: f32,
    /// Two splats are similar when no channel of their base colours differs by more than this.
    pub color: f32,
}

/// Merges pairs that are mutual nearest neighbours, adjacent and similar; clears the statistics.
pub fn merge(state: &mut SplatState, options: &MergeOptions) -> DensityChange {
    let pairs = pairs(state, options);
    unite(state, &pairs);
    let mut gone: Vec<u32> = pairs.iter().map(|(_, b)| *b).collect();
    gone.sort_unstable();
    state.gather(&without((0..state.len() as u32).collect(), &gone));
    state.statistics.clear();
    DensityChange {
        pruned: pairs.len(),
        ..Default::default()
    }
}

fn mean(state: &SplatState, i: usize) -> Vec3 {
    Vec3::from_array(state.splats.mean(i))
}

fn pairs(state: &SplatState, options: &MergeOptions) -> Vec<(u32, u32)> {
    let splats = &state.splats;
    // A union of splats without a mass would have no place.
    let whole = indices(state.len(), |i| is_finite(splats, i) && mass(state, i).is_normal());
    if whole.len() < 2 {
        return Vec::new();
    }
    let positions: Vec<[f32; 3]> = whole.par_iter().map(|i| mean(state, *i as usize).to_array()).collect();
    let tree = Nearest::new(&positions);
    let nearest: Vec<u32> = positions
        .par_iter()
        .enumerate()
        .map(|(i, p)| {
            let found: [_; 2] = tree.of(*p);
            // The splat itself is included unless two others have the same position.
            let own = usize::from(found[0].1 == i as u32);
            found[own].1
        })
        .collect();
    (0..whole.len() as u32)
        .into_par_iter()
        .filter(|i| {
            let other = nearest[*i as usize];
            // There is no nearest splat if distances overflow.
            *i < other && nearest.get(other as usize) == Some(i)
        })
        .map(|i| (whole[i as usize], whole[nearest[i as usize] as usize]))
        .filter(|(a, b)| similar(state, *a as usize, *b as usize, options))
        .collect()
}

fn similar(state: &SplatState, a: usize, b: usize, options: &MergeOptions) -> bool {
    let splats = &state.splats;
    let median = |i: usize| {
        let mut s: [f32; 3] = std::array::from_fn(|c| splats.log_scales.get(c, i));
        s.sort_unstable_by(f32::total_cmp);
        s[1].exp()
    };
    let near = mean(state, a).distance(mean(state, b)) < options.distance * median(a).min(median(b));
    let dc = |i: usize, c: usize| irradia_scene::sh::C0 as f32 * splats.sh.get(c, i);
    near && (0..3).all(|c| (dc(a, c) - dc(b, c)).abs() <= options.color)
}

fn covariance(state: &SplatState, i: usize) -> Mat3 {
    let splats = &state.splats;
    let q = |c: usize| splats.quats.get(c, i);
    let rotation = Mat3::from_quat(Quat::from_xyzw(q(1), q(2), q(3), q(0)).normalize());
    let variance = Vec3::from_array(std::array::from_fn(|c| (2.0 * splats.log_scales.get(c, i)).exp()));
    rotation * Mat3::from_diagonal(variance) * rotation.transpose()
}

/// The union of two splats.
struct Union {
    /// The share of each of the two in the sum of their masses.
    fractions: [f32; 2],
    mean: Vec3,
    rotation: Quat,
    log_scales: [f32; 3],
    opacity_logit: f32,
}

/// The product of the standard deviations.
fn volume(log_scales: [f32; 3]) -> f32 {
    log_scales.into_iter().sum::<f32>().exp()
}

fn mass(state: &SplatState, i: usize) -> f32 {
    state.splats.opacity(i) * volume(std::array::from_fn(|c| state.splats.log_scales.get(c, i)))
}

fn union(state: &SplatState, a: usize, b: usize) -> Union {
    let masses = [a, b].map(|i| mass(state, i));
    let total = (masses[0] + masses[1]).max(f32::MIN_POSITIVE);
    let fractions = masses.map(|m| m / total);
    let (ma, mb) = (mean(state, a), mean(state, b));
    let center = fractions[0] * ma + fractions[1] * mb;
    let outer = |d: Vec3| Mat3::from_cols(d * d.x, d * d.y, d * d.z);
    let cov = (covariance(state, a) + outer(ma - center)) * fractions[0]
        + (covariance(state, b) + outer(mb - center)) * fractions[1];
    let (rotation, variances) = eigen(cov);
    let log_scales = variances.to_array().map(|v| 0.5 * v.max(1e-30).ln());
    let opacity = total / volume(log_scales).max(f32::MIN_POSITIVE);
    Union {
        fractions,
        mean: center,
        rotation,
        log_scales,
        opacity_logit: logit(opacity.clamp(1e-4, 0.999)),
    }
}

/// Replaces the first splat of each pair by the union of the two, and resets its moments.
fn unite(state: &mut SplatState, pairs: &[(u32, u32)]) {
    let unions: Vec<Union> = pairs
        .par_iter()
        .map(|(a, b)| union(state, *a as usize, *b as usize))
        .collect();
    let splats = &mut state.splats;
    for ((a, _), union) in pairs.iter().zip(&unions) {
        let (a, q) = (*a as usize, union.rotation);
        for c in 0..3 {
            splats.means.set(c, a, union.mean[c]);
            splats.log_scales.set(c, a, union.log_scales[c]);
        }
        for (c, v) in [q.w, q.x, q.y, q.z].into_iter().enumerate() {
            splats.quats.set(c, a, v);
        }
        splats.opacity_logits.set(0, a, union.opacity_logit);
    }
    let stride = splats.stride().max(1);
    splats.sh.as_mut_slice().par_chunks_mut(stride).for_each(|plane| {
        for ((a, b), union) in pairs.iter().zip(&unions) {
            let (a, b) = (*a as usize, *b as usize);
            plane[a] = union.fractions[0] * plane[a] + union.fractions[1] * plane[b];
        }
    });
    for column in state.moments.iter_mut().flat_map(|moment| moment.columns_mut()) {
        column.as_mut_slice().par_chunks_mut(stride).for_each(|plane| {
            pairs.iter().for_each(|(a, _)| plane[*a as usize] = 0.0);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Splats, sigmoid};

    fn splat(splats: &mut Splats, i: usize, at: Vec3, turn: Quat, scale: Vec3, opacity: f32, color: f32) {
        for c in 0..3 {
            splats.means.set(c, i, at[c]);
            splats.log_scales.set(c, i, scale[c].ln());
            splats.sh.set(c, i, color / irradia_scene::sh::C0 as f32);
        }
        for (c, v) in [turn.w, turn.x, turn.y, turn.z].into_iter().enumerate() {
            splats.quats.set(c, i, v);
        }
        splats.opacity_logits.set(0, i, logit(opacity));
    }

    #[test]
    fn the_union_preserves_mass_mean_and_covariance() {
        let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.4, 0.2, -0.9);
        let mut splats = Splats::zeros(3, 0);
        splat(&mut splats, 0, Vec3::ZERO, turn, Vec3::new(1.0, 0.3, 0.2), 0.3, 0.1);
        splat(
            &mut splats,
            1,
            Vec3::new(0.1, 0.1, 0.0),
            turn,
            Vec3::new(0.8, 0.4, 0.3),
            0.2,
            0.15,
        );
        splat(&mut splats, 2, Vec3::new(9.0, 0.0, 0.0), turn, Vec3::ONE, 0.2, 0.1);
        let mut state = SplatState::new(splats);
        let near: Vec<usize> = (0..3).filter(|i| mean(&state, *i).x < 5.0).collect();
        let mass = |s: &SplatState, i: usize| {
            sigmoid(s.splats.opacity_logits.get(0, i)) * covariance(s, i).determinant().sqrt()
        };
        let masses = [mass(&state, near[0]), mass(&state, near[1])];
        let total = masses[0] + masses[1];
        let fractions = masses.map(|m| m / total);
        let center = fractions[0] * mean(&state, near[0]) + fractions[1] * mean(&state, near[1]);
        let options = MergeOptions {
            distance: 1.0,
            color: 0.1,
        };
        let mut picky = state.clone();
        assert_eq!(merge(&mut picky, &MergeOptions { color: 0.01, ..options }).pruned, 0);
        let change = merge(&mut state, &options);
        assert_eq!((change.pruned, state.len()), (1, 2));
        let one = (0..2).find(|i| mean(&state, *i).x < 5.0).unwrap();
        assert!(mean(&state, one).distance(center) < 1e-5);
        assert!((mass(&state, one) / total - 1.0).abs() < 1e-3);
    }

    #[test]
    fn splats_too_small_to_have_a_mass_stay_where_they_are() {
        let place = Vec3::new(1.0, 2.0, 3.0);
        for (size, pruned) in [
            (Vec3::splat(1e-13), 0),
            (Vec3::new(1e-3, 1e-3, 1e-35), 0),
            (Vec3::splat(1e-6), 1),
        ] {
            let mut splats = Splats::zeros(2, 0);
            (0..2).for_each(|i| splat(&mut splats, i, place, Quat::IDENTITY, size, 0.3, 0.1));
            let mut state = SplatState::new(splats);
            let options = MergeOptions {
                distance: 1.0,
                color: 0.1,
            };
            assert_eq!(merge(&mut state, &options).pruned, pruned, "{size}");
            for i in 0..state.len() {
                assert!(mean(&state, i).distance(place) < 1e-5, "{size}: {}", mean(&state, i));
                assert!(state.splats.opacity(i) > 0.29, "{size}");
            }
        }
    }
}
