//! Every parser as a function of bytes: what fuzzing and the hostile tests call, and what to use on data that is in
//! memory already. None of them panics on any input or allocates more than a small multiple of what it was given.

pub use crate::dataset::colmap::{
    ColmapCamera, ColmapImage, ColmapPoint, binary as colmap_binary, text as colmap_text,
};
pub use crate::dataset::llff::{LlffPose, parse_poses_bounds as poses_bounds};
pub use crate::dataset::transforms::{CameraKeys, Frame, Transforms, parse_transforms as transforms};
pub use crate::points_ply::parse_points_ply as points_ply;
pub use crate::splats::ply::parse_splat_ply as splat_ply;

/// All tensors of a PyTorch state dict or a safetensors file; see [`crate::read_tensors`].
///
/// # Errors
/// When the bytes are neither, or a tensor is not whole and in 32-bit floats.
pub fn tensors(bytes: &[u8]) -> Result<std::collections::BTreeMap<String, crate::Tensor>, crate::Malformed> {
    crate::tensors::parse(bytes, &|_| true)
}
