//! The empty space around cameras. A camera stands in free space, and nothing that its view is known to see is closer than its
//! nearest points; splats closer than a fraction of that explain one photograph each, and veil the views between.

use irradia_scene::{Dataset, PointCloud, View};
use irradia_splat::SplatState;
use rayon::prelude::*;

/// Points a view must see for its nearest ones to be known.
const ENOUGH_POINTS: usize = 20;
/// The fraction of a view's points that may be closer than its nearest depth: wrong matches lie before the surface too.
const OUTLIERS: f64 = 0.02;
/// The fraction of all points that may lie in a sphere.
const STRAY: f64 = 0.001;

/// A sphere around each training camera of which the nearest depth is known.
#[derive(Clone, Debug, Default)]
pub(crate) struct FreeSpace {
    /// Centre and squared radius, world units.
    spheres: Vec<([f32; 3], f32)>,
}

impl FreeSpace {
    /// Spheres with `fraction` of each training view's nearest depth as radius; none with a fraction of 0.
    pub(crate) fn new(dataset: &Dataset, fraction: f32) -> Self {
        if fraction <= 0.0 {
            return Self::default();
        }
        let sphere = |view: &usize| {
            let view = &dataset.views[*view];
            let mut radius = fraction * nearest_depth(dataset, view)?;
            if let Some(points) = &dataset.points {
                radius = radius.min(distance_to_points(points, view));
            }
            Some((view.camera.pose.position.to_array(), radius * radius))
        };
        Self {
            spheres: dataset.train.par_iter().filter_map(sphere).collect(),
        }
    }

    /// Removes the splats centred in a sphere; returns their number.
    pub(crate) fn clear(&self, state: &mut SplatState) -> usize {
        if self.spheres.is_empty() {
            return 0;
        }
        let n = state.len();
        let means = &state.splats.means;
        let [x, y, z] = [0, 1, 2].map(|c| &means.plane(c)[..n]);
        let kept: Vec<u32> = (0..n as u32)
            .into_par_iter()
            .with_min_len(1024)
            .filter(|i| {
                let i = *i as usize;
                let outside = |(center, square): &([f32; 3], f32)| {
                    let d = [x[i] - center[0], y[i] - center[1], z[i] - center[2]];
                    d[0] * d[0] + d[1] * d[1] + d[2] * d[2] >= *square
                };
                self.spheres.iter().all(outside)
            })
            .collect();
        if kept.len() < n {
            state.gather(&kept);
        }
        n - kept.len()
    }
}

/// Distance from a view's camera to the nearest of all points but a few outliers: a wall behind the camera stays.
fn distance_to_points(points: &PointCloud, view: &View) -> f32 {
    let eye = view.camera.pose.position;
    let mut distances: Vec<f32> = points.positions.iter().map(|p| p.distance(eye)).collect();
    let at = (distances.len() as f64 * STRAY) as usize;
    match distances.is_empty() {
        true => f32::INFINITY,
        false => *distances.select_nth_unstable_by(at, f32::total_cmp).1,
    }
}

/// Depth along +Z of the nearest points that a view sees, or of its depth bounds, world units.
fn nearest_depth(dataset: &Dataset, view: &View) -> Option<f32> {
    let Some(mut depths) = seen_depths(dataset, view) else {
        return view.depth_bounds.map(|bounds| bounds[0]);
    };
    let at = (depths.len() as f64 * OUTLIERS) as usize;
    Some(*depths.select_nth_unstable_by(at, f32::total_cmp).1)
}

/// Depths along +Z of the points that a view sees, world units; `None` if they are too few to know its surfaces.
pub(crate) fn seen_depths(dataset: &Dataset, view: &View) -> Option<Vec<f32>> {
    let positions = &dataset.points.as_ref()?.positions;
    let seen = view.points_seen.iter().filter_map(|i| positions.get(*i as usize));
    let depths: Vec<f32> = seen
        .map(|position| view.camera.pose.camera_from_world(*position).z)
        .filter(|depth| *depth > view.camera.near)
        .collect();
    (depths.len() >= ENOUGH_POINTS).then_some(depths)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_scene::{Camera, Intrinsics, Photo, Pose};
    use irradia_splat::Splats;
    use std::sync::Arc;

    /// A camera at the origin that sees a wall of 100 points at a depth of 10 and two wrong points, and a wall 1 behind it.
    pub(crate) fn dataset(seen: usize, bounds: Option<[f32; 2]>) -> Dataset {
        let pose = Pose {
            rotation: Quat::IDENTITY,
            position: Vec3::ZERO,
        };
        let wall = |z: f32| (0..100).map(move |i| Vec3::new(i as f32 * 0.1, 0.0, z));
        let positions: Vec<Vec3> = wall(10.0).chain([Vec3::Z, Vec3::Z]).chain(wall(-1.0)).collect();
        let photo = Photo {
            width: 1,
            height: 1,
            channels: 3,
            data: vec![0; 3],
            mask: None,
        };
        Dataset {
            views: vec![View {
                depth_bounds: bounds,
                points_seen: (0..seen as u32).collect(),
                ..View::new(
                    "a",
                    Camera::new(pose, Intrinsics::from_fov_x(1, 1, 1.0)),
                    Arc::new(photo),
                )
            }],
            train: vec![0],
            points: Some(PointCloud {
                colors: vec![[0; 3]; positions.len()],
                positions,
            }),
            ..Dataset::default()
        }
    }

    fn left(space: &FreeSpace, depths: &[f32]) -> Vec<f32> {
        let mut splats = Splats::zeros(depths.len(), 0);
        for (i, depth) in depths.iter().enumerate() {
            splats.means.set(2, i, *depth);
        }
        let mut state = SplatState::new(splats);
        let removed = space.clear(&mut state);
        assert_eq!(removed, depths.len() - state.len());
        let mut left: Vec<f32> = (0..state.len()).map(|i| state.splats.means.get(2, i)).collect();
        left.sort_by(f32::total_cmp);
        left
    }

    #[test]
    fn splats_before_a_camera_go_and_surfaces_around_it_stay() {
        let depths = [-2.0, -0.9, 0.5, 0.99, 1.2, 2.9, 10.0];
        // The wall behind the camera limits the sphere to 1.
        let space = FreeSpace::new(&dataset(102, None), 0.3);
        assert_eq!(left(&space, &depths), [-2.0, 1.2, 2.9, 10.0]);
        let mut open = dataset(102, None);
        let points = open.points.as_mut().unwrap();
        points.positions.truncate(102);
        points.positions.extend([Vec3::new(0.0, 0.0, 50.0); 3000]);
        let space = FreeSpace::new(&open, 0.3);
        assert_eq!(left(&space, &depths), [10.0], "2 of 102 points are outliers");
    }

    #[test]
    fn depth_bounds_serve_where_no_points_are_known_and_without_either_nothing_is_removed() {
        let mut bounded = dataset(0, Some([2.0, 9.0]));
        bounded.points = None;
        assert_eq!(left(&FreeSpace::new(&bounded, 0.5), &[0.5, 1.5]), [1.5]);
        bounded.views[0].depth_bounds = None;
        assert_eq!(left(&FreeSpace::new(&bounded, 0.5), &[0.5, 1.5]), [0.5, 1.5]);
        assert_eq!(left(&FreeSpace::new(&dataset(102, None), 0.0), &[0.5]), [0.5]);
    }
}
