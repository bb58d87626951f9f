//! The angle between adjacent photographs, as seen from what they show. If it is large, only a few photographs determine what lies between
//! them.

use crate::pixel_size::view_depth;
use crate::robust::median;
use crate::trainer::train_cameras;
use glam::Vec3;
use irradia_scene::Dataset;
use irradia_splat::init;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Cameras closer than this fraction of the depth are at the same place, as the faces of a panorama are.
const MIN_BASELINE: f32 = 1e-3;

/// The angle between adjacent photographs, radians: at the point on a view's axis that is as deep as what the view shows, the smallest
/// angle between its camera and another one that sees the point; pi if no other one does. The median over the training views.
pub(crate) fn spacing(dataset: &Dataset) -> f64 {
    let cameras = train_cameras(dataset);
    let focus = init::focus_point(&cameras);
    let angle = |view: &usize| {
        let view = &dataset.views[*view];
        let pose = &view.camera.pose;
        let depth = view_depth(dataset, view, focus);
        let target = pose.world_from_camera(depth * Vec3::Z);
        let others = cameras.iter().filter(|other| {
            other.pose.position.distance(pose.position) > MIN_BASELINE * depth && other.sees(target).is_some()
        });
        let angles =
            others.map(|other| f64::from((pose.position - target).angle_between(other.pose.position - target)));
        angles.fold(PI, f64::min)
    };
    median(dataset.train.par_iter().map(angle).collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::free_space::tests::dataset;
    use irradia_scene::Pose;
    use std::f32::consts::TAU;

    /// `count` cameras on a circle of this radius around the origin, evenly over `turn`, each looking across it.
    pub(crate) fn around_at(radius: f32, count: usize, turn: f32) -> Dataset {
        let mut data = dataset(0, None);
        let view = data.views[0].clone();
        let place = |i: usize| {
            let angle = turn * i as f32 / count as f32;
            let mut view = view.clone();
            view.camera.pose = Pose::look_at(radius * Vec3::new(angle.cos(), angle.sin(), 0.0), Vec3::ZERO, Vec3::Z);
            view
        };
        data.views = (0..count).map(place).collect();
        data.train = (0..count).collect();
        data
    }

    fn around(count: usize, turn: f32) -> Dataset {
        around_at(3.0, count, turn)
    }

    #[test]
    fn the_angle_is_that_between_adjacent_cameras() {
        for (count, turn) in [(12, TAU), (36, TAU), (10, 0.5)] {
            let expected = f64::from(turn) / count as f64;
            let found = spacing(&around(count, turn));
            assert!((found - expected).abs() < 0.02 * expected, "{found} {expected}");
        }
    }

    #[test]
    fn cameras_at_the_same_place_and_those_that_look_elsewhere_do_not_count() {
        let mut data = around(12, TAU);
        let faces = data.views.to_vec();
        data.views.extend(faces.into_iter().map(|mut view| {
            let pose = view.camera.pose;
            view.camera.pose = Pose::look_at(pose.position, 2.0 * pose.position, Vec3::Z);
            view
        }));
        let expected = f64::from(TAU) / 12.0;
        assert!((spacing(&data) - expected).abs() < 0.02 * expected);
        // Outwards, no other camera sees what a camera looks at.
        data.train = (12..24).step_by(2).collect();
        assert_eq!(spacing(&data), PI);
    }
}
