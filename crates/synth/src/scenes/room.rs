//! A furnished room with plain walls: a bed, a bookcase, a table, a lamp, a picture and a window.

use super::{any_tint, block, matte, pattern, tint};
use crate::cameras::{Path, Rig};
use crate::scene::{Cluster, Light, Material, Object, SynthScene};
use crate::shape::Shape;
use crate::texture::Texture;
use glam::{Vec2, Vec3};
use irradia_scene::Rng;

/// A lamp above one corner, and the light that walls and ceiling scatter.
const LIGHT: Light = Light {
    sun: Vec3::new(0.36, -0.30, 0.883),
    sun_light: Vec3::new(1.25, 1.12, 0.92),
    sun_spread: 0.09,
    above: Vec3::new(0.95, 0.92, 0.88),
    below: Vec3::new(0.62, 0.56, 0.50),
};

pub fn build(rng: &mut Rng) -> (SynthScene, Rig) {
    let half = Vec2::new(rng.range(2.8, 3.3), rng.range(2.4, 2.7));
    let height = rng.range(2.5, 2.8);
    let wall = tint(rng.uniform(), rng.range(0.02, 0.18), rng.range(0.55, 0.75));
    let floor = Vec3::new(0.42, 0.25, 0.13) * rng.range(0.7, 1.3);
    let interior = Texture::Interior { wall, floor, height };
    let scene = SynthScene {
        surroundings: vec![matte(Shape::Interior { half, height }, interior)],
        clusters: vec![
            Cluster::new(bed(rng, half)),
            Cluster::new(bookcase(rng, half)),
            Cluster::new(table(rng)),
            Cluster::new(wall_hangings(rng, half)),
            Cluster::new(lamp(rng, half)),
        ],
        light: LIGHT,
    };
    let path = Path::Within {
        half: 0.56 * half,
        height: [1.15, 1.75],
    };
    (scene, Rig { path, fov_x: 1.15 })
}

/// A bed along the wall at -X.
fn bed(rng: &mut Rng, half: Vec2) -> Vec<Object> {
    let y = rng.range(-0.5, 0.5);
    let at = |x: f32, z: f32| Vec3::new(-half.x + x, y, z);
    let wood = Texture::Wood(Vec3::new(0.34, 0.19, 0.09));
    let mut parts = vec![
        matte(block(at(0.45, 0.14), Vec3::new(0.45, 1.0, 0.14), 0.0), wood),
        matte(
            block(at(0.45, 0.37), Vec3::new(0.43, 0.97, 0.09), 0.0),
            Texture::Plain(Vec3::splat(0.7)),
        ),
        matte(
            block(at(0.45, 0.465), Vec3::new(0.44, 0.68, 0.02), 0.0),
            pattern(rng, 0.12),
        ),
        matte(
            block(at(0.45, 0.45) + Vec3::Y * 1.0, Vec3::new(0.45, 0.03, 0.45), 0.0),
            wood,
        ),
    ];
    let pillow = any_tint(rng) * 0.5 + 0.3;
    for x in [0.25, 0.65] {
        let place = at(x, 0.50) + Vec3::Y * 0.78;
        parts.push(matte(
            block(place, Vec3::new(0.17, 0.13, 0.05), rng.range(-0.2, 0.2)),
            Texture::Plain(pillow),
        ));
    }
    parts
}

/// A bookcase along the wall at +X: boards and rows of books.
fn bookcase(rng: &mut Rng, half: Vec2) -> Vec<Object> {
    let (x, y) = (half.x - 0.16, rng.range(-0.6, 0.6));
    let wood = Texture::Wood(Vec3::new(0.26, 0.15, 0.08));
    let mut parts: Vec<Object> = (0..5)
        .map(|board| {
            let place = Vec3::new(x, y, 0.04 + 0.42 * board as f32);
            matte(block(place, Vec3::new(0.15, 0.60, 0.015), 0.0), wood)
        })
        .collect();
    for side in [-0.6, 0.6] {
        parts.push(matte(
            block(Vec3::new(x, y + side, 0.87), Vec3::new(0.16, 0.015, 0.87), 0.0),
            wood,
        ));
    }
    for board in 0..4 {
        let (mut along, end) = (-0.56, rng.range(0.1, 0.5));
        while along < end {
            let book = Vec3::new(rng.range(0.08, 0.12), rng.range(0.012, 0.035), rng.range(0.09, 0.165));
            let place = Vec3::new(x, y + along + book.y, 0.06 + 0.42 * board as f32 + book.z);
            parts.push(matte(block(place, book, 0.0), Texture::Plain(any_tint(rng))));
            along += 2.0 * book.y + 0.002;
        }
    }
    parts
}

