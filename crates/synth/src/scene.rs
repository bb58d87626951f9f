use crate::shape::{Ray, Shape};
use crate::sky;
use crate::texture::Texture;
use glam::{Quat, Vec3};
use std::f32::consts::FRAC_PI_2;

/// The reflectance of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Its colour; for metals the colour of the reflection.
    pub texture: Texture,
    /// Reflectance of the clear coat at normal incidence (Schlick's F0), 0 for none. Ignored for metals.
    pub coat: f32,
    /// Whether light is only reflected, in the texture's colour, and not scattered.
    pub metal: bool,
    /// Spread of the reflection, tangent of the typical angle: 0 is a mirror.
    pub roughness: f32,
}

impl Material {
    /// A material that only scatters light.
    pub(crate) fn matte(texture: Texture) -> Self {
        Self {
            texture,
            coat: 0.0,
            metal: false,
            roughness: 1.0,
        }
    }

    /// A material under a clear coat.
    pub(crate) fn glazed(texture: Texture, coat: f32, roughness: f32) -> Self {
        Self {
            texture,
            coat,
            metal: false,
            roughness,
        }
    }

    /// A material that only reflects light.
    pub(crate) fn metal(color: Vec3, roughness: f32) -> Self {
        Self {
            texture: Texture::Plain(color),
            coat: 0.0,
            metal: true,
            roughness,
        }
    }
}

/// A shape with its material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Object {
    /// The shape.
    pub shape: Shape,
    /// The material.
    pub material: Material,
}

/// Objects close together: a ray that misses their bounding sphere skips them.
#[derive(Clone, Debug, PartialEq)]
pub struct Cluster {
    /// Centre and radius of their bounding sphere, world.
    pub bound: (Vec3, f32),
    /// The objects, each with its own bounding sphere, world.
    pub objects: Vec<(Object, (Vec3, f32))>,
}

impl Cluster {
    /// Computes the bounds of `objects`; ground and backdrop, which have none, are skipped.
    pub fn new(objects: impl IntoIterator<Item = Object>) -> Self {
        let objects: Vec<_> = objects
            .into_iter()
            .filter_map(|object| Some((object, object.shape.bound()?)))
            .collect();
        let middle = objects.iter().map(|(_, (center, _))| *center).sum::<Vec3>() / objects.len().max(1) as f32;
        let reach = objects
            .iter()
            .map(|(_, (center, radius))| (center - middle).length() + radius);
        Self {
            bound: (middle, reach.fold(0.0, f32::max)),
            objects,
        }
    }
}

/// A scene. World: z up. In the demo scene the centre of the table top is at the origin, and one unit is about half a metre; in the
/// others the ground or the floor is at `z = 0`, and one unit is a metre.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthScene {
    /// The unbounded objects, ground and backdrop. They cast no shadow.
    pub surroundings: Vec<Object>,
    /// Everything else.
    pub clusters: Vec<Cluster>,
    /// The light that illuminates the scene.
    pub light: Light,
}

/// The light of a scene: a sun or a lamp at infinity, and the mean light from above and from below.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Unit direction to the sun.
    pub sun: Vec3,
    /// Its irradiance on a surface facing it, linear RGB.
    pub sun_light: Vec3,
    /// Tangent of its angular radius.
    pub sun_spread: f32,
    /// Light on a surface that faces up, linear RGB, without the sun's.
    pub above: Vec3,
    /// Light reflected upwards by the ground, linear RGB.
    pub below: Vec3,
}

/// The first surface point along a ray.
#[derive(Clone, Copy, Debug)]
pub struct Hit<'a> {
    /// Distance along the ray, world units.
    pub t: f32,
    /// Position, world.
    pub point: Vec3,
    /// Unit normal, facing the ray's origin, world.
    pub normal: Vec3,
    /// The object.
    pub object: &'a Object,
}

impl SynthScene {
    /// The first hit beyond `near`.
    pub fn hit(&self, ray: &Ray, near: f32) -> Option<Hit<'_>> {
        let mut best = f32::INFINITY;
        let mut found: Option<(Vec3, &Object)> = None;
        let mut meet = |object, best: &mut f32| {
            let object: &Object = object;
            if let Some((t, normal)) = object.shape.intersect(ray, near, *best) {
                *best = t;
                found = Some((normal, object));
            }
        };
        for cluster in &self.clusters {
            if misses(ray, cluster.bound, best) {
                continue;
            }
            for (object, bound) in &cluster.objects {
                if !misses(ray, *bound, best) {
                    meet(object, &mut best);
                }
            }
        }
        for object in &self.surroundings {
            meet(object, &mut best);
        }
        found.map(|(normal, object)| Hit {
            t: best,
            point: ray.at(best),
            normal: if normal.dot(ray.direction) > 0.0 {
                -normal
            } else {
                normal
            },
            object,
        })
    }

    /// Whether anything but the surroundings is hit beyond `near`.
    pub fn is_blocked(&self, ray: &Ray, near: f32) -> bool {
        let reaches = |bound| !misses(ray, bound, f32::INFINITY);
        self.clusters
            .iter()
            .filter(|cluster| reaches(cluster.bound))
            .any(|cluster| {
                cluster.objects.iter().any(|(object, bound)| {
                    reaches(*bound) && object.shape.intersect(ray, near, f32::INFINITY).is_some()
                })
            })
    }
}

