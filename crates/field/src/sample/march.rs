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

/// Rays on their way through an occupancy grid.
#[derive(Clone, Copy, Debug)]
pub struct March<'a> {
    /// Where the grid lies.
    pub space: &'a Space,
    /// What is empty.
    pub grid: &'a OccupancyGrid,
    /// How long steps are.
    pub steps: Steps,
}

impl March<'_> {
    /// The distance at which `ray`'s first step begins. `offset` in \[0, 1) moves all steps by that share of one.
    pub fn first(&self, ray: &Ray, offset: f32) -> f32 {
        ray.near + (offset - 0.5) * self.steps.at(ray.near)
    }

    /// Adds the middles and lengths of the steps from the distance `t` on that lie in occupied cells, at most `most` of them.
    /// Returns the distance at which the rest begins: at or behind the ray's end where there is none.
    pub fn go(&self, ray: &Ray, mut t: f32, most: usize, middles: &mut Vec<f32>, lengths: &mut Vec<f32>) -> f32 {
        let straight = !matches!(self.space.outside, Outside::Contracted);
        let full = middles.len().saturating_add(most);
        while t < ray.far && middles.len() < full {
            let step = self.steps.at(t);
            let middle = t + 0.5 * step;
            let p = ray.at(middle);
            let u = self.space.unit(p);
            let width = match self.grid.at(u) {
                Cell::Occupied => {
                    if middle > ray.near && middle < ray.far {
                        middles.push(middle);
                        lengths.push(step);
                    }
                    t += step;
                    continue;
                }
                Cell::Empty => 1.0 / self.grid.side as f32,
                Cell::EmptyBrick => 4.0 / self.grid.side as f32,
            };
            // Out of the cell by whole steps, so that samples keep their places whatever is skipped. Where space is
            // contracted rays are straight in the inner cube alone.
            let inner = straight || p.iter().all(|v| v.abs() < 1.0);
            if !inner || self.steps.cone > 0.0 && t * self.steps.cone > self.steps.shortest {
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
        t
    }
}
