//! Initial splats: on points from structure from motion, or at random in the cameras' frusta.

use crate::nearest::Nearest;
use crate::{Splats, logit};
use glam::{Vec2, Vec3};
use irradia_scene::{Camera, GaussianCloud, PointCloud, Rng, sh};
use rayon::prelude::*;

/// Options of the initial splats.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitOptions {
    /// Opacity of every splat; 0.1 in 3DGS.
    pub opacity: f32,
    /// Factor on the neighbour distance, which is the initial size; 1 in 3DGS.
    pub scale: f32,
    /// SH degree of the splats.
    pub sh_degree: u32,
}

/// One isotropic splat per point, its size the root mean square distance to the three nearest neighbours (Inria code).
pub fn from_points(points: &PointCloud, options: &InitOptions) -> Splats {
    let kept: Vec<usize> = (0..points.len()).filter(|i| points.positions[*i].is_finite()).collect();
    let positions: Vec<[f32; 3]> = kept.iter().map(|i| points.positions[*i].to_array()).collect();
    let n = positions.len();
    let distances = neighbour_distances(&positions);
    let coefficients = sh::coefficients(options.sh_degree);
    let mut harmonics = vec![0.0; n * coefficients * 3];
    for (to, i) in harmonics.chunks_mut(coefficients * 3).zip(&kept) {
        for (to, color) in to.iter_mut().zip(points.colors[*i]) {
            *to = sh::dc_from_color(f32::from(color) / 255.0);
        }
    }
    Splats::from_cloud(&GaussianCloud {
        means: positions,
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        log_scales: distances.iter().map(|d| [(d * options.scale).ln(); 3]).collect(),
        opacity_logits: vec![logit(options.opacity); n],
        sh: harmonics,
        sh_degree: options.sh_degree,
        ..GaussianCloud::default()
    })
}

/// Root mean square distance to the three nearest neighbours, at least 1e-7 of the cloud's size, since its logarithm is taken.
fn neighbour_distances(positions: &[[f32; 3]]) -> Vec<f32> {
    let size = (0..3)
        .map(|c| {
            let (low, high) = positions
                .iter()
                .fold((f32::MAX, f32::MIN), |(l, h), p| (l.min(p[c]), h.max(p[c])));
            (high - low).max(0.0)
        })
        .fold(0.0f32, f32::max);
    if positions.len() < 2 || size == 0.0 {
        return vec![if size > 0.0 { 0.01 * size } else { 0.01 }; positions.len()];
    }
    let tree = Nearest::new(positions);
    let others = (positions.len() - 1).min(3);
    positions
        .par_iter()
        .map(|p| {
            let near: [_; 4] = tree.of(*p);
            // The first is the point itself.
            let sum: f32 = near[1..=others].iter().map(|(distance, _)| distance).sum();
            (sum / others as f32).sqrt().max(1e-7 * size)
        })
        .collect()
}

/// The content of a photograph's pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelClass {
    /// A colour, sRGB.
    Color([u8; 3]),
    /// Transparent.
    Empty,
    /// Masked: excluded from training.
    Masked,
}