/// Whether the ray misses a bounding sphere, starts past it, or reaches it only beyond `far`.
fn misses(ray: &Ray, (center, radius): (Vec3, f32), far: f32) -> bool {
    let to_center = center - ray.origin;
    let middle = to_center.dot(ray.direction);
    let square = radius * radius;
    let distance = to_center.length_squared();
    distance - middle * middle > square || (distance > square && middle < 0.0) || middle - radius > far
}

/// The demo scene: a round table on a terrace among hills, and on it a satin ball whose colour depends on the viewpoint, an
/// armillary sphere and a lattice mast of thin parts, blocks and balls.
pub fn demo_scene() -> SynthScene {
    let object = |shape, material| Object { shape, material };
    SynthScene {
        light: sky::DAYLIGHT,
        surroundings: vec![
            object(Shape::Ground { height: -1.45 }, Material::matte(Texture::Meadow)),
            object(Shape::Backdrop { radius: 20.0 }, Material::matte(Texture::Sky)),
        ],
        clusters: vec![
            Cluster::new(table()),
            // The ball: rough copper, whose reflection of the sky is smooth enough for low SH bands.
            Cluster::new([object(
                ball(-0.42, -0.38, 0.46),
                Material::metal(Vec3::new(0.86, 0.47, 0.32), 0.22),
            )]),
            Cluster::new(armillary(Vec3::new(0.62, 0.58, 0.0))),
            Cluster::new(mast(Vec3::new(-0.72, 0.92, 0.0))),
            Cluster::new(checkered_block(Vec3::new(0.82, -0.62, 0.0))),
            Cluster::new(striped_drum(Vec3::new(-1.39, -0.12, 0.0))),
            Cluster::new(
                [
                    (0.30, -1.12, 0.17, Vec3::new(0.80, 0.46, 0.05)),
                    (-0.03, -0.93, 0.11, Vec3::new(0.10, 0.40, 0.30)),
                    (-0.95, -1.02, 0.15, Vec3::new(0.72, 0.68, 0.60)),
                ]
                .map(glazed_ball),
            ),
            Cluster::new([glazed_ball((1.42, 0.12, 0.20, Vec3::new(0.16, 0.24, 0.55)))]),
            Cluster::new([glazed_ball((-0.20, 0.42, 0.14, Vec3::new(0.72, 0.22, 0.20)))]),
        ],
    }
}

/// A ball that lies on the table.
fn ball(x: f32, y: f32, radius: f32) -> Shape {
    Shape::Sphere {
        center: Vec3::new(x, y, radius),
        radius,
    }
}

fn glazed_ball((x, y, radius, color): (f32, f32, f32, Vec3)) -> Object {
    Object {
        shape: ball(x, y, radius),
        material: Material::glazed(Texture::Plain(color), 0.05, 0.2),
    }
}

fn table() -> [Object; 3] {
    let wood = Material::matte(Texture::Wood(Vec3::new(0.17, 0.075, 0.035)));
    let drum = |bottom: f32, radius, height| Shape::Drum {
        base: Vec3::Z * bottom,
        radius,
        height,
    };
    let top = Material::glazed(Texture::TableTop { radius: 2.0 }, 0.025, 0.1);
    [
        (drum(-0.14, 2.0, 0.14), top),
        (drum(-1.36, 0.2, 1.22), wood),
        (drum(-1.45, 0.85, 0.09), wood),
    ]
    .map(|(shape, material)| Object { shape, material })
}

fn checkered_block(foot: Vec3) -> [Object; 2] {
    let checker = Texture::Checker {
        colors: [Vec3::new(0.78, 0.74, 0.66), Vec3::new(0.03, 0.16, 0.20)],
        size: 0.21,
    };
    let cube = Shape::Block {
        center: foot + Vec3::Z * 0.21,
        half: Vec3::splat(0.21),
        world_from_block: Quat::from_rotation_z(0.45),
    };
    let brick = Shape::Block {
        center: foot + Vec3::new(0.04, 0.02, 0.49),
        half: Vec3::new(0.24, 0.12, 0.07),
        world_from_block: Quat::from_rotation_z(1.2),
    };
    let orange = Material::matte(Texture::Plain(Vec3::new(0.70, 0.16, 0.06)));
    [(cube, Material::glazed(checker, 0.04, 0.12)), (brick, orange)].map(|(shape, material)| Object { shape, material })
}

