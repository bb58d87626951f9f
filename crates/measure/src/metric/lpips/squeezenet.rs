//! The convolutional part of SqueezeNet 1.1 (Iandola et al. 2016; version 1.1 of the authors' release), cut at LPIPS's
//! taps, and its VJP with regard to the image; the weights are fixed.

use super::layers::{Convolution, Map, max_pool, max_pool_vjp, stop_where_zero};
use super::weights::{LpipsError, Weights};
use crate::real::Real;

/// Squeeze to few channels, then expand them by 1x1 and by 3x3 filters side by side.
struct Fire<T> {
    squeeze: Convolution<T>,
    expand1: Convolution<T>,
    expand3: Convolution<T>,
    /// Channels of each expansion.
    expanded: usize,
}

impl<T: Real> Fire<T> {
    fn expand(&self, squeezed: &Map<T>) -> Map<T> {
        Convolution::forward_side_by_side(&[&self.expand1, &self.expand3], squeezed)
    }

    /// The gradient of `input`; that of the output `out` is used up.
    fn vjp(&self, input: &Map<T>, squeezed: &Map<T>, out: &Map<T>, mut v_out: Map<T>) -> Map<T> {
        stop_where_zero(out, &mut v_out);
        let mut v_squeezed = squeezed.zeros_like();
        self.expand1.vjp(&v_out, 0, &mut v_squeezed);
        self.expand3.vjp(&v_out, self.expanded, &mut v_squeezed);
        stop_where_zero(squeezed, &mut v_squeezed);
        let mut v_input = input.zeros_like();
        self.squeeze.vjp(&v_squeezed, 0, &mut v_input);
        v_input
    }
}

/// `[number in the file, input, squeezed, each expansion]` channels of the fire modules.
const FIRES: [[usize; 4]; 8] = [
    [3, 64, 16, 64],
    [4, 128, 16, 64],
    [6, 128, 32, 128],
    [7, 256, 32, 128],
    [9, 256, 48, 192],
    [10, 384, 48, 192],
    [11, 384, 64, 256],
    [12, 512, 64, 256],
];

#[derive(Clone, Copy)]
enum Step {
    First,
    Pool,
    Fire(usize),
}

/// What leads from each tap (from the image) to the next.
const STEPS: [&[Step]; TAPS] = [
    &[Step::First],
    &[Step::Pool, Step::Fire(0), Step::Fire(1)],
    &[Step::Pool, Step::Fire(2), Step::Fire(3)],
    &[Step::Pool, Step::Fire(4)],
    &[Step::Fire(5)],
    &[Step::Fire(6)],
    &[Step::Fire(7)],
];

/// Places at which LPIPS looks.
pub(super) const TAPS: usize = 7;
/// Channels there.
pub(super) const TAP_CHANNELS: [usize; TAPS] = [64, 128, 256, 384, 384, 512, 512];

pub(super) struct SqueezeNet<T> {
    first: Convolution<T>,
    fires: Vec<Fire<T>>,
}

/// What the VJP needs of a forward pass.
pub(super) struct Tape<T> {
    input: Map<T>,
    /// The output of every step, tap by tap.
    outputs: Vec<Vec<Map<T>>>,
    /// What lies inside the fire modules.
    squeezed: Vec<Map<T>>,
}

impl<T: Real> Tape<T> {
    /// The features at tap `tap`.
    pub(super) fn tap(&self, tap: usize) -> &Map<T> {
        self.outputs[tap].last().expect("a step leads to every tap")
    }
}

impl<T: Real> SqueezeNet<T> {
    pub(super) fn from_weights(weights: &Weights) -> Result<Self, LpipsError> {
        let layer = |name: String, input: usize, output: usize, side: usize, stride: usize, padding: usize| {
            let kernel = weights.tensor(&format!("{name}.weight"), &[output, input, side, side])?;
            let bias = weights.tensor(&format!("{name}.bias"), &[output])?;
            Ok(Convolution::new(&kernel, bias, input, side, stride, padding))
        };
        let fire = |[number, input, squeezed, expanded]: [usize; 4]| {
            let name = |part: &str| format!("features.{number}.{part}");
            Ok(Fire {
                squeeze: layer(name("squeeze"), input, squeezed, 1, 1, 0)?,
                expand1: layer(name("expand1x1"), squeezed, expanded, 1, 1, 0)?,
                expand3: layer(name("expand3x3"), squeezed, expanded, 3, 1, 1)?,
                expanded,
            })
        };
        Ok(Self {
            first: layer("features.0".into(), 3, 64, 3, 2, 0)?,
            fires: FIRES.into_iter().map(fire).collect::<Result<_, _>>()?,
        })
    }

    /// The output of a step, and what lies inside it where it is a fire module.
    fn step(&self, step: Step, input: &Map<T>) -> (Map<T>, Option<Map<T>>) {
        match step {
            Step::First => (self.first.forward(input), None),
            Step::Pool => (max_pool(input), None),
            Step::Fire(i) => {
                let squeezed = self.fires[i].squeeze.forward(input);
                (self.fires[i].expand(&squeezed), Some(squeezed))
            }
        }
    }

    /// The features at tap `tap`, from those at the one before (for tap 0: from the scaled image).
    pub(super) fn up_to_tap(&self, tap: usize, input: &Map<T>) -> Map<T> {
        let (first, rest) = STEPS[tap].split_first().expect("a step leads to every tap");
        let features = self.step(*first, input).0;
        rest.iter()
            .fold(features, |features, step| self.step(*step, &features).0)
    }

    /// All features of the scaled image `input`.
    pub(super) fn forward(&self, input: Map<T>) -> Tape<T> {
        let mut tape = Tape {
            input,
            outputs: Vec::with_capacity(TAPS),
            squeezed: Vec::with_capacity(FIRES.len()),
        };
        for steps in STEPS {
            let mut outputs: Vec<Map<T>> = Vec::with_capacity(steps.len());
            for step in steps {
                let before = outputs.last().or_else(|| tape.outputs.last()?.last());
                let (out, squeezed) = self.step(*step, before.unwrap_or(&tape.input));
                outputs.push(out);
                tape.squeezed.extend(squeezed);
            }
            tape.outputs.push(outputs);
        }
        tape
    }

    /// The gradient of the scaled image, from those of the features at the taps.
    pub(super) fn vjp(&self, tape: &Tape<T>, v_taps: [Map<T>; TAPS]) -> Map<T> {
        let mut v_behind: Option<Map<T>> = None;
        for (tap, v_tap) in v_taps.into_iter().enumerate().rev() {
            let mut v = v_tap;
            if let Some(v_behind) = v_behind.take() {
                for (v, more) in v.data.iter_mut().zip(v_behind.data) {
                    *v += more;
                }
            }
            let outputs = &tape.outputs[tap];
            for (i, step) in STEPS[tap].iter().enumerate().rev() {
                let input = match (i, tap) {
                    (0, 0) => &tape.input,
                    (0, _) => tape.tap(tap - 1),
                    _ => &outputs[i - 1],
                };
                v = match step {
                    Step::First => {
                        stop_where_zero(&outputs[i], &mut v);
                        let mut v_input = input.zeros_like();
                        self.first.vjp(&v, 0, &mut v_input);
                        v_input
                    }
                    Step::Pool => max_pool_vjp(input, &outputs[i], &v),
                    Step::Fire(fire) => self.fires[*fire].vjp(input, &tape.squeezed[*fire], &outputs[i], v),
                };
            }
            v_behind = Some(v);
        }
        v_behind.expect("there are taps")
    }
}
