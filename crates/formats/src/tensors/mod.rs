//! Named tensors of other programs: safetensors files and the state dicts of PyTorch.

mod pickle;
mod torch;

use crate::{FormatError, Malformed};
use safetensors::{Dtype, SafeTensors};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// A single-precision array.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
    /// Row-major.
    pub values: Vec<f32>,
}

/// Larger files are rejected; torchvision's VGG16, with its classifier, has 528 MB.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// The tensors of `path` whose names are `wanted`, from a safetensors file or the output of `torch.save(model.state_dict())`, as a
/// zip archive or in the older format. Nothing in the file is executed; other objects in it are ignored.
///
/// # Errors
/// When the file cannot be read, is neither, or has a wanted tensor that is truncated or not in 32-bit floats.
pub fn read_tensors(path: &Path, wanted: impl Fn(&str) -> bool) -> Result<BTreeMap<String, Tensor>, FormatError> {
    let read_error = |source| FormatError::Read {
        path: path.to_owned(),
        source,
    };
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(read_error)?;
    file.take(MAX_FILE_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(read_error)?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(FormatError::malformed(
            path,
            "larger than 1 GB: not a file of network weights",
        ));
    }
    parse(&bytes, &wanted).map_err(|source| FormatError::Malformed {
        path: path.to_owned(),
        source,
    })
}

pub(crate) fn parse(bytes: &[u8], wanted: &dyn Fn(&str) -> bool) -> Result<BTreeMap<String, Tensor>, Malformed> {
    match bytes {
        [b'P', b'K', 3, 4, ..] => torch::from_archive(bytes, wanted),
        [0x80, ..] => torch::from_stream(bytes, wanted),
        _ => from_safetensors(bytes, wanted),
    }
}

fn from_safetensors(bytes: &[u8], wanted: &dyn Fn(&str) -> bool) -> Result<BTreeMap<String, Tensor>, Malformed> {
    let unknown_format = |error| {
        Malformed(format!(
            "neither a PyTorch state dict nor a complete safetensors file ({error})"
        ))
    };
    let file = SafeTensors::deserialize(bytes).map_err(unknown_format)?;
    let mut tensors = BTreeMap::new();
    for (name, tensor) in file.iter().filter(|(name, _)| wanted(name)) {
        if tensor.dtype() != Dtype::F32 {
            return Err(Malformed(format!(
                "tensor {name} is {:?}; only F32 is supported",
                tensor.dtype()
            )));
        }
        let tensor = Tensor {
            shape: tensor.shape().to_vec(),
            values: floats(tensor.data()),
        };
        tensors.insert(name.to_owned(), tensor);
    }
    Ok(tensors)
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}
