//! Procedural textures, linear RGB. Detail is a few pixels wide in the default views: anything finer than a pixel would be
//! noise that no scene can represent.

use glam::{Vec2, Vec3};
use std::f32::consts::{FRAC_PI_4, TAU};

/// The colour of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Texture {
    /// One colour.
    Plain(Vec3),
    /// Squares of a given size along the object's local axes.
    Checker {
        /// The two colours.
        colors: [Vec3; 2],
        /// Edge of a square, world units.
        size: f32,
    },
    /// Bands along the object's local vertical axis.
    Stripes {
        /// The two colours.
        colors: [Vec3; 2],
        /// Height of a band, world units.
        size: f32,
    },
    /// The table's top: a compass rose in stone, a ring of inlay, staves of wood.
    TableTop {
        /// Radius of the top, world units.
        radius: f32,
    },
    /// Wood with its grain along the object's local vertical axis.
    Wood(Vec3),
    /// Flagstones around the table, then meadow.
    Meadow,
    /// Patches of two colours, such as stone, cloth or leaves.
    Patches {
        /// The two colours.
        colors: [Vec3; 2],
        /// Size of the largest patches, world units.
        size: f32,
    },
    /// A room with a floor of planks, white ceiling and skirting, and plain walls.
    Interior {
        /// Colour of the walls.
        wall: Vec3,
        /// Colour of the planks.
        floor: Vec3,
        /// Height of the room, world units.
        height: f32,
    },
    /// Grass with flowers and a winding path.
    Park,
    /// Sky, clouds and hills on the backdrop; emissive.
    Sky,
    /// Sky and hills as from the middle of a room; emissive. For upright panes across the object's local Y axis.
    Window,
}

impl Texture {
    /// Albedo, or radiance if it is emissive, at a point in the object's local frame.
    pub fn color(&self, local: Vec3) -> Vec3 {
        match *self {
            Texture::Plain(color) => color,
            Texture::Checker { colors, size } => {
                // Offset by a quarter of a square: an edge of the pattern on a face would be decided by rounding.
                let cell = (local / size + 0.25).floor();
                colors[((cell.x + cell.y + cell.z) as i32).rem_euclid(2) as usize]
            }
            Texture::Stripes { colors, size } => {
                colors[((local.z / size + 0.25).floor() as i32).rem_euclid(2) as usize]
            }
            Texture::TableTop { radius } => table_top(local.truncate(), radius),
            Texture::Wood(color) => {
                let grain = fbm(Vec2::new(local.x + 1.7 * local.y, 0.25 * local.z) * 14.0, 2);
                color * (0.75 + 0.5 * grain)
            }
            Texture::Meadow => meadow(local.truncate()),
            Texture::Patches { colors: [a, b], size } => {
                // A slice through the noise that is parallel to no face.
                let p = Vec2::new(local.x + 0.61 * local.z, local.y - 0.53 * local.z) / size;
                a.lerp(b, smoothstep(0.35, 0.65, fbm(p * 2.0, 4)))
            }
            Texture::Interior { wall, floor, height } => interior(local, wall, floor, height),
            Texture::Park => park(local.truncate()),
            Texture::Sky => crate::sky::radiance(local.normalize()),
            Texture::Window => crate::sky::radiance(Vec3::new(local.x, 2.0, local.z + 0.1).normalize()),
        }
    }

    /// Whether its colour is radiance, not albedo.
    pub fn is_emissive(&self) -> bool {
        matches!(self, Texture::Sky | Texture::Window)
    }
}

const STONE: Vec3 = Vec3::new(0.66, 0.60, 0.50);
const INK: Vec3 = Vec3::new(0.055, 0.09, 0.14);
const RUST: Vec3 = Vec3::new(0.45, 0.12, 0.05);
const BRASS: Vec3 = Vec3::new(0.62, 0.42, 0.14);
const WALNUT: Vec3 = Vec3::new(0.23, 0.105, 0.05);

