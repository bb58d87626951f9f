//! Ray tracing of a view: per sample a primary ray, a shadow ray to the sun, and a reflected ray for glossy surfaces. Sky light
//! is analytic (`ambient`), since sampling it would dominate the noise.

use crate::ambient;
use crate::lens::direction;
use crate::scene::{Hit, SynthScene};
use crate::shape::Ray;
use crate::sky;
use glam::{Quat, Vec2, Vec3};
use irradia_scene::{Camera, Image, Rng, srgb_from_linear};
use rayon::prelude::*;
use std::f32::consts::TAU;

/// Offset of secondary rays from the surface, world units.
const RAY_OFFSET: f32 = 1e-3;
/// Clamp of linear sample values, so that one highlight sample does not whiten a pixel.
const MAX_RADIANCE: f32 = 4.0;
/// Samples of a pixel within this distance in sRGB are considered uniform.
const UNIFORM_TOLERANCE: f32 = 0.05;
/// Half the width of the pixel's tent-shaped filter, pixels. Its variance, 0.24, is about that of a lens with its sensor,
/// and of the low-pass filter that splats are rendered with (0.3): splats cannot represent sharper edges.
const FILTER_RADIUS: f32 = 1.2;
/// Exposure, chosen so that sunlit stone stays below white.
const EXPOSURE: f32 = 0.46;

/// One traced view.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthFrame {
    /// `[H, W, 3]` sRGB in \[0, 1\].
    pub color: Image,
    /// Depth along the camera's +Z of the first hit through each pixel centre, `[H, W]`, world units; for wide lenses, the distance.
    pub depth: Image,
    /// Unit normals at the same points, facing the camera, `[H, W, 3]` world.
    pub normals: Image,
}

impl SynthFrame {
    /// The image as 8 bits, `[H, W, 4]`, opaque.
    pub fn rgba(&self) -> Vec<u8> {
        let rgb = self.color.to_u8();
        rgb.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect()
    }
}

impl SynthScene {
    /// Traces the scene with up to `samples` samples per pixel (rounded up to a square number) and random seed `seed`.
    ///
    /// The result does not depend on the number of threads.
    pub fn trace(&self, camera: &Camera, samples: u32, seed: u64) -> SynthFrame {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let side = (1..)
            .find(|n| n * n >= samples)
            .expect("some square is at least `samples`");
        let mut frame = SynthFrame {
            color: Image::zeros(width, height, 3),
            depth: Image::zeros(width, height, 1),
            normals: Image::zeros(width, height, 3),
        };
        let row = width as usize;
        let rows = frame
            .color
            .data
            .par_chunks_mut(3 * row)
            .zip(frame.depth.data.par_chunks_mut(row));
        rows.zip(frame.normals.data.par_chunks_mut(3 * row))
            .enumerate()
            .for_each(|(y, ((color, depth), normals))| {
                for x in 0..row {
                    let mut rng = Rng::new(seed, (y * row + x) as u64);
                    let corner = Vec2::new(x as f32, y as f32);
                    color[3 * x..3 * x + 3].copy_from_slice(&self.pixel(camera, corner, side, &mut rng).to_array());
                    let Some(ray) = pixel_ray(camera, corner + 0.5) else {
                        continue;
                    };
                    if let Some(hit) = self.hit(&ray, camera.near) {
                        depth[x] = hit.t * depth_per_distance(camera, ray.direction);
                        normals[3 * x..3 * x + 3].copy_from_slice(&hit.normal.to_array());
                    }
                }
            });
        frame
    }

    /// sRGB colour of the pixel with upper left `corner`, from at most `side^2` samples.
    fn pixel(&self, camera: &Camera, corner: Vec2, side: u32, rng: &mut Rng) -> Vec3 {
        // Adaptive sampling: nine samples that agree suffice for most pixels.
        if side > 3 {
            let (mean, spread) = self.sampled(camera, corner, 3, rng);
            if spread < UNIFORM_TOLERANCE {
                return mean;
            }
        }
        self.sampled(camera, corner, side, rng).0
    }

    /// sRGB colour from `side^2` samples, and their spread.
    fn sampled(&self, camera: &Camera, corner: Vec2, side: u32, rng: &mut Rng) -> (Vec3, f32) {
        let count = side * side;
        // Each of the three domains of a sample (pixel, sun, mirror) is stratified; strata of different domains are paired
        // at random.
        let mut strata: [Vec<u32>; 2] = std::array::from_fn(|_| (0..count).collect());
        strata.iter_mut().for_each(|order| rng.shuffle(order));
        let (mut sum, mut low, mut high) = (Vec3::ZERO, Vec3::INFINITY, Vec3::NEG_INFINITY);
        for sample in 0..count {
            let mut within = |stratum: u32| {
                let cell = Vec2::new((stratum % side) as f32, (stratum / side) as f32);
                (cell + Vec2::new(rng.uniform(), rng.uniform())) / side as f32
            };
            let ray = pixel_ray(camera, corner + 0.5 + within(sample).map(tent) * FILTER_RADIUS);
            let [sun, mirror] = std::array::from_fn(|plane| within(strata[plane][sample as usize]));
            let radiance = match ray.map(|ray| (ray, self.hit(&ray, camera.near))) {
                Some((ray, Some(hit))) => self.shade(&ray, &hit, sun, mirror),
                Some((ray, None)) => sky::radiance(ray.direction),
                None => Vec3::ZERO,
            };
            let radiance = radiance.min(Vec3::splat(MAX_RADIANCE));
            sum += radiance;
            (low, high) = (low.min(radiance), high.max(radiance));
        }
        (
            tone_map(sum / count as f32),
            (tone_map(high) - tone_map(low)).max_element(),
        )
    }

