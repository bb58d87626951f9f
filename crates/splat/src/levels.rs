//! Fewer splats that look the same from a distance: pairs are merged into splats of the same mass, mean and covariance, the cheapest
//! pairs first.
//!
//! The mass is opacity times the area of the ellipsoid's surface (Kerbl et al. 2024, "A Hierarchical 3D Gaussian Representation",
//! section 4.1), not times its volume as in [`densify::merge`](crate::densify::merge): two flat splats that are not quite in one plane
//! would make a thick one of the same volume, and lose their opacity.

use crate::densify::is_finite;
use crate::nearest::Nearest;
use crate::render::ALPHA_MIN;
use crate::{Splats, eigen, logit};
use glam::{Mat3, Quat, Vec3};
use rayon::prelude::*;

/// Number of nearest neighbours considered as partners, the splat itself included.
const NEIGHBOUR_COUNT: usize = 9;
/// Largest opacity of a merged splat.
const MAX_OPACITY: f32 = 0.999;

/// The properties of a splat that matter for merging.
#[derive(Clone, Copy)]
struct Blob {
    mean: Vec3,
    covariance: Mat3,
    mass: f32,
    /// Colour of degree 0.
    color: Vec3,
}

/// Merges `splats` until at most `count` are left. Splats that can never be visible are removed first.
pub fn merged(splats: &Splats, count: usize) -> Splats {
    let drawn: Vec<u32> = (0..splats.len() as u32)
        .into_par_iter()
        .filter(|i| splats.opacity(*i as usize) >= ALPHA_MIN as f32 && is_finite(splats, *i as usize))
        .collect();
    let mut left = splats.gather(&drawn);
    while left.len() > count.max(1) {
        let blobs: Vec<Blob> = (0..left.len()).into_par_iter().map(|i| blob(&left, i)).collect();
        let pairs = pairs(&blobs, left.len() - count.max(1));
        if pairs.is_empty() {
            break;
        }
        left = unite(&left, &blobs, &pairs);
    }
    left
}

fn blob(splats: &Splats, i: usize) -> Blob {
    let q = |c: usize| splats.quats.get(c, i);
    let rotation = Mat3::from_quat(Quat::from_xyzw(q(1), q(2), q(3), q(0)).normalize());
    let scales = Vec3::from_array(std::array::from_fn(|c| splats.log_scales.get(c, i).exp()));
    Blob {
        mean: Vec3::from(splats.mean(i)),
        covariance: rotation * Mat3::from_diagonal(scales * scales) * rotation.transpose(),
        mass: (splats.opacity(i) * area(scales)).max(f32::MIN_POSITIVE),
        color: Vec3::from_array(std::array::from_fn(|c| splats.sh.get(c, i))),
    }
}

/// Surface of an ellipsoid up to a constant factor (Thomsen's approximation): within 1.1 %.
fn area(scales: Vec3) -> f32 {
    const P: f32 = 1.6075;
    let [a, b, c] = scales.to_array();
    ((a * b).powf(P) + (a * c).powf(P) + (b * c).powf(P)).powf(1.0 / P)
}

/// Disjoint pairs of neighbours, at most `max_pairs`, the cheapest first.
fn pairs(blobs: &[Blob], max_pairs: usize) -> Vec<(u32, u32)> {
    let positions: Vec<[f32; 3]> = blobs.iter().map(|blob| blob.mean.to_array()).collect();
    let tree = Nearest::new(&positions);
    let mut candidates: Vec<(f32, u32, u32)> = (0..blobs.len())
        .into_par_iter()
        .flat_map_iter(|i| {
            let near = tree.of::<NEIGHBOUR_COUNT>(positions[i]);
            let others = near.into_iter().map(|(_, other)| other as usize);
            // Mutual neighbours give the same pair twice, which does no harm.
            others
                .filter(move |other| *other != i && *other < blobs.len())
                .map(move |other| (cost(&blobs[i], &blobs[other]), i.min(other) as u32, i.max(other) as u32))
        })
        .collect();
    // Of many splats in one place, the tree finds the same few for all of them: each is paired with the next one, too.
    let mut by_place: Vec<u32> = (0..blobs.len() as u32).collect();
    by_place.par_sort_unstable_by_key(|i| (positions[*i as usize].map(f32::to_bits), *i));
    candidates.par_extend(by_place.par_windows(2).filter_map(|pair| {
        let (a, b) = (pair[0], pair[1]);
        (positions[a as usize] == positions[b as usize]).then_some((0.0, a, b))
    }));
    candidates.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut taken = vec![false; blobs.len()];
    let mut pairs = Vec::new();
    for (_, a, b) in candidates {
        if pairs.len() == max_pairs {
            break;
        }
        if !taken[a as usize] && !taken[b as usize] {
            taken[a as usize] = true;
            taken[b as usize] = true;
            pairs.push((a, b));
        }
    }
    pairs
}

/// The cost of merging two splats: how far their mass moves (Ward 1963), more if their colours differ.
fn cost(a: &Blob, b: &Blob) -> f32 {
    let reduced = a.mass * b.mass / (a.mass + b.mass);
    reduced * a.mean.distance_squared(b.mean) * (COLOR_SCALE + a.color.distance_squared(b.color))
}

/// Squared difference of colours, in coefficients of degree 0, that doubles the cost of the distance.
const COLOR_SCALE: f32 = 0.1;

