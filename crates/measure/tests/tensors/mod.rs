//! Reading of images and golden tensors.

use irradia_scene::Image;
use safetensors::SafeTensors;
use std::path::PathBuf;

/// An 8-bit file as `[H, W, 3]` in \[0, 1\].
#[allow(dead_code, reason = "each test file is a separate crate and uses what it needs")]
pub fn read_image(path: PathBuf) -> Image {
    let rgb = image::open(&path).expect("the file is there").to_rgb8();
    let data = rgb.as_raw().iter().map(|v| f32::from(*v) / 255.0).collect();
    Image::new(rgb.width(), rgb.height(), 3, data)
}

/// The `[H, W, 3]` float tensor `name`.
pub fn tensor_image(tensors: &SafeTensors, name: &str) -> Image {
    let tensor = tensors.tensor(name).expect("the tensor is there");
    let data = tensor
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|b| f32::from_le_bytes(*b))
        .collect();
    Image::new(tensor.shape()[1] as u32, tensor.shape()[0] as u32, 3, data)
}

/// The double-precision tensor `name`, flat.
#[allow(dead_code, reason = "each test file is a separate crate and uses what it needs")]
pub fn tensor_f64(tensors: &SafeTensors, name: &str) -> Vec<f64> {
    let tensor = tensors.tensor(name).expect("the tensor is there");
    tensor
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|b| f64::from_le_bytes(*b))
        .collect()
}
