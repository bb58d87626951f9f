//! The parts of a glTF document that lead to splats.

use super::{EXTENSION, SPZ_EXTENSIONS};
use crate::splats::axes::Affine;
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde_json::Value;
use std::collections::HashMap;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Document {
    #[serde(default)]
    pub extensions_required: Vec<String>,
    pub scene: Option<usize>,
    #[serde(default)]
    pub scenes: Vec<Scene>,
    #[serde(default)]
    pub nodes: Vec<Node>,
    #[serde(default)]
    pub meshes: Vec<Mesh>,
    #[serde(default)]
    pub accessors: Vec<Accessor>,
    #[serde(default)]
    pub buffer_views: Vec<BufferView>,
    #[serde(default)]
    pub buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
pub(super) struct Scene {
    #[serde(default)]
    pub nodes: Vec<usize>,
}

#[derive(Deserialize)]
pub(super) struct Node {
    pub mesh: Option<usize>,
    #[serde(default)]
    pub children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

impl Node {
    /// The transformation from the node's space to its parent's.
    pub fn transform(&self) -> Affine {
        if let Some(matrix) = self.matrix {
            let matrix = DMat4::from_cols_array(&matrix);
            return Affine {
                linear: DMat3::from_mat4(matrix),
                translation: matrix.w_axis.truncate(),
            };
        }
        let rotation = self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
        let scale = self.scale.map_or(DVec3::ONE, DVec3::from);
        Affine {
            linear: DMat3::from_quat(rotation.normalize()) * DMat3::from_diagonal(scale),
            translation: self.translation.map_or(DVec3::ZERO, DVec3::from),
        }
    }
}

#[derive(Deserialize)]
pub(super) struct Mesh {
    #[serde(default)]
    pub primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
pub(super) struct Primitive {
    #[serde(default)]
    pub attributes: HashMap<String, usize>,
    #[serde(default)]
    extensions: Value,
}

impl Primitive {
    /// Whether it has splats.
    pub fn has_splats(&self) -> bool {
        !self.extensions[EXTENSION].is_null() || self.spz().is_some()
    }

    /// The buffer view of its splats if they are packed as SPZ: within the extension, or, in the first drafts, beside it.
    pub fn spz(&self) -> Option<u64> {
        let locations = [&self.extensions[EXTENSION]["extensions"], &self.extensions];
        let found = locations
            .iter()
            .flat_map(|location| SPZ_EXTENSIONS.map(|name| &location[name]["bufferView"]));
        found.into_iter().find_map(Value::as_u64)
    }

    /// Whether its colours are linear light instead of sRGB-encoded.
    pub fn is_linear(&self) -> bool {
        self.extensions[EXTENSION]["colorSpace"] == "lin_rec709_display"
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    pub buffer_view: Option<usize>,
    #[serde(default)]
    pub byte_offset: u64,
    pub component_type: u32,
    #[serde(default)]
    pub normalized: bool,
    pub count: u64,
    #[serde(rename = "type")]
    pub kind: String,
    #[serde(default)]
    pub sparse: Value,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct BufferView {
    pub buffer: usize,
    #[serde(default)]
    pub byte_offset: u64,
    pub byte_length: u64,
    pub byte_stride: Option<u64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Buffer {
    pub uri: Option<String>,
    pub byte_length: u64,
}