/// Replaces each pair by its union; keeps the other splats.
fn unite(splats: &Splats, blobs: &[Blob], pairs: &[(u32, u32)]) -> Splats {
    let mut gone = vec![false; splats.len()];
    pairs.iter().for_each(|(_, b)| gone[*b as usize] = true);
    let mut united = splats.clone();
    let unions: Vec<(f32, Vec3, Quat, [f32; 3], f32)> = pairs
        .par_iter()
        .map(|(a, b)| union(&blobs[*a as usize], &blobs[*b as usize]))
        .collect();
    for ((a, b), (part, mean, rotation, log_scales, logit)) in pairs.iter().zip(unions) {
        let (a, b) = (*a as usize, *b as usize);
        for c in 0..3 {
            united.means.set(c, a, mean[c]);
            united.log_scales.set(c, a, log_scales[c]);
        }
        for (c, v) in [rotation.w, rotation.x, rotation.y, rotation.z].into_iter().enumerate() {
            united.quats.set(c, a, v);
        }
        united.opacity_logits.set(0, a, logit);
        for c in 0..united.sh.count() {
            let mixed = part * splats.sh.get(c, a) + (1.0 - part) * splats.sh.get(c, b);
            united.sh.set(c, a, mixed);
        }
    }
    let kept: Vec<u32> = (0..splats.len() as u32).filter(|i| !gone[*i as usize]).collect();
    united.gather(&kept)
}

/// The union of two splats: `a`'s share of the mass, then the union's mean, rotation, ln scales and opacity logit.
fn union(a: &Blob, b: &Blob) -> (f32, Vec3, Quat, [f32; 3], f32) {
    let total = a.mass + b.mass;
    let part = a.mass / total;
    let mean = part * a.mean + (1.0 - part) * b.mean;
    let outer = |d: Vec3| Mat3::from_cols(d * d.x, d * d.y, d * d.z);
    let covariance =
        (a.covariance + outer(a.mean - mean)) * part + (b.covariance + outer(b.mean - mean)) * (1.0 - part);
    let (rotation, variances) = eigen(covariance);
    let scales = variances.max(Vec3::splat(1e-30)).map(f32::sqrt);
    let opacity = (total / area(scales)).clamp(1e-4, MAX_OPACITY);
    (part, mean, rotation, scales.map(f32::ln).to_array(), logit(opacity))
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    fn flat(splats: &mut Splats, i: usize, at: Vec3, opacity: f32, color: f32) {
        for c in 0..3 {
            splats.means.set(c, i, at[c]);
            splats.log_scales.set(c, i, [0.1f32, 0.1, 0.001][c].ln());
            splats.sh.set(c, i, color);
        }
        splats.quats.set(0, i, 1.0);
        splats.opacity_logits.set(0, i, logit(opacity));
    }

    #[test]
    fn a_merged_splat_has_mean_covariance_and_mass_of_its_parts() {
        let mut splats = Splats::zeros(3, 0);
        // Two flat ones that are not quite in one plane, and one far away.
        flat(&mut splats, 0, Vec3::ZERO, 0.5, 1.0);
        flat(&mut splats, 1, Vec3::new(0.1, 0.0, 0.01), 0.25, 0.4);
        flat(&mut splats, 2, Vec3::new(5.0, 0.0, 0.0), 0.9, 1.0);
        let both = merged(&splats, 2);
        assert_eq!(both.len(), 2);
        let one = (0..2).find(|i| both.mean(*i)[0] < 1.0).unwrap();
        assert!(Vec3::from(both.mean(one)).distance(Vec3::new(0.1, 0.0, 0.01) / 3.0) < 1e-6);
        assert!((both.sh.get(0, one) - 0.8).abs() < 1e-6);
        let mass = |splats: &Splats, i: usize| blob(splats, i).mass;
        let parts = mass(&splats, 0) + mass(&splats, 1);
        assert!((mass(&both, one) / parts - 1.0).abs() < 1e-3);
        // A volume would have grown by a factor of 5, and the opacity fallen to 0.1.
        assert!(both.opacity(one) > 0.5, "{}", both.opacity(one));
        let spread = blob(&both, one).covariance.x_axis.x;
        assert!((spread - (0.01 + 0.01 * 2.0 / 9.0)).abs() < 1e-6, "{spread}");
    }

    #[test]
    fn half_of_many_splats_in_one_place_are_merged_at_a_time() {
        let mut splats = Splats::zeros(1000, 0);
        (0..1000).for_each(|i| flat(&mut splats, i, Vec3::new(0.5, 0.25, 1.0), 0.5, 1.0));
        let blobs: Vec<Blob> = (0..1000).map(|i| blob(&splats, i)).collect();
        assert_eq!(pairs(&blobs, 1000).len(), 500);
    }

    #[test]
    fn merging_reaches_the_count_and_leaves_out_what_cannot_be_drawn() {
        let mut rng = Rng::new(8, 0);
        let mut splats = Splats::zeros(1000, 1);
        for i in 0..1000 {
            let at = Vec3::new(rng.normal(), rng.normal(), rng.normal());
            flat(&mut splats, i, at, rng.range(0.1, 0.9), rng.normal());
        }
        splats.opacity_logits.set(0, 5, -30.0);
        splats.means.set(1, 6, f32::NAN);
        assert_eq!(merged(&splats, 5000).len(), 998);
        for count in [500, 77, 1] {
            let few = merged(&splats, count);
            assert_eq!(few.len(), count);
            assert!((0..count).all(|i| is_finite(&few, i)));
        }
        assert_eq!(merged(&splats, 200), merged(&splats, 200));
        assert!(merged(&Splats::zeros(0, 0), 3).is_empty());
    }
}
