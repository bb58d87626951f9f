//! The scenes by name. All but the demo follow the seed: layout, sizes and colours.

mod outdoor;
mod room;
mod shelf;
mod thin;

use crate::cameras::{self, Rig};
use crate::scene::{Material, Object, SynthScene, demo_scene};
use crate::shape::Shape;
use crate::texture::Texture;
use glam::{Quat, Vec3};
use irradia_scene::Rng;
use std::fmt;
use std::str::FromStr;

/// A scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SceneName {
    /// A table-top with fine and coarse detail; the same for every seed.
    #[default]
    Demo,
    /// A furnished room with plain walls, seen from within.
    Room,
    /// A shelf, seen from the front.
    Shelf,
    /// Boulders on a meadow among trees, with hills and sky far away.
    Outdoor,
    /// Grids, wires and blades of grass.
    Thin,
}

/// An unknown name of a scene.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown scene `{0}`; use demo, room, shelf, outdoor or thin")]
pub struct UnknownScene(String);

impl SceneName {
    /// All scenes.
    pub const ALL: [SceneName; 5] = [
        SceneName::Demo,
        SceneName::Room,
        SceneName::Shelf,
        SceneName::Outdoor,
        SceneName::Thin,
    ];

    /// The scene and its rig.
    pub fn build(self, seed: u64) -> (SynthScene, Rig) {
        let rng = &mut Rng::new(seed, STREAM_LAYOUT);
        match self {
            SceneName::Demo => (demo_scene(), cameras::DEMO),
            SceneName::Room => room::build(rng),
            SceneName::Shelf => shelf::build(rng),
            SceneName::Outdoor => outdoor::build(rng),
            SceneName::Thin => thin::build(rng),
        }
    }
}

impl fmt::Display for SceneName {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            SceneName::Demo => "demo",
            SceneName::Room => "room",
            SceneName::Shelf => "shelf",
            SceneName::Outdoor => "outdoor",
            SceneName::Thin => "thin",
        })
    }
}

impl FromStr for SceneName {
    type Err = UnknownScene;

    fn from_str(name: &str) -> Result<Self, UnknownScene> {
        let found = Self::ALL.into_iter().find(|scene| scene.to_string() == name);
        found.ok_or_else(|| UnknownScene(name.to_owned()))
    }
}

/// Random stream of the layout, separate from those of cameras and points.
const STREAM_LAYOUT: u64 = 500;

fn matte(shape: Shape, texture: Texture) -> Object {
    Object {
        shape,
        material: Material::matte(texture),
    }
}

fn block(center: Vec3, half: Vec3, turn: f32) -> Shape {
    Shape::Block {
        center,
        half,
        world_from_block: Quat::from_rotation_z(turn),
    }
}

/// A colour of the given hue (0 to 1) and saturation, linear RGB.
fn tint(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let channel = |shift: f32| {
        let distance = ((hue + shift).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        value * (1.0 - saturation * (1.0 - distance.clamp(0.0, 1.0)))
    };
    Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0))
}

/// A random colour.
fn any_tint(rng: &mut Rng) -> Vec3 {
    tint(rng.uniform(), rng.range(0.35, 0.9), rng.range(0.12, 0.65))
}

/// A random pattern of two colours: patches, a checker or stripes, with features of about `size`.
fn pattern(rng: &mut Rng, size: f32) -> Texture {
    let colors = [any_tint(rng), any_tint(rng) * 0.8 + 0.15];
    match rng.below(3) {
        0 => Texture::Patches {
            colors,
            size: 3.0 * size,
        },
        1 => Texture::Checker { colors, size },
        _ => Texture::Stripes { colors, size },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Capture, Split, SynthOptions};

    fn options(scene: SceneName, seed: u64) -> SynthOptions {
        SynthOptions {
            scene,
            views: 12,
            width: 40,
            height: 30,
            seed,
            ..SynthOptions::default()
        }
    }

    #[test]
    fn names_round_trip_and_unknown_ones_are_listed() {
        for scene in SceneName::ALL {
            assert_eq!(scene.to_string().parse(), Ok(scene));
        }
        let error = "attic".parse::<SceneName>().expect_err("unknown").to_string();
        assert!(error.contains("attic") && error.contains("outdoor"), "{error}");
    }

    #[test]
    fn every_scene_is_closed_and_clear_of_its_cameras_and_follows_the_seed() {
        for scene in SceneName::ALL {
            for seed in 0..3 {
                let capture = Capture::new(&options(scene, seed)).expect("options");
                let surfaces = scene.build(seed).0;
                for shot in capture.shots() {
                    let depth = surfaces.trace(&shot.camera, 1, 0).depth;
                    let nearest = depth.data.iter().copied().fold(f32::INFINITY, f32::min);
                    assert!(nearest > 0.25, "{scene} {seed} {}: {nearest}", shot.name());
                }
            }
            let layouts = [0, 1].map(|seed| scene.build(seed).0);
            assert_eq!(layouts[0] == layouts[1], scene == SceneName::Demo, "{scene}");
        }
    }

    #[test]
    fn held_out_views_lie_among_the_training_views() {
        for scene in SceneName::ALL {
            let capture = Capture::new(&options(scene, 1)).expect("options");
            let places = |held_out: bool| {
                let shots = capture
                    .shots()
                    .iter()
                    .filter(move |shot| (shot.split == Split::Test) == held_out);
                shots.map(|shot| shot.camera.pose).collect::<Vec<_>>()
            };
            for held_out in places(true) {
                let near = places(false).iter().any(|pose| {
                    let turn = (pose.rotation * Vec3::Z).dot(held_out.rotation * Vec3::Z);
                    turn > 0.75 && pose.position.distance(held_out.position) < 2.5
                });
                assert!(near, "{scene}: {held_out:?}");
            }
        }
    }

    #[test]
    fn plain_walls_and_the_sky_have_few_points() {
        let per_view = |scene| {
            let capture = Capture::new(&options(scene, 0)).expect("options");
            let shot = &capture.shots()[0];
            let points = capture.points(shot, &capture.trace(shot));
            (points, shot.camera.pose.position)
        };
        let everywhere = per_view(SceneName::Demo).0.len();
        for scene in [SceneName::Room, SceneName::Outdoor] {
            let (points, eye) = per_view(scene);
            assert!(
                points.len() > everywhere / 10 && points.len() < everywhere,
                "{scene}: {}",
                points.len()
            );
            assert!(
                points.positions.iter().all(|p| p.distance(eye) < 200.0),
                "{scene}: points on the sky"
            );
        }
    }
}