fn table_top(p: Vec2, radius: f32) -> Vec3 {
    let r = p.length() / radius;
    let angle = p.y.atan2(p.x);
    let veins = || fbm(p * 2.6 + fbm(p * 1.5, 2) * 2.0, 3);
    if r < 0.52 {
        let veins = veins();
        let stone = STONE * (0.72 + 0.55 * veins);
        // Long points first, then the short ones behind them, each half light and half dark as on a map.
        for (turn, tip, colors) in [(0.0, 0.49, [INK, BRASS]), (FRAC_PI_4, 0.35, [RUST, STONE * 1.15])] {
            let folded = (angle - turn + FRAC_PI_4).rem_euclid(2.0 * FRAC_PI_4) - FRAC_PI_4;
            let (x, y) = (r * folded.cos(), r * folded.sin());
            // The point is the triangle from (tip, 0) to its foot at 45 degrees on the inner circle.
            let foot = 0.15 * FRAC_PI_4.cos();
            if y.abs() * (tip - foot) < foot * (tip - x) {
                return colors[usize::from(y > 0.0)] * (0.85 + 0.3 * veins);
            }
        }
        return stone;
    }
    let inlay = |from: f32, to: f32| r >= from && r < to;
    if inlay(0.52, 0.545) || inlay(0.655, 0.68) || r > 0.965 {
        return INK * (0.8 + 0.5 * veins());
    }
    if r < 0.655 {
        let turns = angle / TAU * 20.0;
        let across = (r - 0.545) / 0.11;
        let saw = 2.0 * (turns.rem_euclid(1.0) - 0.5).abs();
        return if saw < across {
            RUST * (0.9 + 0.3 * veins())
        } else {
            STONE * (0.75 + 0.5 * veins())
        };
    }
    let stave = (angle / TAU * 20.0).floor();
    let tone = 0.62 + 0.85 * lattice_hash(stave as i32, 7);
    // Grain runs outwards: fine across the stave, coarse along it.
    let grain = fbm(Vec2::new(angle * 9.0 + 3.0 * stave, p.length() * 1.4), 3);
    let seam = (angle / TAU * 20.0).rem_euclid(1.0);
    let dark = if seam.min(1.0 - seam) * r < 0.012 { 0.45 } else { 1.0 };
    WALNUT * (tone * (0.55 + 0.95 * grain) * dark)
}

fn meadow(p: Vec2) -> Vec3 {
    let r = p.length();
    let patches = fbm(p * 0.5, 2);
    let grass = Vec3::new(0.085, 0.15, 0.035).lerp(Vec3::new(0.26, 0.24, 0.07), smoothstep(0.3, 0.75, patches));
    let blades = 0.88 + 0.24 * fbm(p * 1.4 + 31.0, 2);
    let row = (r / 0.75).floor();
    let count = (row * 7.0).max(1.0);
    let stone_number = ((p.y.atan2(p.x) / TAU + 0.137 * row) * count).floor().rem_euclid(count);
    let slab = Vec3::new(0.36, 0.335, 0.30) * (0.7 + 0.5 * lattice_hash(stone_number as i32, row as i32 + 50));
    slab.lerp(grass * blades, smoothstep(3.5, 4.3, r + 0.9 * (patches - 0.5)))
}

fn interior(p: Vec3, wall: Vec3, floor: Vec3, height: f32) -> Vec3 {
    const WHITE: Vec3 = Vec3::new(0.78, 0.77, 0.74);
    if p.z > height - 1e-3 {
        return WHITE;
    }
    if p.z > 1e-3 {
        return if p.z < 0.09 { WHITE * 0.9 } else { wall };
    }
    let row = (p.y / 0.16).floor();
    let along = p.x / 1.3 + 0.37 * row;
    let seam = (p.y / 0.16).rem_euclid(1.0) < 0.05 || along.rem_euclid(1.0) < 0.008;
    let tone = 0.7 + 0.5 * lattice_hash(along.floor() as i32, row as i32);
    let grain = 0.7 + 0.6 * fbm(Vec2::new(p.x * 2.0, p.y * 22.0), 3);
    floor * tone * grain * if seam { 0.45 } else { 1.0 }
}

