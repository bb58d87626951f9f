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
    /// What lies behind each, unless the field knows better: see `opaque`.
    pub backgrounds: Vec<[f32; 3]>,
    /// Whether the photograph of each has no alpha: what lies behind it is then what the field has learnt, if it learns that.
    pub opaque: Vec<bool>,
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
    /// What is known of depth.
    pub depths: &'a [KnownDepth],
    /// The number of its appearance code.
    pub image: u32,
}

/// The known depth of one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownDepth {
    /// `y * width + x`.
    pub pixel: u32,
    /// Along the camera's +Z, world units. Not counted unless positive and finite.
    pub depth: f32,
}

/// What a batch is drawn by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// Rays.
    pub rays: usize,
    /// How many of them go through pixels of known depth, where their photograph has some: among all pixels, those that
    /// structure from motion knows would hardly ever be met (DS-NeRF, Deng et al. 2022).
    pub known: usize,
    /// What lies behind photographs.
    pub background: Background,
}

impl RayBatch {
    /// Forgets the rays.
    pub fn clear(&mut self) {
        self.rays.clear();
        self.targets.clear();
        self.backgrounds.clear();
        self.opaque.clear();
        self.images.clear();
        self.depths.clear();
    }

    /// Draws rays through the centres of random pixels of `views`.
    pub fn draw(&mut self, views: &[TrainView], what: &Draw, space: &Space, rng: &mut Rng) {
        self.clear();
        if views.is_empty() {
            return;
        }
        // A photograph that is all masked must not hold us up for ever.
        for _ in 0..8 * what.rays {
            if self.rays.len() == what.rays {
                return;
            }
            let view = &views[rng.below(views.len() as u32) as usize];
            let [width, height] = [view.camera.intrinsics.width, view.camera.intrinsics.height];
            let (pixel, depth) = if self.rays.len() < what.known && !view.depths.is_empty() {
                let known = view.depths[rng.below(view.depths.len() as u32) as usize];
                (known.pixel, known.depth)
            } else {
                (rng.below((width * height).max(1)), 0.0)
            };
            let at = pixel as usize;
            // A photograph or mask of another size than the camera says gives no rays outside itself.
            let Some(rgb) = view.rgb.get(3 * at..3 * at + 3) else {
                continue;
            };
            if view.mask.is_some_and(|mask| mask.get(at).is_none_or(|m| *m == 0)) {
                continue;
            }
            let behind = match what.background {
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
            let cosine = direction.dot(view.camera.pose.rotation * Vec3::Z);
            let known = depth > 0.0 && depth.is_finite();
            self.depths.push(if known { ray.distance(depth / cosine) } else { 0.0 });
            self.rays.push(ray);
            self.targets.push(std::array::from_fn(seen));
            self.backgrounds.push(behind);
            self.opaque.push(view.alpha.is_none());
            self.images.push(view.image);
        }
    }
}
