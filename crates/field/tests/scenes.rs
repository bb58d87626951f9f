//! Scenes with known answers: fog, a wall, empty space.

use glam::{Quat, Vec3};
use irradia_field::encoding::{DirectionEncoding, HashGrid, PositionEncoding};
use irradia_field::net::{Activation, ColorShape, NetShape};
use irradia_field::render::quadrature::{composite, weights};
use irradia_field::sample::OccupancyGrid;
use irradia_field::sample::march::{March, Steps};
use irradia_field::{
    Field, FieldConfig, Occupancy, PointsOptions, RenderOptions, Sampler, Space, density_at, render_view, to_points,
};
use irradia_scene::{Camera, Intrinsics, Lens, Pose};

/// A camera at z = -3, looking along +Z at the cube -1..1.
fn camera() -> Camera {
    let pose = Pose {
        position: Vec3::new(0.0, 0.0, -3.0),
        rotation: Quat::IDENTITY,
    };
    Camera::new(pose, Intrinsics::from_fov_x(16, 12, 0.5))
}

/// A uniform grey field of density e^x in the cells of the cube -1..1 for which `occupied` is true.
fn uniform(x: f32, occupied: impl Fn([usize; 3]) -> bool) -> Field {
    let config = FieldConfig {
        net: NetShape {
            encoding: PositionEncoding::HashGrid(HashGrid {
                levels: 1,
                features: 1,
                log2_table: 10,
                coarsest: 4,
                finest: 4,
            }),
            width: 8,
            depth: 1,
            skip: None,
            geometry: 7,
            activation: Activation::Exp,
            density_bias: x,
            color: Some(ColorShape {
                direction: DirectionEncoding::Harmonics,
                width: 8,
                depth: 1,
                appearance: 0,
            }),
        },
        sampler: Sampler::Occupancy(Occupancy {
            side: 32,
            steps: Steps {
                shortest: 0.005,
                cone: 0.0,
            },
            thickness: 0.01,
            decay: 0.95,
        }),
        images: 0,
        background_degree: None,
    };
    let mut field = Field::new(config, Space::cube([0.0; 3], 1.0), 0).unwrap();
    for parameters in &mut field.parameters {
        parameters.table.fill(0.0);
        parameters.density.fill(0.0);
        parameters.color.fill(0.0);
    }
    let density = (0..32usize.pow(3)).map(|c| {
        if occupied([c % 32, c / 32 % 32, c / 1024]) {
            1e3
        } else {
            0.0
        }
    });
    let mut grid = OccupancyGrid::from_density(32, density.collect()).unwrap();
    grid.threshold(0.01, |_| 0.005);
    field.occupancy = Some(grid);
    field
}

fn with_normals() -> RenderOptions {
    RenderOptions {
        normals: true,
        ..RenderOptions::default()
    }
}

#[test]
fn steps_advance_at_any_distance() {
    let steps = Steps {
        shortest: 0.005,
        cone: 0.0,
    };
    assert_eq!(steps.at(1000.0), 0.005);
    for t in [0.0f32, 1e5, 1e6, 1e20] {
        assert!(t + steps.at(t) > t, "{t}");
    }
}

#[test]
fn uniform_fog_obeys_the_beer_lambert_law() {
    let field = uniform(0.3f32.ln(), |_| true);
    let view = render_view(&field, &camera(), &with_normals());
    // The ray through the image centre crosses 2 units; the lengths for the central pixels differ by less than 1e-4.
    let (middle, want) = (16 * 6 + 8, 1.0 - (-0.3f32 * 2.0).exp());
    // The first and last step may extend half a step outside: 0.3 * 0.005.
    assert!(
        (view.alpha[middle] - want).abs() < 1.5e-3,
        "{}, expected {want}",
        view.alpha[middle]
    );
    assert!((view.color[middle] - 0.5 * want).abs() < 1e-3, "grey 0.5 times alpha");
    assert_eq!(view.median_depth[middle], 0.0, "alpha stays below a half");
    // A uniform density has no gradient.
    assert!(view.normals.iter().all(|n| n.is_finite()));
    let densities = density_at(&field, &[[0.1, 0.2, 0.3], [1.2, 0.0, 0.0], [f32::NAN; 3]]);
    assert!((densities[0] - 0.3).abs() < 1e-6, "{}", densities[0]);
    assert_eq!(densities[1..], [0.0; 2], "zero outside the field");
}

