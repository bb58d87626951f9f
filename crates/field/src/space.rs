//! The mapping from the world to field space.
//!
//! Field space is centred and scaled so that the scene of interest lies within -1..1; networks take points of the unit cube, to
//! which [`Space::unit`] maps it. Distances along rays and densities are in field units.

use crate::contraction::{contract, contract_vjp, uncontract};
use crate::sample::aabb::intersect;
use glam::{Mat3, Quat, Vec2, Vec3};
use irradia_scene::Camera;
use serde::{Deserialize, Serialize};

/// What is outside the cube -1..1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outside {
    /// Nothing.
    Nothing,
    /// The rest of the world, contracted (mip-NeRF 360).
    Contracted,
    /// Nothing: the cube is the frustum of a forward-facing capture up to infinity (NeRF, appendix C).
    Ndc(Frustum),
}

/// The frustum that normalised device coordinates are taken from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frustum {
    /// World-from-camera rotation of the capture's mean camera (`x, y, z, w`).
    pub rotation: [f32; 4],
    /// Centre of the mean camera, world units.
    pub position: [f32; 3],
    /// Focal length over half the width and over half the height, less a margin for cameras off the mean position.
    pub focal: [f32; 2],
    /// Depth of the near plane, world units.
    pub near: f32,
}

/// The mapping from the world to field space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Space {
    /// The world point at the origin of field space.
    pub center: [f32; 3],
    /// Field units per world unit.
    pub scale: f32,
    /// What is outside the cube.
    pub outside: Outside,
}

/// A ray in field space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Origin, field space.
    pub origin: [f32; 3],
    /// Unit direction in field space.
    pub direction: [f32; 3],
    /// Unit direction in the world, on which colour depends.
    pub view: [f32; 3],
    /// Distance at which it enters the field, field units.
    pub near: f32,
    /// Distance at which it leaves the field; at most `near` if it misses.
    pub far: f32,
    /// Conversion of distances along the ray to world distances.
    pub measure: Measure,
}

/// Conversion of distances along a ray in field space to world distances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Measure {
    /// World units per field unit.
    Linear(f32),
    /// Normalised device coordinates.
    Ndc {
        /// World distance to the near plane.
        start: f32,
        /// World distance over which depth grows by the depth of the near plane.
        near: f32,
        /// Length of the whole ray to infinity, field units.
        length: f32,
    },
}

/// Length of contracted rays, field units: beyond it, points move by less than a cell of any grid.
const MAX_RAY_LENGTH: f32 = 200.0;
/// Distance from the axis of the frustum, in its half widths, up to which rays are followed. Cameras a little outside the capture see what
/// is at its sides; a ray that turns away from the axis may have any length.
const MAX_NDC_OFFSET: f32 = 8.0;

impl Space {
    /// The cube about `center` with half size `half`, world units, and nothing outside.
    pub fn cube(center: [f32; 3], half: f32) -> Self {
        Self {
            center,
            scale: 1.0 / half,
            outside: Outside::Nothing,
        }
    }

    /// The same cube in an unbounded world, contracted outside it.
    pub fn contracted(center: [f32; 3], half: f32) -> Self {
        Self {
            outside: Outside::Contracted,
            ..Self::cube(center, half)
        }
    }

    /// The space that `cameras` look at: centred at the point nearest to all their axes, as large as the median camera's view at
    /// that distance. `None` without two cameras whose axes differ.
    ///
    /// If the world is `unbounded`, the cube extends to the cameras, to include what lies between them.
    pub fn around(cameras: &[Camera], unbounded: bool) -> Option<Self> {
        // The normal equations of the point nearest to all axes: sum of (1 - d d^T) (x - o) = 0.
        let (mut a, mut b) = (Mat3::ZERO, Vec3::ZERO);
        for camera in cameras {
            let d = camera.pose.rotation * Vec3::Z;
            let across = Mat3::IDENTITY - Mat3::from_cols(d * d.x, d * d.y, d * d.z);
            a += across;
            b += across * camera.pose.position;
        }
        // Parallel axes have no such point.
        if cameras.len() < 2 || a.determinant().abs() < 1e-6 * (cameras.len() as f32).powi(3) {
            return None;
        }
        let center = a.inverse() * b;
        let mut halves: Vec<f32> = cameras
            .iter()
            .map(|camera| {
                let k = &camera.intrinsics;
                let distance = (camera.pose.position - center).length();
                let tangent = (k.width as f32 / k.fx).max(k.height as f32 / k.fy) / 2.0;
                if unbounded { distance } else { 1.05 * distance * tangent }
            })
            .collect();
        halves.sort_by(f32::total_cmp);
        let half = halves[halves.len() / 2];
        if !(center.is_finite() && half.is_finite() && half > 0.0) {
            return None;
        }
        let center = center.to_array();
        Some(if unbounded {
            Self::contracted(center, half)
        } else {
            Self::cube(center, half)
        })
    }

