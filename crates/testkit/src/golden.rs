use safetensors::{Dtype, SafeTensors};
use std::collections::HashMap;
use std::path::Path;

/// A golden file's arrays in double precision.
pub struct Golden {
    arrays: HashMap<String, Vec<f64>>,
}

impl Golden {
    /// Reads a safetensors file of floats, integers or bytes.
    ///
    /// # Panics
    /// When it cannot be read: golden files are part of the test.
    pub fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let arrays = file
            .iter()
            .map(|(name, tensor)| {
                let data = tensor.data();
                let values: Vec<f64> = match tensor.dtype() {
                    Dtype::F64 => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
                    Dtype::F32 => data
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| f64::from(f32::from_le_bytes(*b)))
                        .collect(),
                    Dtype::I64 => data
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| i64::from_le_bytes(*b) as f64)
                        .collect(),
                    Dtype::I32 => data
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| f64::from(i32::from_le_bytes(*b)))
                        .collect(),
                    Dtype::U8 | Dtype::BOOL => data.iter().map(|b| f64::from(*b)).collect(),
                    other => panic!("{name}: {other:?} is not supported"),
                };
                (name.to_owned(), values)
            })
            .collect();
        Self { arrays }
    }

    /// The array `name`.
    ///
    /// # Panics
    /// When there is no such array.
    pub fn get(&self, name: &str) -> &[f64] {
        self.arrays.get(name).unwrap_or_else(|| panic!("no array {name}"))
    }

    /// The array `name` in single precision.
    pub fn get_f32(&self, name: &str) -> Vec<f32> {
        self.get(name).iter().map(|v| *v as f32).collect()
    }

    /// The only value of `name`.
    pub fn scalar(&self, name: &str) -> f64 {
        let values = self.get(name);
        assert_eq!(values.len(), 1, "{name} is one value");
        values[0]
    }
}
