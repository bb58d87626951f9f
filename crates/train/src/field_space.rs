//! The space of a field, as determined by the arrangement of the cameras.

use crate::recipe::FieldSpace;
use crate::trainer::TrainError;
use glam::{Vec2, Vec3};
use irradia_field::{FORWARD_CONE, Facing, Space};
use irradia_scene::{Camera, Dataset, PointCloud, View};

/// Factor on the nearest depth of the scene, which leaves a margin (NeRF's code: 0.9).
const NEAR_MARGIN: f32 = 0.9;
/// Fraction of a view's points that are nearer than its near depth (LLFF's `imgs2poses`: 0.1 percent).
const OUTLIER_FRACTION: f32 = 0.001;

/// The space of a field trained on `dataset`, and why, in one line. `transparent`: photographs have alpha.
///
/// [`FieldSpace::Auto`] is normalised device coordinates if the cameras face forward ([`Facing::is_forward`]) towards a scene whose
/// nearest depth is known: these coordinates spend cells in proportion to what such cameras see, and none on what is beside or behind them.
/// Whether the depth is known from bounds (LLFF) or from points (COLMAP) does not matter.
///
/// # Errors
/// [`TrainError::NoSpace`].
pub fn field_space(kind: FieldSpace, dataset: &Dataset, transparent: bool) -> Result<(Space, String), TrainError> {
    let views: Vec<&View> = dataset.train.iter().map(|i| &dataset.views[*i]).collect();
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let near = || nearest_depth(dataset, &views).map(|depth| NEAR_MARGIN * depth);
    let (space, why) = match kind {
        FieldSpace::Auto => automatic(&cameras, near, transparent),
        FieldSpace::Ndc => (
            Space::ndc(&cameras, near().unwrap_or(cameras[0].near)),
            "normalised device coordinates, as the recipe says".into(),
        ),
        FieldSpace::Bounded => (Space::around(&cameras, false), "a cube, as the recipe says".into()),
        FieldSpace::Unbounded => (
            Space::around(&cameras, true),
            "a contracted world, as the recipe says".into(),
        ),
    };
    Ok((space.ok_or(TrainError::NoSpace)?, why))
}

fn automatic(cameras: &[Camera], near: impl FnOnce() -> Option<f32>, transparent: bool) -> (Option<Space>, String) {
    let not_forward = match Facing::of(cameras) {
        None => "the cameras face in all directions".to_owned(),
        Some(facing) if facing.cone > FORWARD_CONE => {
            format!("the cameras turn by up to {:.0} degrees from their mean", facing.cone)
        }
        Some(facing) => match near() {
            None => "neither depth bounds nor points say where the scene begins".to_owned(),
            Some(near) => {
                let space = facing.is_forward(near).then(|| Space::ndc(cameras, near)).flatten();
                if space.is_some() {
                    let why = format!(
                        "normalised device coordinates: the cameras face forward, within {:.0} degrees of their mean, and the \
                         scene begins at depth {near:.3}",
                        facing.cone
                    );
                    return (space, why);
                }
                "the scene begins between the cameras, or corners of their images look sideways".to_owned()
            }
        },
    };
    if transparent {
        let why = format!("a cube around what the cameras look at: photographs have alpha, and {not_forward}");
        (Space::around(cameras, false), why)
    } else {
        let why = format!("a contracted world around what the cameras look at: {not_forward}");
        (Space::around(cameras, true), why)
    }
}

/// The nearest depth of the scene over all views, world units: of the depth bounds if every view has them, else of the points
/// that each view shows.
fn nearest_depth(dataset: &Dataset, views: &[&View]) -> Option<f32> {
    let bounds: Option<Vec<f32>> = views.iter().map(|view| view.depth_bounds.map(|b| b[0])).collect();
    let nearest = |depths: Vec<f32>| depths.into_iter().reduce(f32::min);
    match (bounds, &dataset.points) {
        (Some(bounds), _) => nearest(bounds),
        (None, Some(points)) => nearest(views.iter().filter_map(|view| near_depth(view, points)).collect()),
        (None, None) => None,
    }
}