    /// Normalised device coordinates for forward-facing `cameras` whose scene lies beyond depth `near`, world units; `None`
    /// without cameras or if they do not all face forward.
    pub fn ndc(cameras: &[Camera], near: f32) -> Option<Self> {
        let forward: Vec3 = cameras.iter().map(|c| c.pose.rotation * Vec3::Z).sum();
        let down: Vec3 = cameras.iter().map(|c| c.pose.rotation * Vec3::Y).sum();
        let position: Vec3 = cameras.iter().map(|c| c.pose.position).sum::<Vec3>() / cameras.len().max(1) as f32;
        let (forward, right) = (forward.try_normalize()?, down.cross(forward).try_normalize()?);
        let rotation = Quat::from_mat3(&Mat3::from_cols(right, forward.cross(right), forward));
        let mut frustum = Frustum {
            rotation: rotation.to_array(),
            position: position.to_array(),
            focal: [1.0; 2],
            near,
        };
        let mut extent = [1e-6f32; 2];
        for camera in cameras {
            let k = &camera.intrinsics;
            let (w, h) = (k.width as f32, k.height as f32);
            for corner in [[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]] {
                let (from, direction) = camera.ray(Vec2::from(corner));
                let (from, along, _) = frustum.line(from.to_array(), direction.to_array())?;
                for c in 0..2 {
                    extent[c] = extent[c].max(from[c].abs()).max((from[c] + along[c]).abs());
                }
            }
        }
        frustum.focal = extent.map(|e| 1.0 / e);
        Some(Self {
            center: [0.0; 3],
            scale: 1.0,
            outside: Outside::Ndc(frustum),
        })
    }

    /// The ray from a world point along a unit direction; it misses if one of them is not finite.
    pub fn ray(&self, origin: [f32; 3], view: [f32; 3]) -> Ray {
        let from: [f32; 3] = std::array::from_fn(|c| (origin[c] - self.center[c]) * self.scale);
        let mut ray = Ray {
            origin: from,
            direction: view,
            view,
            near: 0.0,
            far: 0.0,
            measure: Measure::Linear(1.0 / self.scale),
        };
        if !from.iter().chain(&view).all(|v| v.is_finite()) {
            return ray;
        }
        match &self.outside {
            Outside::Nothing => {
                if let Some([near, far]) = intersect(from, view, [-1.0; 3], [1.0; 3]) {
                    (ray.near, ray.far) = (near, far);
                }
            }
            Outside::Contracted => (ray.near, ray.far) = (0.0, MAX_RAY_LENGTH),
            Outside::Ndc(frustum) => {
                if let Some((from, along, [start, near])) = frustum.line(origin, view) {
                    let length = along.iter().map(|v| v * v).sum::<f32>().sqrt();
                    (ray.origin, ray.direction) = (from, along.map(|v| v / length));
                    ray.measure = Measure::Ndc { start, near, length };
                    // All of the line lies between -1 and 1 in depth.
                    let (low, high) = ([-MAX_NDC_OFFSET; 3], [MAX_NDC_OFFSET; 3]);
                    if let Some([near, far]) = intersect(from, ray.direction, low, high) {
                        (ray.near, ray.far) = (near, far.min(length));
                    }
                }
            }
        }
        ray
    }

    /// Maps a point of field space to the unit cube.
    #[inline]
    pub fn unit(&self, p: [f32; 3]) -> [f32; 3] {
        match self.outside {
            Outside::Contracted => contract(p).map(|v| 0.25 * v + 0.5),
            _ => p.map(|v| 0.5 * v + 0.5),
        }
    }

    /// The VJP of [`Self::unit`] at the point `p` of field space.
    pub fn unit_vjp(&self, p: [f32; 3], v: [f32; 3]) -> [f32; 3] {
        match self.outside {
            Outside::Contracted => contract_vjp(p, v).map(|v| 0.25 * v),
            _ => v.map(|v| 0.5 * v),
        }
    }

    /// Maps a point of the unit cube to field space: the inverse of [`Self::unit`].
    pub fn from_unit(&self, u: [f32; 3]) -> [f32; 3] {
        match self.outside {
            Outside::Contracted => uncontract(u.map(|v| 4.0 * v - 2.0)),
            _ => u.map(|v| 2.0 * v - 1.0),
        }
    }

    /// Maps a world point to field space, or to normalised device coordinates (`None` at and behind the camera).
    pub fn from_world(&self, world: [f32; 3]) -> Option<[f32; 3]> {
        match &self.outside {
            Outside::Ndc(frustum) => frustum.point(world),
            _ => Some(std::array::from_fn(|c| (world[c] - self.center[c]) * self.scale)),
        }
    }

