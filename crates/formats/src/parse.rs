//! Every parser as a function of bytes: for fuzzing and the hostile tests, and for data already in memory. None of them
//! panics on any input or allocates more than a small multiple of the input's size.

pub use crate::dataset::bundler::parse_bundle as bundle;
pub use crate::dataset::colmap::{
    ColmapCamera, ColmapImage, ColmapPoint, binary as colmap_binary, text as colmap_text,
};
pub use crate::dataset::llff::{LlffPose, parse_poses_bounds as poses_bounds};
pub use crate::dataset::meshroom::parse_meshroom as meshroom;
pub use crate::dataset::nerfies::{parse_nerfies_camera as nerfies_camera, parse_nerfies_dataset as nerfies_dataset};
pub use crate::dataset::nvm::parse_nvm as nvm;
pub use crate::dataset::openmvg::parse_openmvg as openmvg;
pub use crate::dataset::opensfm::parse_opensfm as opensfm;
pub use crate::dataset::phone::{parse_polycam as polycam, parse_record3d as record3d};
pub use crate::dataset::realitycapture::{
    parse_realitycapture_csv as realitycapture_csv, parse_realitycapture_xmp as realitycapture_xmp,
};
pub use crate::dataset::transforms::{CameraKeys, Frame, Transforms, parse_transforms as transforms};
pub use crate::photos::{parse_camera_tags as camera_tags, parse_gimbal as gimbal};
pub use crate::points_ply::parse_points_ply as points_ply;
pub use crate::splats::antimatter::parse as splat;
pub use crate::splats::gltf::parse as glb;
pub use crate::splats::ksplat::parse as ksplat;
pub use crate::splats::ply::parse_splat_ply as splat_ply;
pub use crate::splats::sog::parse as sog;
pub use crate::splats::spz::parse as spz;

/// A `.gltf` file that contains its buffers.
///
/// # Errors
/// The same as for [`glb`].
pub fn gltf(text: &[u8]) -> Result<irradia_scene::GaussianCloud, crate::Malformed> {
    let absent = |_: &str| Err(crate::Malformed("its buffer is in another file".into()));
    crate::splats::gltf::parse_gltf(text, &absent)
}

/// The pixels of a HEIC photograph: width, height, and 3 or 4 channels of 8 bits.
///
/// # Errors
/// When it is damaged, or not coded as HEVC.
pub fn heic(bytes: &[u8]) -> Result<crate::Pixels, crate::Malformed> {
    crate::image_file::decode_heic(bytes).map_err(|error| crate::Malformed(error.to_string()))
}

/// The pixels of an `OpenEXR` image: width, height, and 3 or 4 channels of 8 bits.
///
/// # Errors
/// When it is damaged, or has no colours.
pub fn exr(bytes: &[u8]) -> Result<crate::Pixels, crate::Malformed> {
    crate::image_file::decode_exr(bytes).map_err(|error| crate::Malformed(error.to_string()))
}

/// All tensors of a PyTorch state dict or a safetensors file; see [`crate::read_tensors`].
///
/// # Errors
/// When the bytes are neither, or a tensor is truncated or not in 32-bit floats.
pub fn tensors(bytes: &[u8]) -> Result<std::collections::BTreeMap<String, crate::Tensor>, crate::Malformed> {
    crate::tensors::parse(bytes, &|_| true)
}

/// The number of cameras in an XML file by Metashape.
///
/// # Errors
/// When it is not XML, has no cameras, or has a lens that is not supported.
pub fn metashape(bytes: &[u8]) -> Result<usize, crate::Malformed> {
    crate::dataset::metashape::parse_metashape(bytes).map(|cameras| cameras.len())
}
