//! The solids of the scenes and their intersection with rays.
//!
//! Symbols: a ray is `o + t d` with unit `d`; `t` is in world units.

use glam::{Quat, Vec2, Vec3};

/// A half-line.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Origin, world.
    pub origin: Vec3,
    /// Unit direction, world.
    pub direction: Vec3,
}

impl Ray {
    /// The point at distance `t`.
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }
}

/// A geometric primitive, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// The unbounded plane `z = height`.
    Ground {
        /// World z.
        height: f32,
    },
    /// The inside of a sphere around the origin that contains everything else.
    Backdrop {
        /// World units.
        radius: f32,
    },
    /// The inside of a room: an upright box on `z = 0` about the z axis, which contains everything else.
    Interior {
        /// Half the width and half the length.
        half: Vec2,
        /// Height.
        height: f32,
    },
    /// A ball.
    Sphere {
        /// Centre.
        center: Vec3,
        /// Radius.
        radius: f32,
    },
    /// An upright cylinder with flat ends.
    Drum {
        /// Centre of the lower end.
        base: Vec3,
        /// Radius.
        radius: f32,
        /// Height along +Z.
        height: f32,
    },
    /// A cylinder between two points, with round ends.
    Rod {
        /// One end of the axis.
        a: Vec3,
        /// The other end.
        b: Vec3,
        /// Radius.
        radius: f32,
    },
    /// A torus.
    Ring {
        /// Centre.
        center: Vec3,
        /// World-from-local rotation; the ring's axis is the local +Z.
        world_from_ring: Quat,
        /// Radius of the tube's centre line.
        radius: f32,
        /// Radius of the tube.
        tube: f32,
    },
    /// A box.
    Block {
        /// Centre.
        center: Vec3,
        /// Half the edge lengths along the local axes.
        half: Vec3,
        /// World-from-local rotation.
        world_from_block: Quat,
    },
}

impl Shape {
    /// A sphere that contains the shape, `None` for the shapes that surround everything.
    pub fn bound(&self) -> Option<(Vec3, f32)> {
        match *self {
            Shape::Ground { .. } | Shape::Backdrop { .. } | Shape::Interior { .. } => None,
            Shape::Sphere { center, radius } => Some((center, radius)),
            Shape::Drum { base, radius, height } => Some((base + Vec3::Z * (0.5 * height), radius.hypot(0.5 * height))),
            Shape::Rod { a, b, radius } => Some((0.5 * (a + b), 0.5 * (b - a).length() + radius)),
            Shape::Ring {
                center, radius, tube, ..
            } => Some((center, radius + tube)),
            Shape::Block { center, half, .. } => Some((center, half.length())),
        }
    }

    /// The nearest `t` in `(near, far)` at which the ray hits the surface, and the unit normal there: outward, or inward for
    /// backdrop and interior.
    pub fn intersect(&self, ray: &Ray, near: f32, far: f32) -> Option<(f32, Vec3)> {
        match *self {
            Shape::Ground { height } => {
                let t = (height - ray.origin.z) / ray.direction.z;
                (t > near && t < far).then_some((t, Vec3::Z))
            }
            Shape::Backdrop { radius } => {
                let (_, t) = sphere_interval(ray, Vec3::ZERO, radius)?;
                (t > near && t < far).then(|| (t, -ray.at(t) / radius))
            }
            Shape::Interior { half, height } => {
                let center = Vec3::Z * (0.5 * height);
                let local = Ray {
                    origin: ray.origin - center,
                    ..*ray
                };
                let (_, (t, normal)) = block(&local, half.extend(0.5 * height))?;
                (t > near && t < far).then_some((t, -normal))
            }
            Shape::Sphere { center, radius } => {
                let (t0, t1) = sphere_interval(ray, center, radius)?;
                let t = first_within(t0, t1, near, far)?;
                Some((t, (ray.at(t) - center) / radius))
            }
            Shape::Drum { base, radius, height } => drum(ray, near, far, base, radius, height),
            Shape::Rod { a, b, radius } => rod(ray, near, far, a, b, radius),
            Shape::Ring {
                center,
                world_from_ring,
                radius,
                tube,
            } => {
                let ring_from_world = world_from_ring.inverse();
                let local = Ray {
                    origin: ring_from_world * (ray.origin - center),
                    direction: ring_from_world * ray.direction,
                };
                let (t, normal) = ring(&local, near, far, radius, tube)?;
                Some((t, world_from_ring * normal))
            }
            Shape::Block {
                center,
                half,
                world_from_block,
            } => {
                let block_from_world = world_from_block.inverse();
                let local = Ray {
                    origin: block_from_world * (ray.origin - center),
                    direction: block_from_world * ray.direction,
                };
                let ends = <[_; 2]>::from(block(&local, half)?);
                let (t, normal) = ends.into_iter().find(|(t, _)| *t > near && *t < far)?;
                Some((t, world_from_block * normal))
            }
        }
    }

