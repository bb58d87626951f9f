//! The rays of one step, drawn from photographs.

use crate::space::{Ray, Space};
use glam::{Vec2, Vec3};
use irradia_scene::{Camera, Rng};

/// Rays with what they should show.
#[derive(Clone, Debug, Default)]
pub struct RayBatch {
    /// The rays, in field space.
    pub rays: Vec<Ray>,
    /// The colour each should show, over its background, sRGB in \[0, 1\].
    pub targets: Vec<[f32; 3]>,
    /// What lies behind each.
    pub backgrounds: Vec<[f32; 3]>,
    /// The photograph of each, for its appearance code.
    pub images: Vec<u32>,
    /// Known distance along each ray in field units, or 0; empty where nothing is known.
    pub depths: Vec<f32>,
}

/// What lies behind a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Background {
    /// One colour.
    Fixed([f32; 3]),
    /// Another for each ray of each step, so that a field cannot hide in it (Instant-NGP, for photographs with alpha).
    Random,
}

/// A photograph to draw from, of the size that its camera has.
#[derive(Clone, Copy, Debug)]
pub struct TrainView<'a> {
    /// Its camera; the lens is not looked at, pixels are undistorted.
    pub camera: &'a Camera,
    /// `[H, W, 3]`, over the colour `over` where there is alpha.
    pub rgb: &'a [u8],
    /// `[H, W]`, where the photograph has transparency.
    pub alpha: Option<&'a [u8]>,
    /// What `rgb` lies over, sRGB in \[0, 1\].
    pub over: [f32; 3],
    /// `[H, W]`; where it is 0 no ray is drawn.
    pub mask: Option<&'a [u8]>,
    /// Depth along the camera's +Z, world units, `[H, W]`, 0 where unknown.
    pub depth: Option<&'a [f32]>,
    /// The number of its appearance code.
    pub image: u32,
}

impl RayBatch {
    /// Forgets the rays.
    pub fn clear(&mut self) {
        self.rays.clear();
        self.targets.clear();
        self.backgrounds.clear();
        self.images.clear();
        self.depths.clear();
    }

    /// Draws `count` rays through the centres of random pixels.
    pub fn draw(&mut self, views: &[TrainView], count: usize, background: Background, space: &Space, rng: &mut Rng) {
        self.clear();
        if views.is_empty() {
            return;
        }
        // A photograph that is all masked must not hold us up for ever.
        for _ in 0..8 * count {
            if self.rays.len() == count {
                return;
            }
            let view = &views[rng.below(views.len() as u32) as usize];
            let [width, height] = [view.camera.intrinsics.width, view.camera.intrinsics.height];
            let pixel = rng.below((width * height).max(1));
            let at = pixel as usize;
            // A photograph or mask of another size than the camera says gives no rays outside itself.
            let Some(rgb) = view.rgb.get(3 * at..3 * at + 3) else {
                continue;
            };
            if view.mask.is_some_and(|mask| mask.get(at).is_none_or(|m| *m == 0)) {
                continue;
            }
            let behind = match background {
                Background::Fixed(color) => color,
                Background::Random => [rng.uniform(), rng.uniform(), rng.uniform()],
            };
            let alpha = view
                .alpha
                .and_then(|alpha| alpha.get(at))
                .map_or(1.0, |a| f32::from(*a) / 255.0);
            let seen = |c: usize| f32::from(rgb[c]) / 255.0 + (1.0 - alpha) * (behind[c] - view.over[c]);
            let (x, y) = (pixel % width, pixel / width);
            let direction = view.camera.ray_direction(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let ray = space.ray(view.camera.pose.position.to_array(), direction.to_array());
            let depth = view.depth.and_then(|depth| depth.get(at)).copied().unwrap_or(0.0);
            let cosine = direction.dot(view.camera.pose.rotation * Vec3::Z);
            self.depths
                .push(if depth > 0.0 { ray.distance(depth / cosine) } else { 0.0 });
            self.rays.push(ray);
            self.targets.push(std::array::from_fn(seen));
            self.backgrounds.push(behind);
            self.images.push(view.image);
        }
    }
}