    /// Maps a point of field space to the world.
    pub fn to_world(&self, p: [f32; 3]) -> [f32; 3] {
        match &self.outside {
            Outside::Ndc(frustum) => frustum.world(p),
            _ => std::array::from_fn(|c| p[c] / self.scale + self.center[c]),
        }
    }

    /// The world direction of the gradient `v` at a point of field space, of unspecified length.
    pub fn world_gradient(&self, p: [f32; 3], v: [f32; 3]) -> [f32; 3] {
        match &self.outside {
            Outside::Ndc(frustum) => frustum.gradient(p, v),
            _ => v,
        }
    }

    /// Maps distance `t` to the measure in which samples are evenly spread: distance, and disparity beyond 1 in a contracted
    /// world, where the measure is in \[0, 1\].
    pub fn spread(&self, t: f32) -> f32 {
        match self.outside {
            Outside::Contracted if t < 1.0 => 0.5 * t,
            Outside::Contracted => 1.0 - 0.5 / t,
            _ => t,
        }
    }

    /// The inverse of [`Self::spread`].
    pub fn unspread(&self, s: f32) -> f32 {
        match self.outside {
            Outside::Contracted if s < 0.5 => 2.0 * s,
            Outside::Contracted => 0.5 / (1.0 - s),
            _ => s,
        }
    }
}

impl Frustum {
    fn orientation(&self) -> Quat {
        Quat::from_array(self.rotation)
    }

    /// The straight line to which a world ray maps: its start on the near plane, the vector from there to infinity, and
    /// `[start, near]` of [`Measure::Ndc`]. `None` for rays that do not point forward.
    fn line(&self, origin: [f32; 3], direction: [f32; 3]) -> Option<([f32; 3], [f32; 3], [f32; 2])> {
        let to_camera = self.orientation().inverse();
        let d = to_camera * Vec3::from(direction);
        let o = to_camera * (Vec3::from(origin) - Vec3::from(self.position));
        if d.z < 1e-4 {
            return None;
        }
        let start = (self.near - o.z) / d.z;
        let o = o + start * d;
        let [ax, ay] = self.focal;
        // Appendix C, equations 25 and 26, for a camera looking along +Z; at the near plane 2 n / z is 2.
        let from = [ax * o.x / o.z, ay * o.y / o.z, -1.0];
        let along = [ax * (d.x / d.z - o.x / o.z), ay * (d.y / d.z - o.y / o.z), 2.0];
        Some((from, along, [start, self.near / d.z]))
    }

    fn point(&self, world: [f32; 3]) -> Option<[f32; 3]> {
        let p = self.orientation().inverse() * (Vec3::from(world) - Vec3::from(self.position));
        let [ax, ay] = self.focal;
        (p.z > 1e-6).then(|| [ax * p.x / p.z, ay * p.y / p.z, 1.0 - 2.0 * self.near / p.z])
    }

    /// The VJP of [`Self::point`] at the world point that maps to `p`.
    fn gradient(&self, p: [f32; 3], v: [f32; 3]) -> [f32; 3] {
        let z = 2.0 * self.near / (1.0 - p[2]).max(1e-4);
        let [ax, ay] = self.focal;
        let along = (2.0 * self.near / z * v[2] - p[0] * v[0] - p[1] * v[1]) / z;
        (self.orientation() * Vec3::new(ax * v[0] / z, ay * v[1] / z, along)).to_array()
    }

    fn world(&self, p: [f32; 3]) -> [f32; 3] {
        let z = 2.0 * self.near / (1.0 - p[2]).max(1e-4);
        let [ax, ay] = self.focal;
        let camera = Vec3::new(p[0] * z / ax, p[1] * z / ay, z);
        (self.orientation() * camera + Vec3::from(self.position)).to_array()
    }
}

impl Ray {
    /// The point at distance `t`.
    #[inline]
    pub fn at(&self, t: f32) -> [f32; 3] {
        std::array::from_fn(|c| self.origin[c] + t * self.direction[c])
    }

    /// The distance at which [`Self::world_distance`] is `world`.
    pub fn distance(&self, world: f32) -> f32 {
        match self.measure {
            Measure::Linear(scale) => world / scale,
            Measure::Ndc { start, near, length } => {
                let past_near = (world - start).max(0.0);
                length * past_near / (past_near + near)
            }
        }
    }

    /// World distance from the camera at distance `t`.
    pub fn world_distance(&self, t: f32) -> f32 {
        match self.measure {
            Measure::Linear(scale) => t * scale,
            // Appendix C: t' = 1 - z / (z + t d_z).
            Measure::Ndc { start, near, length } => {
                let fraction = (t / length).min(0.9999);
                start + near * fraction / (1.0 - fraction)
            }
        }
    }
}
