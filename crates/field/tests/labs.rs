//! Experiments with known outcomes: what positional encoding and importance sampling gain.

use irradia_compute::simd::Double;
use irradia_field::Rows;
use irradia_field::encoding::Frequency;
use irradia_field::mlp::{Mlp, MlpShape, MlpTape, PANEL};
use irradia_field::sample::aabb::intersect;
use irradia_field::sample::importance::{density, importance};
use irradia_field::sample::stratified::stratified;
use irradia_scene::Rng;

/// Mean squared error of a small network after 400 steps on a high-frequency signal, at 128 points on a line.
fn fit(encode: impl Fn(&[f64], &mut [f64]), inputs: usize) -> f64 {
    let mlp = Mlp::new(MlpShape {
        inputs,
        outputs: 1,
        width: 32,
        depth: 2,
        skip: None,
    });
    let mut parameters: Vec<f64> = mlp.init(&mut Rng::new(1, 1)).into_iter().map(f64::from).collect();
    let panels = 4;
    let place = |i: usize| i as f64 / (panels * PANEL) as f64 * 2.0 - 1.0;
    let signal = |x: f64| (12.0 * std::f64::consts::PI * x).sin();
    let mut x = Rows::default();
    x.resize(panels * mlp.inputs() * PANEL, 0.0);
    for (p, rows) in x.chunks_exact_mut(mlp.inputs() * PANEL).enumerate() {
        let mut points = [0.0; 3 * PANEL];
        (0..PANEL).for_each(|s| points[s] = place(p * PANEL + s));
        encode(&points, rows);
    }
    let (mut first, mut second) = (vec![0.0; parameters.len()], vec![0.0; parameters.len()]);
    let mut tape = MlpTape::default();
    let mut loss = 0.0;
    for step in 1..=400 {
        mlp.forward(Double, &parameters, &x, &mut tape);
        let rows = mlp.outputs() * PANEL;
        let out: Vec<f64> = tape
            .output()
            .chunks_exact(rows)
            .flat_map(|panel| panel[..PANEL].to_vec())
            .collect();
        let errors: Vec<f64> = out.iter().enumerate().map(|(i, y)| y - signal(place(i))).collect();
        loss = errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64;
        let v = tape.output_gradient();
        v.clear();
        v.resize(panels * rows, 0.0);
        for (p, errors) in errors.chunks_exact(PANEL).enumerate() {
            v[p * rows..][..PANEL].copy_from_slice(errors);
        }
        let mut grads = vec![0.0; parameters.len()];
        let transposed = mlp.transposed(&parameters);
        mlp.backward(Double, &transposed, &x, &mut tape, &mut grads, None);
        for i in 0..grads.len() {
            first[i] = 0.9 * first[i] + 0.1 * grads[i];
            second[i] = 0.99 * second[i] + 0.01 * grads[i] * grads[i];
            let (m, v) = (
                first[i] / (1.0 - 0.9f64.powi(step)),
                second[i] / (1.0 - 0.99f64.powi(step)),
            );
            parameters[i] -= 5e-3 * m / (v.sqrt() + 1e-8);
        }
    }
    loss
}

#[test]
fn positional_encoding_beats_raw_coordinates() {
    let raw = fit(|points, to| to[..3 * PANEL].copy_from_slice(points), 3);
    let encoding = Frequency { octaves: 6 };
    let encoded = fit(|points, to| encoding.encode(Double, points, to), encoding.features());
    eprintln!("mean squared error of sin(12 pi x): raw {raw:.4}, encoded {encoded:.6}");
    // Raw coordinates stay near the signal's own variance of 0.5.
    assert!(raw > 0.1 && encoded < 0.01, "raw {raw}, encoded {encoded}");
}

/// A narrow bump on a line.
fn bump(x: f64) -> f64 {
    (-((x - 0.37) / 0.02).powi(2)).exp()
}

