//! Floaters of five kinds in a scene of surfaces.

use crate::{apply_line, cameras};
use glam::{Quat, Vec3};
use irradia_edit::{Draft, LoadedPhotographs, Photographs, floater_scores};
use irradia_scene::{GaussianCloud, Photo, Rng, sh};
use irradia_splat::{RenderOptions, Renderer, Splats, ViewParams, logit};

const KINDS: [&str; 5] = ["isolated", "needle", "huge", "unseen", "in front"];
/// Number of floaters of each kind.
const FLOATERS_PER_KIND: usize = 100;

fn push(cloud: &mut GaussianCloud, mean: Vec3, scales: [f32; 3], rotation: Quat, opacity: f32, color: f32) {
    cloud.means.push(mean.to_array());
    cloud.quats.push([rotation.w, rotation.x, rotation.y, rotation.z]);
    cloud.log_scales.push(scales.map(f32::ln));
    cloud.opacity_logits.push(logit(opacity));
    cloud.sh.extend([sh::dc_from_color(color); 3]);
}

/// A ball of radius 0.7 surrounded by the cameras, in a room of radius 6, of splats as flat and dense as training makes them.
fn scene(scale: f32) -> Draft {
    let mut cloud = GaussianCloud::default();
    let mut rng = Rng::new(3, 0);
    for (count, radius) in [(6000, 0.7f32), (20_000, 6.0)] {
        let spacing = radius * (4.0 * std::f32::consts::PI / count as f32).sqrt();
        for i in 0..count {
            let z = 1.0 - (2 * i + 1) as f32 / count as f32;
            let angle = i as f32 * 2.399_963;
            let flat = (1.0 - z * z).sqrt();
            let normal = Vec3::new(flat * angle.cos(), flat * angle.sin(), z);
            let size = spacing * rng.range(0.7, 1.3);
            let turn = Quat::from_rotation_arc(Vec3::Z, normal);
            let scales = [size, size * rng.range(0.5, 1.0), 0.1 * size].map(|s| s * scale);
            push(
                &mut cloud,
                normal * radius * scale,
                scales,
                turn,
                0.9,
                rng.range(0.2, 0.8),
            );
        }
    }
    let mut cameras = cameras();
    for camera in &mut cameras {
        camera.intrinsics = camera.intrinsics.scaled(3.0);
        camera.pose.position *= scale;
        camera.near *= scale;
    }
    Draft::new(cloud, cameras)
}

/// Adds [`FLOATERS_PER_KIND`] floaters of each kind.
fn plant(draft: &Draft, scale: f32) -> Draft {
    let mut cloud = draft.cloud.clone();
    let mut rng = Rng::new(8, 0);
    for kind in 0..KINDS.len() {
        for _ in 0..FLOATERS_PER_KIND {
            let camera = &draft.cameras[rng.below(8) as usize];
            let k = camera.intrinsics;
            let pixel = glam::Vec2::new(
                rng.range(0.1, 0.9) * k.width as f32,
                rng.range(0.1, 0.9) * k.height as f32,
            );
            let (eye, ray) = camera.ray(pixel);
            let ball = |size: f32| [size * scale; 3];
            let direction = Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize();
            let opacity = rng.range(0.3, 0.95);
            let (mean, scales, opacity) = match kind {
                0 => (
                    eye + ray * scale * rng.range(0.8, 1.8),
                    ball(rng.range(0.01, 0.03)),
                    opacity,
                ),
                1 => {
                    let length = rng.range(0.3, 1.0) * scale;
                    (
                        eye + ray * scale * rng.range(0.8, 2.0),
                        [length, 0.01 * length, 0.01 * length],
                        opacity,
                    )
                }
                2 => {
                    let sizes = [rng.range(3.0, 6.0), rng.range(2.0, 4.0), 1.0];
                    (direction * 2.0 * scale, sizes.map(|s| s * scale), rng.range(0.02, 0.2))
                }
                3 => (
                    direction * scale * rng.range(7.0, 12.0),
                    ball(rng.range(0.02, 0.1)),
                    opacity,
                ),
                _ => (
                    eye + ray * scale * rng.range(0.1, 0.4),
                    ball(rng.range(0.005, 0.03)),
                    opacity,
                ),
            };
            let turn = Quat::from_xyzw(rng.normal(), rng.normal(), rng.normal(), rng.normal()).normalize();
            push(&mut cloud, mean, scales, turn, opacity, rng.uniform());
        }
    }
    Draft::new(cloud, draft.cameras.clone())
}

