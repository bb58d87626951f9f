//! Compares networks on every instruction set with double precision, at sizes with partial tiles, strips and blocks.

use irradia_compute::Level;
use irradia_compute::simd::{Double, Kernel, Lanes, Scalar, Simd};
use irradia_field::Rows;
use irradia_field::mlp::{Mlp, MlpShape, MlpTape, PANEL};
use irradia_scene::Rng;

/// A network with its inputs and output gradients.
struct Case {
    mlp: Mlp,
    parameters: Vec<f32>,
    x: Vec<f32>,
    v: Vec<f32>,
}

/// Outputs, gradients of the parameters and of the input.
type Results = [Vec<f64>; 3];

impl Case {
    fn new(shape: MlpShape, panels: usize) -> Self {
        let mlp = Mlp::new(shape);
        let mut rng = Rng::new(7, 8);
        let mut rows = |real: usize, padded: usize| -> Vec<f32> {
            (0..panels * padded * PANEL)
                .map(|at| {
                    let value = rng.range(-1.0, 1.0);
                    if at / PANEL % padded < real { value } else { 0.0 }
                })
                .collect()
        };
        let (x, v) = (rows(shape.inputs, mlp.inputs()), rows(shape.outputs, mlp.outputs()));
        let parameters = mlp.init(&mut Rng::new(9, 1));
        Self { mlp, parameters, x, v }
    }

    #[inline(always)]
    fn run<S: Simd>(&self, simd: S) -> Results {
        let convert = |values: &[f32]| -> Vec<<S::F as Lanes>::Scalar> {
            values.iter().map(|v| Scalar::from_f64(f64::from(*v))).collect()
        };
        let double = |values: &[<S::F as Lanes>::Scalar]| -> Vec<f64> { values.iter().map(|v| v.to_f64()).collect() };
        let (parameters, x) = (convert(&self.parameters), convert(&self.x));
        let mut tape = MlpTape::default();
        self.mlp.forward(simd, &parameters, &x, &mut tape);
        let out = double(tape.output());
        tape.output_gradient().extend_from_slice(&convert(&self.v));
        let transposed = self.mlp.transposed(&parameters);
        let (mut grads, mut v_x) = (convert(&vec![0.0; parameters.len()]), Rows::default());
        self.mlp
            .backward(simd, &transposed, &x, &mut tape, &mut grads, Some(&mut v_x));
        [out, double(&grads), double(&v_x)]
    }
}

impl Kernel for &Case {
    type Output = Results;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Results
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.run(simd)
    }
}

#[test]
fn every_level_matches_double_precision() {
    for (inputs, width, outputs, skip, panels) in [
        (3, 8, 1, None, 1),
        (11, 24, 5, Some(1), 5),
        (32, 40, 33, None, 6),
        (27, 64, 16, Some(2), 9),
    ] {
        let shape = MlpShape {
            inputs,
            outputs,
            width,
            depth: 3,
            skip,
        };
        let case = Case::new(shape, panels);
        let truth = case.run(Double);
        for level in Level::all() {
            let results = level.run(&case);
            for ((got, want), what) in results.iter().zip(&truth).zip(["output", "parameters", "input"]) {
                let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
                let size = norm(&mut want.iter().copied());
                let error = norm(&mut got.iter().zip(want).map(|(a, b)| a - b));
                // Sums of some hundred products in single precision, and the occasional ReLU that rounding flips.
                assert!(
                    error <= 1e-4 * size && size > 0.0,
                    "{what} of {shape:?} with {}: off by {error:e} of {size:e}",
                    level.name()
                );
            }
        }
    }
}