#[test]
fn an_opaque_wall_renders_its_depth_and_colour() {
    // The wall begins at z = 0 in the world, 3 units in front of the camera.
    let field = uniform(8.0, |[_, _, z]| z >= 16);
    let view = render_view(&field, &camera(), &with_normals());
    for pixel in 0..view.alpha.len() {
        assert!(view.alpha[pixel] > 0.9999);
        assert!((view.color[pixel] - 0.5).abs() < 1e-4);
        // Within a step of 0.005 along the ray and its midpoint.
        assert!((view.depth[pixel] - 3.0).abs() < 0.006, "{}", view.depth[pixel]);
        assert!(
            (view.median_depth[pixel] - 3.0).abs() < 0.006,
            "{}",
            view.median_depth[pixel]
        );
    }
    let options = PointsOptions {
        count: 500,
        ..PointsOptions::default()
    };
    let points = to_points(&field, &[camera()], &options, |_, _| true);
    assert!((100..=500).contains(&points.len()), "{} points", points.len());
    assert_eq!(points.colors, vec![[128; 3]; points.len()]);
    assert!(points.positions.iter().all(|p| p.z.abs() < 0.006));

    // A mask that keeps the three leftmost columns: beyond 5 pixels, or 0.479 units of the wall, from the middle.
    let masked = to_points(&field, &[camera()], &options, |_, pixel| pixel.x < 3.0);
    assert!(masked.len() > 100, "{} points", masked.len());
    assert!(masked.positions.iter().all(|p| p.x < -0.478));
    assert!(to_points(&field, &[camera()], &options, |_, _| false).is_empty());
}

#[test]
fn no_points_lie_where_a_lens_shows_nothing() {
    let field = uniform(8.0, |[_, _, z]| z >= 16);
    // The image circle, whose radius is pi times 2 pixels, leaves the corners of the image dark.
    let fisheye = Intrinsics {
        fx: 2.0,
        fy: 2.0,
        lens: Lens::fisheye([0.0; 4]),
        ..Intrinsics::from_fov_x(16, 16, 1.0)
    };
    let camera = Camera::new(camera().pose, fisheye);
    let options = PointsOptions {
        count: 500,
        ..PointsOptions::default()
    };
    let points = to_points(&field, &[camera], &options, |_, _| true);
    let axial = points.positions.iter().filter(|p| p.truncate().length() < 1e-4);
    assert!(points.len() > 100 && axial.count() == 0, "{} points", points.len());
}

#[test]
fn an_empty_ray_is_transparent() {
    let field = uniform(8.0, |[x, _, _]| x == 31);
    let options = RenderOptions {
        background: [0.2, 0.4, 0.6],
        ..with_normals()
    };
    let view = render_view(&field, &camera(), &options);
    let (middle, pixels) = (16 * 6 + 8, 16 * 12);
    assert_eq!((view.alpha[middle], view.depth[middle]), (0.0, 0.0));
    assert_eq!([0, 1, 2].map(|c| view.color[c * pixels + middle]), [0.2, 0.4, 0.6]);
    assert_eq!([0, 1, 2].map(|c| view.normals[c * pixels + middle]), [0.0; 3]);
    assert!(to_points(&field, &[], &PointsOptions::default(), |_, _| true).is_empty());
}

#[test]
fn weights_are_non_negative_and_sum_to_alpha() {
    let mut rng = irradia_scene::Rng::new(1, 1);
    for round in 0..50 {
        let transmittances: Vec<f64> = (0..40).map(|_| f64::from(rng.uniform()).powi(round % 4)).collect();
        let mut w = vec![0.0; 40];
        let (counted, remaining) = weights(&transmittances, &mut w);
        let mut transmittance = 1.0;
        for weight in &w {
            assert!(*weight >= 0.0);
            transmittance -= weight;
        }
        assert!((transmittance - remaining).abs() < 1e-12 && remaining >= 0.0);
        assert!(w[counted..].iter().all(|w| *w == 0.0));
    }
}

