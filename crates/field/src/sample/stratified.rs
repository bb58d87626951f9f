//! Even intervals with random jitter (NeRF, equation 2).

use irradia_scene::Rng;

/// `n + 1` edges from 0 to 1; with `rng` the inner ones are jittered by up to half an interval.
pub fn stratified(n: usize, rng: Option<&mut Rng>, edges: &mut Vec<f32>) {
    let step = 1.0 / n as f32;
    edges.clear();
    edges.extend((0..=n).map(|i| i as f32 * step));
    if let Some(rng) = rng {
        for edge in &mut edges[1..n] {
            *edge += step * (rng.uniform() - 0.5);
        }
    }
}
