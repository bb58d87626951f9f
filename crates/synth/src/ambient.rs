//! Analytic ambient light: the mean sky colour over the hemisphere of the normal, less the fraction that nearby solids occlude.
//! Solids are approximated by balls and discs, whose form factors have closed forms.
//!
//! Symbols: `n` the surface's normal, `w` the unit direction to a solid at distance `d`.

use crate::scene::{Hit, Light, SynthScene};
use crate::shape::Shape;
use crate::texture::smoothstep;
use glam::Vec3;

/// Irradiance over pi of everything but the sun, linear RGB, without occlusion.
pub fn unoccluded(light: &Light, hit: &Hit) -> Vec3 {
    // Close to the table top or the ground, shadows of the objects on it reduce the reflected light.
    let bounce = if hit.point.z > 0.0 {
        0.35 + 0.65 * smoothstep(0.0, 0.45, hit.point.z)
    } else {
        0.5
    };
    (light.below * bounce).lerp(light.above, 0.5 + 0.5 * hit.normal.z)
}

/// As [`unoccluded`], less occlusion by the other objects.
pub fn occluded(scene: &SynthScene, hit: &Hit) -> Vec3 {
    let mut uncovered = 1.0;
    for (object, _) in scene.clusters.iter().flat_map(|cluster| &cluster.objects) {
        if !std::ptr::eq(object, hit.object) {
            uncovered *= 1.0 - occlusion(&object.shape, hit.point, hit.normal);
        }
    }
    uncovered * unoccluded(&scene.light, hit)
}

/// The cosine-weighted fraction of the hemisphere over `n` that a solid occludes, 0 to 1.
fn occlusion(shape: &Shape, point: Vec3, n: Vec3) -> f32 {
    match *shape {
        // Thin parts occlude almost nothing; the surroundings are the light itself.
        Shape::Ground { .. }
        | Shape::Backdrop { .. }
        | Shape::Interior { .. }
        | Shape::Rod { .. }
        | Shape::Ring { .. } => 0.0,
        Shape::Block { half, .. } if half.min_element() < 0.2 * half.max_element() => 0.0,
        Shape::Sphere { center, radius } => ball_occlusion(center - point, radius, n),
        Shape::Block { center, half, .. } => ball_occlusion(center - point, 1.2 * half.element_sum() / 3.0, n),
        Shape::Drum { base, radius, height } if radius > 2.0 * height => disc_occlusion(base - point, radius, n),
        Shape::Drum { base, radius, height } => ball_occlusion(
            base + Vec3::Z * (0.5 * height) - point,
            0.5 * (radius + 0.5 * height),
            n,
        ),
    }
}

/// A ball entirely above the horizon occludes `cos (r / d)^2` (exact); the fraction falls smoothly to 0 as the ball sets.
fn ball_occlusion(to_center: Vec3, radius: f32, n: Vec3) -> f32 {
    let d = to_center.length();
    let size = (radius / d).min(1.0);
    let cosine = n.dot(to_center) / d;
    if cosine > size {
        cosine * size * size
    } else {
        0.25 * size * (cosine + size).max(0.0).powi(2)
    }
}

/// A horizontal disc seen from below: `A cos cos / (pi d^2 + A)`, exact on its axis.
fn disc_occlusion(to_center: Vec3, radius: f32, n: Vec3) -> f32 {
    if to_center.z <= 0.0 {
        return 0.0;
    }
    let square = to_center.length_squared();
    let w = to_center / square.sqrt();
    n.dot(w).max(0.0) * w.z * radius * radius / (square + radius * radius)
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    /// The fraction of cosine-distributed directions that hit the shape.
    fn sampled(shape: Shape, point: Vec3) -> f32 {
        let mut rng = Rng::new(5, 0);
        let count = 40_000;
        let mut hits = 0;
        for _ in 0..count {
            let (r2, angle) = (rng.uniform(), rng.range(0.0, std::f32::consts::TAU));
            let flat = glam::Vec2::from_angle(angle) * r2.sqrt();
            let ray = crate::shape::Ray {
                origin: point,
                direction: flat.extend((1.0 - r2).sqrt()),
            };
            hits += usize::from(shape.intersect(&ray, 1e-4, 100.0).is_some());
        }
        hits as f32 / count as f32
    }

    #[test]
    fn closed_forms_match_sampling() {
        let ball = |x: f32, z: f32| Shape::Sphere {
            center: Vec3::new(x, 0.0, z),
            radius: 0.5,
        };
        let disc = |z: f32| Shape::Drum {
            base: Vec3::Z * z,
            radius: 1.0,
            height: 0.01,
        };
        // Standard error of 40,000 samples: 0.0025. The formula for a partly set ball is approximate: 0.02.
        for (shape, tolerance) in [
            (ball(0.0, 1.0), 0.01),
            (ball(0.6, 0.8), 0.01),
            (ball(0.9, 0.5), 0.02),
            (disc(0.7), 0.01),
        ] {
            let (closed, truth) = (occlusion(&shape, Vec3::ZERO, Vec3::Z), sampled(shape, Vec3::ZERO));
            assert!((closed - truth).abs() < tolerance, "{shape:?}: {closed} for {truth}");
        }
    }
}
