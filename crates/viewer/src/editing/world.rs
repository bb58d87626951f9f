//! Conversion from the world, in which pages work, to the dataset's coordinates, in which lists of edits are.

use glam::{DQuat, DVec3};
use irradia_edit::{Operation, SelectStep, Shape, Transform};
use irradia_scene::{Camera, Similarity};

/// Converts the positions and lengths of a step from the world to the dataset's coordinates.
pub(crate) fn step_to_dataset(step: &mut SelectStep, world: &Similarity) {
    let point = |p: &mut [f64; 3]| *p = world.invert(DVec3::from(*p)).to_array();
    let length = |v: &mut f64| *v /= world.scale;
    match &mut step.shape {
        Shape::Box { center, size, .. } => {
            point(center);
            size.iter_mut().for_each(length);
        }
        Shape::Sphere { center, radius } => {
            point(center);
            length(radius);
        }
        Shape::HalfSpace { point: p, .. } => point(p),
        Shape::Polygon { camera, .. } | Shape::Brush { camera, .. } => point(&mut camera.position),
        Shape::Size { min, max } => [min, max].into_iter().flatten().for_each(length),
        Shape::Clusters { gap, .. } | Shape::Connected { gap } => gap.iter_mut().for_each(length),
        Shape::Grow { by } => length(by),
        _ => {}
    }
}

/// Converts the positions and lengths of an operation from the world to the dataset's coordinates.
pub(crate) fn operation_to_dataset(op: &mut Operation, world: &Similarity) {
    let point = |p: &mut [f64; 3]| *p = world.invert(DVec3::from(*p)).to_array();
    match op {
        Operation::Move { by } | Operation::Duplicate { by } => by.iter_mut().for_each(|v| *v /= world.scale),
        Operation::Rotate { about, .. } | Operation::Scale { about, .. } => about.iter_mut().for_each(point),
        Operation::Upright { ground, .. } => ground.iter_mut().for_each(point),
        Operation::SetLength { from, to, .. } => [from, to].into_iter().for_each(point),
        _ => {}
    }
}

/// The transform of the scene from the world `from` to the world `to`, after it was moved by `moved` in the dataset's coordinates.
pub(crate) fn placement(from: &Similarity, moved: &Transform, to: &Similarity) -> Transform {
    // to (k R (x / s + c) + t - c')
    Transform {
        scale: to.scale * moved.scale / from.scale,
        rotation: moved.rotation,
        translation: to.apply(moved.apply(from.center)),
    }
}

/// `camera`, moved with the scene.
pub(crate) fn moved_camera(camera: &Camera, by: &Transform) -> Camera {
    let mut camera = *camera;
    let rotation: DQuat = by.rotation * camera.pose.rotation.as_dquat();
    camera.pose.rotation = rotation.normalize().as_quat();
    camera.pose.position = by.apply(camera.pose.position.as_dvec3()).as_vec3();
    camera
}

#[cfg(test)]
mod tests {
    use super::*;

    const DISTANT_WORLD: Similarity = Similarity {
        scale: 0.01,
        center: DVec3::new(1e5, -2e5, 30.0),
    };

    #[test]
    fn lengths_and_points_follow_the_world() {
        let mut step = SelectStep::add(Shape::Sphere {
            center: [1.0, 2.0, 3.0],
            radius: 0.5,
        });
        step_to_dataset(&mut step, &DISTANT_WORLD);
        let Shape::Sphere { center, radius } = step.shape else {
            panic!("a sphere")
        };
        assert!((radius - 50.0).abs() < 1e-9);
        assert!((DVec3::from(center) - DVec3::new(100_100.0, -199_800.0, 330.0)).length() < 1e-6);
        let mut op = Operation::Move { by: [0.0, 0.0, 1.0] };
        operation_to_dataset(&mut op, &DISTANT_WORLD);
        assert_eq!(op, Operation::Move { by: [0.0, 0.0, 100.0] });
    }

    #[test]
    fn a_placement_is_the_way_through_the_dataset() {
        let moved = Transform::about(DVec3::new(1e5, 0.0, 0.0), 2.0, DQuat::from_rotation_y(0.7));
        let to = Similarity {
            scale: 0.02,
            center: DVec3::new(5.0, 6.0, 7.0),
        };
        let by = placement(&DISTANT_WORLD, &moved, &to);
        let point = DVec3::new(0.3, -0.2, 0.1);
        let expected = to.apply(moved.apply(DISTANT_WORLD.invert(point)));
        assert!((by.apply(point) - expected).length() < 1e-6 * expected.length());
        let there = Transform::to_world(&DISTANT_WORLD).apply(DISTANT_WORLD.invert(point));
        assert!((there - point).length() < 1e-6);
    }
}
