//! The surfaces of a trained field as points, to initialise a Gaussian cloud.

use crate::field::Field;
use crate::pass::{Pass, trace};
use crate::render::view::camera_ray;
use crate::space::Ray;
use glam::{Vec2, Vec3};
use irradia_compute::Level;
use irradia_scene::{Camera, PointCloud, Rng};
use rayon::prelude::*;

/// How surfaces are sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointsOptions {
    /// Maximum number of points.
    pub count: usize,
    /// Minimum alpha of a ray that counts as hitting a surface.
    pub alpha: f32,
    /// Random seed.
    pub seed: u64,
}

impl Default for PointsOptions {
    /// 100,000 points on rays with an alpha of at least a half.
    fn default() -> Self {
        Self {
            count: 100_000,
            alpha: 0.5,
            seed: 0,
        }
    }
}

/// Hits per point requested: a surface's cells are then hit more than once on average.
const HITS_PER_POINT: usize = 2;
/// Maximum number of rounds, each with as many rays as hits are needed: much of each image may be empty.
const MAX_ROUNDS: u64 = 16;
/// Rays per task.
const RAYS_PER_TASK: usize = 1024;
/// Maximum number of pixels drawn for one ray: all may be masked.
const MAX_DRAWS: usize = 100;
/// The finest grid for thinning, cells per side of the unit cube.
const MAX_SIDE: u32 = 4096;

/// Where one ray hit a surface.
#[derive(Clone, Copy)]
struct Hit {
    unit: [f32; 3],
    color: [f32; 3],
}

/// Traces rays through random pixels of `cameras`, those for which `is_used(camera, pixel)` holds, and keeps one point per cell of the
/// finest even grid that has at most `options.count` non-empty cells. The grid is in the field's own space, so that distant surfaces are
/// thinned to the field's resolution there.
pub fn to_points(
    field: &Field,
    cameras: &[Camera],
    options: &PointsOptions,
    is_used: impl Fn(usize, Vec2) -> bool + Sync,
) -> PointCloud {
    if cameras.is_empty() || options.count == 0 {
        return PointCloud::default();
    }
    let wanted = HITS_PER_POINT * options.count;
    let chunks = wanted.div_ceil(RAYS_PER_TASK) as u64;
    let mut hits: Vec<Hit> = Vec::new();
    for round in 0..MAX_ROUNDS {
        let traced: Vec<Vec<Hit>> = (round * chunks..(round + 1) * chunks)
            .into_par_iter()
            .map_init(Vec::new, |passes, chunk| {
                let mut rng = Rng::new(options.seed, chunk);
                let draws = (0..RAYS_PER_TASK).filter_map(|_| draw(cameras, &is_used, &mut rng));
                let rays: Vec<Ray> = draws
                    .map(|(camera, pixel)| camera_ray(field, camera, pixel.x, pixel.y).0)
                    .collect();
                trace_hits(field, &rays, options.alpha, passes)
            })
            .collect();
        hits.extend(traced.into_iter().flatten());
        if hits.len() >= wanted {
            break;
        }
    }
    let (mut low, mut high) = (1, MAX_SIDE);
    while low < high {
        let side = (low + high).div_ceil(2);
        let mut cells: Vec<u64> = hits.iter().map(|hit| cell(hit.unit, side)).collect();
        cells.par_sort_unstable();
        cells.dedup();
        (low, high) = if cells.len() <= options.count {
            (side, high)
        } else {
            (low, side - 1)
        };
    }
    thin(field, &hits, low)
}

/// A random pixel of `cameras` that is used and at which the lens shows something.
fn draw<'a>(cameras: &'a [Camera], is_used: impl Fn(usize, Vec2) -> bool, rng: &mut Rng) -> Option<(&'a Camera, Vec2)> {
    (0..MAX_DRAWS).find_map(|_| {
        let view = rng.below(cameras.len() as u32) as usize;
        let k = &cameras[view].intrinsics;
        let pixel = Vec2::new(rng.uniform() * k.width as f32, rng.uniform() * k.height as f32);
        (k.shows(pixel) && is_used(view, pixel)).then_some((&cameras[view], pixel))
    })
}

/// Where the rays that reach an alpha of `min_alpha` hit a surface.
fn trace_hits(field: &Field, rays: &[Ray], min_alpha: f32, passes: &mut Vec<Pass>) -> Vec<Hit> {
    let (mut hits, mut at) = (Vec::new(), 0);
    while at < rays.len() {
        let taken = trace(Level::detect(), field, &rays[at..], &[], None, passes);
        let pass = &passes[passes.len() - 1];
        for r in 0..taken {
            let (color, alpha) = pass.composite(r);
            if let (Some(i), true) = (pass.median(r), alpha >= min_alpha) {
                hits.push(Hit {
                    unit: field.space.unit(rays[at + r].at(pass.middles[i])),
                    color: color.map(|c| c / alpha),
                });
            }
        }
        at += taken;
    }
    hits
}

/// The index of a point's cell in a grid of `side` cells per side.
fn cell(unit: [f32; 3], side: u32) -> u64 {
    let [x, y, z] = unit.map(|u| ((u * side as f32) as u64).min(u64::from(side) - 1));
    x | y << 20 | z << 40
}

/// One point per cell: the mean of its hits.
fn thin(field: &Field, hits: &[Hit], side: u32) -> PointCloud {
    let mut order: Vec<(u64, u32)> = (0u32..).zip(hits).map(|(i, hit)| (cell(hit.unit, side), i)).collect();
    order.par_sort_unstable();
    let mut points = PointCloud::default();
    for members in order.chunk_by(|a, b| a.0 == b.0) {
        let mut sum = Hit {
            unit: [0.0; 3],
            color: [0.0; 3],
        };
        for (_, i) in members {
            let hit = &hits[*i as usize];
            (0..3).for_each(|c| sum.unit[c] += hit.unit[c]);
            (0..3).for_each(|c| sum.color[c] += hit.color[c]);
        }
        let mean = 1.0 / members.len() as f32;
        let world = field.space.to_world(field.space.from_unit(sum.unit.map(|v| v * mean)));
        points.positions.push(Vec3::from(world));
        points.colors.push(sum.color.map(|v| (v * mean * 255.0).round() as u8));
    }
    points
}
