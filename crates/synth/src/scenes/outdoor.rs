//! Boulders on a meadow with a path, a fence and trees, and hills and sky far away.

use super::{any_tint, block, matte, tint};
use crate::cameras::{Path, Rig};
use crate::scene::{Cluster, Object, SynthScene};
use crate::shape::Shape;
use crate::sky;
use crate::texture::Texture;
use glam::{Vec2, Vec3};
use irradia_scene::Rng;
use std::f32::consts::TAU;

/// Radius of the sky, metres: a hundred times the cameras' distance, so that it has no parallax.
const SKY_RADIUS: f32 = 400.0;

pub fn build(rng: &mut Rng) -> (SynthScene, Rig) {
    let mut clusters = vec![Cluster::new(boulders(rng)), Cluster::new(sign(rng))];
    clusters.extend(fence(rng).chunks(12).map(|part| Cluster::new(part.iter().copied())));
    let turn = rng.uniform();
    for number in 0..26 {
        // From the edge of the clearing to the hills, ever sparser.
        let distance = 8.0 * (1.0 + 6.5 * (number as f32 / 26.0).powi(2)) * rng.range(0.95, 1.15);
        let azimuth = TAU * (turn + 0.618_034 * number as f32 + rng.range(-0.02, 0.02));
        let foot = (Vec2::from_angle(azimuth) * distance).extend(0.0);
        clusters.push(Cluster::new(tree(rng, foot)));
    }
    let scene = SynthScene {
        surroundings: vec![
            matte(Shape::Ground { height: 0.0 }, Texture::Park),
            matte(Shape::Backdrop { radius: SKY_RADIUS }, Texture::Sky),
        ],
        clusters,
        light: sky::DAYLIGHT,
    };
    let path = Path::Around {
        target: Vec3::new(0.0, 0.0, 0.7),
        distance: [3.6, 4.8],
        elevation: [0.06, 0.45],
        aside: 0.2,
    };
    (scene, Rig { path, fov_x: 1.05 })
}

/// A pile of rocks in the middle.
fn boulders(rng: &mut Rng) -> Vec<Object> {
    let stone = Vec3::new(0.40, 0.37, 0.33) * rng.range(0.8, 1.2);
    let moss = Vec3::new(0.13, 0.17, 0.06);
    (0..9)
        .map(|number| {
            let radius = if number < 3 {
                rng.range(0.45, 0.75)
            } else {
                rng.range(0.15, 0.4)
            };
            let place = Vec2::from_angle(rng.range(0.0, TAU)) * rng.range(0.1, 1.5);
            let center = place.extend(radius * rng.range(0.2, 0.75) + if number < 2 { 0.4 } else { 0.0 });
            let colors = [
                stone * rng.range(0.6, 1.2),
                if rng.below(3) == 0 { moss } else { stone * 0.45 },
            ];
            matte(
                Shape::Sphere { center, radius },
                Texture::Patches {
                    colors,
                    size: rng.range(0.3, 0.7),
                },
            )
        })
        .collect()
}

/// A signpost beside the path.
fn sign(rng: &mut Rng) -> Vec<Object> {
    let foot = Vec3::new(rng.range(-1.0, 1.0), 1.9, 0.0);
    let turn = rng.range(-0.6, 0.6);
    let board = Texture::Checker {
        colors: [any_tint(rng), Vec3::splat(0.75)],
        size: 0.12,
    };
    let post = Shape::Rod {
        a: foot,
        b: foot + Vec3::Z * 1.5,
        radius: 0.035,
    };
    vec![
        matte(post, Texture::Wood(Vec3::new(0.3, 0.19, 0.1))),
        matte(
            block(foot + Vec3::new(0.0, 0.0, 1.35), Vec3::new(0.36, 0.05, 0.17), turn),
            board,
        ),
    ]
}

/// Posts and rails around the clearing, with a gap for the path.
fn fence(rng: &mut Rng) -> Vec<Object> {
    let wood = Texture::Wood(Vec3::new(0.36, 0.25, 0.15) * rng.range(0.7, 1.2));
    let radius = rng.range(6.2, 6.8);
    let post = |number: usize| (Vec2::from_angle(TAU * number as f32 / 32.0) * radius).extend(0.0);
    let mut parts = Vec::new();
    for number in (0..32).filter(|number| !matches!(number, 0 | 15 | 16 | 31)) {
        let (here, next) = (post(number), post(number + 1));
        let rod = |a, b, radius| matte(Shape::Rod { a, b, radius }, wood);
        parts.push(rod(here, here + Vec3::Z * 1.05, 0.05));
        for height in [0.5, 0.9] {
            parts.push(rod(
                here + Vec3::Z * height,
                next + Vec3::Z * (height + rng.range(-0.04, 0.04)),
                0.028,
            ));
        }
    }
    parts
}

/// A trunk and a crown of balls.
fn tree(rng: &mut Rng, foot: Vec3) -> Vec<Object> {
    let height = rng.range(2.2, 4.5);
    let hue = rng.range(0.17, 0.32);
    let leaves = [tint(hue, 0.75, 0.10), tint(hue - 0.03, 0.7, 0.30)];
    let mut parts = vec![matte(
        Shape::Drum {
            base: foot,
            radius: 0.05 * height,
            height: 0.6 * height,
        },
        Texture::Wood(Vec3::new(0.22, 0.15, 0.10)),
    )];
    for number in 0..7 {
        let around = Vec2::from_angle(TAU * number as f32 / 6.0) * if number == 6 { 0.0 } else { 0.18 * height };
        let radius = height * rng.range(0.15, 0.24);
        let center = foot + around.extend(height * rng.range(0.62, 0.95));
        parts.push(matte(
            Shape::Sphere { center, radius },
            Texture::Patches {
                colors: leaves,
                size: 0.12 * height,
            },
        ));
    }
    parts
}
