//! The world in which a dataset is trained: that of its files, unless positions or sizes are too large or too small for `f32`.

use glam::DVec3;
use irradia_scene::{Similarity, median};

/// Distance of the cameras' median from the origin above which the origin is moved there, in units of the median distance of a camera
/// from that median. At this limit, neighbouring `f32` values are up to 1e-5 of these units apart: a hundredth of a pixel in most
/// photographs.
const MAX_ORIGIN_DISTANCE: f64 = 100.0;
/// Range of the median distance of a camera from the cameras' median, in the files' unit, in which that unit is kept: from a hand-held
/// close-up to a building, both in metres. It also covers the arbitrary units of structure from motion.
const RADIUS_RANGE: [f64; 2] = [0.1, 50.0];

/// The world of cameras at `positions`. Its origin is the cameras' median if that is far from the files' origin. If the median distance
/// of a camera from there is not within [`RADIUS_RANGE`], the unit is a power of ten of the files', such that this distance is 1 to 10
/// units; constants in world units, like the near plane, then follow the scene's size. Medians, since one camera may be misplaced.
pub(super) fn world_from_dataset(positions: &[DVec3]) -> Similarity {
    let median_along = |axis: usize| median(positions.iter().map(|p| p[axis]).collect()).unwrap_or(0.0);
    let center = DVec3::new(median_along(0), median_along(1), median_along(2));
    let radius = median(positions.iter().map(|p| p.distance(center)).collect()).unwrap_or(0.0);
    let keeps_units = radius == 0.0 || (RADIUS_RANGE[0]..=RADIUS_RANGE[1]).contains(&radius);
    let scale = if keeps_units {
        1.0
    } else {
        10f64.powf(-radius.log10().floor())
    };
    let moves_origin = center.length() > MAX_ORIGIN_DISTANCE * radius;
    let world = Similarity {
        scale,
        center: if moves_origin { center } else { DVec3::ZERO },
    };
    if world.is_valid() { world } else { Similarity::IDENTITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras on a circle of `radius` about `center`.
    fn ring(center: DVec3, radius: f64) -> Vec<DVec3> {
        let angle = |i: i32| f64::from(i) * 0.1;
        (0..63)
            .map(|i| center + radius * DVec3::new(angle(i).cos(), angle(i).sin(), 0.0))
            .collect()
    }

    #[test]
    fn ordinary_scenes_keep_their_coordinates() {
        for (center, radius) in [
            (DVec3::ZERO, 4.0),
            (DVec3::new(30.0, -20.0, 5.0), 0.4),
            (DVec3::X, 40.0),
        ] {
            assert!(world_from_dataset(&ring(center, radius)).is_identity());
        }
        assert!(world_from_dataset(&[]).is_identity());
        assert!(world_from_dataset(&[DVec3::ZERO; 3]).is_identity());
    }

    #[test]
    fn utm_and_millimetres_become_a_scene_of_ordinary_size_at_the_origin() {
        let utm = DVec3::new(5e5, 5.4e6, 300.0);
        for (radius, scale) in [(4.0, 1.0), (2500.0, 1e-3), (120.0, 1e-2), (3e-3, 1e3)] {
            let world = world_from_dataset(&ring(utm, radius));
            assert!((world.scale / scale - 1.0).abs() < 1e-12, "{radius}: {}", world.scale);
            assert!(world.center.distance(utm) < 2.0 * radius);
        }
        let near = world_from_dataset(&ring(DVec3::new(1000.0, 0.0, 0.0), 2000.0));
        assert_eq!(near.center, DVec3::ZERO);
    }

    #[test]
    fn one_camera_out_of_place_moves_nothing() {
        let mut positions = ring(DVec3::ZERO, 4.0);
        positions.push(DVec3::new(1e9, 0.0, 0.0));
        assert!(world_from_dataset(&positions).is_identity());
    }
}
