//! The convolutional parts of SqueezeNet 1.1, AlexNet and VGG16, with torchvision's layer numbers, split at LPIPS's taps, and
//! their VJP with respect to the image; the weights are fixed.

use super::layers::{Convolution, Map, Pool, max_pool, max_pool_vjp, relu_vjp};
use super::net::LpipsNet;
use super::weights::{LpipsError, Tensors};
use crate::real::Real;

/// A step of a published architecture; `number` is the layer's in `features.{number}`.
#[derive(Clone, Copy)]
enum Plan {
    /// A square convolution with ReLU.
    Convolution {
        number: usize,
        input: usize,
        output: usize,
        side: usize,
        stride: usize,
        padding: usize,
    },
    Pool(Pool),
    /// A fire module: squeezes to few channels, then expands them by parallel 1x1 and 3x3 filters to `expanded` channels each.
    Fire {
        number: usize,
        input: usize,
        squeezed: usize,
        expanded: usize,
    },
}

/// 3x3 with stride 1 and zero padding.
const fn conv3(number: usize, input: usize, output: usize) -> Plan {
    Plan::Convolution {
        number,
        input,
        output,
        side: 3,
        stride: 1,
        padding: 1,
    }
}

const fn fire(number: usize, input: usize, squeezed: usize, expanded: usize) -> Plan {
    Plan::Fire {
        number,
        input,
        squeezed,
        expanded,
    }
}

const fn pool(side: usize, ceil: bool) -> Plan {
    Plan::Pool(Pool { side, ceil })
}

/// The steps that lead to each tap, from the tap before or the image.
fn plan(net: LpipsNet) -> &'static [&'static [Plan]] {
    match net {
        LpipsNet::Squeeze => SQUEEZE,
        LpipsNet::Alex => ALEX,
        LpipsNet::Vgg => VGG,
    }
}

const SQUEEZE: &[&[Plan]] = &[
    &[Plan::Convolution {
        number: 0,
        input: 3,
        output: 64,
        side: 3,
        stride: 2,
        padding: 0,
    }],
    &[pool(3, true), fire(3, 64, 16, 64), fire(4, 128, 16, 64)],
    &[pool(3, true), fire(6, 128, 32, 128), fire(7, 256, 32, 128)],
    &[pool(3, true), fire(9, 256, 48, 192)],
    &[fire(10, 384, 48, 192)],
    &[fire(11, 384, 64, 256)],
    &[fire(12, 512, 64, 256)],
];

const ALEX: &[&[Plan]] = &[
    &[Plan::Convolution {
        number: 0,
        input: 3,
        output: 64,
        side: 11,
        stride: 4,
        padding: 2,
    }],
    &[
        pool(3, false),
        Plan::Convolution {
            number: 3,
            input: 64,
            output: 192,
            side: 5,
            stride: 1,
            padding: 2,
        },
    ],
    &[pool(3, false), conv3(6, 192, 384)],
    &[conv3(8, 384, 256)],
    &[conv3(10, 256, 256)],
];

const VGG: &[&[Plan]] = &[
    &[conv3(0, 3, 64), conv3(2, 64, 64)],
    &[pool(2, false), conv3(5, 64, 128), conv3(7, 128, 128)],
    &[
        pool(2, false),
        conv3(10, 128, 256),
        conv3(12, 256, 256),
        conv3(14, 256, 256),
    ],
    &[
        pool(2, false),
        conv3(17, 256, 512),
        conv3(19, 512, 512),
        conv3(21, 512, 512),
    ],
    &[
        pool(2, false),
        conv3(24, 512, 512),
        conv3(26, 512, 512),
        conv3(28, 512, 512),
    ],
];

/// Number of channels at each tap.
pub(super) fn tap_channels(net: LpipsNet) -> Vec<usize> {
    let channels = |plan: &Plan| match plan {
        Plan::Convolution { output, .. } => *output,
        Plan::Fire { expanded, .. } => 2 * expanded,
        Plan::Pool(_) => unreachable!("no tap follows a pooling"),
    };
    let last = |steps: &&[Plan]| channels(steps.last().expect("a step leads to every tap"));
    plan(net).iter().map(last).collect()
}

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

    /// The gradient of `input`, given that of the output `out`.
    fn vjp(&self, input: &Map<T>, squeezed: &Map<T>, out: &Map<T>, mut v_out: Map<T>) -> Map<T> {
        relu_vjp(out, &mut v_out);
        let mut v_squeezed = squeezed.zeros_like();
        self.expand1.vjp(&v_out, 0, &mut v_squeezed);
        self.expand3.vjp(&v_out, self.expanded, &mut v_squeezed);
        relu_vjp(squeezed, &mut v_squeezed);
        let mut v_input = input.zeros_like();
        self.squeeze.vjp(&v_squeezed, 0, &mut v_input);
        v_input
    }
}

/// The output of a step, and the squeezed map of a fire module.
type StepOutput<T> = (Map<T>, Option<Map<T>>);

/// A [`Plan`] step with its weights.
enum Step<T> {
    Convolution(Convolution<T>),
    Pool(Pool),
    Fire(Fire<T>),
}

