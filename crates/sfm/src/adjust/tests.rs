use super::*;
use glam::DQuat;
use irradia_scene::Rng;

/// The exact problem of cameras on an arc around random points, observed with noise of `noise` px, and a perturbed copy of it.
fn world(poses: usize, points: usize, cameras: usize, noise: f64, seed: u64) -> (Problem, Problem) {
    let mut rng = Rng::new(seed, 0);
    let mut normal = |scale: f64| scale * f64::from(rng.normal());
    let mut exact = Problem::default();
    for _ in 0..cameras {
        let camera = DCamera {
            width: 640,
            height: 480,
            parameters: [500.0, 505.0, 320.0, 240.0, 0.05 + normal(0.01), -0.03, 0.001, -0.001],
            fisheye: false,
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
        exact.views.push(View::new(i as u32, (i % cameras) as u32));
    }
    exact.starts.push(0);
    for _ in 0..points {
        let point = DVec3::new(normal(1.0), normal(0.7), normal(1.0));
        for (i, pose) in exact.poses.iter().enumerate() {
            let p = pose.camera_from_world(point);
            let at = exact.cameras[i % cameras].camera.pixel(p);
            if p.z > 0.5 && normal(1.0) < 0.8 {
                let at = at + DVec2::new(normal(noise), normal(noise));
                exact.observations.push(Observation { view: i as u32, at });
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

/// The cost rises equally on both sides of the solution in every direction, measured by finite differences of the cost alone.
#[test]
fn the_gradient_vanishes_at_the_solution() {
    for (loss, cameras) in [(Loss::Squared, 1), (Loss::SoftL1(1.0), 2), (Loss::Cauchy(2.0), 8)] {
        let (_, mut problem) = world(8, 60, cameras, 0.7, 3);
        for camera in &mut problem.cameras {
            camera.freedom = Freedom {
                focal: Focal::Free,
                radial: 1,
                ..Freedom::HELD
            };
            camera.prior = Prior {
                values: [480.0, 1.02, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0],
                weights: [0.1, 1e5, 0.0, 0.0, 1e4, 0.0, 0.0, 0.0],
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
            // At a minimum both sides rise equally: their difference is small relative to the rise.
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
        slope("fy", 100.0, &|p, h| p.cameras[0].camera.parameters[1] += h);
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

/// One pose and free points: only the priors determine the camera.
#[test]
fn a_prior_decides_where_nothing_else_does() {
    let (_, mut problem) = world(1, 30, 1, 0.0, 6);
    problem.held_poses[0] = true;
    problem.cameras[0].freedom = EVERYTHING;
    // Each point can follow any camera: only the priors have a minimum.
    problem.cameras[0].prior = Prior {
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

/// Reference values, computed once with SciPy 1.17's `least_squares` (trf, all tolerances 1e-15, rotation vectors, translations,
/// points, f and k1 free, numeric Jacobian) on the same formulas; for the Cauchy loss each observation's residual was scaled to the
/// root of its loss.
#[test]
fn the_final_cost_is_that_of_an_independent_solver() {
    for (loss, start, answer, focal) in [
        (Loss::Squared, 280.028_602_359_170_9, 64.490_224_133_650_44, 503.382_9),
        (
            Loss::Cauchy(1.0),
            85.780_961_032_912_77,
            20.364_753_659_342_654,
            493.961_0,
        ),
    ] {
        let mut problem = formulas();
        assert!(
            (problem.cost(loss) - start).abs() < 1e-9 * start,
            "{}",
            problem.cost(loss)
        );
        let report = problem.solve(&AdjustOptions {
            loss,
            iterations: 2000,
            tolerance: 1e-13,
        });
        assert!((report.final_cost / answer - 1.0).abs() < 1e-6, "{loss:?} {report:?}");
        assert!(
            (problem.cameras[0].camera.parameters[0] - focal).abs() < 0.05,
            "{:?}",
            problem.cameras[0]
        );
    }
}

#[test]
fn cameras_on_a_rig_move_with_it() {
    // The same cameras, two per pose: every second one is mounted on the one before it.
    let (exact, mut problem) = world(8, 60, 1, 0.0, 5);
    for i in (0..8).step_by(2) {
        let [first, second] = [exact.poses[i], exact.poses[i + 1]];
        // The position of the rig, with the axes of each of its cameras.
        for (view, pose) in [(i, first), (i + 1, second)] {
            problem.views[view] = View {
                rig_from_camera: first.rotation.inverse() * pose.rotation,
                ..View::new(i as u32, 0)
            };
            let seen = DPose {
                position: first.position,
                ..pose
            };
            for point in 0..problem.points.len() {
                for o in exact.starts[point]..exact.starts[point + 1] {
                    let observation = &mut problem.observations[o as usize];
                    if observation.view as usize == view {
                        let p = seen.camera_from_world(exact.points[point]);
                        observation.at = exact.cameras[0].camera.pixel(p);
                    }
                }
            }
        }
    }
    let report = problem.solve(&PRECISE);
    assert!(report.initial_cost > 1e3 && report.final_cost < 1e-12, "{report:?}");
    let turned = |pose: &DPose| exact.poses[0].rotation.inverse() * pose.rotation;
    let relative = |poses: &[DPose]| turned(&poses[0]).inverse() * turned(&poses[2]);
    assert!(relative(&problem.poses).angle_between(relative(&exact.poses)) < 1e-6);
}

/// Six cameras and twenty points from formulas, with errors of up to 0.7 px and some of 5 px.
fn formulas() -> Problem {
    let truth = DCamera {
        parameters: [500.0, 500.0, 320.0, 240.0, 0.05, 0.0, 0.0, 0.0],
        ..DCamera::centered(640, 480, 500.0)
    };
    let mut problem = Problem::default();
    for i in 0..6 {
        let angle = 0.25 * f64::from(i);
        problem.poses.push(DPose {
            rotation: DQuat::from_rotation_y(-angle),
            position: DVec3::new(6.0 * angle.sin(), 0.3 * (3.0 * f64::from(i)).cos(), -6.0 * angle.cos()),
        });
        problem.held_poses.push(false);
        problem.views.push(View::new(i as u32, 0));
    }
    problem.starts.push(0);
    let mut k = 0;
    for j in 0..20 {
        let j = f64::from(j);
        let point = DVec3::new(
            1.2 * (1.7 * j).sin(),
            0.9 * (2.3 * j).cos(),
            1.1 * (0.9 * j + 1.0).sin(),
        );
        for (i, pose) in problem.poses.iter().enumerate() {
            let phase = f64::from(k);
            let error = DVec2::new(0.7 * (12.9898 * phase).sin(), 0.7 * (78.233 * phase + 1.0).sin());
            k += 1;
            let wrong = if k % 17 == 0 { 5.0 } else { 0.0 };
            let at = truth.pixel(pose.camera_from_world(point)) + error + DVec2::new(wrong, 0.0);
            problem.observations.push(Observation { view: i as u32, at });
        }
        problem.points.push(point);
        problem.held_points.push(false);
        problem.starts.push(problem.observations.len() as u32);
    }
    let freedom = Freedom {
        focal: Focal::Tied,
        radial: 1,
        ..Freedom::HELD
    };
    problem
        .cameras
        .push(AdjustedCamera::new(DCamera::centered(640, 480, 510.0), freedom));
    problem
}
