//! Importance sampling: the inverse of a histogram's distribution function (NeRF, section 5.2).

use irradia_scene::Rng;

/// `n` ascending samples of the histogram with `edges [m + 1]` and unnormalised `weights [m]`, in equal steps of probability,
/// jittered within them by `rng`. A histogram of zeros counts as uniform.
pub fn importance(edges: &[f32], weights: &[f32], n: usize, mut rng: Option<&mut Rng>, samples: &mut Vec<f32>) {
    samples.clear();
    let total: f32 = weights.iter().sum();
    let uniform = total <= 0.0 || !total.is_finite();
    let weight = |i: usize| if uniform { edges[i + 1] - edges[i] } else { weights[i] };
    let total = if uniform {
        edges[weights.len()] - edges[0]
    } else {
        total
    };
    let (mut bin, mut below) = (0, 0.0);
    for k in 0..n {
        let within = rng.as_mut().map_or(0.5, |rng| rng.uniform());
        let target = (k as f32 + within) / n as f32 * total;
        while bin + 1 < weights.len() && below + weight(bin) <= target {
            below += weight(bin);
            bin += 1;
        }
        let fraction = ((target - below) / weight(bin).max(1e-20)).clamp(0.0, 1.0);
        samples.push(edges[bin] + fraction * (edges[bin + 1] - edges[bin]));
    }
}

/// The density of [`importance`]'s distribution at `x`; 0 outside.
pub fn density(edges: &[f32], weights: &[f32], x: f32) -> f32 {
    let total: f32 = weights.iter().sum();
    let bin = edges.partition_point(|e| *e <= x);
    if bin == 0 || bin >= edges.len() || total <= 0.0 {
        return 0.0;
    }
    weights[bin - 1] / total / (edges[bin] - edges[bin - 1])
}
