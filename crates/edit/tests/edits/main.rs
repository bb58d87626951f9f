//! Properties of edits: identity, inverse, composition and rendering.

mod floaters;
mod hostile;
mod operations;
mod renders;
mod selections;
mod undo;

use glam::Vec3;
use irradia_edit::{Applied, Draft, Edit, apply, open_nothing};
use irradia_scene::{Camera, GaussianCloud, Intrinsics, Pose, Rng, sh};

/// `n` random splats of a degree, in a ball of radius 1.
fn cloud(n: usize, degree: u32, seed: u64) -> GaussianCloud {
    let mut rng = Rng::new(seed, 0);
    let width = 3 * sh::coefficients(degree);
    let mut cloud = GaussianCloud {
        sh_degree: degree,
        ..GaussianCloud::default()
    };
    for _ in 0..n {
        let direction = Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize();
        cloud.means.push((direction * rng.uniform().cbrt()).to_array());
        cloud.quats.push(std::array::from_fn(|_| rng.normal()));
        cloud.log_scales.push(std::array::from_fn(|_| rng.range(-4.0, -2.0)));
        cloud.opacity_logits.push(rng.range(-3.0, 4.0));
        cloud
            .sh
            .extend((0..width).map(|k| rng.normal() * if k < 3 { 1.0 } else { 0.3 }));
    }
    cloud
}

fn draft(n: usize, degree: u32) -> Draft {
    Draft::new(cloud(n, degree, 1), cameras())
}

/// Eight cameras around the origin.
fn cameras() -> Vec<Camera> {
    (0..8)
        .map(|i| {
            let angle = i as f32 * std::f32::consts::TAU / 8.0;
            let eye = 3.0 * Vec3::new(angle.cos(), 0.3, angle.sin());
            Camera::new(
                Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y),
                Intrinsics::from_fov_x(96, 72, 0.9),
            )
        })
        .collect()
}

/// Applies the edit of a line of text.
fn apply_line(draft: &mut Draft, line: &str) -> Applied {
    let edit: Edit = line.parse().unwrap_or_else(|error| panic!("{line}: {error}"));
    apply(draft, &edit, &open_nothing).unwrap_or_else(|error| panic!("{line}: {error}"))
}

fn edited(draft: &Draft, lines: &[&str]) -> Draft {
    let mut draft = draft.clone();
    for line in lines {
        apply_line(&mut draft, line);
    }
    draft
}

/// Largest difference between corresponding numbers of two clouds with the same number of splats; quaternions up to sign.
fn difference(a: &GaussianCloud, b: &GaussianCloud) -> f32 {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    assert_eq!(a.world_from_dataset, b.world_from_dataset);
    let between = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let quats = a.quats.iter().zip(&b.quats).map(|(a, b)| {
        let negated = b.map(|v| -v);
        between(a, b).min(between(a, &negated))
    });
    [
        between(a.means.as_flattened(), b.means.as_flattened()),
        between(a.log_scales.as_flattened(), b.log_scales.as_flattened()),
        between(&a.opacity_logits, &b.opacity_logits),
        between(&a.sh, &b.sh),
        quats.fold(0.0, f32::max),
    ]
    .into_iter()
    .fold(0.0, f32::max)
}
