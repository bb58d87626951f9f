//! Distant light: a low sun, a clear sky with thin clouds, three ranges of hills.

use crate::scene::Light;
use crate::texture::{fbm, noise, smoothstep};
use glam::{Vec2, Vec3};

/// Unit direction to the afternoon sun, at an elevation of 36 degrees.
const SUN: Vec3 = Vec3::new(-0.548, -0.591, 0.592);

/// The light of a sunny afternoon.
pub const DAYLIGHT: Light = Light {
    sun: SUN,
    sun_light: Vec3::new(2.75, 2.25, 1.62),
    // Four times the real one: a soft edge can be trained, a sharp one aliases.
    sun_spread: 0.018,
    above: Vec3::new(0.44, 0.56, 0.78),
    below: Vec3::new(0.40, 0.30, 0.22),
};

const ZENITH: Vec3 = Vec3::new(0.16, 0.33, 0.68);
const HORIZON: Vec3 = Vec3::new(0.78, 0.72, 0.66);

/// The sky without clouds or hills.
fn clear(direction: Vec3) -> Vec3 {
    let up = direction.z.max(0.0);
    let toward_sun = direction.dot(SUN).max(0.0);
    HORIZON.lerp(ZENITH, 1.0 - (1.0 - up).powi(3)) + Vec3::new(0.55, 0.38, 0.18) * (0.8 * toward_sun.powi(6))
}

/// Radiance from a unit direction, seen from the origin, linear RGB.
pub fn radiance(direction: Vec3) -> Vec3 {
    let mut color = clear(direction);
    if direction.z > 0.02 {
        // Clouds lie on a plane: they grow denser towards the horizon and fade into its haze.
        let above = direction.z + 0.22;
        let cover = smoothstep(0.47, 0.82, fbm(direction.truncate() / above * 1.15 + 4.0, 4));
        color = color.lerp(
            Vec3::new(1.05, 0.98, 0.92),
            0.85 * cover * smoothstep(0.02, 0.22, direction.z),
        );
    }
    // From far to near: each range is lower, greener and less hazy.
    for (number, (base, swing, tint)) in [
        (0.115, 0.075, Vec3::new(0.36, 0.43, 0.55)),
        (0.045, 0.065, Vec3::new(0.20, 0.29, 0.30)),
        (-0.015, 0.045, Vec3::new(0.10, 0.165, 0.085)),
    ]
    .into_iter()
    .enumerate()
    {
        let ridge = base + swing * ridge_line(direction, number as f32);
        let below = smoothstep(-0.004, 0.004, ridge - direction.z);
        if below == 0.0 {
            continue;
        }
        let depth = (ridge - direction.z).max(0.0) / 0.16;
        let slopes =
            0.82 + 0.36 * noise(direction.truncate() * 8.0 + Vec2::new(direction.z * 26.0, 9.0 * number as f32));
        let sunlit = 0.85 + 0.3 * direction.truncate().normalize_or_zero().dot(-SUN.truncate());
        let hill = (tint * slopes * sunlit).lerp(HORIZON, 0.25 * depth.min(1.0));
        color = color.lerp(hill, below);
    }
    color
}

/// Height of a range of hills, about -1 to 1: whole numbers of waves, so that it is periodic.
fn ridge_line(direction: Vec3, range: f32) -> f32 {
    let angle = direction.y.atan2(direction.x);
    let wave = |count: f32, phase: f32| (angle * count + phase * (range + 1.0)).sin();
    0.5 * wave(3.0, 1.3) + 0.3 * wave(7.0, 2.9) + 0.15 * wave(13.0, 0.7) + 0.07 * wave(29.0, 4.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sun_is_above_the_horizon_and_the_panorama_is_periodic() {
        assert!((SUN.length() - 1.0).abs() < 1e-3 && SUN.z > 0.0);
        for z in [0.02f32, 0.15, 0.4, 0.9] {
            let r = (1.0 - z * z).sqrt();
            let (a, b) = (Vec3::new(-r, 1e-5, z), Vec3::new(-r, -1e-5, z));
            assert!((radiance(a) - radiance(b)).length() < 2e-2, "{z}");
            assert!((ridge_line(a, 1.0) - ridge_line(b, 1.0)).abs() < 1e-3);
        }
        assert!(radiance(Vec3::Z).min_element() > 0.0);
    }
}
