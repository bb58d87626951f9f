use super::*;
use glam::DQuat;
use irradia_scene::Rng;

/// Cameras on an arc around random points, with noise of `noise` px, and the exact problem.
fn world(poses: usize, points: usize, cameras: usize, noise: f64, seed: u64) -> (Problem, Problem) {
    let mut rng = Rng::new(seed, 0);
    let mut normal = |scale: f64| scale * f64::from(rng.normal());
    let mut exact = Problem::default();
    for _ in 0..cameras {
        let camera = DCamera {
            width: 640,
            height: 480,
            parameters: [500.0, 505.0, 320.0, 240.0, 0.05 + normal(0.01), -0.03, 0.001, -0.001],
        };
        exact.cameras.push(AdjustedCamera::new(camera, Freedom::HELD));
    }
    for i in 0..poses {
        let angle = 0.2 * i as f64;
        let rotation = DQuat::from_rotation_y(-angle)
            * DQuat::from_scaled_axis(DVec3::new(normal(0.05), normal(0.05), normal(0.2)));
        exact.poses.push(DPose {
            rotation,
            position: DVec3::new(6.0 * angle.sin(), normal(0.5), -6.0 * angle.cos()),
        });
        exact.held_poses.push(false);
        exact.camera_of.push((i % cameras) as u32);
    }
    exact.starts.push(0);
    for _ in 0..points {
        let point = DVec3::new(normal(1.0), normal(0.7), normal(1.0));
        for (i, pose) in exact.poses.iter().enumerate() {
            let p = pose.camera_from_world(point);
            let at = exact.cameras[i % cameras].camera.pixel(p);
            if p.z > 0.5 && normal(1.0) < 0.8 {
                let at = at + DVec2::new(normal(noise), normal(noise));
                exact.observations.push(Observation { pose: i as u32, at });
            }
        }
        exact.points.push(point);
        exact.held_points.push(false);
        exact.starts.push(exact.observations.len() as u32);
    }
    let mut moved = exact.clone();
    for pose in &mut moved.poses {
        *pose = pose.moved(
            DVec3::new(normal(0.01), normal(0.01), normal(0.01)),
            DVec3::new(normal(0.05), normal(0.05), normal(0.05)),
        );
    }
    for point in &mut moved.points {
        *point += DVec3::new(normal(0.05), normal(0.05), normal(0.05));
    }
    (exact, moved)
}

const EVERYTHING: Freedom = Freedom {
    focal: Focal::Free,
    principal: true,
    radial: 2,
    tangential: true,
};

const PRECISE: AdjustOptions = AdjustOptions {
    loss: Loss::Squared,
    iterations: 100,
    tolerance: 1e-14,
};

#[test]
fn without_noise_the_cost_vanishes_and_intrinsics_return() {
    let (exact, mut problem) = world(8, 60, 1, 0.0, 1);
    problem.cameras[0].camera.parameters = [520.0, 520.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0];
    problem.cameras[0].freedom = EVERYTHING;
    let report = problem.solve(&PRECISE);
    assert!(report.final_cost < 1e-12, "{report:?}");
    for (got, want) in problem.cameras[0]
        .camera
        .parameters
        .iter()
        .zip(exact.cameras[0].camera.parameters)
    {
        assert!(
            (got - want).abs() < 1e-4 * want.abs().max(0.01),
            "{:?}",
            problem.cameras[0].camera
        );
    }
}

#[test]
fn held_values_do_not_move() {
    let (_, mut problem) = world(8, 60, 2, 0.5, 2);
    problem.held_poses[0] = true;
    problem.held_poses[3] = true;
    problem.held_points[5] = true;
    problem.cameras[0].freedom = Freedom {
        focal: Focal::Tied,
        radial: 1,
        ..Freedom::HELD
    };
    let before = problem.clone();
    let report = problem.solve(&PRECISE);
    assert!(
        report.final_cost < 0.05 * report.initial_cost && report.converged,
        "{report:?}"
    );
    assert_eq!(report.final_cost, problem.cost(Loss::Squared));
    assert_eq!(problem.poses[0], before.poses[0]);
    assert_eq!(problem.poses[3], before.poses[3]);
    assert_eq!(problem.points[5], before.points[5]);
    assert_eq!(problem.cameras[1], before.cameras[1]);
    let (now, then) = (
        problem.cameras[0].camera.parameters,
        before.cameras[0].camera.parameters,
    );
    assert!((now[0] / now[1] - then[0] / then[1]).abs() < 1e-12);
    assert!(now[0] != then[0] && now[4] != then[4]);
    assert_eq!((now[2], now[3], now[5], now[6]), (then[2], then[3], then[5], then[6]));
}