fn park(p: Vec2) -> Vec3 {
    let tufts = fbm(p * 1.1, 5);
    let fields = fbm(p * 0.06 + 3.0, 3);
    let grass = Vec3::new(0.06, 0.13, 0.03).lerp(Vec3::new(0.27, 0.30, 0.08), smoothstep(0.3, 0.7, tufts));
    let dry = Vec3::new(0.36, 0.31, 0.13) * (0.6 + 0.8 * tufts);
    let land = grass.lerp(dry, smoothstep(0.45, 0.65, fields));
    let cell = (p / 0.3).floor();
    let off_flower = (p / 0.3 - cell - 0.5).length();
    let is_flower = off_flower < 0.25 && lattice_hash(cell.x as i32, cell.y as i32 + 900) > 0.93;
    let land = if is_flower { Vec3::new(0.75, 0.62, 0.18) } else { land };
    let gravel = Vec3::new(0.44, 0.38, 0.30) * (0.55 + 0.9 * fbm(p * 7.0, 3));
    let off_path = (p.y + 1.2 * (0.45 * p.x).sin()).abs();
    gravel.lerp(land, smoothstep(0.55, 0.8, off_path + 0.3 * (tufts - 0.5)))
}

/// 0 below `from`, 1 above `to`, smooth in between.
pub fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A hash in \[0, 1) of a point of the integer lattice.
pub fn lattice_hash(x: i32, y: i32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    ((h ^ (h >> 15)) >> 8) as f32 / 16_777_216.0
}

/// Value noise: smoothly interpolated lattice values, in \[0, 1\].
pub fn noise(p: Vec2) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let f = f * f * (3.0 - 2.0 * f);
    let (x, y) = (cell.x as i32, cell.y as i32);
    let low = lattice_hash(x, y) + (lattice_hash(x + 1, y) - lattice_hash(x, y)) * f.x;
    let high = lattice_hash(x, y + 1) + (lattice_hash(x + 1, y + 1) - lattice_hash(x, y + 1)) * f.x;
    low + (high - low) * f.y
}

/// Sum of octaves of [`noise`], each twice as fine and half as strong, in \[0, 1\].
pub fn fbm(p: Vec2, octaves: u32) -> f32 {
    let (mut sum, mut total, mut weight, mut q) = (0.0, 0.0, 1.0, p);
    for _ in 0..octaves {
        sum += weight * noise(q);
        total += weight;
        weight *= 0.5;
        // Rotated, so that the lattices of octaves do not align.
        q = Vec2::new(1.6 * q.x - 1.2 * q.y, 1.2 * q.x + 1.6 * q.y) + 17.3;
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_bounded_and_continuous_across_cells() {
        for i in 0..1000 {
            let p = Vec2::new(0.37 * i as f32 - 150.0, -0.11 * i as f32);
            assert!((0.0..=1.0).contains(&noise(p)) && (0.0..=1.0).contains(&fbm(p, 4)));
        }
        for x in -3..3 {
            let border = Vec2::new(x as f32, 0.3);
            assert!((noise(border - Vec2::X * 1e-4) - noise(border + Vec2::X * 1e-4)).abs() < 1e-3);
        }
    }

    #[test]
    fn a_checker_alternates_and_the_rose_has_two_halves() {
        let checker = Texture::Checker {
            colors: [Vec3::ZERO, Vec3::ONE],
            size: 1.0,
        };
        let at = |x: f32| checker.color(Vec3::new(x, 0.1, 0.1));
        assert!(at(0.3) != at(1.3) && at(0.3) == at(2.3));
        let top = Texture::TableTop { radius: 2.0 };
        let (left, right) = (
            top.color(Vec3::new(0.5, 0.02, 0.0)),
            top.color(Vec3::new(0.5, -0.02, 0.0)),
        );
        assert!((left - right).length() > 0.2, "{left} {right}");
    }
}