#[test]
fn two_intervals_composite_exactly() {
    // Each transmits a half: weights of 1/2 and 1/4, and a transmittance of 1/4.
    let (value, alpha) = composite(&[2f64.ln(); 2], &[1.0; 2], &[10.0, 20.0]);
    assert!((value - 10.0).abs() < 1e-12 && (alpha - 0.75).abs() < 1e-12);
    assert_eq!(composite(&[], &[], &[]), (0.0, 0.0));
}

#[test]
fn skipping_keeps_every_occupied_sample_in_place() {
    let space = Space::cube([0.0; 3], 1.0);
    let steps = Steps {
        shortest: 0.01,
        cone: 0.0,
    };
    let mut rng = irradia_scene::Rng::new(2, 1);
    let density = (0..32usize.pow(3)).map(|_| if rng.below(40) == 0 { 1.0 } else { 0.0 });
    let mut grid = OccupancyGrid::from_density(32, density.collect()).unwrap();
    let full = OccupancyGrid::new(32);
    grid.threshold(0.01, |_| 1.0);
    let mut found = 0;
    for _ in 0..100 {
        let direction = Vec3::new(0.2 * rng.normal(), 0.2 * rng.normal(), 2.0).normalize();
        let ray = space.ray([0.3 * rng.normal(), 0.3 * rng.normal(), -3.0], direction.to_array());
        // Also in stretches of a few steps.
        let on = |grid, most| {
            let march = March {
                space: &space,
                grid,
                steps,
            };
            let (mut middles, mut lengths) = (Vec::new(), Vec::new());
            let mut t = march.first(&ray, 0.3);
            while t < ray.far {
                t = march.advance(&ray, t, most, &mut middles, &mut lengths);
            }
            (middles, lengths)
        };
        let (all, some) = (on(&full, usize::MAX), on(&grid, usize::MAX));
        assert_eq!(some, on(&grid, 3));
        let occupied = |t: &&f32| grid.at(space.unit(ray.at(**t))) == irradia_field::sample::occupancy::Cell::Occupied;
        let want = all.0.iter().filter(occupied).count();
        found += want;
        // Rounding may move a sample across a face it lies on.
        assert!(some.0.len().abs_diff(want) <= 1, "{}, expected {want}", some.0.len());
        for t in &some.0 {
            assert!(all.0.iter().any(|a| (a - t).abs() < 1e-4), "a sample at {t} has moved");
        }
    }
    assert!(found > 50, "only {found} samples tested");
}

#[test]
fn what_is_empty_is_reported_as_large_as_it_is_aligned() {
    use irradia_field::sample::occupancy::Cell;
    // 40 cells per side: the last blocks of 16 stick out.
    let side = 40;
    let mut density = vec![0.0; side * side * side];
    density[side * side * 3 + side * 2 + 1] = 1.0;
    let mut grid = OccupancyGrid::from_density(side, density).expect("a multiple of four");
    grid.threshold(0.01, |_| 1.0);
    let at = |cell: [usize; 3]| grid.at(cell.map(|c| (c as f32 + 0.5) / side as f32));
    assert_eq!(at([1, 2, 3]), Cell::Occupied);
    for (cell, cells) in [
        ([0, 2, 3], 1),
        ([3, 3, 3], 1),
        ([4, 2, 3], 4),
        ([15, 15, 15], 4),
        ([16, 2, 3], 16),
        ([39, 39, 39], 16),
    ] {
        assert_eq!(at(cell), Cell::Empty { cells }, "{cell:?}");
    }
    assert_eq!(
        grid.at([-1.0, 0.06, 0.08]),
        Cell::Empty { cells: 1 },
        "the nearest cell"
    );
}
