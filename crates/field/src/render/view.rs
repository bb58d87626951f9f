//! A camera's view of a field.

use crate::field::Field;
use crate::net::get3;
use crate::pass::{Pass, trace};
use crate::space::Ray;
use glam::{Vec2, Vec3};
use irradia_compute::Level;
use irradia_scene::Camera;
use rayon::prelude::*;

/// Options of [`render_view`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RenderOptions {
    /// Background, sRGB in \[0, 1\], unless the field has learnt one.
    pub background: [f32; 3],
    /// The photograph whose appearance code to use; `None` for the mean code, zero.
    pub image: Option<u32>,
    /// Whether to compute normals, which takes a third more time.
    pub normals: bool,
}

/// A rendered view; every plane is `[H * W]`, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FieldView {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Red, green and blue, `[3, H * W]`, over the background.
    pub color: Vec<f32>,
    /// Opacity of the field in each pixel.
    pub alpha: Vec<f32>,
    /// [Depth](irradia_scene::Intrinsics::depth), world units, the weighted mean along the ray; 0 where alpha is 0.
    pub depth: Vec<f32>,
    /// Depth at which the ray's transmittance falls below a half; 0 where it never does.
    pub median_depth: Vec<f32>,
    /// Unit normals in the world, `[3, H * W]`: the weighted mean of the negative density gradient along the ray; 0 where alpha is
    /// 0. Empty if not requested.
    pub normals: Vec<f32>,
}

/// The field's ray through pixel coordinates `(x, y)` of `camera`, and the depth per world unit along it.
pub fn camera_ray(field: &Field, camera: &Camera, x: f32, y: f32) -> (Ray, f32) {
    let (from, direction) = camera.ray(Vec2::new(x, y));
    let ray = field.space.ray(from.to_array(), direction.to_array());
    (ray, camera.depth_along(direction))
}

/// Renders the view of `camera`.
pub fn render_view(field: &Field, camera: &Camera, options: &RenderOptions) -> FieldView {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let pixels = width as usize * height as usize;
    let level = Level::detect();
    let transposed = field.transposed();
    let last = field.nets.len() - 1;
    let mut rows = vec![[0.0f32; 9]; pixels];
    rows.par_chunks_mut(width.max(1) as usize).enumerate().for_each_init(
        || (Vec::new(), Vec::new()),
        |(passes, rays): &mut (Vec<Pass>, Vec<(Ray, f32)>), (y, row)| {
            rays.clear();
            rays.extend((0..width).map(|x| camera_ray(field, camera, x as f32 + 0.5, y as f32 + 0.5)));
            let only: Vec<Ray> = rays.iter().map(|(ray, _)| *ray).collect();
            let images = vec![options.image.unwrap_or(u32::MAX); only.len()];
            let mut at = 0;
            while at < only.len() {
                let taken = trace(level, field, &only[at..], &images[at..], None, passes);
                let pass = &mut passes[last];
                if options.normals {
                    pass.slope(level, field, last, &transposed[last]);
                }
                for r in 0..taken {
                    row[at + r] = pixel(field, pass, r, &rays[at + r], options);
                }
                at += taken;
            }
        },
    );
    let plane = |c: usize| rows.iter().map(move |row| row[c]);
    FieldView {
        width,
        height,
        color: (0..3).flat_map(plane).collect(),
        alpha: plane(3).collect(),
        depth: plane(4).collect(),
        median_depth: plane(5).collect(),
        normals: if options.normals {
            (6..9).flat_map(plane).collect()
        } else {
            Vec::new()
        },
    }
}

/// Red, green, blue, alpha, mean and median depth and the normal of ray `r`.
fn pixel(field: &Field, pass: &Pass, r: usize, (ray, cosine): &(Ray, f32), options: &RenderOptions) -> [f32; 9] {
    let (color, alpha) = pass.composite(r);
    let depth_at = |i: usize| cosine * ray.world_distance(pass.middles[i]);
    let mut depth = 0.0;
    let mut normal = Vec3::ZERO;
    for i in pass.samples_of(r) {
        depth += pass.weights[i] * depth_at(i);
        if options.normals {
            let slope = field.space.unit_vjp(ray.at(pass.middles[i]), get3(&pass.slopes, i));
            let slope = Vec3::from(field.space.world_gradient(ray.at(pass.middles[i]), slope));
            normal -= pass.weights[i] * slope.normalize_or_zero();
        }
    }
    let background = field.background_toward(ray.view).unwrap_or(options.background);
    let color: [f32; 3] = std::array::from_fn(|c| color[c] + pass.transmittance[r] * background[c]);
    let depth = if alpha > 0.0 { depth / alpha } else { 0.0 };
    let median = pass.median(r).map_or(0.0, depth_at);
    let [x, y, z] = normal.normalize_or_zero().to_array();
    [color[0], color[1], color[2], alpha, depth, median, x, y, z]
}