    /// Transforms a world point to the shape's local frame, in which its texture is defined.
    pub fn local(&self, world: Vec3) -> Vec3 {
        match *self {
            Shape::Ground { .. } | Shape::Backdrop { .. } | Shape::Interior { .. } => world,
            Shape::Sphere { center, .. } => world - center,
            Shape::Drum { base, .. } => world - base,
            Shape::Rod { a, .. } => world - a,
            Shape::Ring {
                center,
                world_from_ring,
                ..
            } => world_from_ring.inverse() * (world - center),
            Shape::Block {
                center,
                world_from_block,
                ..
            } => world_from_block.inverse() * (world - center),
        }
    }
}

fn first_within(t0: f32, t1: f32, near: f32, far: f32) -> Option<f32> {
    [t0, t1].into_iter().find(|t| *t > near && *t < far)
}

/// The interval of the line inside a sphere.
///
/// The discriminant is computed from the foot of the perpendicular, which stays accurate for distant spheres.
pub fn sphere_interval(ray: &Ray, center: Vec3, radius: f32) -> Option<(f32, f32)> {
    let to_center = center - ray.origin;
    let middle = to_center.dot(ray.direction);
    let foot = to_center - ray.direction * middle;
    let inside = radius * radius - foot.length_squared();
    (inside >= 0.0).then(|| {
        let half = inside.sqrt();
        (middle - half, middle + half)
    })
}

/// The interval of the line within `low..high` along one axis.
fn slab_interval(origin: f32, direction: f32, low: f32, high: f32) -> Option<(f32, f32)> {
    if direction.abs() < 1e-9 {
        return (origin >= low && origin <= high).then_some((f32::NEG_INFINITY, f32::INFINITY));
    }
    let (a, b) = ((low - origin) / direction, (high - origin) / direction);
    Some((a.min(b), a.max(b)))
}

fn drum(ray: &Ray, near: f32, far: f32, base: Vec3, radius: f32, height: f32) -> Option<(f32, Vec3)> {
    let o = ray.origin - base;
    let d = ray.direction;
    let (z0, z1) = slab_interval(o.z, d.z, 0.0, height)?;
    let (o_xy, d_xy) = (o.truncate(), d.truncate());
    let a = d_xy.length_squared();
    let (s0, s1) = if a < 1e-12 {
        (o_xy.length_squared() <= radius * radius).then_some((f32::NEG_INFINITY, f32::INFINITY))?
    } else {
        let middle = -o_xy.dot(d_xy) / a;
        let inside = radius * radius - (o_xy + d_xy * middle).length_squared();
        if inside < 0.0 {
            return None;
        }
        let half = (inside / a).sqrt();
        (middle - half, middle + half)
    };
    let (t0, t1) = (z0.max(s0), z1.min(s1));
    if t0 > t1 {
        return None;
    }
    let t = first_within(t0, t1, near, far)?;
    let through_end = if t == t0 { z0 >= s0 } else { z1 <= s1 };
    let p = o + d * t;
    let normal = if through_end {
        Vec3::Z * if p.z > 0.5 * height { 1.0 } else { -1.0 }
    } else {
        (p.truncate() / radius).extend(0.0)
    };
    Some((t, normal))
}

