//! Steps along a ray through the occupancy grid (Mueller et al. 2022, appendix E).

use super::occupancy::{Cell, OccupancyGrid};
use crate::space::{Outside, Ray, Space};
use serde::{Deserialize, Serialize};

/// How long steps are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Steps {
    /// Shortest step, field units (the cube is 2 wide).
    pub shortest: f32,
    /// A step is at least this share of the distance from the camera: 0 in a bounded scene, 1/256 in Instant-NGP's unbounded
    /// ones.
    pub cone: f32,
}

impl Steps {
    /// The step at distance `t`.
    #[inline]
    pub fn at(&self, t: f32) -> f32 {
        self.shortest.max(t * self.cone)
    }

    /// About the step at a point of field space that cameras see from near the middle.
    pub fn near(&self, p: [f32; 3]) -> f32 {
        self.at(p.iter().map(|v| v * v).sum::<f32>().sqrt())
    }
}

/// Adds the middles and lengths of the steps that lie in occupied cells. `offset` in \[0, 1) moves all of them by that share of
/// a step.
pub fn march(
    space: &Space,
    grid: &OccupancyGrid,
    steps: &Steps,
    ray: &Ray,
    offset: f32,
    middles: &mut Vec<f32>,
    lengths: &mut Vec<f32>,
) {
    let straight = !matches!(space.outside, Outside::Contracted);
    let mut t = ray.near + (offset - 0.5) * steps.at(ray.near);
    while t < ray.far {
        let step = steps.at(t);
        let middle = t + 0.5 * step;
        let p = ray.at(middle);
        let u = space.unit(p);
        let width = match grid.at(u) {
            Cell::Occupied => {
                if middle > ray.near && middle < ray.far {
                    middles.push(middle);
                    lengths.push(step);
                }
                t += step;
                continue;
            }
            Cell::Empty => 1.0 / grid.side as f32,
            Cell::EmptyBrick => 4.0 / grid.side as f32,
        };
        // Out of the cell by whole steps, so that samples keep their places whatever is skipped. Where space is
        // contracted rays are straight in the inner cube alone.
        let inner = straight || p.iter().all(|v| v.abs() < 1.0);
        if !inner || steps.cone > 0.0 && t * steps.cone > steps.shortest {
            t += step;
            continue;
        }
        let unit = if straight { 0.5 } else { 0.25 };
        let mut exit = f32::INFINITY;
        for c in 0..3 {
            let slope = ray.direction[c] * unit;
            let cell = (u[c] / width).floor();
            let face = if slope > 0.0 {
                (cell + 1.0) * width
            } else {
                cell * width
            };
            if slope != 0.0 {
                exit = exit.min((face - u[c]) / slope);
            }
        }
        t += step * (exit / step).ceil().max(1.0);
    }
}
