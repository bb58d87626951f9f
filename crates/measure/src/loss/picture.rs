//! Test images for the losses.

use super::{DepthGradient, Target, Truth};
use irradia_scene::{Image, Rng};

/// A render, a truth and an optional mask, planar.
pub(super) struct Picture {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) render: Vec<f64>,
    pub(super) truth: Vec<f64>,
    pub(super) mask: Option<Vec<u8>>,
}

impl Picture {
    /// Smooth colours with noise, and a render close to the truth. Values are rounded to single precision, so that both precisions
    /// use the same ones.
    pub(super) fn random(width: usize, height: usize, masked: bool, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 0);
        let pixels = width * height;
        let truth: Vec<f64> = (0..3 * pixels)
            .map(|i| {
                let wave = (i % width) as f32 * 0.3 + (i / width) as f32 * 0.17;
                f64::from(0.5 + 0.3 * wave.sin() + 0.1 * rng.normal())
            })
            .collect();
        let render = truth
            .iter()
            .map(|t| f64::from(*t as f32 + 0.1 * rng.normal()))
            .collect();
        let mask = masked.then(|| (0..pixels).map(|_| [0, 255, 255, 100][rng.below(4) as usize]).collect());
        Self {
            width,
            height,
            render,
            truth,
            mask,
        }
    }

    pub(super) fn target(&self) -> Target<'_, f64> {
        Target {
            width: self.width,
            height: self.height,
            truth: Truth::Planar(&self.truth),
            mask: self.mask.as_deref(),
        }
    }

    /// The planes as an image.
    pub(super) fn image(&self, planar: &[f64]) -> Image {
        let pixels = self.width * self.height;
        let data = (0..3 * pixels).map(|i| planar[i % 3 * pixels + i / 3] as f32).collect();
        Image::new(self.width as u32, self.height as u32, 3, data)
    }
}

/// The result of `loss`, and its gradients with respect to depth and opacity, added to planes of `pixels` times `first`.
pub(super) fn depth_gradient<T: Copy, R>(
    pixels: usize,
    first: T,
    loss: impl FnOnce(&mut DepthGradient<T>) -> R,
) -> (R, [Vec<T>; 2]) {
    let [mut depth, mut alpha] = [vec![first; pixels], vec![first; pixels]];
    let mut gradient = DepthGradient {
        depth: &mut depth,
        alpha: &mut alpha,
    };
    let result = loss(&mut gradient);
    (result, [depth, alpha])
}