fn rod(ray: &Ray, near: f32, far: f32, a: Vec3, b: Vec3, radius: f32) -> Option<(f32, Vec3)> {
    let length = (b - a).length();
    let axis = (b - a) / length;
    let o = ray.origin - a;
    let (o_along, d_along) = (o.dot(axis), ray.direction.dot(axis));
    let (o_across, d_across) = (o - axis * o_along, ray.direction - axis * d_along);
    let square = d_across.length_squared();
    let mut best: Option<(f32, Vec3)> = None;
    if square > 1e-12 {
        let middle = -o_across.dot(d_across) / square;
        let inside = radius * radius - (o_across + d_across * middle).length_squared();
        // The round ends lie within the infinite cylinder: a line that misses it misses them.
        if inside < 0.0 {
            return None;
        }
        let half = (inside / square).sqrt();
        for t in [middle - half, middle + half] {
            let along = o_along + t * d_along;
            if t > near && t < far && (0.0..=length).contains(&along) {
                best = Some((t, (o_across + d_across * t) / radius));
                break;
            }
        }
    }
    for end in [a, b] {
        let Some((t0, t1)) = sphere_interval(ray, end, radius) else {
            continue;
        };
        for t in [t0, t1] {
            let outside = !(0.0..=length).contains(&(o_along + t * d_along));
            if outside && t > near && t < far && best.is_none_or(|(found, _)| t < found) {
                best = Some((t, (ray.at(t) - end) / radius));
            }
        }
    }
    best
}

/// Intersects a torus by sphere tracing (Hart 1996) with its exact distance, between the planes tangent to the tube.
fn ring(ray: &Ray, near: f32, far: f32, radius: f32, tube: f32) -> Option<(f32, Vec3)> {
    const HIT_DISTANCE: f32 = 2e-5;
    let (z0, z1) = slab_interval(ray.origin.z, ray.direction.z, -tube, tube)?;
    let (s0, s1) = sphere_interval(ray, Vec3::ZERO, radius + tube)?;
    let (mut t, end) = (z0.max(s0).max(near), z1.min(s1).min(far));
    for _ in 0..96 {
        if t > end {
            return None;
        }
        let p = ray.at(t);
        let across = Vec2::new(p.truncate().length() - radius, p.z);
        let distance = across.length() - tube;
        if distance < HIT_DISTANCE {
            let outward = p.truncate().normalize_or_zero() * across.x;
            return Some((t, outward.extend(across.y).normalize_or(Vec3::Z)));
        }
        t += distance;
    }
    None
}

