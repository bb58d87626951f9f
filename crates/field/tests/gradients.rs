//! Checks every gradient against central differences in double precision, using the code that trains: encodings and networks are
//! generic over lanes, and here a lane is one `f64`.

use irradia_compute::simd::Double;
use irradia_field::contraction::{contract, contract_vjp, uncontract};
use irradia_field::encoding::direction::{harmonics, harmonics_vjp};
use irradia_field::encoding::{DirectionEncoding, Frequency, HashGrid, PositionEncoding};
use irradia_field::mlp::{Mlp, MlpShape, MlpTape, PANEL};
use irradia_field::net::{Activation, Block, ColorShape, Net, NetParameters, NetShape, get3, sample_offset, set3};
use irradia_field::render::quadrature::{weights, weights_vjp};
use irradia_field::sample::proposal::{distortion, interlevel};
use irradia_field::{Rows, background_color, background_vjp};
use irradia_scene::Rng;
use irradia_testkit::finite_differences::FiniteDifferences;

/// Step of the differences; truncation error is its square, 1e-10, and rounding error 1e-16 / 1e-5.
const H: f64 = 1e-5;

/// Compares `gradient` with central differences of `f` at `x`, in the components `which`.
fn check(what: &str, x: &[f64], gradient: &[f64], which: impl Iterator<Item = usize>, f: impl Fn(&[f64]) -> f64) {
    FiniteDifferences::relative_to_max(H, 1e-6).check(what, x, gradient, which, f);
}

