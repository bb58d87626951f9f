//! The LPIPS weights file: validated reading, and conversion from the files that the networks' authors publish.

use super::backbone::{Backbone, tap_channels};
use super::net::LpipsNet;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use std::cell::RefCell;
use std::collections::BTreeMap;
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
        /// The system's error.
        source: std::io::Error,
    },
    /// The file does not hold valid weights.
    #[error(
        "{} holds no LPIPS weights: {reason}; make the file with `irradia lpips --import FEATURES HEADS`",
        .path.display()
    )]
    Weights {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The tensors to import do not form a network.
    #[error(
        "{reason}; give the features of torchvision's SqueezeNet 1.1, AlexNet or VGG16 and the LPIPS v0.1 heads of the same network"
    )]
    Import {
        /// What is wrong.
        reason: String,
    },
    /// The image is too small for the network's poolings.
    #[error("an image of {width}x{height} is too small for LPIPS; use sides of at least {least} pixels")]
    TooSmall {
        /// Pixels.
        width: usize,
        /// Pixels.
        height: usize,
        /// Smallest side for this network, pixels.
        least: u32,
    },
}

/// VGG's weights, the largest, take 59 MB; a far larger file is rejected without reading it.
const MAX_BYTES: u64 = 80 << 20;

/// Reads the file.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, LpipsError> {
    let unreadable = |source| LpipsError::Read {
        path: path.to_owned(),
        source,
    };
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(unreadable)?;
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(LpipsError::Weights {
            path: path.to_owned(),
            reason: format!("it is larger than {} MB", MAX_BYTES >> 20),
        });
    }
    Ok(bytes)
}

/// A source of a network's tensors.
pub(super) trait Tensors {
    /// The values of tensor `name`, which must be of `shape` and finite.
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, LpipsError>;
}

/// The tensors of a weights file.
pub(super) struct Weights<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
}

impl<'a> Weights<'a> {
    pub(super) fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Self, LpipsError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| LpipsError::Weights {
            path: path.to_owned(),
            reason: format!("it is not a complete safetensors file ({error})"),
        })?;
        Ok(Self { path, tensors })
    }

    /// The network these features belong to.
    pub(super) fn net(&self) -> Result<LpipsNet, LpipsError> {
        LpipsNet::recognise(|name| self.tensors.tensor(name).is_ok())
            .ok_or_else(|| self.wrong("it has no features of SqueezeNet, AlexNet or VGG16".to_owned()))
    }

    fn wrong(&self, reason: String) -> LpipsError {
        LpipsError::Weights {
            path: self.path.to_owned(),
            reason,
        }
    }
}

impl Tensors for Weights<'_> {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, LpipsError> {
        let missing = |_| self.wrong(format!("tensor {name} is missing"));
        let tensor = self.tensors.tensor(name).map_err(missing)?;
        if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
            let (dtype, found) = (tensor.dtype(), tensor.shape());
            return Err(self.wrong(format!("tensor {name} is {dtype:?} {found:?}, expected F32 {shape:?}")));
        }
        let (values, _) = tensor.data().as_chunks::<4>();
        let values: Vec<f32> = values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        if values.iter().any(|v| !v.is_finite()) {
            return Err(self.wrong(format!("tensor {name} has values that are not finite")));
        }
        Ok(values)
    }
}

/// The tensor of head `tap`.
pub(super) fn head_name(tap: usize) -> String {
    format!("lin{tap}.model.1.weight")
}

/// The values of every head, `[tap][C]`.
pub(super) fn heads(net: LpipsNet, weights: &dyn Tensors) -> Result<Vec<Vec<f32>>, LpipsError> {
    let channels = tap_channels(net);
    let head = |(tap, channels): (usize, &usize)| weights.tensor(&head_name(tap), &[1, *channels, 1, 1]);
    channels.iter().enumerate().map(head).collect()
}

/// A tensor to import.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedTensor {
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub values: Vec<f32>,
}

/// Tensors by name, and those requested so far.
struct Imported<'a> {
    tensors: &'a BTreeMap<String, ImportedTensor>,
    used: RefCell<BTreeMap<String, &'a ImportedTensor>>,
}

impl Tensors for Imported<'_> {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, LpipsError> {
        let wrong = |reason: String| LpipsError::Import { reason };
        let tensor = self.tensors.get(name);
        let tensor = tensor.ok_or_else(|| wrong(format!("tensor {name} is missing")))?;
        if tensor.shape != shape || tensor.values.len() != shape.iter().product::<usize>() {
            return Err(wrong(format!(
                "tensor {name} is {:?}, expected {shape:?}",
                tensor.shape
            )));
        }
        if tensor.values.iter().any(|v| !v.is_finite()) {
            return Err(wrong(format!("tensor {name} has values that are not finite")));
        }
        self.used.borrow_mut().insert(name.to_owned(), tensor);
        Ok(tensor.values.clone())
    }
}

/// Recognises the network of `tensors`, features and heads under the names of torchvision and LPIPS, and returns it with the
/// bytes of its weights file. Other tensors are skipped.
///
/// # Errors
/// When a tensor of the network is missing, of another shape or not finite.
pub fn to_weights_file(tensors: &BTreeMap<String, ImportedTensor>) -> Result<(LpipsNet, Vec<u8>), LpipsError> {
    let wrong = |reason: String| LpipsError::Import { reason };
    let net = LpipsNet::recognise(|name| tensors.contains_key(name))
        .ok_or_else(|| wrong("no features of SqueezeNet, AlexNet or VGG16 were found".to_owned()))?;
    let imported = Imported {
        tensors,
        used: RefCell::default(),
    };
    Backbone::<f32>::from_weights(net, &imported)?;
    heads(net, &imported)?;
    let bytes: Vec<(String, &[usize], Vec<u8>)> = imported
        .used
        .into_inner()
        .into_iter()
        .map(|(name, tensor)| {
            let bytes = tensor.values.iter().flat_map(|v| v.to_le_bytes()).collect();
            (name, tensor.shape.as_slice(), bytes)
        })
        .collect();
    let views = bytes.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(Dtype::F32, shape.to_vec(), bytes).expect("the length matches the shape");
        (name, view)
    });
    let file = safetensors::serialize(views, None).map_err(|error| wrong(error.to_string()))?;
    Ok((net, file))
}
