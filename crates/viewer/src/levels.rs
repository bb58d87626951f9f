//! Selects the level of detail that is drawn while the camera moves; at rest the scene itself is drawn.

use glam::Vec2;
use irradia_scene::Camera;
use irradia_splat::Splats;
use std::sync::Arc;

/// Minimum number of splats per covered pixel of a level that is drawn because of its distance alone. Pictures of such levels of fox and
/// fern are closer to the picture at full size, shrunk, than those of all splats, which are widened to a pixel each, or at most 0.6 dB
/// farther from it. `levels.js` has the same value.
const MIN_SPLATS_PER_PIXEL: f32 = 2.0;
/// Number of positions used to estimate what a camera sees.
const MAX_SAMPLES: usize = 4096;
/// Share of the splats in view that is left out on either side when the covered area is measured.
const MARGIN_SHARE: f32 = 0.05;

/// Levels of detail, each with about half the splats of the one before, the first with half of the scene's.
#[derive(Clone, Default)]
pub(crate) struct Levels {
    levels: Arc<[Splats]>,
}

impl Levels {
    pub fn new(levels: Vec<Splats>) -> Self {
        Self { levels: levels.into() }
    }

    /// All of them, the finest first.
    pub fn all(&self) -> &[Splats] {
        &self.levels
    }

    /// The level `number`, counted from 1; 0 is the scene itself.
    pub fn get(&self, number: usize) -> Option<&Splats> {
        self.levels.get(number.checked_sub(1)?)
    }

    /// The number of the level to draw for a moving camera: the coarsest with at least [`MIN_SPLATS_PER_PIXEL`] splats per pixel, or a
    /// coarser one if only the fraction `affordable` of the scene's splats can be drawn in time.
    pub fn choose(&self, camera: &Camera, affordable: f32) -> usize {
        let Some(coarsest) = self.levels.last() else { return 0 };
        let by_time = (-affordable.log2()).ceil() as usize;
        let seen = splats_per_pixel(coarsest, camera);
        let dense = |level: &&Splats| seen * level.len() as f32 / coarsest.len().max(1) as f32 >= MIN_SPLATS_PER_PIXEL;
        let by_distance = self.levels.iter().take_while(dense).count();
        by_time.max(by_distance).min(self.levels.len())
    }
}

/// Splats in view per pixel of the box that contains most of them.
fn splats_per_pixel(splats: &Splats, camera: &Camera) -> f32 {
    let k = &camera.intrinsics;
    let size = Vec2::new(k.width as f32, k.height as f32);
    let step = splats.len().div_ceil(MAX_SAMPLES).max(1);
    let in_view: Vec<Vec2> = (0..splats.len())
        .step_by(step)
        .filter_map(|i| camera.project(splats.mean(i).into()))
        .map(|(pixel, _)| pixel)
        .filter(|pixel| pixel.cmpge(Vec2::ZERO).all() && pixel.cmplt(size).all())
        .collect();
    let extent = |along: fn(&Vec2) -> f32| {
        let mut values: Vec<f32> = in_view.iter().map(along).collect();
        values.sort_unstable_by(f32::total_cmp);
        let at = |share: f32| {
            values
                .get((values.len() as f32 * share) as usize)
                .copied()
                .unwrap_or(0.0)
        };
        (at(1.0 - MARGIN_SHARE) - at(MARGIN_SHARE)).max(1.0)
    };
    (in_view.len() * step) as f32 / (extent(|p| p.x) * extent(|p| p.y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_scene::{Intrinsics, Pose, Rng};
    use irradia_splat::levels::merged;
    use irradia_splat::{RenderOptions, Renderer, logit};
    use irradia_train::model::Model;

    /// A ball of splats of two colours around the origin, one unit in radius.
    fn ball(count: usize) -> Splats {
        let mut rng = Rng::new(5, 1);
        let mut splats = Splats::zeros(count, 0);
        for i in 0..count {
            let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize();
            for (c, value) in mean.to_array().into_iter().enumerate() {
                splats.means.set(c, i, value);
                splats.log_scales.set(c, i, (1.5 / (count as f32).sqrt()).ln());
                splats.sh.set(c, i, if mean[c] > 0.0 { 1.0 } else { -1.0 });
            }
            splats.quats.set(0, i, 1.0);
            splats.opacity_logits.set(0, i, logit(0.8));
        }
        splats
    }

    fn camera(distance: f32) -> Camera {
        let pose = Pose {
            rotation: Quat::IDENTITY,
            position: Vec3::new(0.0, 0.0, -distance),
        };
        Camera::new(pose, Intrinsics::from_fov_x(400, 300, 1.0))
    }

    fn with_levels(splats: &Splats) -> Levels {
        let mut levels: Vec<Splats> = Vec::new();
        for level in 1..=3 {
            let next = merged(levels.last().unwrap_or(splats), splats.len() >> level);
            levels.push(next);
        }
        Levels::new(levels)
    }

    #[test]
    fn coarser_from_afar_or_where_time_is_short_and_whole_from_near() {
        let splats = ball(20_000);
        let levels = with_levels(&splats);
        let mut by_distance: Vec<usize> = (3..60).map(|d| levels.choose(&camera(0.5 * d as f32), 1.0)).collect();
        assert!(by_distance.is_sorted(), "{by_distance:?}");
        by_distance.dedup();
        assert_eq!(by_distance, [0, 1, 2, 3]);
        // Where nothing is in view, and within the ball.
        assert_eq!(levels.choose(&camera(-5.0), 1.0), 0);
        assert_eq!(levels.choose(&camera(0.0), 1.0), 0);
        let by_time = [1.0, 0.5, 0.3, 0.2, 0.01].map(|affordable| levels.choose(&camera(1.5), affordable));
        assert_eq!(by_time, [0, 1, 2, 3, 3]);
        assert_eq!(Levels::default().choose(&camera(100.0), 0.1), 0);
    }

    #[test]
    fn pictures_from_afar_agree() {
        let splats = ball(20_000);
        let levels = with_levels(&splats);
        let mut renderer = Renderer::new();
        let mut picture = |splats: &Splats, camera: &Camera| {
            let frame = Model::of_splats(splats).render(&mut renderer, camera, &RenderOptions::default());
            frame.color.data
        };
        let mut chosen = Vec::new();
        for distance in [5.0, 7.0, 10.0, 14.0, 20.0, 50.0] {
            let camera = camera(distance);
            let level = levels.choose(&camera, 1.0);
            let Some(coarse) = levels.get(level) else { continue };
            let (a, b) = (picture(&splats, &camera), picture(coarse, &camera));
            let squares = a.iter().zip(&b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
            let psnr = -10.0 * (squares / a.len() as f64).log10();
            assert!(psnr > 32.0, "at {distance} level {level}: {psnr:.1} dB");
            chosen.push(level);
        }
        assert!(chosen.contains(&1) && chosen.contains(&3), "{chosen:?}");
    }
}
