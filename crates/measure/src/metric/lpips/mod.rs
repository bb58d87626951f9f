//! LPIPS (Zhang, Isola, Efros, Shechtman, Wang 2018), version 0.1 with the SqueezeNet 1.1 backbone.

mod layers;
mod squeezenet;
mod weights;

pub use weights::LpipsError;

use super::assert_same_size;
use irradia_scene::Image;
use layers::Map;
use squeezenet::SqueezeNet;
use std::path::Path;
use weights::Weights;

/// LPIPS's own normalisation of inputs in \[-1, 1\] (the scaling layer of the published code): `(v - SHIFT) / SCALE`.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// The perceptual distance, with its network's weights.
pub struct Lpips {
    net: SqueezeNet,
    /// What each channel of each tap counts, `[7][C]`.
    heads: [Vec<f32>; SqueezeNet::TAPS],
}

impl Lpips {
    /// Images narrower or lower than this leave nothing after the network's poolings.
    pub const MIN_SIDE: u32 = 17;

    /// Reads `lpips_squeeze.safetensors`: `features.*` of SqueezeNet 1.1 (OIHW) and the heads `lin0` to `lin6`.
    ///
    /// # Errors
    /// When the file cannot be read, is no safetensors file, or lacks a tensor of the right shape with finite values.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, LpipsError> {
        let bytes = weights::read(path.as_ref())?;
        let weights = Weights::parse(path.as_ref(), &bytes)?;
        let net = SqueezeNet::from_weights(&weights)?;
        let mut heads: [Vec<f32>; SqueezeNet::TAPS] = Default::default();
        for (i, head) in heads.iter_mut().enumerate() {
            *head = weights.tensor(
                &format!("lin{i}.model.1.weight"),
                &[1, SqueezeNet::TAP_CHANNELS[i], 1, 1],
            )?;
        }
        Ok(Self { net, heads })
    }

    /// The distance between two images `[H, W, 3]` with values in \[0, 1\]; 0 for equal ones, about 0.1 for good renders.
    ///
    /// # Errors
    /// When a side is below [`Lpips::MIN_SIDE`].
    ///
    /// # Panics
    /// When sizes differ or there are not three channels: that is a bug of the caller.
    pub fn distance(&self, render: &Image, truth: &Image) -> Result<f64, LpipsError> {
        assert_same_size(render, truth, None);
        assert_eq!(truth.channels, 3, "LPIPS is for colour");
        if truth.width.min(truth.height) < Self::MIN_SIDE {
            return Err(LpipsError::TooSmall {
                width: truth.width,
                height: truth.height,
            });
        }
        // Both images go through the network side by side, so that no more than two layers of each are ever held.
        let (mut a, mut b) = (network_input(render), network_input(truth));
        let mut total = 0.0;
        for (tap, head) in self.heads.iter().enumerate() {
            a = self.net.up_to_tap(tap, a);
            b = self.net.up_to_tap(tap, b);
            total += tap_distance(&a, &b, head);
        }
        Ok(total)
    }
}

fn network_input(image: &Image) -> Map {
    let scaled = |(i, v): (usize, &f32)| (2.0 * v - 1.0 - SHIFT[i % 3]) / SCALE[i % 3];
    Map {
        height: image.height as usize,
        width: image.width as usize,
        channels: 3,
        data: image.data.iter().enumerate().map(scaled).collect(),
    }
}

/// Mean over pixels of `sum_c head_c (a_c / |a| - b_c / |b|)^2` (eq. 1 of the paper).
fn tap_distance(a: &Map, b: &Map, head: &[f32]) -> f64 {
    // The published code adds it to the norm; it decides only where a pixel's features are all zero.
    const EPSILON: f32 = 1e-10;
    let norm = |v: &[f32]| v.iter().map(|v| v * v).sum::<f32>().sqrt() + EPSILON;
    let pixels = a.data.chunks_exact(a.channels).zip(b.data.chunks_exact(b.channels));
    let total: f64 = pixels
        .map(|(a, b)| {
            let (scale_a, scale_b) = (1.0 / norm(a), 1.0 / norm(b));
            let features = a.iter().zip(b).zip(head);
            let distance: f32 = features
                .map(|((a, b), w)| w * (a * scale_a - b * scale_b).powi(2))
                .sum();
            f64::from(distance)
        })
        .sum();
    total / (a.height * a.width) as f64
}
