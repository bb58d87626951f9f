//! Thin structures: a wire grid, a spoked wheel, hanging wires, bare twigs and blades of grass, on a slab under the open sky.

use super::{any_tint, block, matte, tint};
use crate::cameras::{Path, Rig};
use crate::scene::{Cluster, Material, Object, SynthScene};
use crate::shape::Shape;
use crate::sky;
use crate::texture::Texture;
use glam::{Quat, Vec2, Vec3};
use irradia_scene::Rng;
use std::f32::consts::{FRAC_PI_2, TAU};

pub fn build(rng: &mut Rng) -> (SynthScene, Rig) {
    let slab = Texture::Patches {
        colors: [Vec3::new(0.50, 0.46, 0.40), Vec3::new(0.30, 0.28, 0.26)],
        size: 0.8,
    };
    let turn = rng.range(0.0, TAU);
    // Four groups on the slab, a quarter turn apart.
    let mut place = (0..4).map(|quarter| {
        let azimuth = turn + FRAC_PI_2 * quarter as f32;
        (Vec2::from_angle(azimuth) * 0.85).extend(0.1)
    });
    let mut next = || place.next().expect("four places");
    let (grid_at, wheel_at, twigs_at, grass_at) = (next(), next(), next(), next());
    let mut clusters = vec![
        Cluster::new([matte(
            Shape::Drum {
                base: Vec3::ZERO,
                radius: 1.9,
                height: 0.1,
            },
            slab,
        )]),
        Cluster::new(grid(rng, grid_at)),
        Cluster::new(wheel(rng, wheel_at)),
        Cluster::new(twigs(rng, twigs_at)),
        Cluster::new(wires(rng)),
    ];
    clusters.extend((0..5).map(|tuft| {
        let aside = Vec2::from_angle(TAU * tuft as f32 / 5.0) * rng.range(0.15, 0.4);
        Cluster::new(grass(rng, grass_at + aside.extend(0.0)))
    }));
    let scene = SynthScene {
        surroundings: vec![
            matte(Shape::Ground { height: 0.0 }, Texture::Park),
            matte(Shape::Backdrop { radius: 20.0 }, Texture::Sky),
        ],
        clusters,
        light: sky::DAYLIGHT,
    };
    let path = Path::Around {
        target: Vec3::new(0.0, 0.0, 0.6),
        distance: [3.0, 3.8],
        elevation: [0.12, 0.7],
        aside: 0.1,
    };
    (scene, Rig { path, fov_x: 0.84 })
}

fn rod(a: Vec3, b: Vec3, radius: f32, texture: Texture) -> Object {
    matte(Shape::Rod { a, b, radius }, texture)
}

/// An upright wire grid in a frame.
fn grid(rng: &mut Rng, foot: Vec3) -> Vec<Object> {
    let turn = Quat::from_rotation_z(rng.range(0.0, TAU));
    let (half, height) = (rng.range(0.4, 0.55), rng.range(0.8, 1.1));
    let meshes = 7 + rng.below(5);
    let (wire, frame) = (
        Texture::Plain(Vec3::splat(rng.range(0.3, 0.65))),
        Texture::Plain(any_tint(rng)),
    );
    let at = |x: f32, z: f32| foot + turn * Vec3::new(half * x, 0.0, 0.05 + height * z);
    let mut parts = Vec::new();
    for line in 0..=meshes {
        let t = line as f32 / meshes as f32;
        let edge = line == 0 || line == meshes;
        let (radius, texture) = if edge { (0.02, frame) } else { (0.006, wire) };
        parts.push(rod(at(2.0 * t - 1.0, 0.0), at(2.0 * t - 1.0, 1.0), radius, texture));
        parts.push(rod(at(-1.0, t), at(1.0, t), radius, texture));
    }
    parts
}

