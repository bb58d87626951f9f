//! The empty space before cameras. A camera stands in free space, and nothing that its view is known to see is closer than its
//! nearest points; splats closer than a fraction of that depth explain one photograph each, and veil the views in between. Only splats
//! around a nearer point that many views see, such as the tip of a leaf, are kept. Little is known about the space behind a camera, or
//! around one that stands among surfaces which its view does not show, as in a room: smooth walls have no points.

use glam::Vec3;
use irradia_scene::{Dataset, PointCloud, View};
use irradia_splat::SplatState;
use rayon::prelude::*;
use std::collections::HashSet;

/// Minimum number of points that a view sees for its nearest depth to be known.
const MIN_POINTS: usize = 20;
/// The fraction of a view's points that may be closer than its nearest depth: wrong matches are in front of the surface too.
const MAX_OUTLIER_FRACTION: f64 = 0.02;
/// The fraction of all points that may lie in a sphere.
const MAX_STRAY_FRACTION: f64 = 0.001;
/// The factor on the radius around a camera that stands among surfaces: points that its view need not show are closer than the radius. Held-out
/// PSNR, 480 pixels, 1,000 steps, with radii limited by the distance to these points, and with a seventh of the radius around all cameras:
/// offices 28.52, 29.00 dB; small room 26.65, 27.06; campus 22.29, 22.52; courthouse 18.49, 18.87. Of the cameras there 54 to 95 % stand among
/// surfaces, of nine captures of objects and façades 0 to 8 %. A mouse on a table needs the whole radius (25.85, 23.99).
const AMONG_SURFACES: f32 = 1.0 / 7.0;
/// Cosine of the angle from a camera's axis up to which space is free, 60 degrees: more than most views show, since a splat beside a view
/// reaches into it. Held-out PSNR with 180, 90 and 60 degrees: a figure on a table, smooth walls and door frames around it, 31.03, 31.48,
/// 32.01 dB (480 pixels, 1,000 steps); a mouse on a table 25.79, 25.79, 26.00, with 45 degrees 24.71 (240 pixels, 1,500 steps).
const MIN_COSINE: f32 = 0.5;
/// Minimum number of views that see a point for it to be certain. Held-out PSNR without support and with that of points seen by 3 and 6: a
/// plant in a room, with some photographs taken from among its leaves, 23.25, 23.54, 23.38 dB; mouse, whose table has wrong points, 24.23,
/// 23.82, 24.23; lund_door and maryRose the same.
const MIN_WITNESSES: u32 = 6;
/// Distance from such a point, relative to its distance from the camera, up to which splats may belong to the same surface.
const SUPPORT_RATIO: f32 = 0.15;

/// A cone before each training camera whose nearest depth is known.
#[derive(Clone, Debug, Default)]
pub(crate) struct FreeSpace {
    cones: Vec<Cone>,
}

/// A sector of a sphere around a camera.
#[derive(Clone, Debug)]
struct Cone {
    /// The camera's view.
    view: usize,
    apex: Vec3,
    /// The camera's axis, of unit length.
    axis: Vec3,
    /// Least cosine of the angle from the axis.
    min_cosine: f32,
    radius: f32,
    /// Points within or near the sphere that many views see, such as the tips of leaves, and the distance up to which each supports splats;
    /// world units.
    points: Vec<(Vec3, f32)>,
}

impl Cone {
    /// Whether a splat may be at `position`; nowhere if that is not a number.
    fn allows(&self, position: Vec3) -> bool {
        let offset = position - self.apex;
        let distance = offset.length();
        let supports = |(point, reach): &(Vec3, f32)| point.distance_squared(position) < reach * reach;
        distance >= self.radius
            || offset.dot(self.axis) < self.min_cosine * distance
            || self.points.iter().any(supports)
    }
}

impl FreeSpace {
    /// Cones with `fraction` of each training view's nearest depth as radius; none with a fraction of 0.
    pub(crate) fn new(dataset: &Dataset, fraction: f32) -> Self {
        if fraction <= 0.0 {
            return Self::default();
        }
        let certain = certain_points(dataset);
        let cone = |index: &usize| {
            let view = &dataset.views[*index];
            let mut radius = fraction * nearest_depth(dataset, view)?;
            let around = dataset.points.as_ref().map(|points| distance_to_points(points, view));
            if let Some(around) = around.filter(|around| *around < radius) {
                radius = around.min(AMONG_SURFACES * radius);
            }
            let pose = &view.camera.pose;
            let apex = pose.position;
            let near = certain
                .iter()
                .map(|point| (*point, SUPPORT_RATIO * point.distance(apex)));
            Some(Cone {
                view: *index,
                apex,
                axis: pose.rotation * Vec3::Z,
                // A wide lens may see everything around it.
                min_cosine: if view.camera.intrinsics.lens.is_wide() {
                    -1.0
                } else {
                    MIN_COSINE
                },
                radius,
                points: near
                    .filter(|(point, reach)| point.distance(apex) < radius + reach)
                    .collect(),
            })
        };
        Self {
            cones: dataset.train.par_iter().filter_map(cone).collect(),
        }
    }

    /// Keeps the cones of these views only.
    pub(crate) fn keep(&mut self, views: &HashSet<usize>) {
        self.cones.retain(|cone| views.contains(&cone.view));
    }