    /// Radiance towards the ray's origin; `sun` and `mirror` are uniform in the unit square.
    fn shade(&self, ray: &Ray, hit: &Hit, sun: Vec2, mirror: Vec2) -> Vec3 {
        let (material, light) = (&hit.object.material, &self.light);
        let color = material.texture.color(hit.object.shape.local(hit.point));
        if material.texture.is_emissive() {
            return color;
        }
        let start = hit.point + hit.normal * RAY_OFFSET;
        let toward_sun = tilted(light.sun, disc(sun) * light.sun_spread);
        let facing = hit.normal.dot(toward_sun);
        let lit = facing > 0.0
            && !self.is_blocked(
                &Ray {
                    origin: start,
                    direction: toward_sun,
                },
                RAY_OFFSET,
            );
        let sunlight = if lit { light.sun_light * facing } else { Vec3::ZERO };

        let mut radiance = Vec3::ZERO;
        if !material.metal {
            radiance += color * (sunlight + ambient::occluded(self, hit));
        }
        let reflectance = if material.metal {
            color
        } else {
            Vec3::splat(material.coat)
        };
        if reflectance.max_element() > 0.0 {
            let cosine = (-ray.direction.dot(hit.normal)).clamp(0.0, 1.0);
            // Schlick's approximation (1994); rough surfaces gain less at grazing angles.
            let grazing = (1.0 - cosine).powi(5) * (1.0 - 2.0 * material.roughness).max(0.0);
            let fresnel = reflectance + (Vec3::ONE - reflectance) * grazing;
            let exact = ray.direction - 2.0 * ray.direction.dot(hit.normal) * hit.normal;
            // A metal shows only its reflection: four rays a quarter turn apart reduce noise.
            let rays = if material.metal { 4 } else { 1 };
            let mut reflected = Vec3::ZERO;
            for turn in 0..rays {
                let lobe = disc(mirror + Vec2::Y * (turn as f32 / rays as f32)) * material.roughness;
                let mut direction = tilted(exact, lobe);
                // A rough lobe may extend below the surface: mirror it back.
                let below = direction.dot(hit.normal);
                if below < 0.02 {
                    direction = (direction + hit.normal * (0.02 - below)).normalize();
                }
                reflected += self.incoming(start, direction) / rays as f32;
            }
            if lit {
                // The sun's reflection: a Gaussian of the lobe's width around the mirror direction.
                let off = 2.0 * (1.0 - exact.dot(light.sun)).max(0.0);
                let width = 0.5 * material.roughness * material.roughness + light.sun_spread * light.sun_spread;
                reflected += light.sun_light * ((-off / width).exp() * 0.05 / width);
            }
            radiance += fresnel * reflected;
        }
        radiance
    }

    /// Radiance arriving at a point from a direction: the sky, or a surface with simplified lighting.
    fn incoming(&self, origin: Vec3, direction: Vec3) -> Vec3 {
        let ray = Ray { origin, direction };
        let Some(hit) = self.hit(&ray, RAY_OFFSET) else {
            return sky::radiance(direction);
        };
        let texture = hit.object.material.texture;
        let color = texture.color(hit.object.shape.local(hit.point));
        if texture.is_emissive() {
            return color;
        }
        let light = &self.light;
        // Without a shadow ray: 0.7 is the assumed fraction of sunlit surfaces.
        let sunlit = 0.7 * hit.normal.dot(light.sun).max(0.0);
        color * (light.sun_light * sunlit + ambient::unoccluded(light, &hit))
    }
}

/// The depth, as in [`SynthFrame`], of a point at distance 1 along the unit `direction`.
pub(crate) fn depth_per_distance(camera: &Camera, direction: Vec3) -> f32 {
    if camera.intrinsics.lens.is_wide() {
        1.0
    } else {
        direction.dot(camera.pose.rotation * Vec3::Z)
    }
}

/// The ray through pixel coordinates; `None` outside the image circle of a fisheye.
pub(crate) fn pixel_ray(camera: &Camera, pixel: Vec2) -> Option<Ray> {
    let (k, mut pose) = (&camera.intrinsics, camera.pose);
    if let Some(shutter) = &camera.shutter {
        let time = shutter.time(pixel, [k.width, k.height]);
        pose.position = pose.world_from_camera(time * shutter.translation);
        pose.rotation *= Quat::from_scaled_axis(time * shutter.rotation);
    }
    Some(Ray {
        origin: pose.position,
        direction: pose.rotation * direction(k, pixel)?,
    })
}

