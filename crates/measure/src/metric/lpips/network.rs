//! The distance between the features of two images, and its gradient with respect to the first.

use super::backbone::Backbone;
use super::layers::Map;
use super::net::LpipsNet;
use super::weights::{self, LpipsError, Tensors, Weights};
use crate::real::{Real, sum_over};
use rayon::prelude::*;
use std::path::Path;

/// LPIPS's own normalisation of inputs in \[-1, 1\] (the scaling layer of the published code): `(v - SHIFT) / SCALE`.
const SHIFT: [f64; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f64; 3] = [0.458, 0.448, 0.450];

/// A backbone with its heads.
pub(crate) struct Network<T> {
    pub(super) net: LpipsNet,
    backbone: Backbone<T>,
    /// Weight of each channel at each tap, `[tap][C]`.
    heads: Vec<Vec<T>>,
}

impl<T: Real> Network<T> {
    /// As [`super::Lpips::load`].
    pub(crate) fn load(path: &Path) -> Result<Self, LpipsError> {
        let bytes = weights::read(path)?;
        let weights = Weights::parse(path, &bytes)?;
        Self::from_weights(weights.net()?, &weights)
    }

    pub(super) fn from_weights(net: LpipsNet, weights: &dyn Tensors) -> Result<Self, LpipsError> {
        let backbone = Backbone::from_weights(net, weights)?;
        let head = |head: Vec<f32>| head.iter().map(|v| T::from_f64(f64::from(*v))).collect();
        let heads = weights::heads(net, weights)?.into_iter().map(head).collect();
        Ok(Self { net, backbone, heads })
    }

    /// The distance between two images `[H, W, 3]` with values in \[0, 1\].
    pub(super) fn distance(&self, render: Map<T>, truth: Map<T>) -> f64 {
        // Both images pass through the network in step, so that at most three layers of each are held at a time.
        let (mut a, mut b) = (scaled(render), scaled(truth));
        let mut total = 0.0;
        for (tap, head) in self.heads.iter().enumerate() {
            a = self.backbone.up_to_tap(tap, &a);
            b = self.backbone.up_to_tap(tap, &b);
            total += tap_distance(&a, &b, head, None);
        }
        total
    }

    /// The distance and its gradient with respect to the render, `[H, W, 3]`.
    pub(crate) fn distance_and_gradient(&self, render: Map<T>, truth: Map<T>) -> (f64, Map<T>) {
        let tape = self.backbone.forward(scaled(render));
        let mut b = scaled(truth);
        let mut total = 0.0;
        let mut v_taps = Vec::with_capacity(self.heads.len());
        for (tap, head) in self.heads.iter().enumerate() {
            b = self.backbone.up_to_tap(tap, &b);
            let a = tape.tap(tap);
            let mut v = a.zeros_like();
            total += tap_distance(a, &b, head, Some(&mut v));
            v_taps.push(v);
        }
        let mut v = self.backbone.vjp(&tape, v_taps);
        for pixel in v.data.as_chunks_mut::<3>().0 {
            for (v, scale) in pixel.iter_mut().zip(SCALE) {
                *v *= T::from_f64(2.0 / scale);
            }
        }
        (total, v)
    }
}

/// Colours in \[0, 1\], normalised for the network.
fn scaled<T: Real>(mut image: Map<T>) -> Map<T> {
    let offsets: [T; 3] = std::array::from_fn(|c| T::from_f64(-1.0 - SHIFT[c]));
    let scales: [T; 3] = std::array::from_fn(|c| T::from_f64(SCALE[c]));
    for pixel in image.data.as_chunks_mut::<3>().0 {
        for c in 0..3 {
            pixel[c] = (pixel[c] + pixel[c] + offsets[c]) / scales[c];
        }
    }
    image
}

/// Mean over pixels of `sum_c head_c (a_c / |a| - b_c / |b|)^2` (eq. 1 of the paper); its gradient with respect to `a`
/// is written to `v_a`.
fn tap_distance<T: Real>(a: &Map<T>, b: &Map<T>, head: &[T], v_a: Option<&mut Map<T>>) -> f64 {
    let count = (a.height * a.width) as f64;
    let row = a.width * a.channels;
    let rows = a.data.par_chunks(row).zip(b.data.par_chunks(row));
    let sums: Vec<f64> = match v_a {
        None => rows.map(|(a, b)| row_distance(a, b, head, |_, _, _, _| ())).collect(),
        Some(v_a) => rows
            .zip(v_a.data.par_chunks_mut(row))
            .map(|((a, b), v)| {
                let gain = T::from_f64(2.0 / count);
                row_distance(a, b, head, |pixel, b, [scale_a, scale_b, norm_a], a| {
                    let v = &mut v[pixel * head.len()..(pixel + 1) * head.len()];
                    pixel_vjp(a, b, head, [scale_a, scale_b, norm_a], gain, v);
                })
            })
            .collect(),
    };
    // Summed in row order, independent of threads.
    sums.iter().sum::<f64>() / count
}

/// The sum over a row's pixels; calls `visit(pixel, b, [1 / |a|, 1 / |b|, |a|], a)` for each.
fn row_distance<T: Real>(a: &[T], b: &[T], head: &[T], mut visit: impl FnMut(usize, &[T], [T; 3], &[T])) -> f64 {
    // As in the published code, added to the norm; it matters only where a pixel's features are all zero.
    let epsilon = T::from_f64(1e-10);
    let pixels = a.chunks_exact(head.len()).zip(b.chunks_exact(head.len()));
    let mut total = 0.0;
    for (pixel, (a, b)) in pixels.enumerate() {
        let [norm_a, norm_b] = [a, b].map(|v| sum_over(v.len(), |c| v[c] * v[c]).sqrt());
        let (scale_a, scale_b) = (T::one() / (norm_a + epsilon), T::one() / (norm_b + epsilon));
        let distance = sum_over(head.len(), |c| {
            let d = a[c] * scale_a - b[c] * scale_b;
            head[c] * d * d
        });
        total += distance.to_f64();
        visit(pixel, b, [scale_a, scale_b, norm_a], a);
    }
    total
}

/// With e the gradient with respect to `a / |a|`: `v = (e - (a / |a|) (e . a) / |a|) / |a|`. 0 where all features are 0: there
/// the distance has no slope, and ReLU would block the gradient.
fn pixel_vjp<T: Real>(a: &[T], b: &[T], head: &[T], [scale_a, scale_b, norm_a]: [T; 3], gain: T, v: &mut [T]) {
    if norm_a == T::zero() {
        return;
    }
    for c in 0..head.len() {
        v[c] = gain * head[c] * (a[c] * scale_a - b[c] * scale_b);
    }
    let along = sum_over(head.len(), |c| v[c] * a[c]) * scale_a / norm_a;
    for c in 0..head.len() {
        v[c] = scale_a * (v[c] - along * a[c]);
    }
}