/// A wheel with spokes on a stand.
fn wheel(rng: &mut Rng, foot: Vec3) -> Vec<Object> {
    let radius = rng.range(0.38, 0.48);
    let center = foot + Vec3::Z * (radius + 0.12);
    let turn = Quat::from_rotation_z(rng.range(0.0, TAU)) * Quat::from_rotation_x(FRAC_PI_2);
    let spokes = 16 + rng.below(12);
    let metal = Material::metal(Vec3::new(0.75, 0.76, 0.78), 0.3);
    let mut parts = vec![
        Object {
            shape: Shape::Ring {
                center,
                world_from_ring: turn,
                radius,
                tube: 0.022,
            },
            material: Material::matte(Texture::Plain(any_tint(rng))),
        },
        Object {
            shape: Shape::Sphere { center, radius: 0.04 },
            material: metal,
        },
    ];
    for spoke in 0..spokes {
        let rim = turn * (Vec2::from_angle(TAU * spoke as f32 / spokes as f32) * radius).extend(0.0);
        let shape = Shape::Rod {
            a: center,
            b: center + rim,
            radius: 0.005,
        };
        parts.push(Object { shape, material: metal });
    }
    for side in [-1.0, 1.0] {
        let base = foot + turn * Vec3::new(0.0, 0.0, 0.16 * side);
        parts.push(rod(
            base,
            center + turn * Vec3::Z * 0.04 * side,
            0.015,
            Texture::Plain(Vec3::splat(0.08)),
        ));
    }
    parts
}

/// A bare branch that forks into ever thinner twigs.
fn twigs(rng: &mut Rng, foot: Vec3) -> Vec<Object> {
    let bark = Texture::Wood(Vec3::new(0.25, 0.16, 0.10));
    let mut parts = Vec::new();
    let mut growing = vec![(foot, Vec3::Z, 0.45, 0.03)];
    while let Some((from, direction, length, radius)) = growing.pop() {
        let to = from + direction * length;
        parts.push(rod(from, to, radius, bark));
        if radius > 0.006 {
            for _ in 0..3 {
                let aside = Vec3::new(rng.normal(), rng.normal(), 0.5 * rng.normal()) * 0.45;
                let onwards = (direction + aside + Vec3::Z * 0.1).normalize();
                growing.push((to, onwards, length * rng.range(0.55, 0.8), 0.58 * radius));
            }
        }
    }
    parts
}

/// Two poles at the slab's edge, and wires that hang between them, with small flags.
fn wires(rng: &mut Rng) -> Vec<Object> {
    let turn = Quat::from_rotation_z(rng.range(0.0, TAU));
    let ends = [-1.6f32, 1.6].map(|x| turn * Vec3::new(x, 0.0, 0.1));
    let pole = Texture::Plain(Vec3::splat(0.2));
    let mut parts: Vec<Object> = ends
        .iter()
        .map(|foot| rod(*foot, *foot + Vec3::Z * 1.5, 0.03, pole))
        .collect();
    for wire in 0..3 {
        let height = 1.45 - 0.12 * wire as f32;
        let sag = rng.range(0.1, 0.35);
        let texture = Texture::Plain(Vec3::splat(0.05));
        let at = |t: f32| {
            let drop = sag * (1.0 - (2.0 * t - 1.0).powi(2));
            ends[0].lerp(ends[1], t) + Vec3::Z * (height - drop)
        };
        for part in 0..14 {
            let (a, b) = (at(part as f32 / 14.0), at((part + 1) as f32 / 14.0));
            parts.push(rod(a, b, 0.006, texture));
            if wire == 0 && part % 2 == 1 {
                let flag = block(a - Vec3::Z * 0.06, Vec3::new(0.045, 0.004, 0.055), rng.range(-0.3, 0.3));
                parts.push(matte(flag, Texture::Plain(any_tint(rng))));
            }
        }
    }
    parts
}

/// A tuft of bent blades.
fn grass(rng: &mut Rng, foot: Vec3) -> Vec<Object> {
    let mut parts = Vec::new();
    for _ in 0..26 {
        let root = foot + Vec3::new(rng.normal(), rng.normal(), 0.0) * 0.045;
        let lean = Vec3::new(rng.normal(), rng.normal(), 0.0) * 0.16;
        let height = rng.range(0.25, 0.55);
        let texture = Texture::Plain(tint(rng.range(0.17, 0.3), 0.75, rng.range(0.15, 0.4)));
        let at = |t: f32| root + lean * t * t + Vec3::Z * (height * t);
        for part in 0..3 {
            let (a, b) = (part as f32 / 3.0, (part + 1) as f32 / 3.0);
            parts.push(rod(at(a), at(b), 0.011 - 0.003 * part as f32, texture));
        }
    }
    parts
}
