//! `field.safetensors`: a radiance field that can be looked at again, with its configuration in the header.

use crate::trainer::TrainError;
use irradia_field::{Field, FieldConfig, Space};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::de::DeserializeOwned;
use std::collections::HashMap;

const FORMAT: &str = "irradia-field-1";

/// `field` as a safetensors file.
pub fn to_bytes(field: &Field) -> Vec<u8> {
    let tensors = field.tensors();
    let arrays: Vec<(String, Vec<usize>, Vec<u8>)> = tensors
        .into_iter()
        .map(|(name, shape, values)| (name, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let views = arrays.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), bytes).expect("shape and bytes agree");
        (name.as_str(), view)
    });
    let metadata = HashMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        (
            "config".to_owned(),
            serde_json::to_string(&field.config).expect("plain values"),
        ),
        (
            "space".to_owned(),
            serde_json::to_string(&field.space).expect("plain values"),
        ),
    ]);
    safetensors::serialize(views, Some(metadata)).expect("in memory")
}

/// The field of [`to_bytes`].
///
/// # Errors
/// When the bytes are not such a file, or not a whole one.
pub fn from_bytes(bytes: &[u8]) -> Result<Field, TrainError> {
    let wrong = |why: String| TrainError::Checkpoint(format!("not a field of this program: {why}"));
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| wrong(e.to_string()))?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| wrong(e.to_string()))?;
    let metadata = header.metadata().clone().unwrap_or_default();
    if metadata.get("format").map(String::as_str) != Some(FORMAT) {
        return Err(wrong(format!("its format is not {FORMAT}")));
    }
    fn read<T: DeserializeOwned>(metadata: &HashMap<String, String>, name: &str) -> Result<T, String> {
        let text = metadata.get(name).ok_or_else(|| format!("no {name}"))?;
        serde_json::from_str(text).map_err(|e| format!("{name}: {e}"))
    }
    let config: FieldConfig = read(&metadata, "config").map_err(wrong)?;
    let space: Space = read(&metadata, "space").map_err(wrong)?;
    Ok(Field::from_tensors(config, space, |name| floats(&file, name))?)
}

/// The tensor `name` of 32-bit floats, if there is one.
pub(crate) fn floats(file: &SafeTensors, name: &str) -> Option<Vec<f32>> {
    let view = file.tensor(name).ok().filter(|view| view.dtype() == Dtype::F32)?;
    Some(
        view.data()
            .as_chunks()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect(),
    )
}
