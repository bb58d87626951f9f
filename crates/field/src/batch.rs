//! The rays of one step, sampled from photographs.

use crate::space::{Ray, Space};
use glam::Vec2;
use irradia_scene::{Camera, Rng};

/// Rays with their target colours.
#[derive(Clone, Debug, Default)]
pub struct RayBatch {
    /// The rays, in field space.
    pub rays: Vec<Ray>,
    /// Target colour of each ray, over its background, sRGB in \[0, 1\].
    pub targets: Vec<[f32; 3]>,
    /// Background of each ray, unless the field has learnt one: see `opaque`.
    pub backgrounds: Vec<[f32; 3]>,
    /// Whether the photograph of each ray lacks alpha: a learnt background then replaces the one given, if the field has one.
    pub opaque: Vec<bool>,
    /// Photograph of each ray, for its appearance code.
    pub images: Vec<u32>,
    /// Known distance along each ray in field units, 0 if unknown; empty if no distance is known.
    pub depths: Vec<f32>,
}

/// The background behind a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Background {
    /// One colour.
    Fixed([f32; 3]),
    /// A random colour per ray and step, which a field cannot imitate (Instant-NGP, for photographs with alpha).
    Random,
}

/// A photograph to sample rays from, at the size of its camera.
#[derive(Clone, Copy, Debug)]
pub struct TrainView<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// `[H, W, 3]`, composited over the colour `over` if there is alpha.
    pub rgb: &'a [u8],
    /// `[H, W]`, if the photograph has transparency.
    pub alpha: Option<&'a [u8]>,
    /// The colour `rgb` is composited over, sRGB in \[0, 1\].
    pub over: [f32; 3],
    /// `[H, W]`; no ray is sampled where it is 0.
    pub mask: Option<&'a [u8]>,
    /// Pixels of known depth.
    pub depths: &'a [KnownDepth],
    /// Index of its appearance code.
    pub image: u32,
}

/// The known depth of one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownDepth {
    /// `y * width + x`.
    pub pixel: u32,
    /// [Depth](irradia_scene::Intrinsics::depth), world units. Ignored unless positive and finite.
    pub depth: f32,
}

/// How a batch is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// Number of rays.
    pub rays: usize,
    /// How many of them pass through pixels of known depth, if their photograph has some: uniform sampling would hardly ever
    /// hit the pixels of structure-from-motion points (DS-NeRF, Deng et al. 2022).
    pub known: usize,
    /// The background behind photographs.
    pub background: Background,
}

/// Pixels without a ray that are drawn in a row before a batch remains smaller: all photographs may be masked. If a hundredth of the pixels
/// is usable, a batch of 16,384 rays remains smaller once in 10^39.
const MAX_MISSES: usize = 10_000;

impl RayBatch {
    /// Removes all rays.
    pub fn clear(&mut self) {
        self.rays.clear();
        self.targets.clear();
        self.backgrounds.clear();
        self.opaque.clear();
        self.images.clear();
        self.depths.clear();
    }

    /// Samples rays through the centres of random pixels of `views`.
    pub fn draw(&mut self, views: &[TrainView], what: &Draw, space: &Space, rng: &mut Rng) {
        self.clear();
        if views.is_empty() {
            return;
        }
        let mut misses = 0;
        while self.rays.len() < what.rays && misses < MAX_MISSES {
            misses += 1;
            let view = &views[rng.below(views.len() as u32) as usize];
            let [width, height] = [view.camera.intrinsics.width, view.camera.intrinsics.height];
            let (pixel, depth) = if self.rays.len() < what.known && !view.depths.is_empty() {
                let known = view.depths[rng.below(view.depths.len() as u32) as usize];
                (known.pixel, known.depth)
            } else {
                (rng.below((width * height).max(1)), 0.0)
            };
            let at = pixel as usize;
            // A photograph or mask smaller than its camera's image yields no rays outside itself.
            let Some(rgb) = view.rgb.get(3 * at..3 * at + 3) else {
                continue;
            };
            if view.mask.is_some_and(|mask| mask.get(at).is_none_or(|m| *m == 0)) {
                continue;
            }
            let background = match what.background {
                Background::Fixed(color) => color,
                Background::Random => [rng.uniform(), rng.uniform(), rng.uniform()],
            };
            let alpha = view
                .alpha
                .and_then(|alpha| alpha.get(at))
                .map_or(1.0, |a| f32::from(*a) / 255.0);
            let target = |c: usize| f32::from(rgb[c]) / 255.0 + (1.0 - alpha) * (background[c] - view.over[c]);
            let (x, y) = (pixel % width, pixel / width);
            let (from, direction) = view.camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let ray = space.ray(from.to_array(), direction.to_array());
            let cosine = view.camera.depth_along(direction);
            let known = depth > 0.0 && depth.is_finite();
            self.depths.push(if known { ray.distance(depth / cosine) } else { 0.0 });
            self.rays.push(ray);
            self.targets.push(std::array::from_fn(target));
            self.backgrounds.push(background);
            self.opaque.push(view.alpha.is_none());
            self.images.push(view.image);
            misses = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Intrinsics, Pose};

    #[test]
    fn a_batch_is_full_if_a_mask_keeps_few_pixels_and_empty_if_it_keeps_none() {
        let camera = Camera::new(
            Pose::look_at(glam::Vec3::NEG_Z, glam::Vec3::ZERO, glam::Vec3::NEG_Y),
            Intrinsics::from_fov_x(50, 50, 0.8),
        );
        // 2 % of the pixels are white, the others black.
        let rgb: Vec<u8> = (0..3 * 2500).map(|i| if i < 3 * 50 { 255 } else { 0 }).collect();
        let what = Draw {
            rays: 1000,
            known: 0,
            background: Background::Fixed([0.0; 3]),
        };
        let drawn = |kept: usize| {
            let mask: Vec<u8> = (0..2500).map(|i| u8::from(i < kept)).collect();
            let view = TrainView {
                camera: &camera,
                rgb: &rgb,
                alpha: None,
                over: [0.0; 3],
                mask: Some(&mask),
                depths: &[],
                image: 0,
            };
            let mut batch = RayBatch::default();
            batch.draw(&[view], &what, &Space::cube([0.0; 3], 1.0), &mut Rng::new(1, 0));
            batch.targets
        };
        assert_eq!(drawn(50), [[1.0; 3]; 1000]);
        assert!(drawn(0).is_empty());
    }
}
