//! The weights file, checked before anything is taken from it.

use irradia_compute::simd::Scalar;
use safetensors::{Dtype, SafeTensors};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Why LPIPS cannot be computed.
#[derive(Debug, thiserror::Error)]
pub enum LpipsError {
    /// The file cannot be read.
    #[error("cannot read the LPIPS weights {}: {source}; check the path", .path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// It is not the file it should be.
    #[error("{} holds no LPIPS weights: {reason}; give lpips_squeeze.safetensors (SqueezeNet 1.1, LPIPS v0.1)", .path.display())]
    Weights {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The network's poolings would leave no pixel.
    #[error(
        "an image of {width}x{height} is too small for LPIPS; use sides of at least {} pixels",
        super::Lpips::MIN_SIDE
    )]
    TooSmall {
        /// Pixels.
        width: usize,
        /// Pixels.
        height: usize,
    },
}

/// SqueezeNet's weights take 2.9 MB; a file far beyond that is another file, and is not read whole to find out.
const MAX_BYTES: u64 = 64 << 20;

/// The file's bytes.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, LpipsError> {
    let failed = |source| LpipsError::Read {
        path: path.to_owned(),
        source,
    };
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(failed)?;
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(failed)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(LpipsError::Weights {
            path: path.to_owned(),
            reason: format!("it is larger than {} MB", MAX_BYTES >> 20),
        });
    }
    Ok(bytes)
}

/// Tensors by name.
pub(super) struct Weights<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
}

impl<'a> Weights<'a> {
    pub(super) fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Self, LpipsError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| LpipsError::Weights {
            path: path.to_owned(),
            reason: format!("it is no whole safetensors file ({error})"),
        })?;
        Ok(Self { path, tensors })
    }

    /// The values of tensor `name`, which must be of `shape`, stored in single precision and finite.
    pub(super) fn tensor<T: Scalar>(&self, name: &str, shape: &[usize]) -> Result<Vec<T>, LpipsError> {
        let wrong = |reason: String| LpipsError::Weights {
            path: self.path.to_owned(),
            reason,
        };
        let tensor = self
            .tensors
            .tensor(name)
            .map_err(|_| wrong(format!("tensor {name} is missing")))?;
        if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
            let (dtype, found) = (tensor.dtype(), tensor.shape());
            return Err(wrong(format!(
                "tensor {name} is {dtype:?} {found:?} and not F32 {shape:?}"
            )));
        }
        let (values, _) = tensor.data().as_chunks::<4>();
        let values: Vec<f32> = values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        if values.iter().any(|v| !v.is_finite()) {
            return Err(wrong(format!("tensor {name} has values that are not finite")));
        }
        Ok(values.iter().map(|v| T::from_f64(f64::from(*v))).collect())
    }
}