#[test]
fn planted_floaters_are_found_and_the_scene_stays() {
    let clean = scene(1.0);
    let n = clean.len();
    let planted = plant(&clean, 1.0);
    let scores = floater_scores(&planted);
    let found = |range: std::ops::Range<usize>| scores[range].iter().filter(|score| score.score() >= 1.0).count();
    assert!(found(0..n) * 100 <= n, "{} of {n} splats lost", found(0..n));
    let each: Vec<usize> = (0..KINDS.len())
        .map(|kind| found(n + FLOATERS_PER_KIND * kind..n + FLOATERS_PER_KIND * (kind + 1)))
        .collect();
    let all: usize = each.iter().sum();
    assert!(
        all >= 475,
        "{all} of 500 found: {:?}",
        KINDS.iter().zip(&each).collect::<Vec<_>>()
    );
    assert!(each.iter().all(|found| *found >= 90), "{each:?}");
    // A clean scene has almost no floaters.
    let mut same = clean.clone();
    apply_line(&mut same, "delete floaters");
    assert!(same.len() * 1000 >= n * 999);
}

/// Nothing depends on the unit of length.
#[test]
fn scores_are_free_of_scale() {
    let (small, large) = (
        floater_scores(&plant(&scene(1.0), 1.0)),
        floater_scores(&plant(&scene(50.0), 50.0)),
    );
    let differ = small
        .iter()
        .zip(&large)
        .filter(|(a, b)| (a.score() >= 1.0) != (b.score() >= 1.0))
        .count();
    // Rounding decides about a few.
    assert!(differ * 1000 < small.len(), "{differ}");
}

#[test]
fn without_cameras_geometry_finds_what_it_can() {
    let mut planted = plant(&scene(1.0), 1.0);
    planted.cameras.clear();
    let n = planted.len() - 500;
    let scores = floater_scores(&planted);
    let found = |range: std::ops::Range<usize>| scores[range].iter().filter(|score| score.score() >= 1.0).count();
    assert!(found(0..n) * 1000 <= n);
    // Splats far from everything are found; those that only a view shows to be in front, or large relative to a camera, are not.
    let unseen = found(n + 3 * FLOATERS_PER_KIND..n + 4 * FLOATERS_PER_KIND);
    assert!(unseen >= 90, "{unseen}");
}

/// Photographs of `draft`, rendered for its cameras.
fn photographs(draft: &Draft) -> Photographs {
    let splats = Splats::from_cloud(&draft.cloud);
    let mut renderer = Renderer::new();
    let mut photo = |(number, camera)| {
        renderer.render(&splats, &ViewParams::new(camera), &RenderOptions::default());
        let (pixels, color) = (renderer.alpha().len(), renderer.color());
        let byte = |at: usize| (255.0 * color[at % 3 * pixels + at / 3].clamp(0.0, 1.0)).round() as u8;
        let taken = Photo {
            width: camera.intrinsics.width,
            height: camera.intrinsics.height,
            channels: 3,
            data: (0..3 * pixels).map(byte).collect(),
            mask: None,
        };
        (number, taken)
    };
    let photos = draft.cameras.iter().enumerate().map(&mut photo).collect();
    Photographs::new(move || {
        Some(LoadedPhotographs {
            photos,
            background: [0.0; 3],
        })
    })
}

/// By shape alone, part of a plain wall looks like a veil.
#[test]
fn photographs_tell_a_wall_from_a_veil() {
    let mut clean = scene(1.0);
    let wall = clean.len();
    let flat = [4.0, 4.0, 0.02];
    push(
        &mut clean.cloud,
        Vec3::new(0.0, 0.0, 5.8),
        flat,
        Quat::IDENTITY,
        0.6,
        0.9,
    );
    let clean = Draft::new(clean.cloud, clean.cameras);
    let mut planted = plant(&clean, 1.0);
    let veils = wall + 1 + 2 * FLOATERS_PER_KIND..wall + 1 + 3 * FLOATERS_PER_KIND;
    let is_found = |draft: &Draft| {
        let scores: Vec<f32> = floater_scores(draft).iter().map(|score| score.score()).collect();
        let found = scores[veils.clone()].iter().filter(|score| **score >= 1.0).count();
        (
            scores[wall] >= 1.0,
            found,
            scores[..wall].iter().filter(|score| **score >= 1.0).count(),
        )
    };
    let (wall_is_found, ..) = is_found(&planted);
    assert!(wall_is_found, "by its size alone");
    planted.photographs = Some(photographs(&clean));
    let (wall_is_found, found, lost) = is_found(&planted);
    assert!(
        !wall_is_found && found >= 95 && lost * 100 <= wall,
        "{wall_is_found} {found} {lost}"
    );
    // A scene that no longer matches its photographs is not judged by them; deleting leaves the rest unchanged.
    crate::apply_line(&mut planted, "delete sphere center=0,0,0 radius=0.1");
    assert!(planted.photographs.is_some());
    crate::apply_line(&mut planted, "recolor exposure=1");
    assert!(planted.photographs.is_none());
}