/// At most `count` points in the cameras' frusta, for scenes without points. `depth_bounds[i]` holds the nearest and farthest
/// depth of view i's scene, where known; otherwise depths are drawn around that of the point on which the cameras focus.
///
/// Points are drawn along rays of random pixels at which the lens shows something, uniformly in inverse depth, and kept with a
/// probability that grows with the fraction of cameras that see them, so that they concentrate where views overlap.
/// `open(view)` opens a photograph and returns the content of its pixels; photographs are opened one after the other, in one or
/// a few passes over all of them. A point that is transparent in any camera is outside the visual hull (Laurentini 1994) and is
/// discarded; so is one that is masked in more cameras than not, since training would never remove it. A point's colour is the
/// mean over the cameras that see it: correct if it lies on a surface, and elsewhere never so dark that the clamp of negative
/// colours prevents it from learning.
///
/// # Errors
/// Those of `open`.
pub fn random_points<E, C: Fn(Vec2) -> PixelClass + Sync>(
    cameras: &[Camera],
    depth_bounds: &[Option<[f32; 2]>],
    count: usize,
    rng: &mut Rng,
    mut open: impl FnMut(usize) -> Result<C, E>,
) -> Result<PointCloud, E> {
    let mut cloud = PointCloud::default();
    let focus = focus_point(cameras);
    let mut draw = || {
        let view = rng.below(cameras.len() as u32) as usize;
        let camera = &cameras[view];
        let k = &camera.intrinsics;
        let pixel = Vec2::new(rng.uniform() * k.width as f32, rng.uniform() * k.height as f32);
        if !k.shows(pixel) {
            return None;
        }
        let [near, far] = depth_bounds.get(view).copied().flatten().unwrap_or_else(|| {
            let distance = focus.distance(camera.pose.position).max(4.0 * camera.near);
            [0.5 * distance, 1.6 * distance]
        });
        let inverse = rng.range(1.0 / far, 1.0 / near);
        let point = camera.pose.position + camera.pose.rotation * k.ray(pixel) / inverse;
        Some(Candidate {
            point,
            chance: rng.uniform(),
            ..Candidate::default()
        })
    };
    let attempts = if cameras.is_empty() { 0 } else { 20 * count };
    let mut made = 0;
    while made < attempts && cloud.len() < count {
        // Usually one pass suffices.
        let batch = (4 * count).min(attempts - made);
        let mut candidates: Vec<Candidate> = (0..batch).filter_map(|_| draw()).collect();
        for (view, camera) in cameras.iter().enumerate() {
            let content = open(view)?;
            candidates
                .par_iter_mut()
                .with_min_len(1024)
                .for_each(|candidate| candidate.observe(camera, &content));
        }
        for (attempt, candidate) in (made..).zip(&candidates) {
            let Some((seen, color)) = candidate.mean_color() else {
                continue;
            };
            // Late attempts accept any point: a scene whose cameras overlap little must still get its points.
            let accepted = candidate.chance < seen as f32 / cameras.len() as f32 || attempt > count * 15;
            if accepted && cloud.len() < count {
                cloud.positions.push(candidate.point);
                cloud.colors.push(color);
            }
        }
        made += batch;
    }
    Ok(cloud)
}

/// A point that may become part of the scene.
#[derive(Clone, Copy, Default)]
struct Candidate {
    point: Vec3,
    /// In \[0, 1\], compared with the fraction of the cameras that see it.
    chance: f32,
    seen: u32,
    masked: u32,
    /// Sum of its colours in the cameras that see it.
    sum: [u32; 3],
    /// Whether it is transparent in a camera.
    is_outside: bool,
}

impl Candidate {
    /// Adds the observation by `camera`, whose photograph has `content`.
    fn observe(&mut self, camera: &Camera, content: &impl Fn(Vec2) -> PixelClass) {
        if self.is_outside {
            return;
        }
        if let Some((pixel, _)) = camera.sees(self.point) {
            match content(pixel) {
                PixelClass::Color(color) => {
                    self.seen += 1;
                    (0..3).for_each(|c| self.sum[c] += u32::from(color[c]));
                }
                PixelClass::Masked => self.masked += 1,
                PixelClass::Empty => self.is_outside = true,
            }
        }
    }

    /// Number of cameras that see it, and its mean colour in them; `None` if it cannot be part of the scene.
    fn mean_color(&self) -> Option<(u32, [u8; 3])> {
        if self.is_outside || self.masked > self.seen {
            return None;
        }
        Some((self.seen, self.sum.map(|s| (s / self.seen.max(1)) as u8)))
    }
}

/// The point nearest to all optical axes, in the least-squares sense, moved in front of the cameras if the axes are parallel
/// (forward-facing captures), where it would be at infinity.
pub fn focus_point(cameras: &[Camera]) -> Vec3 {
    let n = cameras.len().max(1) as f32;
    let center = cameras.iter().map(|c| c.pose.position).sum::<Vec3>() / n;
    let spread = camera_extent(cameras);
    let mut normal = glam::Mat3::from_diagonal(Vec3::splat(1e-3));
    let mut right =
        1e-3 * (center + cameras.iter().map(|c| c.pose.rotation * Vec3::Z).sum::<Vec3>() / n * 4.0 * spread);
    for camera in cameras {
        let axis = camera.pose.rotation * Vec3::Z;
        let across = glam::Mat3::IDENTITY - glam::Mat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        let across = across * (1.0 / n);
        normal += across;
        right += across * camera.pose.position;
    }
    normal.inverse() * right
}