fn random(rng: &mut Rng, n: usize, low: f32, high: f32) -> Vec<f64> {
    (0..n).map(|_| f64::from(rng.range(low, high))).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn rows(values: &[f64]) -> Rows<f64> {
    let mut rows = Rows::default();
    rows.extend_from_slice(values);
    rows
}

#[test]
fn contraction_gradients_match_finite_differences() {
    let mut rng = Rng::new(1, 1);
    for scale in [0.5f32, 1.5, 3.0, 40.0] {
        let x: [f64; 3] = std::array::from_fn(|_| f64::from(rng.range(-scale, scale)));
        let v: [f64; 3] = std::array::from_fn(|_| f64::from(rng.range(-1.0, 1.0)));
        let back = uncontract(contract(x));
        (0..3).for_each(|c| assert!((back[c] - x[c]).abs() < 1e-9 * x[c].abs().max(1.0)));
        check("contract", &x, &contract_vjp(x, v), 0..3, |x| {
            dot(&contract([x[0], x[1], x[2]]), &v)
        });
    }
}

#[test]
fn direction_harmonics_gradients_match_finite_differences() {
    let mut rng = Rng::new(2, 1);
    let x: [f64; 3] = std::array::from_fn(|_| f64::from(rng.range(-1.0, 1.0)));
    let v: [f64; 16] = std::array::from_fn(|_| f64::from(rng.range(-1.0, 1.0)));
    let lanes = |x: &[f64]| harmonics(std::array::from_fn(|c| lane(x[c])));
    let value = |x: &[f64]| (0..16).map(|k| number(lanes(x)[k]) * v[k]).sum();
    let gradient = harmonics_vjp(x.map(lane), &v.map(lane)).map(number);
    check("harmonics", &x, &gradient, 0..3, value);
}

type Lane = <Double as irradia_compute::simd::Simd>::F;

fn lane(x: f64) -> Lane {
    irradia_compute::simd::Simd::set(Double, x)
}

fn number(lane: Lane) -> f64 {
    irradia_compute::simd::Lanes::sum(lane)
}

#[test]
fn frequency_encoding_gradients_match_finite_differences() {
    let mut rng = Rng::new(3, 1);
    let encoding = Frequency { octaves: 4 };
    let rows = encoding.features().next_multiple_of(8);
    let points = random(&mut rng, 3 * PANEL, -1.0, 1.0);
    let v = random(&mut rng, rows * PANEL, -1.0, 1.0);
    let encode = |points: &[f64]| {
        let mut to = vec![0.0; rows * PANEL];
        encoding.encode(Double, points, &mut to);
        to
    };
    let encoded = encode(&points);
    // Octave 2 of y is sin and cos of 4 pi y.
    let angle = 4.0 * std::f64::consts::PI * points[PANEL + 5];
    assert!((encoded[(3 + 12 + 1) * PANEL + 5] - angle.sin()).abs() < 1e-12);
    assert!((encoded[(6 + 12 + 1) * PANEL + 5] - angle.cos()).abs() < 1e-12);
    let mut gradient = vec![0.0; 3 * PANEL];
    encoding.encode_vjp(Double, &encoded, &v, &mut gradient);
    // The padding rows of `v` multiply zeros.
    check("frequency", &points, &gradient, (0..96).step_by(7), |p| {
        dot(&encode(p), &v)
    });
}

#[test]
fn mlp_gradients_with_a_skip_match_finite_differences() {
    let mut rng = Rng::new(4, 1);
    let mlp = Mlp::new(MlpShape {
        inputs: 11,
        outputs: 5,
        width: 16,
        depth: 3,
        skip: Some(1),
    });
    let parameters: Vec<f64> = mlp.init(&mut rng).into_iter().map(f64::from).collect();
    let mut x = vec![0.0; 2 * mlp.inputs() * PANEL];
    for panel in x.chunks_exact_mut(mlp.inputs() * PANEL) {
        panel[..11 * PANEL].copy_from_slice(&random(&mut rng, 11 * PANEL, -1.0, 1.0));
    }
    let mut v = vec![0.0; 2 * mlp.outputs() * PANEL];
    for panel in v.chunks_exact_mut(mlp.outputs() * PANEL) {
        panel[..5 * PANEL].copy_from_slice(&random(&mut rng, 5 * PANEL, -1.0, 1.0));
    }
    let loss = |parameters: &[f64], x: &[f64]| {
        let mut tape = MlpTape::default();
        mlp.forward(Double, parameters, x, &mut tape);
        dot(tape.output(), &v)
    };
    let mut tape = MlpTape::default();
    mlp.forward(Double, &parameters, &x, &mut tape);
    tape.output_gradient().extend_from_slice(&v);
    let (mut grads, mut v_x) = (vec![0.0; parameters.len()], Rows::default());
    let transposed = mlp.transposed(&parameters);
    mlp.backward(Double, &transposed, &x, &mut tape, &mut grads, Some(&mut v_x));
    // Padding weights have zero gradients, since `v` is zero in the padding rows of the output.
    check(
        "mlp parameter",
        &parameters,
        &grads,
        (0..grads.len()).step_by(13),
        |p| loss(p, &x),
    );
    check("mlp input", &x, &v_x, (0..11 * PANEL).step_by(17), |x| {
        loss(&parameters, x)
    });
}

fn shapes() -> [NetShape; 3] {
    let grid = NetShape {
        encoding: PositionEncoding::HashGrid(HashGrid {
            levels: 4,
            features: 2,
            // The last two levels are hashed.
            log2_table: 9,
            coarsest: 4,
            finest: 31,
        }),
        width: 16,
        depth: 1,
        skip: None,
        geometry: 7,
        activation: Activation::Exp,
        density_bias: -0.5,
        color: Some(ColorShape {
            direction: DirectionEncoding::Harmonics,
            width: 8,
            depth: 2,
            appearance: 3,
        }),
    };
    let frequency = NetShape {
        encoding: PositionEncoding::Frequency(Frequency { octaves: 2 }),
        depth: 3,
        skip: Some(2),
        activation: Activation::Softplus,
        color: Some(ColorShape {
            direction: DirectionEncoding::Frequency(Frequency { octaves: 2 }),
            width: 8,
            depth: 1,
            appearance: 3,
        }),
        ..grid
    };
    // NeRF uses a ReLU; the bias keeps its kink away from the samples.
    let relu = NetShape {
        activation: Activation::Relu,
        density_bias: 0.3,
        ..frequency
    };
    [grid, frequency, relu]
}

/// A network, a block of 37 samples, and a loss that is linear in densities and colours.
struct Scene {
    net: Net,
    points: Vec<f64>,
    directions: Vec<f64>,
    codes: Vec<f64>,
    v_density: Vec<f64>,
    v_rgb: Vec<f64>,
}

const SAMPLES: usize = 37;

impl Scene {
    fn new(shape: NetShape, rng: &mut Rng) -> Self {
        let mut directions = vec![0.0; 2 * 3 * PANEL];
        let mut v_rgb = vec![0.0; 2 * 3 * PANEL];
        let mut v_density = vec![0.0; 2 * PANEL];
        for i in 0..SAMPLES {
            let d = glam::Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize();
            set3(&mut directions, i, d.to_array().map(f64::from));
            set3(&mut v_rgb, i, std::array::from_fn(|_| f64::from(rng.range(-1.0, 1.0))));
            v_density[i] = f64::from(rng.range(-1.0, 1.0));
        }
        Self {
            net: Net::new(shape),
            points: random(rng, 2 * 3 * PANEL, 0.02, 0.98),
            directions,
            codes: random(rng, 2 * 3 * PANEL, -1.0, 1.0),
            v_density,
            v_rgb,
        }
    }

    fn forward(&self, parameters: &NetParameters<f64>, points: &[f64], codes: &[f64]) -> Block<f64> {
        let mut block = Block::default();
        block.reset(SAMPLES);
        block.points.copy_from_slice(points);
        self.net.density(Double, parameters, &mut block);
        block.directions = rows(&self.directions);
        block.codes = rows(codes);
        self.net.color(Double, parameters, &mut block);
        block
    }

    fn loss(&self, parameters: &NetParameters<f64>, points: &[f64], codes: &[f64]) -> f64 {
        let block = self.forward(parameters, points, codes);
        (0..SAMPLES)
            .map(|i| block.density[i] * self.v_density[i] + dot(&get3(&block.rgb, i), &get3(&self.v_rgb, i)))
            .sum()
    }
}

#[test]
fn network_gradients_match_finite_differences() {
    for shape in shapes() {
        let mut rng = Rng::new(5, 1);
        let scene = Scene::new(shape, &mut rng);
        let start = scene.net.init(&mut rng);
        let wide = |list: &[f32], scale: f64| list.iter().map(|v| f64::from(*v) * scale).collect::<Vec<f64>>();
        let parameters = NetParameters {
            table: wide(&start.table, 1e4),
            density: wide(&start.density, 1.0),
            color: wide(&start.color, 1.0),
        };
        let (points, codes) = (&scene.points, &scene.codes);
        let mut block = scene.forward(&parameters, points, codes);
        block.v_density = rows(&scene.v_density);
        block.v_rgb = rows(&scene.v_rgb);
        let mut grads = parameters.zeros_like();
        let transposed = scene.net.transposed(&parameters);
        scene.net.backward(Double, &transposed, &mut block, &mut grads, true);
        scene
            .net
            .table_gradient(Double, &block.points, &block.v_encoded, &mut grads.table);
        let mut v_points = Rows::default();
        scene
            .net
            .point_gradient(Double, &parameters.table, &block, &mut v_points);
        for part in 0..3 {
            let of = |p: &mut NetParameters<f64>, values: &[f64]| match part {
                0 => p.table = values.to_vec(),
                1 => p.density = values.to_vec(),
                _ => p.color = values.to_vec(),
            };
            let (values, gradient) = [
                (&parameters.table, &grads.table),
                (&parameters.density, &grads.density),
                (&parameters.color, &grads.color),
            ][part];
            check(
                ["table", "density part", "colour part"][part],
                values,
                gradient,
                (0..values.len()).step_by(11),
                |x| {
                    let mut moved = parameters.clone();
                    of(&mut moved, x);
                    scene.loss(&moved, points, codes)
                },
            );
        }
        // Samples 0 to 31 fill the first panel.
        check("point", points, &v_points, (0..3 * PANEL).step_by(5), |x| {
            scene.loss(&parameters, x, codes)
        });
        let v_codes: Vec<f64> = (0..3 * PANEL)
            .map(|i| scene.net.code_gradient(&block, i % PANEL, i / PANEL))
            .collect();
        check("code", codes, &v_codes, (0..3 * PANEL).step_by(5), |x| {
            scene.loss(&parameters, points, x)
        });
    }
}

#[test]
fn density_slope_matches_finite_differences() {
    for shape in shapes() {
        let mut rng = Rng::new(6, 1);
        let scene = Scene::new(shape, &mut rng);
        let start = scene.net.init(&mut rng);
        let wide = |list: &[f32], scale: f64| list.iter().map(|v| f64::from(*v) * scale).collect::<Vec<f64>>();
        let parameters = NetParameters {
            table: wide(&start.table, 1e4),
            density: wide(&start.density, 1.0),
            color: wide(&start.color, 1.0),
        };
        let mut block = scene.forward(&parameters, &scene.points, &scene.codes);
        let transposed = scene.net.transposed(&parameters);
        let mut slope = Rows::default();
        scene
            .net
            .density_slope(Double, &parameters, &transposed, &mut block, &mut slope);
        let total = |points: &[f64]| {
            scene.forward(&parameters, points, &scene.codes).density[..SAMPLES]
                .iter()
                .sum()
        };
        check("slope", &scene.points, &slope, (0..3 * PANEL).step_by(5), total);
    }
}

#[test]
fn a_dense_grid_level_interpolates_linearly() {
    // A dense level whose corners store their own coordinates returns the coordinates of any point.
    let shape = NetShape {
        encoding: PositionEncoding::HashGrid(HashGrid {
            levels: 1,
            features: 4,
            log2_table: 12,
            coarsest: 10,
            finest: 10,
        }),
        color: None,
        ..shapes()[0]
    };
    let net = Net::new(shape);
    assert!(net.levels[0].dense);
    let mut parameters = net.init(&mut Rng::new(7, 1));
    for (i, entry) in parameters.table.chunks_exact_mut(4).enumerate() {
        entry[..3].copy_from_slice(&[i % 11, i / 11 % 11, i / 121].map(|x| x as f32 / 10.0));
    }
    let parameters = NetParameters {
        table: parameters.table.iter().map(|v| f64::from(*v)).collect(),
        density: parameters.density.iter().map(|v| f64::from(*v)).collect(),
        color: Vec::new(),
    };
    let mut rng = Rng::new(8, 1);
    let mut block = Block::default();
    block.reset(40);
    let points: Vec<[f64; 3]> = (0..40)
        // The far faces belong to the grid.
        .map(|i| {
            if i == 0 {
                [1.0; 3]
            } else {
                std::array::from_fn(|_| f64::from(rng.uniform()))
            }
        })
        .collect();
    points
        .iter()
        .enumerate()
        .for_each(|(i, p)| set3(&mut block.points, i, *p));
    net.density(Double, &parameters, &mut block);
    let rows = net.encoded_rows();
    for (i, point) in points.iter().enumerate() {
        for c in 0..3 {
            let got = block.encoded[sample_offset(rows, i) + c * PANEL];
            // Corners are stored in single precision.
            assert!((got - point[c]).abs() < 1e-7, "{got}, expected {}", point[c]);
        }
    }
}

#[test]
fn compositing_gradients_match_finite_differences() {
    let mut rng = Rng::new(9, 1);
    let optical_depths = random(&mut rng, 12, 0.0, 0.6);
    let v = random(&mut rng, 12, -1.0, 1.0);
    let forward = |optical_depths: &[f64]| {
        let transmittances: Vec<f64> = optical_depths.iter().map(|t| (-t).exp()).collect();
        let mut w = vec![0.0; 12];
        let (counted, transmittance) = weights(&transmittances, &mut w);
        (transmittances, w, counted, transmittance)
    };
    let (transmittances, w, counted, _) = forward(&optical_depths);
    let mut gradient = vec![0.0; 12];
    weights_vjp(&transmittances, &w, &v, counted, &mut gradient);
    check("optical depth", &optical_depths, &gradient, 0..12, |t| {
        dot(&forward(t).1, &v)
    });
}

#[test]
fn background_gradients_of_every_degree_match_finite_differences() {
    for degree in 0..=3usize {
        let mut rng = Rng::new(12, degree as u64);
        let coefficients = random(&mut rng, 3 * (degree + 1).pow(2), -1.0, 1.0);
        let d = glam::DVec3::new(rng.normal().into(), rng.normal().into(), rng.normal().into()).normalize();
        let v: [f64; 3] = std::array::from_fn(|_| f64::from(rng.range(-1.0, 1.0)));
        let color = background_color(&coefficients, d.to_array());
        let mut gradient = vec![0.0; coefficients.len()];
        background_vjp(color, d.to_array(), v, &mut gradient);
        check("background", &coefficients, &gradient, 0..coefficients.len(), |c| {
            dot(&background_color(c, d.to_array()), &v)
        });
    }
    assert_eq!(
        background_color(&[0.0; 12], [0.0, 0.0, 1.0]),
        [0.5; 3],
        "grey before training"
    );
}

#[test]
fn proposal_losses_match_their_equations_and_finite_differences() {
    let mut rng = Rng::new(10, 1);
    let mut edges = |n: usize| {
        let mut list = random(&mut rng, n + 1, 0.0, 1.0);
        list.sort_by(f64::total_cmp);
        (list[0], list[n]) = (0.0, 1.0);
        list
    };
    let (s, s_hat) = (edges(9), edges(6));
    let mut rng = Rng::new(11, 1);
    let (w, w_hat) = (random(&mut rng, 9, 0.0, 0.3), random(&mut rng, 6, 0.0, 0.15));
    let mut gradient = vec![0.0; 6];
    let loss = interlevel(&s, &w, &s_hat, &w_hat, 0.7, &mut gradient);
    // Equation 13 literally: the bound sums the proposal's overlapping intervals.
    let plain: f64 = (0..9)
        .map(|i| {
            let bound: f64 = (0..6)
                .filter(|j| s_hat[j + 1] > s[i] && s_hat[*j] < s[i + 1])
                .map(|j| w_hat[j])
                .sum();
            0.7 * (w[i] - bound).max(0.0).powi(2) / (w[i] + 1e-7)
        })
        .sum();
    assert!(loss > 0.0 && (loss - plain).abs() < 1e-12, "{loss} and {plain}");
    check("proposal weight", &w_hat, &gradient, 0..6, |w_hat| {
        interlevel(&s, &w, &s_hat, w_hat, 0.7, &mut [0.0; 6])
    });
    let mut gradient = vec![0.0; 9];
    let loss = distortion(&s, &w, 0.7, &mut gradient);
    let middle = |i: usize| 0.5 * (s[i] + s[i + 1]);
    let mut plain = 0.0;
    for i in 0..9 {
        plain += 0.7 / 3.0 * w[i] * w[i] * (s[i + 1] - s[i]);
        plain += (0..9)
            .map(|j| 0.7 * w[i] * w[j] * (middle(i) - middle(j)).abs())
            .sum::<f64>();
    }
    assert!((loss - plain).abs() < 1e-12, "{loss} and {plain}");
    check("weight", &w, &gradient, 0..9, |w| distortion(&s, w, 0.7, &mut [0.0; 9]));
}