    /// Removes the splats centred in a cone; returns their number.
    pub(crate) fn clear(&self, state: &mut SplatState) -> usize {
        if self.cones.is_empty() {
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
                let position = Vec3::new(x[i], y[i], z[i]);
                self.cones.iter().all(|cone| cone.allows(position))
            })
            .collect();
        if kept.len() < n {
            state.gather(&kept);
        }
        n - kept.len()
    }
}

/// Points that enough training views see to be certain.
fn certain_points(dataset: &Dataset) -> Vec<Vec3> {
    let positions = dataset.points.as_ref().map_or(&[][..], |points| &points.positions);
    let mut witnesses = vec![0u32; positions.len()];
    let seen = |view: &usize| dataset.views[*view].points_seen.iter();
    for point in dataset.train.iter().flat_map(seen) {
        if let Some(count) = witnesses.get_mut(*point as usize) {
            *count += 1;
        }
    }
    let certain = |(position, count): (&Vec3, u32)| (count >= MIN_WITNESSES).then_some(*position);
    positions.iter().zip(witnesses).filter_map(certain).collect()
}

/// Distance from a view's camera to the nearest of all points except a few outliers, so that a wall behind the camera is kept.
fn distance_to_points(points: &PointCloud, view: &View) -> f32 {
    let eye = view.camera.pose.position;
    let mut distances: Vec<f32> = points.positions.iter().map(|p| p.distance(eye)).collect();
    let at = (distances.len() as f64 * MAX_STRAY_FRACTION) as usize;
    if distances.is_empty() {
        f32::INFINITY
    } else {
        *distances.select_nth_unstable_by(at, f32::total_cmp).1
    }
}

/// Depth along +Z of the nearest points that a view sees, or of its depth bounds, world units.
fn nearest_depth(dataset: &Dataset, view: &View) -> Option<f32> {
    let Some(mut depths) = seen_depths(dataset, view) else {
        return view.depth_bounds.map(|bounds| bounds[0]);
    };
    let at = (depths.len() as f64 * MAX_OUTLIER_FRACTION) as usize;
    Some(*depths.select_nth_unstable_by(at, f32::total_cmp).1)
}

/// Depths along +Z of the points that a view sees, world units; `None` if there are too few to determine its surfaces.
pub(crate) fn seen_depths(dataset: &Dataset, view: &View) -> Option<Vec<f32>> {
    let positions = &dataset.points.as_ref()?.positions;
    let seen = view.points_seen.iter().filter_map(|i| positions.get(*i as usize));
    let depths: Vec<f32> = seen
        .map(|position| view.camera.pose.camera_from_world(*position).z)
        .filter(|depth| *depth > view.camera.near)
        .collect();
    (depths.len() >= MIN_POINTS).then_some(depths)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use glam::Quat;
    use irradia_scene::{Camera, Intrinsics, Lens, Photo, Pose};
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

    /// The camera with points far away instead of the wall behind it.
    fn open() -> Dataset {
        let mut open = dataset(102, None);
        let positions = &mut open.points.as_mut().unwrap().positions;
        positions.truncate(102);
        positions.extend([Vec3::new(0.0, 0.0, 50.0); 3000]);
        open
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
        let depths = [-2.0, -0.9, 0.2, 0.4, 0.5, 0.99, 1.2, 2.9, 10.0];
        // The wall behind the camera is closer than 3: the radius is a seventh of that, 0.43.
        let space = FreeSpace::new(&dataset(102, None), 0.3);
        assert_eq!(left(&space, &depths), [-2.0, -0.9, 0.5, 0.99, 1.2, 2.9, 10.0]);
        let mut open = open();
        let space = FreeSpace::new(&open, 0.3);
        let expected = [-2.0, -0.9, 10.0];
        assert_eq!(left(&space, &depths), expected, "2 of 102 points are outliers");
        // A fisheye may see what is beside and behind it.
        open.views[0].camera.intrinsics.lens = Lens::fisheye([0.0; 4]);
        assert_eq!(left(&FreeSpace::new(&open, 0.3), &depths), [10.0]);
    }

    #[test]
    fn splats_beside_a_view_go_up_to_60_degrees_from_its_axis() {
        let space = FreeSpace::new(&open(), 0.3);
        let at = |degrees: f32| 2.0 * Vec3::new(degrees.to_radians().sin(), 0.0, degrees.to_radians().cos());
        let allowed = [0.0, 59.0, 61.0, 180.0].map(|degrees| space.cones[0].allows(at(degrees)));
        assert_eq!(allowed, [false, false, true, true]);
        assert!(!space.cones[0].allows(Vec3::NAN));
    }

    #[test]
    fn what_surrounds_a_nearer_point_that_many_views_see_stays() {
        let mut data = open();
        // The points at a depth of 1 are seen by one view, then by six.
        let depths = [0.5, 0.8, 0.9, 1.1, 1.2, 2.9];
        assert_eq!(left(&FreeSpace::new(&data, 0.3), &depths), Vec::<f32>::new());
        data.views = vec![data.views[0].clone(); 6];
        data.train = (0..6).collect();
        assert_eq!(left(&FreeSpace::new(&data, 0.3), &depths), [0.9, 1.1]);
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