/// The scene's extent as 3DGS measures it: 1.1 times the largest distance of a camera from the cameras' mean.
pub fn camera_extent(cameras: &[Camera]) -> f32 {
    let center = cameras.iter().map(|c| c.pose.position).sum::<Vec3>() / cameras.len().max(1) as f32;
    let radius = cameras
        .iter()
        .map(|c| c.pose.position.distance(center))
        .fold(0.0, f32::max);
    if radius > 0.0 { 1.1 * radius } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Intrinsics, Lens, Pose};

    const OPTIONS: InitOptions = InitOptions {
        opacity: 0.1,
        scale: 1.0,
        sh_degree: 1,
    };

    #[test]
    fn a_grid_gets_its_spacing_as_scale_and_its_colour_as_dc() {
        let mut points = PointCloud::default();
        for i in 0..4 {
            for j in 0..4 {
                for k in 0..4 {
                    points.positions.push(Vec3::new(i as f32, j as f32, k as f32) * 0.5);
                    points.colors.push([255, 0, 51]);
                }
            }
        }
        let splats = from_points(&points, &OPTIONS);
        assert_eq!(splats.len(), 64);
        for i in 0..64 {
            assert!((splats.log_scales.get(1, i) - 0.5f32.ln()).abs() < 1e-5);
            assert!((splats.opacity(i) - 0.1).abs() < 1e-6);
            assert!((sh::color_from_dc(splats.sh.get(2, i)) - 0.2).abs() < 1e-5);
        }
    }

    #[test]
    fn coincident_points_one_point_and_poison_give_finite_scales() {
        let same = |n: usize| PointCloud {
            positions: vec![Vec3::ONE; n],
            colors: vec![[9; 3]; n],
        };
        for mut points in [same(0), same(1), same(100)] {
            points.positions.push(Vec3::NAN);
            points.colors.push([0; 3]);
            let n = points.len() - 1;
            let splats = from_points(&points, &OPTIONS);
            assert_eq!(splats.len(), n);
            assert!(splats.log_scales.as_slice().iter().all(|s| s.is_finite()));
        }
    }

    #[test]
    fn no_points_lie_where_a_lens_shows_nothing() {
        // The image circle has a radius of pi times 10 pixels, and half of the image's area.
        let fisheye = Intrinsics {
            fx: 10.0,
            fy: 10.0,
            lens: Lens::fisheye([0.0; 4]),
            ..Intrinsics::from_fov_x(80, 80, 1.0)
        };
        let camera = Camera::new(Pose::look_at(Vec3::NEG_Z, Vec3::ZERO, Vec3::NEG_Y), fisheye);
        let open = |_| Ok::<_, ()>(|_| PixelClass::Color([0; 3]));
        let cloud = random_points(&[camera], &[], 1000, &mut Rng::new(1, 0), open).unwrap();
        let axial = cloud
            .positions
            .iter()
            .filter(|p| p.truncate().length() < 1e-3 * p.length());
        assert_eq!((cloud.len(), axial.count()), (1000, 0));
    }

    #[test]
    fn a_ring_of_cameras_focuses_on_its_centre_and_points_lie_in_view() {
        let target = Vec3::new(1.0, 2.0, 0.5);
        let cameras: Vec<Camera> = (0..12)
            .map(|i| {
                let angle = i as f32 * std::f32::consts::FRAC_PI_6;
                let eye = target + Vec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 2.0);
                Camera::new(Pose::look_at(eye, target, Vec3::Z), Intrinsics::from_fov_x(64, 64, 0.7))
            })
            .collect();
        assert!(focus_point(&cameras).distance(target) < 0.02);
        let points = |cameras: &[Camera], count: usize, content: fn(usize) -> PixelClass| -> PointCloud {
            let open = |view| Ok::<_, ()>(move |_| content(view));
            random_points(cameras, &[], count, &mut Rng::new(1, 0), open).unwrap()
        };
        let cloud = points(&cameras, 500, |view| PixelClass::Color([view as u8; 3]));
        assert_eq!(cloud.len(), 500);
        let mean = cloud.positions.iter().sum::<Vec3>() / 500.0;
        assert!(mean.distance(target) < 0.5, "{mean}");
        assert!(points(&[], 10, |_| PixelClass::Color([0; 3])).is_empty());
        assert!(points(&cameras, 10, |_| PixelClass::Empty).is_empty());
        assert!(points(&cameras, 10, |_| PixelClass::Masked).is_empty());
        let fails = |_| Err::<fn(Vec2) -> PixelClass, _>("not a photograph");
        assert!(random_points(&cameras, &[], 10, &mut Rng::new(1, 0), fails).is_err());
    }
}
