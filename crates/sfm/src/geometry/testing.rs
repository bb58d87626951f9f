//! Two cameras in front of random points, for tests.

use super::essential::Motion;
use glam::{DQuat, DVec2, DVec3};
use irradia_scene::Rng;

/// Two views of random points.
pub struct TwoViews {
    /// The true motion.
    pub motion: Motion,
    /// `[N]` world points, in the first camera's axes.
    pub world: Vec<DVec3>,
    /// `[N]` the projections of the points on both planes z = 1.
    pub points: Vec<[DVec2; 2]>,
}

impl TwoViews {
    /// `count` points at depths of 3 to 8, with normal noise of standard deviation `noise` on both planes.
    pub fn new(seed: u64, count: usize, noise: f64) -> Self {
        let mut rng = Rng::new(seed, 77);
        let mut uniform = |low: f32, high: f32| f64::from(rng.range(low, high));
        let turn = DVec3::new(uniform(-0.2, 0.2), uniform(-0.2, 0.2), uniform(-0.4, 0.4));
        let direction = DVec3::new(uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-0.5, 0.5));
        let motion = Motion {
            rotation: DQuat::from_scaled_axis(turn),
            translation: direction.normalize(),
        };
        let world: Vec<DVec3> = (0..count)
            .map(|_| {
                let depth = uniform(3.0, 8.0);
                DVec3::new(uniform(-0.5, 0.5) * depth, uniform(-0.5, 0.5) * depth, depth)
            })
            .collect();
        let mut rng = Rng::new(seed, 78);
        let mut noisy = |p: DVec3| {
            let shift = DVec2::new(f64::from(rng.normal()), f64::from(rng.normal()));
            p.truncate() / p.z + noise * shift
        };
        let points = world
            .iter()
            .map(|p| [noisy(*p), noisy(motion.rotation * *p + motion.translation)])
            .collect();
        Self { motion, world, points }
    }
}
