//! Ray marching through the occupancy grid (Mueller et al. 2022, appendix E).

use super::occupancy::{Cell, OccupancyGrid};
use crate::space::{Outside, Ray, Space};
use serde::{Deserialize, Serialize};

/// Step lengths.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Steps {
    /// Shortest step, field units (the cube is 2 wide).
    pub shortest: f32,
    /// Minimum step as a fraction of the distance from the camera: 0 in a bounded scene, 1/256 in Instant-NGP's unbounded
    /// ones.
    pub cone: f32,
}

/// Minimum step as a fraction of the distance: shorter ones would vanish in rounding, and a ray would not end.
const MIN_CONE: f32 = 4.0 * f32::EPSILON;

impl Steps {
    /// Step length at distance `t`.
    #[inline]
    pub fn at(&self, t: f32) -> f32 {
        self.shortest.max(t * self.growth())
    }

    /// Step length as a fraction of the distance, where that exceeds [`Self::shortest`].
    #[inline]
    pub fn growth(&self) -> f32 {
        self.cone.max(MIN_CONE)
    }

    /// Approximate step length at a point of field space, for cameras near the centre.
    pub fn near(&self, p: [f32; 3]) -> f32 {
        self.at(p.iter().map(|v| v * v).sum::<f32>().sqrt())
    }
}

/// A ray marcher.
#[derive(Clone, Copy, Debug)]
pub struct March<'a> {
    /// The space of the grid.
    pub space: &'a Space,
    /// The occupied cells.
    pub grid: &'a OccupancyGrid,
    /// Step lengths.
    pub steps: Steps,
}

impl March<'_> {
    /// The distance at which the first step of `ray` begins. `offset` in \[0, 1) shifts all steps by that fraction of a step.
    pub fn first(&self, ray: &Ray, offset: f32) -> f32 {
        ray.near + (offset - 0.5) * self.steps.at(ray.near)
    }

    /// Appends the middles and lengths of up to `max_steps` steps in occupied cells, starting at distance `t`. Returns the distance at
    /// which to continue, at or beyond the ray's end when done.
    pub fn advance(
        &self,
        ray: &Ray,
        mut t: f32,
        max_steps: usize,
        middles: &mut Vec<f32>,
        lengths: &mut Vec<f32>,
    ) -> f32 {
        let straight = !matches!(self.space.outside, Outside::Contracted);
        let full = middles.len().saturating_add(max_steps);
        let unit = if straight { 0.5 } else { 0.25 };
        let inverse = ray.direction.map(|d| 1.0 / (d * unit));
        while t < ray.far && middles.len() < full {
            let step = self.steps.at(t);
            let middle = t + 0.5 * step;
            let p = ray.at(middle);
            let u = self.space.unit(p);
            let cells = match self.grid.at(u) {
                Cell::Occupied => {
                    if middle > ray.near && middle < ray.far {
                        middles.push(middle);
                        lengths.push(step);
                    }
                    t += step;
                    continue;
                }
                Cell::Empty { cells } => cells as f32,
            };
            // Leaves the empty cells by whole steps, so that sample positions do not depend on what is skipped. In contracted
            // space rays are straight only in the inner cube.
            let inner = straight || p.iter().all(|v| v.abs() < 1.0);
            if !inner || step > self.steps.shortest {
                t += step;
                continue;
            }
            let width = cells / self.grid.side as f32;
            let per_width = self.grid.side as f32 / cells;
            let mut exit = f32::INFINITY;
            for c in 0..3 {
                // Casts instead of `floor` and `ceil`, which are calls on x86-64 without SSE 4.1. A point that rounding puts below 0 or
                // above 1 leaves by one step.
                let cell = (u[c] * per_width) as u32 as f32;
                let face = if inverse[c] > 0.0 { cell + 1.0 } else { cell } * width;
                if inverse[c].is_finite() {
                    exit = exit.min((face - u[c]) * inverse[c]);
                }
            }
            let steps = exit / step;
            let whole = steps as u32 as f32;
            t += step * if whole < steps { whole + 1.0 } else { whole.max(1.0) };
        }
        t
    }
}
