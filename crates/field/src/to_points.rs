//! The surfaces of a trained field as points, to initialise a Gaussian cloud.

use crate::field::Field;
use crate::pass::{Pass, trace};
use crate::render::view::camera_ray;
use irradia_compute::Level;
use irradia_scene::{Camera, Rng};
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

/// Points on a field's surfaces. All columns have the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FieldPoints {
    /// World positions.
    pub positions: Vec<[f32; 3]>,
    /// sRGB in \[0, 1\], the mean over the rays that hit the point's cell.
    pub colors: Vec<[f32; 3]>,
    /// Mean alpha of the rays that hit the point's cell, 0 to 1.
    pub opacities: Vec<f32>,
    /// Half the distance to the neighbours, world units: a standard deviation at which neighbouring Gaussians overlap.
    pub sizes: Vec<f32>,
}

/// Hits per point requested: a surface's cells are then hit more than once on average.
const HITS_PER_POINT: usize = 2;
/// Maximum number of rounds, each with as many rays as hits are needed: much of each image may be empty.
const MAX_ROUNDS: u64 = 16;
/// Rays per task.
const RAYS_PER_TASK: usize = 1024;
/// The finest grid for thinning, cells per side of the unit cube.
const MAX_SIDE: u32 = 4096;

/// Where one ray hit a surface.
#[derive(Clone, Copy)]
struct Hit {
    unit: [f32; 3],
    color: [f32; 3],
    alpha: f32,
}

/// Traces rays through random pixels of `cameras` and keeps one point per cell of the finest even grid that has at most
/// `options.count` non-empty cells. The grid is in the field's own space, so that distant surfaces are thinned to the field's
/// resolution there.
pub fn to_points(field: &Field, cameras: &[Camera], options: &PointsOptions) -> FieldPoints {
    if cameras.is_empty() || options.count == 0 {
        return FieldPoints::default();
    }
    let wanted = HITS_PER_POINT * options.count;
    let chunks = wanted.div_ceil(RAYS_PER_TASK) as u64;
    let mut hits: Vec<Hit> = Vec::new();
    for round in 0..MAX_ROUNDS {
        let traced: Vec<Vec<Hit>> = (round * chunks..(round + 1) * chunks)
            .into_par_iter()
            .map_init(Vec::new, |passes, chunk| {
                trace_hits(field, cameras, options, chunk, passes)
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

fn trace_hits(
    field: &Field,
    cameras: &[Camera],
    options: &PointsOptions,
    chunk: u64,
    passes: &mut Vec<Pass>,
) -> Vec<Hit> {
    let mut rng = Rng::new(options.seed, chunk);
    let rays: Vec<_> = (0..RAYS_PER_TASK)
        .map(|_| {
            let camera = &cameras[rng.below(cameras.len() as u32) as usize];
            let (w, h) = (camera.intrinsics.width as f32, camera.intrinsics.height as f32);
            camera_ray(field, camera, rng.uniform() * w, rng.uniform() * h).0
        })
        .collect();
    let (mut hits, mut at) = (Vec::new(), 0);
    while at < rays.len() {
        let taken = trace(Level::detect(), field, &rays[at..], &[], None, passes);
        let pass = &passes[passes.len() - 1];
        for r in 0..taken {
            let (color, alpha) = pass.composite(r);
            if let (Some(i), true) = (pass.median(r), alpha >= options.alpha) {
                hits.push(Hit {
                    unit: field.space.unit(rays[at + r].at(pass.middles[i])),
                    color: color.map(|c| c / alpha),
                    alpha,
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
fn thin(field: &Field, hits: &[Hit], side: u32) -> FieldPoints {
    let mut order: Vec<(u64, u32)> = (0u32..).zip(hits).map(|(i, hit)| (cell(hit.unit, side), i)).collect();
    order.par_sort_unstable();
    let half = 0.5 / side as f32;
    let mut points = FieldPoints::default();
    for members in order.chunk_by(|a, b| a.0 == b.0) {
        let mut sum = Hit {
            unit: [0.0; 3],
            color: [0.0; 3],
            alpha: 0.0,
        };
        for (_, i) in members {
            let hit = &hits[*i as usize];
            (0..3).for_each(|c| sum.unit[c] += hit.unit[c]);
            (0..3).for_each(|c| sum.color[c] += hit.color[c]);
            sum.alpha += hit.alpha;
        }
        let mean = 1.0 / members.len() as f32;
        let unit = sum.unit.map(|v| v * mean);
        let world = |unit: [f32; 3]| glam::Vec3::from(field.space.to_world(field.space.from_unit(unit)));
        let widths = (0..3).map(|c| {
            let [mut low, mut high] = [unit; 2];
            (low[c], high[c]) = ((unit[c] - half).max(0.0), (unit[c] + half).min(1.0));
            world(low).distance(world(high))
        });
        points.sizes.push(widths.sum::<f32>() / 6.0);
        points.positions.push(world(unit).to_array());
        points.colors.push(sum.color.map(|v| v * mean));
        points.opacities.push(sum.alpha * mean);
    }
    points
}
