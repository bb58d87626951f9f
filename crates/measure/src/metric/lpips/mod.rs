//! LPIPS (Zhang, Isola, Efros, Shechtman, Wang 2018), version 0.1, of SqueezeNet 1.1, AlexNet and VGG16.

mod backbone;
mod layers;
mod net;
mod network;
mod weights;

#[cfg(test)]
mod tests;

pub(crate) use layers::Map;
pub use net::LpipsNet;
pub(crate) use network::Network;
pub use weights::{ImportedTensor, LpipsError, to_weights_file};

use super::assert_same_size;
use irradia_scene::Image;
use std::path::Path;

/// The LPIPS metric, with its network's weights.
pub struct Lpips {
    pub(crate) network: Network<f32>,
}

impl Lpips {
    /// Reads a weights file: `features.*` (OIHW) of one of the three networks, recognised by its tensors, and the heads
    /// `lin0.model.1.weight`, ..
    ///
    /// # Errors
    /// When the file cannot be read, is not a safetensors file, or lacks a tensor of the right shape with finite values.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, LpipsError> {
        let network = Network::load(path.as_ref())?;
        Ok(Self { network })
    }

    /// The network whose features are compared.
    pub fn net(&self) -> LpipsNet {
        self.network.net
    }

    /// The distance between two images `[H, W, 3]` with values in \[0, 1\]; 0 for equal images, about 0.1 for good renders.
    ///
    /// # Errors
    /// When a side is below [`LpipsNet::min_side`].
    ///
    /// # Panics
    /// When sizes differ or there are not three channels: a bug in the caller.
    pub fn distance(&self, render: &Image, truth: &Image) -> Result<f64, LpipsError> {
        assert_same_size(render, truth, None);
        assert_eq!(truth.channels, 3, "LPIPS takes three channels");
        self.check_size(truth.width as usize, truth.height as usize)?;
        Ok(self.network.distance(map_of(render), map_of(truth)))
    }

    /// Checks that an image of this size is large enough for the network.
    pub(crate) fn check_size(&self, width: usize, height: usize) -> Result<(), LpipsError> {
        let least = self.net().min_side();
        if width.min(height) < least as usize {
            return Err(LpipsError::TooSmall { width, height, least });
        }
        Ok(())
    }
}

fn map_of(image: &Image) -> Map<f32> {
    Map {
        height: image.height as usize,
        width: image.width as usize,
        channels: 3,
        data: image.data.clone(),
    }
}