fn striped_drum(foot: Vec3) -> [Object; 2] {
    let plinth = Shape::Block {
        center: foot + Vec3::Z * 0.09,
        half: Vec3::new(0.26, 0.15, 0.09),
        world_from_block: Quat::from_rotation_z(0.5),
    };
    let drum = Shape::Drum {
        base: foot + Vec3::Z * 0.18,
        radius: 0.115,
        height: 0.34,
    };
    let stripes = Texture::Stripes {
        colors: [Vec3::new(0.80, 0.74, 0.62), Vec3::new(0.62, 0.08, 0.06)],
        size: 0.085,
    };
    let blue = Texture::Plain(Vec3::new(0.05, 0.20, 0.42));
    [(plinth, blue), (drum, stripes)].map(|(shape, texture)| Object {
        shape,
        material: Material::matte(texture),
    })
}

/// An armillary sphere: rings about a golden ball on a stand.
fn armillary(foot: Vec3) -> Vec<Object> {
    let center = foot + Vec3::Z * 0.82;
    let ring = |turn: Quat, radius| Shape::Ring {
        center,
        world_from_ring: turn,
        radius,
        tube: 0.03,
    };
    let rod = |from, to, radius| Shape::Rod { a: from, b: to, radius };
    let pole = Vec3::new(0.15, 0.0, 0.415);
    let brass = [
        ring(Quat::from_rotation_x(FRAC_PI_2), 0.44),
        ring(Quat::from_rotation_x(0.42), 0.376),
        ring(Quat::from_rotation_z(0.9) * Quat::from_rotation_x(1.25), 0.312),
        rod(center - pole, center + pole, 0.022),
        Shape::Sphere { center, radius: 0.10 },
    ];
    let stand = [
        rod(foot, foot + Vec3::Z * 0.36, 0.04),
        Shape::Drum {
            base: foot,
            radius: 0.24,
            height: 0.07,
        },
    ];
    let shiny = Material::metal(Vec3::new(0.90, 0.66, 0.30), 0.35);
    let dark = Material::matte(Texture::Plain(Vec3::new(0.10, 0.06, 0.045)));
    let of = |material| move |shape| Object { shape, material };
    brass.map(of(shiny)).into_iter().chain(stand.map(of(dark))).collect()
}

/// A lattice mast: four legs, square belts, braces, a ball on top.
fn mast(foot: Vec3) -> Vec<Object> {
    let white = Material::matte(Texture::Plain(Vec3::new(0.72, 0.70, 0.66)));
    let red = Material::matte(Texture::Plain(Vec3::new(0.62, 0.09, 0.05)));
    let corner = |level: f32, number: usize| {
        let half = 0.30 - 0.24 * level;
        let (x, y) = [(half, half), (-half, half), (-half, -half), (half, -half)][number % 4];
        foot + Quat::from_rotation_z(0.3) * Vec3::new(x, y, 1.25 * level + 0.02)
    };
    let rod = |from, to, radius, material| Object {
        shape: Shape::Rod { a: from, b: to, radius },
        material,
    };
    let mut parts = vec![Object {
        shape: Shape::Sphere {
            center: foot + Vec3::Z * 1.35,
            radius: 0.085,
        },
        material: Material::glazed(Texture::Plain(Vec3::new(0.75, 0.10, 0.05)), 0.05, 0.2),
    }];
    for number in 0..4 {
        parts.push(rod(corner(0.0, number), corner(1.0, number), 0.03, white));
        parts.push(rod(corner(0.0, number), corner(0.38, number + 1), 0.021, white));
        for level in [0.38, 0.70, 1.0] {
            parts.push(rod(corner(level, number), corner(level, number + 1), 0.024, red));
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn down_at(x: f32, y: f32) -> Ray {
        Ray {
            origin: Vec3::new(x, y, 5.0),
            direction: -Vec3::Z,
        }
    }

    #[test]
    fn vertical_rays_hit_the_table_the_ball_and_the_ground() {
        let scene = demo_scene();
        for (x, y, depth) in [(0.0, 0.0, 5.0), (-0.42, -0.38, 5.0 - 0.92), (3.0, 0.0, 6.45)] {
            let hit = scene.hit(&down_at(x, y), 1e-4).expect("a hit");
            assert!((hit.t - depth).abs() < 1e-4, "({x}, {y}): {} for {depth}", hit.t);
            assert!((hit.normal - Vec3::Z).length() < 1e-3);
        }
    }

    #[test]
    fn every_ray_hits_and_bounds_do_not_change_hits() {
        let scene = demo_scene();
        let mut unbounded = scene.clone();
        for cluster in &mut unbounded.clusters {
            cluster.bound.1 = 1e3;
            cluster.objects.iter_mut().for_each(|(_, bound)| bound.1 = 1e3);
        }
        let mut rng = irradia_scene::Rng::new(1, 0);
        for _ in 0..2000 {
            let mut point = || Vec3::new(rng.normal(), rng.normal(), rng.normal());
            let ray = Ray {
                origin: point() + Vec3::Z * 2.0,
                direction: point().normalize(),
            };
            let (a, b) = (scene.hit(&ray, 1e-3), unbounded.hit(&ray, 1e-3));
            assert_eq!(a.map(|hit| hit.t), b.map(|hit| hit.t));
            assert!(a.is_some());
        }
    }
}