/// An area-preserving polar map from the unit square to the unit disc (cf. Shirley and Chiu 1997).
fn disc(square: Vec2) -> Vec2 {
    Vec2::from_angle(TAU * square.y) * square.x.sqrt()
}

/// Maps a uniform number to \[-1, 1\] with a tent distribution.
fn tent(u: f32) -> f32 {
    if u < 0.5 {
        (2.0 * u).sqrt() - 1.0
    } else {
        1.0 - (2.0 - 2.0 * u).sqrt()
    }
}

/// `axis` tilted by an offset on the plane at distance 1.
fn tilted(axis: Vec3, offset: Vec2) -> Vec3 {
    let (s, t) = axis.any_orthonormal_pair();
    (axis + s * offset.x + t * offset.y).normalize()
}

/// Linear radiance to sRGB: Narkowicz's fit (2015) of the ACES film curve, then sRGB.
fn tone_map(linear: Vec3) -> Vec3 {
    let x = linear * EXPOSURE;
    let film = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14);
    Vec3::from_array(film.to_array().map(|v| srgb_from_linear(v.clamp(0.0, 1.0))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo_scene;
    use irradia_scene::{Intrinsics, Pose};

    fn camera(size: u32) -> Camera {
        Camera::new(
            Pose::look_at(Vec3::new(3.2, -2.4, 1.9), Vec3::new(0.0, 0.0, 0.3), Vec3::Z),
            Intrinsics::from_fov_x(size, size, 0.85),
        )
    }

    #[test]
    fn a_vertical_view_has_the_depth_of_the_table() {
        let camera = Camera::new(
            Pose::look_at(Vec3::new(0.1, 0.0, 4.0), Vec3::new(0.1, 0.0, 0.0), Vec3::Y),
            Intrinsics::from_fov_x(33, 33, 0.05),
        );
        let frame = demo_scene().trace(&camera, 1, 0);
        assert!(frame.depth.data.iter().all(|depth| (depth - 4.0).abs() < 1e-4));
        assert!((Vec3::from_slice(frame.normals.pixel(16, 16)) - Vec3::Z).length() < 1e-5);
    }

    #[test]
    fn depth_unprojects_to_the_hit_point_and_normals_face_the_camera() {
        let (scene, camera) = (demo_scene(), camera(48));
        let frame = scene.trace(&camera, 1, 0);
        for y in 0..48 {
            for x in 0..48 {
                let pixel = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let ray = pixel_ray(&camera, pixel).expect("a pinhole has all rays");
                let hit = scene.hit(&ray, camera.near).expect("the backdrop closes the scene");
                let (at, depth) = camera.project(hit.point).expect("in front");
                assert!((at - pixel).length() < 1e-2, "{x} {y}");
                assert!((frame.depth.pixel(x, y)[0] - depth).abs() < 1e-4 * depth, "{x} {y}");
                let normal = Vec3::from_slice(frame.normals.pixel(x, y));
                assert!((normal.length() - 1.0).abs() < 1e-3 && normal.dot(ray.direction) <= 0.0);
            }
        }
    }

    #[test]
    fn the_ball_has_the_depth_of_a_sphere() {
        let center = Vec3::new(-0.42, -0.38, 0.46);
        let eye = Vec3::new(-2.5, -3.0, 1.6);
        let camera = Camera::new(Pose::look_at(eye, center, Vec3::Z), Intrinsics::from_fov_x(31, 31, 0.1));
        let frame = demo_scene().trace(&camera, 1, 0);
        let expected = (eye - center).length() - 0.46;
        assert!((frame.depth.pixel(15, 15)[0] - expected).abs() < 1e-4);
    }

    #[test]
    fn frames_depend_on_the_seed_but_not_on_the_number_of_threads() {
        let scene = demo_scene();
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        let first = one.install(|| scene.trace(&camera(24), 4, 0));
        assert_eq!(first, scene.trace(&camera(24), 4, 0));
        assert!(first.color.data.iter().all(|v| (0.0..=1.0).contains(v)));
        let second = scene.trace(&camera(24), 4, 1);
        assert!(first.color != second.color && first.depth == second.depth);
    }

    #[test]
    fn only_the_ball_changes_colour_with_the_viewpoint() {
        let scene = demo_scene();
        let seen = |target: Vec3, offset: Vec3| {
            let pose = Pose::look_at(target + offset, target, Vec3::Z);
            let frame = scene.trace(&Camera::new(pose, Intrinsics::from_fov_x(1, 1, 0.01)), 1024, 0);
            Vec3::from_slice(frame.color.pixel(0, 0))
        };
        let difference = |target: Vec3| {
            // The ball reflects the sky to a high camera and the hills to a low one.
            let [high, low] =
                [Vec3::new(-1.0, -1.6, 3.0), Vec3::new(-3.0, -1.5, 0.5)].map(|offset| seen(target, offset));
            (high - low).length()
        };
        let on_the_ball = Vec3::new(-0.42, -0.38, 0.46) + Vec3::new(-0.6, -0.8, 0.0) * 0.46;
        assert!(difference(on_the_ball) > 0.15);
        assert!(difference(Vec3::new(6.0, -4.0, -1.45)) < 0.02);
    }
}
