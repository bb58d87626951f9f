//! A field that adds to the colours of given points.

use irradia_field::encoding::{DirectionEncoding, Frequency, HashGrid, PositionEncoding};
use irradia_field::net::{Activation, ColorShape, NetShape};
use irradia_field::{Field, FieldState, Sight, Space, StepOptions, residual_at, train_residual};
use irradia_scene::Rng;

fn net() -> NetShape {
    NetShape {
        encoding: PositionEncoding::HashGrid(HashGrid {
            levels: 2,
            features: 2,
            log2_table: 8,
            coarsest: 2,
            finest: 4,
        }),
        width: 16,
        depth: 1,
        skip: None,
        geometry: 7,
        activation: Activation::Exp,
        density_bias: 0.0,
        color: Some(ColorShape {
            direction: DirectionEncoding::Frequency(Frequency { octaves: 2 }),
            width: 16,
            depth: 1,
            appearance: 0,
        }),
    }
}

/// Points within the cube of half side 1, and a few outside it.
fn sights(n: usize) -> Vec<Sight> {
    let mut rng = Rng::new(3, 0);
    (0..n)
        .map(|i| {
            let reach = if i % 10 == 9 { 3.0 } else { 1.0 };
            let mut point = [0.0; 3].map(|_: f32| rng.range(-1.0, 1.0));
            point[0] += reach - 1.0 + if reach > 1.0 { 1.0 } else { 0.0 };
            let d = glam::Vec3::from([0.0; 3].map(|_: f32| rng.range(-1.0, 1.0)));
            Sight {
                point,
                direction: d.normalize_or(glam::Vec3::X).to_array(),
            }
        })
        .collect()
}

fn fresh() -> FieldState {
    FieldState::new(Field::residual(net(), false, Space::cube([0.0; 3], 1.0), 1).unwrap())
}

#[test]
fn it_adds_nothing_at_first_and_learns_what_depends_on_the_direction() {
    let sights = sights(600);
    let mut state = fresh();
    assert!(residual_at(&state.field, &sights).iter().flatten().all(|v| *v == 0.0));
    let wanted = |s: &Sight| [0.4 * s.direction[0], -0.3 * s.direction[1], 0.2 * s.point[2].abs()];
    let options = StepOptions {
        table_rate: 1e-2,
        net_rate: 1e-2,
        beta2: 0.99,
        ..StepOptions::default()
    };
    let mut errors = Vec::new();
    for _ in 0..300 {
        let shown = residual_at(&state.field, &sights);
        let mut error = 0.0;
        let v: Vec<[f32; 3]> = shown
            .iter()
            .zip(&sights)
            .map(|(shown, sight)| std::array::from_fn(|c| shown[c] - wanted(sight)[c]))
            .collect();
        for (v, sight) in v.iter().zip(&sights) {
            if sight.point[0].abs() <= 1.0 {
                error += v.iter().map(|v| v * v).sum::<f32>();
            }
        }
        errors.push(error);
        train_residual(&mut state, &sights, &v, &options);
    }
    // 100 times less; a field that knew no direction would keep two thirds of it.
    assert!(errors[299] < 0.02 * errors[0], "{} to {}", errors[0], errors[299]);
    for (sight, added) in sights.iter().zip(residual_at(&state.field, &sights)) {
        assert!(
            sight.point[0].abs() <= 1.0 || added == [0.0; 3],
            "{sight:?} is not within reach"
        );
    }
}

#[test]
fn a_step_descends_along_the_gradient() {
    // Not at rest: with a last layer of zeros nothing before it has a gradient.
    let sights = sights(200);
    let mut state = fresh();
    let options = StepOptions {
        table_rate: 1e-2,
        net_rate: 1e-2,
        beta2: 0.99,
        ..StepOptions::default()
    };
    let v: Vec<[f32; 3]> = sights.iter().map(|s| s.direction).collect();
    let value = |state: &FieldState| -> f64 {
        let added = residual_at(&state.field, &sights);
        let products = added.iter().zip(&v).flat_map(|(a, v)| (0..3).map(move |c| a[c] * v[c]));
        products.map(f64::from).sum()
    };
    let mut last = value(&state);
    for step in 0..20 {
        train_residual(&mut state, &sights, &v, &options);
        let now = value(&state);
        assert!(now < last, "step {step}: {last} to {now}");
        last = now;
    }
}