/// A low table in the middle, on a rug, with objects on it.
fn table(rng: &mut Rng) -> Vec<Object> {
    let center = Vec3::new(rng.range(-0.3, 0.3), rng.range(-0.3, 0.3), 0.0);
    let turn = rng.range(-0.5, 0.5);
    let wood = Texture::Wood(Vec3::new(0.48, 0.30, 0.15));
    let mut parts = vec![
        matte(
            block(center + Vec3::Z * 0.01, Vec3::new(1.0, 0.75, 0.01), turn),
            pattern(rng, 0.17),
        ),
        Object {
            shape: block(center + Vec3::Z * 0.42, Vec3::new(0.5, 0.32, 0.02), turn),
            material: Material::glazed(wood, 0.03, 0.15),
        },
    ];
    let rotation = glam::Quat::from_rotation_z(turn);
    for (x, y) in [(-0.45, -0.27), (0.45, -0.27), (0.45, 0.27), (-0.45, 0.27)] {
        let foot = center + rotation * Vec3::new(x, y, 0.04);
        let leg = Shape::Rod {
            a: foot,
            b: foot + Vec3::Z * 0.36,
            radius: 0.025,
        };
        parts.push(matte(leg, wood));
    }
    for x in [-0.3, 0.0, 0.3] {
        let place = center + rotation * Vec3::new(x + rng.range(-0.06, 0.06), rng.range(-0.18, 0.18), 0.44);
        let size = rng.range(0.06, 0.11);
        parts.push(match rng.below(3) {
            0 => Object {
                shape: Shape::Sphere {
                    center: place + Vec3::Z * size,
                    radius: size,
                },
                material: Material::glazed(Texture::Plain(any_tint(rng)), 0.05, 0.15),
            },
            1 => matte(
                Shape::Drum {
                    base: place,
                    radius: 0.7 * size,
                    height: 2.4 * size,
                },
                pattern(rng, 0.04),
            ),
            _ => matte(
                block(
                    place + Vec3::Z * 0.5 * size,
                    Vec3::new(1.3 * size, size, 0.5 * size),
                    rng.range(0.0, 1.5),
                ),
                pattern(rng, 0.04),
            ),
        });
    }
    parts
}

/// A picture at +Y and a window at -Y.
fn wall_hangings(rng: &mut Rng, half: Vec2) -> Vec<Object> {
    let frame = Texture::Plain(any_tint(rng) * 0.5);
    let white = Texture::Plain(Vec3::splat(0.75));
    let (picture, window) = (rng.range(-1.2, 1.2), rng.range(-0.6, 0.6));
    let wide = rng.range(0.35, 0.6);
    let at = |x: f32, side: f32, z: f32| Vec3::new(x, side * half.y, z);
    let mut parts = vec![
        matte(
            block(at(picture, 0.996, 1.5), Vec3::new(wide + 0.04, 0.02, 0.37), 0.0),
            frame,
        ),
        matte(
            block(at(picture, 0.99, 1.5), Vec3::new(wide, 0.02, 0.33), 0.0),
            Texture::Patches {
                colors: [any_tint(rng), any_tint(rng) + 0.2],
                size: 0.5,
            },
        ),
        matte(block(at(window, -0.996, 1.5), Vec3::new(0.72, 0.02, 0.55), 0.0), white),
        matte(
            block(at(window, -0.99, 1.5), Vec3::new(0.66, 0.02, 0.49), 0.0),
            Texture::Window,
        ),
    ];
    for (x, size) in [(0.0, Vec3::new(0.025, 0.03, 0.5)), (0.0, Vec3::new(0.67, 0.03, 0.025))] {
        parts.push(matte(block(at(window + x, -0.985, 1.5), size, 0.0), white));
    }
    parts
}

/// A floor lamp in a corner.
fn lamp(rng: &mut Rng, half: Vec2) -> Vec<Object> {
    let foot = Vec3::new(half.x - 0.45, half.y - 0.45 - rng.range(0.0, 0.2), 0.0);
    let dark = Texture::Plain(Vec3::splat(0.06));
    let drum = |z: f32, radius: f32, height: f32| Shape::Drum {
        base: foot + Vec3::Z * z,
        radius,
        height,
    };
    vec![
        matte(drum(0.0, 0.16, 0.03), dark),
        matte(
            Shape::Rod {
                a: foot,
                b: foot + Vec3::Z * 1.4,
                radius: 0.015,
            },
            dark,
        ),
        matte(
            drum(1.3, 0.18, 0.28),
            Texture::Plain(tint(rng.range(0.05, 0.15), 0.3, 0.8)),
        ),
    ]
}
