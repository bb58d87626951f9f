//! Captures of Nerfies and HyperNeRF: `dataset.json`, `metadata.json`, a file per camera in `camera` and photographs in `rgb/1x` or
//! smaller (<https://github.com/google/nerfies#datasets>). Poses are camera-from-world rotations and camera centres, OpenCV axes.

use super::declared::{
    DeclaredCamera, DeclaredDataset, DeclaredPose, DeclaredView, Focal, Split, lens_or_pinhole, pose_from_axes,
};
use super::files::find_image;
use crate::error::read_and_parse;
use crate::json::parse_json;
use crate::{FormatError, Malformed};
use glam::DVec3;
use irradia_scene::Lens;
use serde::Deserialize;
use std::collections::{HashMap, HashSet};
use std::path::Path;

/// Downscale factors of the folders of photographs.
const DOWNSCALE_FACTORS: [u32; 5] = [1, 2, 4, 8, 16];

/// `dataset.json`.
#[derive(Clone, Debug, Deserialize)]
pub struct NerfiesDataset {
    /// All photographs.
    pub ids: Vec<String>,
    /// Those to train on.
    #[serde(default)]
    pub train_ids: Vec<String>,
    /// Those held out.
    #[serde(default)]
    pub val_ids: Vec<String>,
}

/// The entry of a photograph in `metadata.json`.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct NerfiesMetadata {
    /// Number of its deformation (Nerfies), which counts time.
    pub warp_id: Option<f64>,
    /// Number of its moment (HyperNeRF).
    pub time_id: Option<f64>,
}

/// A file of `camera`.
#[derive(Clone, Debug, Deserialize)]
pub struct NerfiesCamera {
    /// Rows: the camera's axes (right, down, forward) in the world.
    pub orientation: [[f64; 3]; 3],
    /// The camera's centre.
    pub position: [f64; 3],
    /// Pixels, along x.
    pub focal_length: f64,
    /// Pixels.
    pub principal_point: [f64; 2],
    /// Focal length along y over that along x.
    #[serde(default = "one")]
    pub pixel_aspect_ratio: f64,
    /// k1, k2, k3.
    #[serde(default, alias = "radial")]
    pub radial_distortion: [f64; 3],
    /// p1, p2.
    #[serde(default, alias = "tangential")]
    pub tangential_distortion: [f64; 2],
    /// Width and height, pixels.
    pub image_size: [f64; 2],
}

fn one() -> f64 {
    1.0
}

pub(super) fn is_in(path: &Path) -> bool {
    path.join("dataset.json").is_file() && path.join("camera").is_dir()
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let dataset = read_and_parse(&path.join("dataset.json"), parse_nerfies_dataset)?;
    let file = path.join("metadata.json");
    let metadata: HashMap<String, NerfiesMetadata> = if file.is_file() {
        read_and_parse(&file, |bytes| parse_json(bytes, "metadata file of Nerfies"))?
    } else {
        HashMap::new()
    };
    let folder = |factor: u32| path.join(format!("rgb/{factor}x"));
    let exact = DOWNSCALE_FACTORS
        .into_iter()
        .find(|factor| downscale == *factor as f32 && folder(*factor).is_dir());
    let Some(factor) = exact.or_else(|| DOWNSCALE_FACTORS.into_iter().find(|factor| folder(*factor).is_dir())) else {
        return Err(FormatError::malformed(path, "has no photographs in rgb/1x, rgb/2x, .."));
    };
    let mut warnings = Vec::new();
    if exact.is_none() && factor > 1 {
        warnings.push(format!(
            "the photographs are taken from `rgb/{factor}x`, and any downscale is relative to it"
        ));
    }
    let [train, held_out] = [&dataset.train_ids, &dataset.val_ids].map(|ids| ids.iter().collect::<HashSet<_>>());
    let mut views = Vec::with_capacity(dataset.ids.len());
    for id in &dataset.ids {
        // An id is a file name, and must not lead to another folder.
        if id.contains(['/', '\\']) {
            return Err(FormatError::malformed(
                &path.join("dataset.json"),
                format!("`{id}` is not a file name"),
            ));
        }
        let camera = read_and_parse(&path.join(format!("camera/{id}.json")), parse_nerfies_camera)?;
        let image = find_image(&folder(factor).join(format!("{id}.png")));
        let entry = metadata.get(id);
        let time = entry.and_then(|entry| entry.time_id.or(entry.warp_id));
        let split = if held_out.contains(id) {
            Some(Split::Test)
        } else if train.contains(id) {
            Some(Split::Train)
        } else {
            (!train.is_empty()).then_some(Split::Unlisted)
        };
        views.push(DeclaredView {
            time: time.map(|time| time as f32).filter(|time| time.is_finite()),
            split,
            ..DeclaredView::posed(
                path,
                &format!("rgb/{factor}x/{id}.png"),
                image,
                camera.pose(),
                camera.intrinsics(),
            )
        });
    }
    Ok(DeclaredDataset {
        kind: "Nerfies",
        root: path.to_owned(),
        views,
        points: None,
        downscale: if exact.is_some() { 1.0 } else { downscale },
        warnings,
    })
}

/// Parses `dataset.json`.
///
/// # Errors
/// When it is not JSON with `ids`.
pub fn parse_nerfies_dataset(bytes: &[u8]) -> Result<NerfiesDataset, Malformed> {
    parse_json(bytes, "dataset file of Nerfies")
}

/// Parses a file of `camera`.
///
/// # Errors
/// When it is not JSON with these keys.
pub fn parse_nerfies_camera(bytes: &[u8]) -> Result<NerfiesCamera, Malformed> {
    parse_json(bytes, "camera file of Nerfies")
}

impl NerfiesCamera {
    fn pose(&self) -> Option<DeclaredPose> {
        let [right, down, forward] = self.orientation.map(DVec3::from);
        pose_from_axes(right, down, forward, self.position.into())
    }

    fn intrinsics(&self) -> DeclaredCamera {
        DeclaredCamera {
            size: Some(self.image_size).filter(|[w, h]| *w >= 1.0 && *h >= 1.0),
            focal: Focal::Pixels([self.focal_length, self.focal_length * self.pixel_aspect_ratio]),
            center: Some(self.principal_point),
            lens: lens_or_pinhole(Lens::brown(self.radial_distortion, self.tangential_distortion)),
        }
    }
}