/// Where the line enters the box and where it leaves it, with the outward normals there.
fn block(ray: &Ray, half: Vec3) -> Option<((f32, Vec3), (f32, Vec3))> {
    let (mut t0, mut t1) = (f32::NEG_INFINITY, f32::INFINITY);
    let (mut axis0, mut axis1) = (0, 0);
    for axis in 0..3 {
        let (a, b) = slab_interval(ray.origin[axis], ray.direction[axis], -half[axis], half[axis])?;
        if a > t0 {
            (t0, axis0) = (a, axis);
        }
        if b < t1 {
            (t1, axis1) = (b, axis);
        }
    }
    let end = |t: f32, axis: usize| {
        let mut normal = Vec3::ZERO;
        normal[axis] = ray.at(t)[axis].signum();
        (t, normal)
    };
    (t0 <= t1).then(|| (end(t0, axis0), end(t1, axis1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shoot(shape: Shape, origin: Vec3, direction: Vec3) -> Option<(f32, Vec3)> {
        let ray = Ray {
            origin,
            direction: direction.normalize(),
        };
        shape.intersect(&ray, 1e-4, 100.0)
    }

    #[test]
    fn rays_hit_every_solid_at_known_points() {
        let one = Vec3::new(1.0, 0.0, 0.0);
        let cases = [
            (
                Shape::Sphere {
                    center: one,
                    radius: 0.5,
                },
                Vec3::new(1.0, 0.0, 4.0),
                -Vec3::Z,
                3.5,
                Vec3::Z,
            ),
            (
                Shape::Drum {
                    base: one,
                    radius: 0.5,
                    height: 2.0,
                },
                Vec3::new(-3.0, 0.0, 1.0),
                Vec3::X,
                3.5,
                -Vec3::X,
            ),
            (
                Shape::Drum {
                    base: one,
                    radius: 0.5,
                    height: 2.0,
                },
                Vec3::new(1.2, 0.0, 4.0),
                -Vec3::Z,
                2.0,
                Vec3::Z,
            ),
            (
                Shape::Rod {
                    a: Vec3::ZERO,
                    b: one,
                    radius: 0.1,
                },
                Vec3::new(0.5, 0.0, 2.0),
                -Vec3::Z,
                1.9,
                Vec3::Z,
            ),
            (
                Shape::Rod {
                    a: Vec3::ZERO,
                    b: one,
                    radius: 0.1,
                },
                Vec3::new(3.0, 0.0, 0.0),
                -Vec3::X,
                1.9,
                Vec3::X,
            ),
            (
                Shape::Block {
                    center: one,
                    half: Vec3::splat(0.25),
                    world_from_block: Quat::IDENTITY,
                },
                Vec3::new(4.0, 0.1, 0.1),
                -Vec3::X,
                2.75,
                Vec3::X,
            ),
            (
                Shape::Ground { height: -1.0 },
                Vec3::new(5.0, 5.0, 2.0),
                -Vec3::Z,
                3.0,
                Vec3::Z,
            ),
            (
                Shape::Backdrop { radius: 20.0 },
                Vec3::new(3.0, 0.0, 0.0),
                Vec3::X,
                17.0,
                -Vec3::X,
            ),
        ];
        for (shape, origin, direction, t, normal) in cases {
            let (found, n) = shoot(shape, origin, direction).expect("a hit");
            assert!((found - t).abs() < 1e-5, "{shape:?}: {found} for {t}");
            assert!((n - normal).length() < 1e-5, "{shape:?}: {n} for {normal}");
        }
    }

    #[test]
    fn rays_hit_a_ring_on_its_tube_and_pass_through_its_hole() {
        let standing = Shape::Ring {
            center: Vec3::Z,
            world_from_ring: Quat::from_rotation_x(std::f32::consts::FRAC_PI_2),
            radius: 0.5,
            tube: 0.05,
        };
        let (t, n) = shoot(standing, Vec3::new(0.5, -2.0, 1.0), Vec3::Y).expect("a hit");
        assert!((t - 1.95).abs() < 1e-4 && (n + Vec3::Y).length() < 1e-2, "{t} {n}");
        assert!(shoot(standing, Vec3::new(0.0, -2.0, 1.0), Vec3::Y).is_none());
        let (t, n) = shoot(standing, Vec3::new(0.0, 0.0, 3.0), -Vec3::Z).expect("a hit");
        assert!((t - 1.45).abs() < 1e-4 && (n - Vec3::Z).length() < 1e-2, "{t} {n}");
    }

    #[test]
    fn every_hit_is_within_the_bound() {
        let shapes = [
            Shape::Drum {
                base: Vec3::ZERO,
                radius: 0.5,
                height: 0.4,
            },
            Shape::Rod {
                a: Vec3::ZERO,
                b: Vec3::ONE,
                radius: 0.2,
            },
            Shape::Block {
                center: Vec3::X,
                half: Vec3::new(0.3, 0.2, 0.5),
                world_from_block: Quat::from_rotation_z(0.7),
            },
        ];
        let mut rng = irradia_scene::Rng::new(3, 0);
        let mut point = || Vec3::new(rng.normal(), rng.normal(), rng.normal());
        for shape in shapes {
            let (center, radius) = shape.bound().expect("bounded");
            let mut hits = 0;
            for _ in 0..500 {
                let origin = center + point().normalize() * 3.0;
                let target = center + point() * 0.2;
                let ray = Ray {
                    origin,
                    direction: (target - origin).normalize(),
                };
                if let Some((t, normal)) = shape.intersect(&ray, 1e-4, 100.0) {
                    hits += 1;
                    assert!((ray.at(t) - center).length() < radius + 1e-4);
                    assert!((normal.length() - 1.0).abs() < 1e-4 && normal.dot(ray.direction) < 1e-3);
                }
            }
            assert!(hits > 100, "{shape:?}: {hits}");
        }
    }
}
