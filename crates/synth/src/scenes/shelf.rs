//! A shelf with objects in front of a plain wall, captured from the front.

use super::{any_tint, block, matte, pattern, tint};
use crate::cameras::{Path, Rig};
use crate::scene::{Cluster, Light, Material, Object, SynthScene};
use crate::shape::Shape;
use crate::texture::Texture;
use glam::{Vec2, Vec3};
use irradia_scene::Rng;

/// A lamp to the left of the cameras.
const LIGHT: Light = Light {
    sun: Vec3::new(-0.40, -0.66, 0.636),
    sun_light: Vec3::new(1.5, 1.4, 1.2),
    sun_spread: 0.05,
    above: Vec3::new(0.80, 0.80, 0.82),
    below: Vec3::new(0.50, 0.45, 0.40),
};

/// Half the width, half the depth and the height, metres.
const SHELF_SIZE: Vec3 = Vec3::new(1.25, 0.19, 1.9);

pub fn build(rng: &mut Rng) -> (SynthScene, Rig) {
    let wall = tint(rng.uniform(), rng.range(0.05, 0.2), rng.range(0.5, 0.7));
    let floor = Vec3::new(0.40, 0.26, 0.15) * rng.range(0.6, 1.2);
    // The room surrounds the shelf and the cameras; the wall behind the shelf is a cluster, which casts no shadow on the shelf.
    let room = Shape::Interior {
        half: Vec2::new(6.0, 6.0),
        height: 3.2,
    };
    let mut clusters = vec![Cluster::new([matte(
        block(Vec3::new(0.0, 0.26, 1.6), Vec3::new(6.0, 0.05, 1.6), 0.0),
        Texture::Plain(wall),
    )])];
    let (columns, rows) = (3 + rng.below(2), 3 + rng.below(2));
    clusters.push(Cluster::new(boards(rng, columns, rows)));
    for row in 0..rows {
        for column in 0..columns {
            let cell = Vec2::new(2.0 * SHELF_SIZE.x / columns as f32, SHELF_SIZE.z / rows as f32);
            let corner = Vec3::new(
                -SHELF_SIZE.x + cell.x * column as f32 + 0.03,
                0.0,
                cell.y * row as f32 + 0.03,
            );
            clusters.push(Cluster::new(objects(rng, corner, cell - 0.05)));
        }
    }
    let scene = SynthScene {
        surroundings: vec![matte(
            room,
            Texture::Interior {
                wall,
                floor,
                height: 3.2,
            },
        )],
        clusters,
        light: LIGHT,
    };
    let path = Path::InFront {
        target: Vec3::new(0.0, 0.0, 1.0),
        distance: 2.3,
        half: Vec2::new(0.55, 0.35),
    };
    (scene, Rig { path, fov_x: 0.95 })
}

fn boards(rng: &mut Rng, columns: u32, rows: u32) -> Vec<Object> {
    let wood = Texture::Wood(Vec3::new(0.5, 0.33, 0.19) * rng.range(0.4, 1.2));
    let level = |row: u32| SHELF_SIZE.z * row as f32 / rows as f32 + 0.015;
    let upright = |column: u32| -SHELF_SIZE.x + 2.0 * SHELF_SIZE.x * column as f32 / columns as f32;
    let mut parts = vec![matte(
        block(
            Vec3::new(0.0, 0.2, 0.5 * SHELF_SIZE.z),
            Vec3::new(SHELF_SIZE.x, 0.008, 0.5 * SHELF_SIZE.z),
            0.0,
        ),
        wood,
    )];
    let half = Vec3::new(SHELF_SIZE.x + 0.015, SHELF_SIZE.y, 0.015);
    parts.extend((0..=rows).map(|row| matte(block(Vec3::Z * level(row), half, 0.0), wood)));
    let half = Vec3::new(0.015, SHELF_SIZE.y, 0.5 * SHELF_SIZE.z);
    let place = |column| Vec3::new(upright(column), 0.0, 0.5 * SHELF_SIZE.z);
    parts.extend((0..=columns).map(|column| matte(block(place(column), half, 0.0), wood)));
    parts
}

/// The objects in the compartment with the given lower left corner and size.
fn objects(rng: &mut Rng, corner: Vec3, size: Vec2) -> Vec<Object> {
    let mut parts = Vec::new();
    let mut along = 0.02;
    if rng.below(3) == 0 {
        // A row of books.
        let end = size.x * rng.range(0.5, 0.95);
        while along < end {
            let book = Vec3::new(
                rng.range(0.012, 0.03),
                rng.range(0.09, 0.14),
                size.y * rng.range(0.27, 0.44),
            );
            let place = corner + Vec3::new(along + book.x, rng.range(-0.03, 0.03), book.z);
            let cover = if rng.below(3) == 0 {
                pattern(rng, 0.04)
            } else {
                Texture::Plain(any_tint(rng))
            };
            parts.push(matte(block(place, book, 0.0), cover));
            along += 2.0 * book.x + 0.002;
        }
        return parts;
    }
    loop {
        let radius = rng.range(0.05, 0.5 * size.y.min(0.26));
        if along + 2.0 * radius > size.x - 0.02 {
            return parts;
        }
        let place = corner + Vec3::new(along + radius, rng.range(-0.06, 0.06), 0.0);
        let glazed = |texture| Material::glazed(texture, 0.05, 0.15);
        let plain = rng.below(2) == 0;
        let texture = if plain {
            Texture::Plain(any_tint(rng))
        } else {
            pattern(rng, 0.035)
        };
        let (shape, material) = match rng.below(4) {
            0 => {
                let center = place + Vec3::Z * radius;
                (Shape::Sphere { center, radius }, glazed(texture))
            }
            1 => {
                let (radius, height) = (0.7 * radius, size.y * rng.range(0.35, 0.8));
                let base = place;
                (Shape::Drum { base, radius, height }, glazed(texture))
            }
            2 => {
                let half = Vec3::new(0.75 * radius, 0.6 * radius, size.y * rng.range(0.15, 0.4));
                let turn = rng.range(-0.4, 0.4);
                (block(place + Vec3::Z * half.z, half, turn), Material::matte(texture))
            }
            _ => {
                let tube = 0.2 * radius;
                let ring = Shape::Ring {
                    center: place + Vec3::Z * radius,
                    world_from_ring: glam::Quat::from_rotation_x(1.4),
                    radius: radius - tube,
                    tube,
                };
                (ring, Material::metal(any_tint(rng) * 0.4 + 0.45, 0.3))
            }
        };
        parts.push(Object { shape, material });
        along += 2.0 * radius + rng.range(0.01, 0.08);
    }
}