impl<T: Real> Step<T> {
    fn from_weights(plan: Plan, weights: &dyn Tensors) -> Result<Self, LpipsError> {
        let layer = |name: String, input: usize, output: usize, side: usize, stride: usize, padding: usize| {
            let values = |part: &str, shape: &[usize]| -> Result<Vec<T>, LpipsError> {
                let values = weights.tensor(&format!("{name}.{part}"), shape)?;
                Ok(values.iter().map(|v| T::from_f64(f64::from(*v))).collect())
            };
            let kernel = values("weight", &[output, input, side, side])?;
            let bias = values("bias", &[output])?;
            Ok(Convolution::new(&kernel, bias, input, side, stride, padding))
        };
        Ok(match plan {
            Plan::Convolution {
                number,
                input,
                output,
                side,
                stride,
                padding,
            } => {
                let name = format!("features.{number}");
                Self::Convolution(layer(name, input, output, side, stride, padding)?)
            }
            Plan::Pool(pool) => Self::Pool(pool),
            Plan::Fire {
                number,
                input,
                squeezed,
                expanded,
            } => {
                let name = |part: &str| format!("features.{number}.{part}");
                Self::Fire(Fire {
                    squeeze: layer(name("squeeze"), input, squeezed, 1, 1, 0)?,
                    expand1: layer(name("expand1x1"), squeezed, expanded, 1, 1, 0)?,
                    expand3: layer(name("expand3x3"), squeezed, expanded, 3, 1, 1)?,
                    expanded,
                })
            }
        })
    }

    fn forward(&self, input: &Map<T>) -> StepOutput<T> {
        match self {
            Self::Convolution(layer) => (layer.forward(input), None),
            Self::Pool(pool) => (max_pool(input, *pool), None),
            Self::Fire(fire) => {
                let squeezed = fire.squeeze.forward(input);
                (fire.expand(&squeezed), Some(squeezed))
            }
        }
    }

    /// The gradient of `input`, given what [`Self::forward`] returned and the gradient of the output.
    fn vjp(&self, input: &Map<T>, (out, squeezed): &StepOutput<T>, mut v_out: Map<T>) -> Map<T> {
        match self {
            Self::Convolution(layer) => {
                relu_vjp(out, &mut v_out);
                let mut v_input = input.zeros_like();
                layer.vjp(&v_out, 0, &mut v_input);
                v_input
            }
            Self::Pool(pool) => max_pool_vjp(input, out, &v_out, *pool),
            Self::Fire(fire) => {
                let squeezed = squeezed.as_ref().expect("a fire module keeps its squeezed map");
                fire.vjp(input, squeezed, out, v_out)
            }
        }
    }
}

/// The steps that lead to each tap.
pub(super) struct Backbone<T> {
    taps: Vec<Vec<Step<T>>>,
}

/// The activations that the VJP needs.
pub(super) struct Tape<T> {
    input: Map<T>,
    /// The output of every step, tap by tap.
    outputs: Vec<Vec<StepOutput<T>>>,
}

impl<T: Real> Tape<T> {
    /// The features at tap `tap`.
    pub(super) fn tap(&self, tap: usize) -> &Map<T> {
        &self.outputs[tap].last().expect("a step leads to every tap").0
    }
}

impl<T: Real> Backbone<T> {
    pub(super) fn from_weights(net: LpipsNet, weights: &dyn Tensors) -> Result<Self, LpipsError> {
        let steps = |steps: &&[Plan]| steps.iter().map(|plan| Step::from_weights(*plan, weights)).collect();
        Ok(Self {
            taps: plan(net).iter().map(steps).collect::<Result<_, _>>()?,
        })
    }

    /// The features at tap `tap`, from those at the one before (for tap 0: from the scaled image).
    pub(super) fn up_to_tap(&self, tap: usize, input: &Map<T>) -> Map<T> {
        let (first, rest) = self.taps[tap].split_first().expect("a step leads to every tap");
        let features = first.forward(input).0;
        rest.iter().fold(features, |features, step| step.forward(&features).0)
    }

    /// All features of the scaled image `input`.
    pub(super) fn forward(&self, input: Map<T>) -> Tape<T> {
        let mut tape = Tape {
            input,
            outputs: Vec::with_capacity(self.taps.len()),
        };
        for (tap, steps) in self.taps.iter().enumerate() {
            let mut outputs: Vec<StepOutput<T>> = Vec::with_capacity(steps.len());
            for step in steps {
                let input = match (outputs.last(), tap) {
                    (Some((before, _)), _) => before,
                    (None, 0) => &tape.input,
                    (None, _) => tape.tap(tap - 1),
                };
                outputs.push(step.forward(input));
            }
            tape.outputs.push(outputs);
        }
        tape
    }

    /// The gradient of the scaled image, from those of the features at the taps.
    pub(super) fn vjp(&self, tape: &Tape<T>, v_taps: Vec<Map<T>>) -> Map<T> {
        let mut v_next: Option<Map<T>> = None;
        for (tap, v_tap) in v_taps.into_iter().enumerate().rev() {
            let mut v = v_tap;
            if let Some(v_next) = v_next.take() {
                for (v, more) in v.data.iter_mut().zip(v_next.data) {
                    *v += more;
                }
            }
            let outputs = &tape.outputs[tap];
            for (i, step) in self.taps[tap].iter().enumerate().rev() {
                let input = match (i, tap) {
                    (0, 0) => &tape.input,
                    (0, _) => tape.tap(tap - 1),
                    _ => &outputs[i - 1].0,
                };
                v = step.vjp(input, &outputs[i], v);
            }
            v_next = Some(v);
        }
        v_next.expect("there are taps")
    }
}