/// The step solves the damped normal equations, assembled densely and without elimination from finite differences.
#[test]
fn the_gradient_vanishes_at_the_solution() {
    for (loss, cameras) in [(Loss::Squared, 1), (Loss::SoftL1(1.0), 2), (Loss::Cauchy(2.0), 8)] {
        let (_, mut problem) = world(8, 60, cameras, 0.7, 3);
        for camera in &mut problem.cameras {
            camera.freedom = Freedom {
                focal: Focal::Tied,
                radial: 1,
                ..Freedom::HELD
            };
        }
        let report = problem.solve(&AdjustOptions { loss, ..PRECISE });
        assert!(report.final_cost < 0.1 * report.initial_cost, "{report:?}");
        let cost = |moved: &dyn Fn(&mut Problem)| {
            let mut copy = problem.clone();
            moved(&mut copy);
            copy.cost(loss)
        };
        const H: f64 = 1e-5;
        let slope = |name: &str, scale: f64, moved: &dyn Fn(&mut Problem, f64)| {
            let h = H * scale;
            let (plus, minus) = (cost(&|p| moved(p, h)), cost(&|p| moved(p, -h)));
            // At a minimum both sides rise alike: the difference is small against the rise.
            let rise = plus + minus - 2.0 * report.final_cost;
            assert!(
                rise > 0.0 && (plus - minus).abs() < 0.05 * rise,
                "{name}: {} of {rise}",
                plus - minus
            );
        };
        for i in 0..8 {
            for axis in 0..3 {
                slope("turn", 1.0, &|p, h| {
                    p.poses[i] = p.poses[i].moved(DVec3::AXES[axis] * h, DVec3::ZERO)
                });
                slope("shift", 1.0, &|p, h| p.poses[i].position += DVec3::AXES[axis] * h);
            }
        }
        for i in 0..10 {
            slope("point", 1.0, &|p, h| p.points[i].y += h);
        }
        slope("focal", 100.0, &|p, h| {
            let ratio = p.cameras[0].camera.parameters[1] / p.cameras[0].camera.parameters[0];
            p.cameras[0].camera.parameters[0] += h;
            p.cameras[0].camera.parameters[1] += h * ratio;
        });
        slope("k1", 1.0, &|p, h| p.cameras[0].camera.parameters[4] += h);
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let run = |threads: usize| {
        let (_, mut problem) = world(10, 400, 2, 0.5, 4);
        problem.cameras[1].freedom = EVERYTHING;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("a pool");
        let options = AdjustOptions {
            loss: Loss::Cauchy(1.0),
            iterations: 5,
            tolerance: 0.0,
        };
        let report = pool.install(|| problem.solve(&options));
        (report.final_cost.to_bits(), format!("{:?}", problem.poses))
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn points_behind_a_camera_do_not_break_it() {
    let (_, mut problem) = world(4, 30, 1, 0.5, 5);
    problem.points[0] = problem.poses[0].position - DVec3::Z * 100.0;
    let report = problem.solve(&PRECISE);
    assert!(report.initial_cost.is_infinite() && report.iterations == 0);
    assert!(Problem::default().solve(&PRECISE).final_cost == 0.0);
}

/// One pose, one point, nothing to see but what is believed.
#[test]
fn what_is_believed_of_a_camera_decides_where_nothing_else_does() {
    let (_, mut problem) = world(1, 30, 1, 0.0, 6);
    problem.held_poses[0] = true;
    problem.cameras[0].freedom = EVERYTHING;
    // Each point can follow any camera: only beliefs have a minimum.
    problem.cameras[0].belief = Belief {
        values: [510.0, 1.01, 322.0, 241.0, 0.02, -0.02, 0.0, 0.0],
        weights: [1e2, 1e6, 1e2, 1e2, 1e6, 1e6, 1e6, 1e6],
    };
    let report = problem.solve(&PRECISE);
    assert!(report.final_cost < 1e-9, "{report:?}");
    for (got, want) in problem.cameras[0]
        .camera
        .parameters
        .iter()
        .zip([510.0, 515.1, 322.0, 241.0, 0.02, -0.02, 0.0, 0.0])
    {
        assert!(
            (got - want).abs() < 1e-3 * f64::abs(want).max(0.01),
            "{:?}",
            problem.cameras[0].camera
        );
    }
}
