//! The size of a pixel in the scene: what a training photograph can resolve, in world units.

use crate::free_space::seen_depths;
use crate::robust::median;
use crate::trainer::train_cameras;
use glam::Vec3;
use irradia_scene::{Camera, Dataset, View};
use irradia_splat::init;
use rayon::prelude::*;

/// The width that a pixel covers at the depth of what a training view shows, world units: the median over views, of which there must be at
/// least one.
pub(crate) fn pixel_size(dataset: &Dataset) -> f32 {
    median_over_views(dataset, |camera, depth| {
        depth / camera.intrinsics.fx.max(camera.intrinsics.fy)
    })
}

/// The depth of what a training view shows, world units: the median over views, of which there must be at least one.
pub(crate) fn content_depth(dataset: &Dataset) -> f32 {
    median_over_views(dataset, |_, depth| depth)
}

/// The median of `of` over the training views, by the camera of each and the depth of what it shows.
fn median_over_views(dataset: &Dataset, of: impl Fn(&Camera, f32) -> f32 + Sync) -> f32 {
    let focus = init::focus_point(&train_cameras(dataset));
    let value = |view: &usize| {
        let view = &dataset.views[*view];
        f64::from(of(&view.camera, view_depth(dataset, view, focus).max(view.camera.near)))
    };
    median(dataset.train.par_iter().map(value).collect()) as f32
}

/// The median depth of the points that a view sees, else the geometric mean of its depth bounds, else the distance of the cameras' `focus`.
pub(crate) fn view_depth(dataset: &Dataset, view: &View, focus: Vec3) -> f32 {
    typical_depth(dataset, view).unwrap_or_else(|| focus.distance(view.camera.pose.position))
}

/// The median depth of the points that a view sees, else the geometric mean of its depth bounds.
fn typical_depth(dataset: &Dataset, view: &View) -> Option<f32> {
    match seen_depths(dataset, view) {
        Some(depths) => Some(median(depths.into_iter().map(f64::from).collect()) as f32),
        None => view.depth_bounds.map(|[near, far]| (near * far).sqrt()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::free_space::tests::dataset;

    #[test]
    fn a_pixel_is_as_large_as_at_the_points_else_between_the_bounds_else_at_the_focus() {
        let focal = |dataset: &Dataset| dataset.views[0].camera.intrinsics.fx;
        let is_near = |dataset: &Dataset, depth: f32| (pixel_size(dataset) * focal(dataset) / depth - 1.0).abs() < 1e-3;
        assert!(is_near(&dataset(102, None), 10.0), "two of 102 points are outliers");
        assert!(is_near(&dataset(19, Some([2.0, 8.0])), 4.0), "too few points");

        let mut around = dataset(0, None);
        let view = around.views[0].clone();
        around.views = [Vec3::X, Vec3::Y, -Vec3::X, -Vec3::Y]
            .map(|side| {
                let mut view = view.clone();
                view.camera.pose.position = 3.0 * side;
                view.camera.pose.rotation = glam::Quat::from_rotation_arc(Vec3::Z, -side);
                view
            })
            .to_vec();
        around.train = (0..4).collect();
        assert!(is_near(&around, 3.0));
    }
}