#[test]
fn importance_sampling_beats_stratified_sampling_at_equal_count() {
    let truth = 0.02 * std::f64::consts::PI.sqrt();
    let (mut coarse, mut edges, mut samples) = (Vec::new(), Vec::new(), Vec::new());
    stratified(32, None, &mut coarse);
    let weights: Vec<f32> = coarse
        .windows(2)
        .map(|e| (bump(f64::from(e[0] + e[1]) / 2.0) + 1e-3) as f32)
        .collect();
    let rounds = 400;
    let mut squares = [0.0f64; 2];
    for round in 0..rounds {
        let mut rng = Rng::new(round, 1);
        // 64 samples, each weighted by the inverse of its sampling density.
        stratified(64, Some(&mut rng), &mut edges);
        let even: f64 = edges
            .windows(2)
            .map(|e| bump(f64::from(rng.range(e[0], e[1]))) * f64::from(e[1] - e[0]))
            .sum();
        importance(&coarse, &weights, 64, Some(&mut rng), &mut samples);
        let drawn: f64 = samples
            .iter()
            .map(|s| bump(f64::from(*s)) / f64::from(density(&coarse, &weights, *s)) / 64.0)
            .sum();
        squares[0] += (even - truth).powi(2) / rounds as f64;
        squares[1] += (drawn - truth).powi(2) / rounds as f64;
    }
    let [even, drawn] = squares.map(|s| s.sqrt() / truth);
    eprintln!("relative error of the integral of a bump: even {even:.4}, by importance {drawn:.4}");
    assert!(drawn < 0.5 * even, "even {even}, by importance {drawn}");
}

#[test]
fn importance_samples_follow_their_density() {
    let edges = [0.0, 0.1, 0.4, 0.5, 1.0];
    let weights = [0.2, 0.0, 0.7, 0.1];
    let mut samples = Vec::new();
    importance(&edges, &weights, 1000, None, &mut samples);
    assert!(samples.is_sorted());
    for (bin, weight) in weights.iter().enumerate() {
        let count = samples
            .iter()
            .filter(|s| (edges[bin]..edges[bin + 1]).contains(*s))
            .count();
        assert!((count as f32 - 1000.0 * weight).abs() <= 1.0, "bin {bin}: {count}");
    }
    // The density integrates to 1 and is the derivative of the distribution function that samples invert.
    let total: f32 = (0..4)
        .map(|b| density(&edges, &weights, edges[b] + 0.01) * (edges[b + 1] - edges[b]))
        .sum();
    assert!((total - 1.0).abs() < 1e-6);
    assert_eq!(
        [density(&edges, &weights, -0.1), density(&edges, &weights, 1.5)],
        [0.0; 2]
    );
    for k in 0..999 {
        let gap = samples[k + 1] - samples[k];
        let middle = samples[k] + 0.5 * gap;
        let p = density(&edges, &weights, middle);
        if p > 0.0 && gap < 0.01 {
            // Two samples of the same bin are 1/1000 of probability apart.
            let same_bin =
                edges.partition_point(|e| *e <= samples[k]) == edges.partition_point(|e| *e <= samples[k + 1]);
            assert!(!same_bin || (p * gap - 1e-3).abs() < 1e-4, "{p} * {gap}");
        }
    }
    // A histogram of zeros is uniform; NaN does not panic.
    importance(&edges, &[0.0; 4], 10, None, &mut samples);
    assert!(
        samples
            .iter()
            .enumerate()
            .all(|(k, s)| (s - (k as f32 + 0.5) / 10.0).abs() < 1e-6)
    );
    importance(&edges, &[f32::NAN; 4], 10, None, &mut samples);
    assert_eq!(samples.len(), 10);
}

#[test]
fn ray_box_intersections_are_exact() {
    let (low, high) = ([-1.0; 3], [1.0; 3]);
    assert_eq!(
        intersect([0.0, 0.0, -3.0], [0.0, 0.0, 1.0], low, high),
        Some([2.0, 4.0])
    );
    assert_eq!(
        intersect([0.0; 3], [0.0, 0.0, 1.0], low, high),
        Some([0.0, 1.0]),
        "from within"
    );
    assert_eq!(intersect([0.0, 0.0, -3.0], [0.0, 0.0, -1.0], low, high), None, "behind");
    assert_eq!(intersect([0.0, 2.0, -3.0], [0.0, 0.0, 1.0], low, high), None, "beside");
    // In the plane of a face, where dividing would give 0 / 0.
    assert_eq!(
        intersect([0.0, 1.0, -3.0], [0.0, 0.0, 1.0], low, high),
        Some([2.0, 4.0])
    );
    let d = 1.0 / 3f32.sqrt();
    let [near, far] = intersect([-3.0; 3], [d; 3], low, high).unwrap();
    assert!((near - 2.0 / d).abs() < 1e-5 && (far - 4.0 / d).abs() < 1e-5);
}
