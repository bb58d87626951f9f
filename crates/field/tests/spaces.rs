//! Mappings between the world and the unit cube.

use glam::{Quat, Vec3};
use irradia_field::{Facing, Outside, Space};
use irradia_scene::{Camera, Intrinsics, Pose, Rng};

fn forward_facing() -> Vec<Camera> {
    (0..5)
        .map(|i| {
            let pose = Pose {
                position: Vec3::new(i as f32 * 0.1 - 0.2, 0.05 * (i % 2) as f32, 0.0),
                rotation: Quat::from_rotation_y(0.02 * (i as f32 - 2.0)),
            };
            Camera::new(pose, Intrinsics::from_fov_x(40, 30, 0.9))
        })
        .collect()
}

#[test]
fn normalised_device_coordinates_keep_rays_straight_and_invert() {
    let cameras = forward_facing();
    let space = Space::ndc(&cameras, 2.0).unwrap();
    let mut rng = Rng::new(1, 1);
    for _ in 0..200 {
        let camera = &cameras[rng.below(5) as usize];
        let pixel = glam::Vec2::new(rng.uniform() * 40.0, rng.uniform() * 30.0);
        let (o, d) = camera.ray(pixel);
        let ray = space.ray(o.to_array(), d.to_array());
        for t in [0.01, 0.3, 0.6, 0.9] {
            let p = ray.at(ray.far * t);
            assert!(
                p.iter().all(|v| v.abs() <= 1.0 + 1e-4),
                "every camera's rays lie in the cube: {p:?}"
            );
            let distance = ray.world_distance(ray.far * t);
            let world = o + d * distance;
            let back = Vec3::from(space.to_world(p));
            assert!(back.distance(world) < 1e-3 * distance, "{back} and {world}");
            let again = space.from_world(world.to_array()).unwrap();
            (0..3).for_each(|c| assert!((again[c] - p[c]).abs() < 1e-4));
            assert!((ray.distance(distance) - ray.far * t).abs() < 1e-4);
        }
    }
    assert!(space.from_world([0.0, 0.0, -1.0]).is_none(), "behind the cameras");
    // The normal of a plane across the view is along the view at every point.
    let p = space.from_world([0.3, 0.2, 5.0]).unwrap();
    let n = Vec3::from(space.world_gradient(p, [0.0, 0.0, 1.0])).normalize();
    assert!(n.z > 0.999, "{n}");
}