/// The near depth of the points visible in `view`; of all points in the image if it does not list them.
fn near_depth(view: &View, points: &PointCloud) -> Option<f32> {
    let k = &view.camera.intrinsics;
    let size = Vec2::new(k.width as f32, k.height as f32);
    let depth = |position: &Vec3| {
        let (at, depth) = view.camera.project(*position)?;
        (at.cmpge(Vec2::ZERO).all() && at.cmplt(size).all()).then_some(depth)
    };
    let mut depths: Vec<f32> = if view.points_seen.is_empty() {
        points.positions.iter().filter_map(depth).collect()
    } else {
        let seen = view.points_seen.iter().map(|i| &points.positions[*i as usize]);
        seen.filter_map(depth).collect()
    };
    let place = (OUTLIER_FRACTION * depths.len() as f32) as usize;
    (!depths.is_empty()).then(|| *depths.select_nth_unstable_by(place, f32::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_field::Outside;
    use irradia_scene::{Intrinsics, Photo, PointCloud, Pose};
    use std::sync::Arc;

    /// Cameras at `places` and turned by `angles` about the vertical, with depth bounds from `near`.
    fn dataset(places: [f32; 3], angles: [f32; 3], near: Option<f32>) -> Dataset {
        let photo = Arc::new(Photo {
            width: 1,
            height: 1,
            channels: 3,
            data: vec![0; 3],
            mask: None,
        });
        let view = |(x, angle): (f32, f32)| View {
            depth_bounds: near.map(|near| [near, 100.0]),
            ..View::new(
                x.to_string(),
                Camera::new(
                    Pose {
                        position: Vec3::new(x, 0.1 * x * x, 0.0),
                        rotation: Quat::from_rotation_y(angle.to_radians()),
                    },
                    Intrinsics::from_fov_x(40, 30, 0.9),
                ),
                photo.clone(),
            )
        };
        Dataset {
            views: places.into_iter().zip(angles).map(view).collect(),
            train: vec![0, 1, 2],
            ..Dataset::default()
        }
    }

    #[test]
    fn only_cameras_that_face_forward_get_normalised_device_coordinates() {
        let across = [-1.0, 0.0, 1.0];
        let inwards = [8.0, 0.0, -8.0];
        let auto =
            |dataset: &Dataset, transparent| field_space(FieldSpace::Auto, dataset, transparent).expect("a space");
        let (space, why) = auto(&dataset(across, inwards, Some(4.0)), false);
        assert!(
            matches!(space.outside, Outside::Ndc(frustum) if frustum.near == NEAR_MARGIN * 4.0),
            "{why}"
        );
        assert!(why.contains("within 8 degrees"), "{why}");
        for (angles, near, transparent, outside, says) in [
            ([70.0, 0.0, -70.0], Some(4.0), false, Outside::Contracted, "70 degrees"),
            ([70.0, 0.0, -70.0], Some(4.0), true, Outside::Nothing, "alpha"),
            (inwards, None, false, Outside::Contracted, "neither"),
        ] {
            let (space, why) = auto(&dataset(across, angles, near), transparent);
            assert!(space.outside == outside && why.contains(says), "{why}");
        }
        // One camera is beyond the nearest depth of the others.
        let mut advanced = dataset(across, inwards, Some(0.5));
        advanced.views[1].camera.pose.position.z = 3.0;
        let (space, why) = auto(&advanced, false);
        assert!(space.outside == Outside::Contracted && why.contains("between"), "{why}");
    }

    #[test]
    fn points_tell_the_nearest_depth_like_bounds() {
        let mut dataset = dataset([-1.0, 0.0, 1.0], [8.0, 0.0, -8.0], None);
        dataset.points = Some(PointCloud {
            positions: vec![Vec3::new(0.0, 0.0, 5.0), Vec3::new(0.0, 0.0, 6.0)],
            colors: vec![[0; 3]; 2],
        });
        dataset.views[1].points_seen = vec![0, 1];
        let (space, _) = field_space(FieldSpace::Auto, &dataset, false).expect("a space");
        assert!(matches!(space.outside, Outside::Ndc(frustum) if (frustum.near - 4.5).abs() < 1e-5));
    }
}
