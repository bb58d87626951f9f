//! A field that adds to the colours of given points.

use irradia_field::encoding::{DirectionEncoding, Frequency, HashGrid, PositionEncoding};
use irradia_field::net::{Activation, ColorShape, NetShape};
use irradia_field::{Field, FieldState, ResidualQuery, Space, StepOptions, residual_at, train_residual};
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

/// Points within the cube of half size 1, and a few outside it.
fn queries(n: usize) -> Vec<ResidualQuery> {
    let mut rng = Rng::new(3, 0);
    (0..n)
        .map(|i| {
            let reach = if i % 10 == 9 { 3.0 } else { 1.0 };
            let mut point = [0.0; 3].map(|_: f32| rng.range(-1.0, 1.0));
            point[0] += reach - 1.0 + if reach > 1.0 { 1.0 } else { 0.0 };
            let d = glam::Vec3::from([0.0; 3].map(|_: f32| rng.range(-1.0, 1.0)));
            ResidualQuery {
                point,
                direction: d.normalize_or(glam::Vec3::X).to_array(),
            }
        })
        .collect()
}

fn fresh() -> FieldState {
    FieldState::new(Field::residual(net(), false, 0, Space::cube([0.0; 3], 1.0), 1).unwrap())
}

#[test]
fn a_residual_field_starts_at_zero_and_learns_view_dependence() {
    let queries = queries(600);
    let mut state = fresh();
    assert!(
        residual_at(&state.field, &queries, None)
            .iter()
            .flatten()
            .all(|v| *v == 0.0)
    );
    let wanted = |s: &ResidualQuery| [0.4 * s.direction[0], -0.3 * s.direction[1], 0.2 * s.point[2].abs()];
    let options = StepOptions {
        table_rate: 1e-2,
        net_rate: 1e-2,
        beta2: 0.99,
        ..StepOptions::default()
    };
    let mut errors = Vec::new();
    for _ in 0..300 {
        let shown = residual_at(&state.field, &queries, None);
        let mut error = 0.0;
        let v: Vec<[f32; 3]> = shown
            .iter()
            .zip(&queries)
            .map(|(shown, query)| std::array::from_fn(|c| shown[c] - wanted(query)[c]))
            .collect();
        for (v, query) in v.iter().zip(&queries) {
            if query.point[0].abs() <= 1.0 {
                error += v.iter().map(|v| v * v).sum::<f32>();
            }
        }
        errors.push(error);
        train_residual(&mut state, &queries, &[(None, 1.0)], &v, &options);
    }
    // The error falls by a factor of about 100; a field without directions would keep two thirds of it.
    assert!(errors[299] < 0.02 * errors[0], "{} to {}", errors[0], errors[299]);
    for (query, added) in queries.iter().zip(residual_at(&state.field, &queries, None)) {
        assert!(
            query.point[0].abs() <= 1.0 || added == [0.0; 3],
            "{query:?} is outside the field"
        );
    }
}

#[test]
fn a_step_descends_along_the_gradient() {
    // The first steps move the last layer: while it is zero, earlier layers have no gradient.
    let queries = queries(200);
    let mut state = fresh();
    let options = StepOptions {
        table_rate: 1e-2,
        net_rate: 1e-2,
        beta2: 0.99,
        ..StepOptions::default()
    };
    let v: Vec<[f32; 3]> = queries.iter().map(|s| s.direction).collect();
    let value = |state: &FieldState| -> f64 {
        let added = residual_at(&state.field, &queries, None);
        let products = added.iter().zip(&v).flat_map(|(a, v)| (0..3).map(move |c| a[c] * v[c]));
        products.map(f64::from).sum()
    };
    let mut last = value(&state);
    for step in 0..20 {
        train_residual(&mut state, &queries, &[(None, 1.0)], &v, &options);
        let now = value(&state);
        assert!(now < last, "step {step}: {last} to {now}");
        last = now;
    }
}

#[test]
fn codes_descend_along_their_gradient_each_for_its_photograph() {
    let queries = queries(200);
    let mut shape = net();
    shape.color = shape.color.map(|color| ColorShape { appearance: 4, ..color });
    let field = Field::residual(shape, false, 3, Space::cube([0.0; 3], 1.0), 1).unwrap();
    let mut state = FieldState::new(field);
    // What the light of photograph 1 adds to the mean light.
    let terms = [(Some(1), 1.0), (None, -1.0)];
    let added = |state: &FieldState| -> Vec<[f32; 3]> {
        let [of_one, of_all] = [Some(1), None].map(|image| residual_at(&state.field, &queries, image));
        let pairs = of_one.iter().zip(&of_all);
        pairs.map(|(a, b)| std::array::from_fn(|c| a[c] - b[c])).collect()
    };
    let v: Vec<[f32; 3]> = queries.iter().map(|s| s.direction).collect();
    let value = |state: &FieldState| -> f64 {
        let products = added(state).into_iter().zip(&v);
        products
            .flat_map(|(a, v)| (0..3).map(move |c| f64::from(a[c] * v[c])))
            .sum()
    };
    assert!(added(&state).iter().flatten().all(|v| *v == 0.0));
    let rates = |net_rate: f32, code_rate: f32| StepOptions {
        table_rate: net_rate,
        net_rate,
        code_rate,
        beta2: 0.99,
        ..StepOptions::default()
    };
    // While the last layer is zero, codes have no gradient.
    for _ in 0..10 {
        train_residual(&mut state, &queries, &terms, &v, &rates(1e-2, 0.0));
    }
    let before = state.field.codes.clone();
    let mut last = value(&state);
    for step in 0..20 {
        train_residual(&mut state, &queries, &terms, &v, &rates(0.0, 1e-2));
        let now = value(&state);
        assert!(now < last, "step {step}: {last} to {now}");
        last = now;
    }
    let after = state.field.codes.clone();
    assert!((4..8).all(|i| before[i] != after[i]), "{before:?} {after:?}");
    assert!(
        (0..4).chain(8..12).all(|i| before[i] == after[i]),
        "the codes of other photographs change"
    );
}