#[test]
fn rays_of_cameras_elsewhere_are_followed_near_the_frustum_only() {
    let space = Space::ndc(&forward_facing(), 2.0).unwrap();
    let mut hits = 0;
    for (distance, degrees) in [(3.0f32, 60.0f32), (300.0, 90.0)] {
        let pose = Pose {
            position: Vec3::new(-5.0, 0.0, -distance),
            rotation: Quat::from_rotation_y(degrees.to_radians()),
        };
        let camera = Camera::new(pose, Intrinsics::from_fov_x(64, 48, 0.9));
        for i in 0..64 * 48 {
            let (from, direction) = camera.ray(glam::Vec2::new((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5));
            let ray = space.ray(from.to_array(), direction.to_array());
            // 8 half widths to all sides, and the depth of the cube; distances of some thousand units have errors of 1e-3.
            assert!(ray.far - ray.near < 23.0, "{ray:?}");
            if ray.near < ray.far {
                hits += 1;
                let middle = ray.at(0.5 * (ray.near + ray.far));
                assert!(middle.iter().all(|v| v.abs() < 8.01), "{middle:?}");
            }
        }
    }
    assert!(hits > 100, "{hits}");
}

#[test]
fn rays_that_are_not_finite_miss() {
    let ndc = Space::ndc(&forward_facing(), 2.0).unwrap();
    for space in [Space::cube([0.0; 3], 1.0), Space::contracted([0.0; 3], 1.0), ndc] {
        for (origin, view) in [([f32::NAN; 3], [0.0, 0.0, 1.0]), ([0.0; 3], [f32::NAN; 3])] {
            let ray = space.ray(origin, view);
            assert!(ray.near >= ray.far, "{ray:?}");
        }
    }
}

#[test]
fn ndc_gradients_match_finite_differences_in_the_world() {
    let space = Space::ndc(&forward_facing(), 2.0).unwrap();
    let (world, v) = ([0.3f32, -0.4, 5.0], [0.3f32, -0.7, 0.5]);
    let value = |w: [f32; 3]| {
        let p = space.from_world(w).unwrap();
        p.iter().zip(v).map(|(p, v)| f64::from(*p) * f64::from(v)).sum::<f64>()
    };
    let gradient = space.world_gradient(space.from_world(world).unwrap(), v);
    for c in 0..3 {
        let (mut low, mut high) = (world, world);
        (low[c], high[c]) = (world[c] - 0.05, world[c] + 0.05);
        let difference = (value(high) - value(low)) / 0.1;
        // Single precision: 1e-7 / 0.05.
        assert!(
            (difference - f64::from(gradient[c])).abs() < 1e-3,
            "{difference} and {}",
            gradient[c]
        );
    }
}

#[test]
fn contracted_space_maps_the_world_into_the_unit_cube() {
    let space = Space::contracted([1.0, 2.0, 3.0], 2.0);
    for point in [[1.0, 2.0, 3.0], [1.5, 1.0, 4.0], [30.0, -50.0, 7.0], [1e3, 0.0, 0.0]] {
        let p = space.from_world(point).unwrap();
        let u = space.unit(p);
        assert!(u.iter().all(|v| (0.0..=1.0).contains(v)));
        let back = space.to_world(space.from_unit(u));
        // Near the boundary a unit in the last place of `u` is a long way in the world.
        (0..3).for_each(|c| assert!((back[c] - point[c]).abs() < 1e-3 * point[c].abs().max(1.0), "{back:?}"));
    }
    for t in [0.1, 0.9, 1.0, 3.0, 150.0] {
        assert!((space.unspread(space.spread(t)) - t).abs() < 1e-3 * t);
    }
}

#[test]
fn spaces_are_derived_from_cameras() {
    let looking_in: Vec<Camera> = (0..6)
        .map(|i| {
            let rotation = Quat::from_rotation_y(i as f32);
            let pose = Pose {
                position: Vec3::new(1.0, 2.0, 3.0) + rotation * Vec3::new(0.0, 0.0, -4.0),
                rotation,
            };
            Camera::new(pose, Intrinsics::from_fov_x(40, 40, 0.5))
        })
        .collect();
    let space = Space::around(&looking_in, false).unwrap();
    assert!(Vec3::from(space.center).distance(Vec3::new(1.0, 2.0, 3.0)) < 1e-4);
    // 1.05 of 4 tan(0.25).
    assert!((1.0 / space.scale - 4.2 * 0.25f32.tan()).abs() < 1e-3);
    assert_eq!(Space::around(&looking_in, true).unwrap().outside, Outside::Contracted);
    assert!(Space::around(&looking_in[..1], false).is_none());
    assert!(Space::around(&[looking_in[0]; 3], false).is_none(), "all axes coincide");
    assert!(Space::ndc(&[], 1.0).is_none());
    assert!(Space::ndc(&looking_in, 1.0).is_none(), "they do not face one way");
}

#[test]
fn cameras_face_forward_within_a_cone_and_before_the_scene() {
    let facing = Facing::of(&forward_facing()).unwrap();
    assert!((facing.cone - 0.04f32.to_degrees()).abs() < 0.05, "{facing:?}");
    assert!(facing.foremost.abs() < 0.01 && facing.is_forward(2.0) && !facing.is_forward(-0.1));
    let around: Vec<Camera> = (0..6)
        .map(|i| {
            let mut camera = forward_facing()[0];
            camera.pose.rotation = Quat::from_rotation_y(0.3 * i as f32);
            camera
        })
        .collect();
    assert!(!Facing::of(&around).unwrap().is_forward(2.0));
    assert!(Facing::of(&[]).is_none());
}
