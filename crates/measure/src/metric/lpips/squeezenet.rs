//! The convolutional part of SqueezeNet 1.1 (Iandola et al. 2016; version 1.1 of the authors' release), cut at LPIPS's taps.

use super::layers::{Convolution, Map, max_pool};
use super::weights::{LpipsError, Weights};

/// Squeeze to few channels, then expand them by 1x1 and by 3x3 filters side by side.
struct Fire {
    squeeze: Convolution,
    expand1: Convolution,
    expand3: Convolution,
}

impl Fire {
    fn forward(&self, input: &Map) -> Map {
        let squeezed = self.squeeze.forward(input);
        Convolution::forward_side_by_side(&[&self.expand1, &self.expand3], &squeezed)
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

pub(super) struct SqueezeNet {
    first: Convolution,
    fires: Vec<Fire>,
}

impl SqueezeNet {
    /// Places at which LPIPS looks.
    pub(super) const TAPS: usize = 7;
    /// Channels there.
    pub(super) const TAP_CHANNELS: [usize; Self::TAPS] = [64, 128, 256, 384, 384, 512, 512];

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
            })
        };
        Ok(Self {
            first: layer("features.0".into(), 3, 64, 3, 2, 0)?,
            fires: FIRES.into_iter().map(fire).collect::<Result<_, _>>()?,
        })
    }

    /// The features at tap `tap`, from those at the one before (for tap 0: from the scaled image).
    pub(super) fn up_to_tap(&self, tap: usize, input: Map) -> Map {
        let fire = |i: usize, input: &Map| self.fires[i].forward(input);
        match tap {
            0 => self.first.forward(&input),
            1 | 2 => fire(2 * tap - 1, &fire(2 * tap - 2, &max_pool(&input))),
            3 => fire(4, &max_pool(&input)),
            _ => fire(tap + 1, &input),
        }
    }
}
