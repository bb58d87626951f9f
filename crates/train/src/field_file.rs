//! `field.safetensors`: a trained radiance field, with its configuration in the header.

use crate::tensor_file::{self, NamedTensor, TensorSource};
use crate::trainer::TrainError;
use irradia_field::{Field, FieldConfig, FieldState, Space};
use safetensors::tensor::SafeTensors;
use serde::{Deserialize, Serialize};

/// The header's only key.
const METADATA_KEY: &str = "irradia_field";
const FORMAT_VERSION: u32 = 1;

/// The content of the header.
#[derive(Serialize, Deserialize)]
struct Header {
    format: u32,
    config: FieldConfig,
    space: Space,
}

/// `field` as a safetensors file.
pub fn to_bytes(field: &Field) -> Vec<u8> {
    let tensors = field.tensors().into_iter();
    let tensors: Vec<NamedTensor> = tensors
        .map(|(name, shape, values)| NamedTensor::f32s(name, shape, values))
        .collect();
    let header = Header {
        format: FORMAT_VERSION,
        config: field.config.clone(),
        space: field.space,
    };
    let header = serde_json::to_string(&header).expect("plain values");
    tensor_file::to_bytes(&tensors, (METADATA_KEY, header))
}

/// The inverse of [`to_bytes`].
///
/// # Errors
/// If the bytes are not such a file, or are truncated.
pub fn from_bytes(bytes: &[u8]) -> Result<Field, TrainError> {
    let wrong = |why: String| TrainError::Checkpoint(format!("not a field of this program: {why}"));
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| wrong(e.to_string()))?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| wrong(e.to_string()))?;
    let text = header
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get(METADATA_KEY));
    let text = text.ok_or_else(|| wrong("its header does not describe one".into()))?;
    let header: Header = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
    if header.format != FORMAT_VERSION {
        return Err(wrong(format!("format {}, expected {FORMAT_VERSION}", header.format)));
    }
    header.config.check()?;
    // Before allocating what the header merely claims.
    let (wanted, found) = (header.config.value_count(), bytes.len() / size_of::<f32>());
    if wanted > found {
        return Err(wrong(format!(
            "it should hold {wanted} numbers and has room for {found}"
        )));
    }
    let Space { center, scale, .. } = header.space;
    if !(scale > 0.0 && scale.is_finite() && center.iter().all(|c| c.is_finite())) {
        return Err(wrong("its space is empty".into()));
    }
    let tensors = TensorSource::new(&file, "");
    Ok(Field::from_tensors(header.config, header.space, |name| {
        tensors.f32s(name)
    })?)
}

/// A field in training, for a checkpoint.
pub(crate) fn state_tensors(state: &FieldState) -> Vec<NamedTensor> {
    let tensors = state.tensors().into_iter();
    let whole = NamedTensor::u64s("whole", &[state.step, state.rays as u64]);
    tensors
        .map(|(name, shape, values)| NamedTensor::f32s(name, shape, values))
        .chain([whole])
        .collect()
}

/// The inverse of [`state_tensors`], for a field of this configuration.
///
/// # Errors
/// One line, when a tensor is missing or has another length.
pub(crate) fn state_from(config: FieldConfig, space: Space, tensors: TensorSource) -> Result<FieldState, String> {
    let whole = tensors.u64s("whole").unwrap_or_default();
    let [step, rays] = whole[..] else {
        return Err("whole is missing or has the wrong length".into());
    };
    FieldState::from_tensors(config, space, step, rays as usize, |name| tensors.f32s(name))
        .map_err(|error| error.to_string())
}
