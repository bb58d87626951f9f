//! Named tensors in safetensors files: in checkpoints, and in the files beside a scene.

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;

/// A named array of numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTensor {
    /// Unique within its owner.
    pub name: String,
    /// Lengths of the dimensions.
    pub shape: Vec<usize>,
    dtype: Dtype,
    bytes: Vec<u8>,
}

impl NamedTensor {
    /// 32-bit floats, as many as `shape` holds.
    pub fn f32s(name: impl Into<String>, shape: Vec<usize>, values: &[f32]) -> Self {
        Self {
            name: name.into(),
            shape,
            dtype: Dtype::F32,
            bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        }
    }

    /// Double-precision numbers, one-dimensional.
    pub(crate) fn f64s(name: impl Into<String>, values: &[f64]) -> Self {
        Self {
            name: name.into(),
            shape: vec![values.len()],
            dtype: Dtype::F64,
            bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        }
    }

    /// Integers, one-dimensional.
    pub fn u64s(name: impl Into<String>, values: &[u64]) -> Self {
        Self {
            name: name.into(),
            shape: vec![values.len()],
            dtype: Dtype::U64,
            bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        }
    }

    /// The same tensor, with `prefix` before its name.
    pub fn prefixed(self, prefix: &str) -> Self {
        let name = format!("{prefix}{}", self.name);
        Self { name, ..self }
    }

    /// The type of its numbers.
    pub(crate) fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Its numbers, little-endian.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Its name, and its view for the safetensors crate.
    ///
    /// # Panics
    /// When shape and values do not match: a bug in its owner.
    pub(crate) fn view(&self) -> (&str, TensorView<'_>) {
        let view = TensorView::new(self.dtype, self.shape.clone(), &self.bytes).expect("shape and values agree");
        (&self.name, view)
    }
}

/// `tensors` as a safetensors file with `metadata` in its header: one pair, since the order of several would vary between runs.
pub fn to_bytes(tensors: &[NamedTensor], (key, value): (&str, String)) -> Vec<u8> {
    let metadata = HashMap::from([(key.to_owned(), value)]);
    safetensors::serialize(tensors.iter().map(NamedTensor::view), Some(metadata)).expect("in memory")
}

/// The tensors of a file with a common prefix.
#[derive(Clone, Copy)]
pub struct TensorSource<'a> {
    file: &'a SafeTensors<'a>,
    prefix: &'a str,
}

impl<'a> TensorSource<'a> {
    /// The tensors of `file` that begin with `prefix`.
    pub fn new(file: &'a SafeTensors<'a>, prefix: &'a str) -> Self {
        Self { file, prefix }
    }

    /// The tensor named `name`, of type `dtype`.
    ///
    /// # Errors
    /// One line, when it is missing or of another type.
    pub(crate) fn view(&self, name: &str, dtype: Dtype) -> Result<TensorView<'a>, String> {
        let name = format!("{}{name}", self.prefix);
        let view = self.file.tensor(&name).map_err(|error| error.to_string())?;
        if view.dtype() == dtype {
            Ok(view)
        } else {
            Err(format!("{name} is not {dtype:?}"))
        }
    }

    /// The 32-bit floats named `name`.
    pub fn f32s(&self, name: &str) -> Option<Vec<f32>> {
        let view = self.view(name, Dtype::F32).ok()?;
        Some(decoded(&view, f32::from_le_bytes))
    }

    /// The 32-bit floats named `name`, of shape `[rows, N]`.
    ///
    /// # Errors
    /// One line, when they are missing or of another shape.
    pub fn rows<const N: usize>(&self, name: &str, rows: usize) -> Result<Vec<[f32; N]>, String> {
        let view = self.view(name, Dtype::F32).map_err(|_| format!("{name} is missing"))?;
        if view.shape() != [rows, N] {
            return Err(format!("{name} has the shape {:?}, not [{rows}, {N}]", view.shape()));
        }
        let values = decoded(&view, f32::from_le_bytes);
        Ok(values.as_chunks().0.to_vec())
    }

    /// The integers named `name`.
    pub fn u64s(&self, name: &str) -> Option<Vec<u64>> {
        self.required_u64s(name).ok()
    }

    /// The integers named `name`.
    ///
    /// # Errors
    /// One line, when they are missing or of another type.
    pub(crate) fn required_u64s(&self, name: &str) -> Result<Vec<u64>, String> {
        Ok(decoded(&self.view(name, Dtype::U64)?, u64::from_le_bytes))
    }

    /// The double-precision numbers named `name`.
    ///
    /// # Errors
    /// One line, when they are missing or of another type.
    pub(crate) fn required_f64s(&self, name: &str) -> Result<Vec<f64>, String> {
        Ok(decoded(&self.view(name, Dtype::F64)?, f64::from_le_bytes))
    }
}

/// The numbers of a tensor, each of `N` bytes.
fn decoded<T, const N: usize>(view: &TensorView, from_bytes: impl Fn([u8; N]) -> T) -> Vec<T> {
    let bytes = view.data().as_chunks::<N>().0;
    bytes.iter().map(|bytes| from_bytes(*bytes)).collect()
}
