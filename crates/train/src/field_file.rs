//! `field.safetensors`: a radiance field that can be looked at again, with its configuration in the header.

use crate::trainer::TrainError;
use irradia_field::{Field, FieldConfig, Space};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// The header's one key: with several, their order would differ from run to run.
const KEY: &str = "irradia_field";
const FORMAT: u32 = 1;

/// What the header says.
#[derive(Serialize, Deserialize)]
struct Header {
    format: u32,
    config: FieldConfig,
    space: Space,
}

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
    let header = Header {
        format: FORMAT,
        config: field.config.clone(),
        space: field.space,
    };
    let header = serde_json::to_string(&header).expect("plain values");
    let metadata = HashMap::from([(KEY.to_owned(), header)]);
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
    let text = header.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
    let text = text.ok_or_else(|| wrong("its header does not describe one".into()))?;
    let header: Header = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
    if header.format != FORMAT {
        return Err(wrong(format!("format {} and not {FORMAT}", header.format)));
    }
    header.config.check()?;
    // Before there is memory for what the header only claims.
    let (wanted, found) = (header.config.numbers(), bytes.len() / size_of::<f32>());
    if wanted > found {
        return Err(wrong(format!(
            "it should hold {wanted} numbers and has room for {found}"
        )));
    }
    let Space { center, scale, .. } = header.space;
    if !(scale > 0.0 && scale.is_finite() && center.iter().all(|c| c.is_finite())) {
        return Err(wrong("its space has no size".into()));
    }
    Ok(Field::from_tensors(header.config, header.space, |name| {
        floats(&file, name)
    })?)
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
