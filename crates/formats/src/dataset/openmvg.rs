//! `sfm_data.json` of OpenMVG (<https://openmvg.readthedocs.io/en/latest/openMVG/sfm/sfm/>). Poses are a camera-from-world rotation, row
//! by row, and the camera's centre. Points have no colours.

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredPose, Focal, lens_or_pinhole, pose_from_axes};
use super::files::{file_named, find_image, locate_image};
use super::linked::{Linked, LinkedView};
use super::tracks::declared_points;
use crate::error::read_and_parse;
use crate::json::parse_json;
use crate::{FormatError, Malformed};
use irradia_scene::Lens;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Where OpenMVG's scripts write it.
const FILE_PATHS: [&str; 3] = [
    "sfm_data.json",
    "reconstruction/sfm_data.json",
    "reconstruction_sequential/sfm_data.json",
];
/// Where the photographs are, relative to the file, if not where it says.
const IMAGE_FOLDERS: [&str; 3] = ["images", "", "../images"];
/// The colour of points, sRGB.
const POINT_COLOR: [u8; 3] = [128; 3];

/// The file.
#[derive(Clone, Debug, Deserialize)]
pub struct SfmData {
    /// Folder of the photographs.
    #[serde(default)]
    root_path: String,
    views: Vec<Entry<Pointer<View>>>,
    intrinsics: Vec<Entry<Pointer<Intrinsics>>>,
    extrinsics: Vec<Entry<Pose>>,
    #[serde(default)]
    structure: Vec<Entry<Landmark>>,
}

/// An entry of a map.
#[derive(Clone, Debug, Deserialize)]
struct Entry<T> {
    key: u32,
    value: T,
}

/// An object behind a pointer.
#[derive(Clone, Debug, Deserialize)]
struct Pointer<T> {
    ptr_wrapper: Wrapper<T>,
}

#[derive(Clone, Debug, Deserialize)]
struct Wrapper<T> {
    data: T,
}

/// A photograph.
#[derive(Clone, Debug, Deserialize)]
struct View {
    #[serde(default)]
    local_path: String,
    filename: String,
    id_view: u32,
    id_intrinsic: u32,
    id_pose: u32,
}

/// A camera: its model follows from the coefficients that it has.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Intrinsics {
    /// What it has in common with simpler models, in files of later versions.
    value0: Option<Box<Intrinsics>>,
    width: Option<f64>,
    height: Option<f64>,
    focal_length: Option<f64>,
    principal_point: Option<[f64; 2]>,
    disto_k1: Option<[f64; 1]>,
    disto_k3: Option<[f64; 3]>,
    /// k1, k2, k3, p1, p2.
    disto_t2: Option<[f64; 5]>,
    fisheye: Option<[f64; 4]>,
}

#[derive(Clone, Debug, Deserialize)]
struct Pose {
    rotation: [[f64; 3]; 3],
    center: [f64; 3],
}

#[derive(Clone, Debug, Deserialize)]
struct Landmark {
    #[serde(rename = "X")]
    position: [f64; 3],
    /// By view.
    #[serde(default)]
    observations: Vec<Observation>,
}

#[derive(Clone, Debug, Deserialize)]
struct Observation {
    key: u32,
}

/// Whether a file has the name of this format.
pub(super) fn is_file_name(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with("sfm_data") && name.ends_with(".json")
}

pub(super) fn find(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return is_file_name(path).then(|| path.to_owned());
    }
    FILE_PATHS.into_iter().find_map(|name| file_named(path, name))
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = find(path).ok_or_else(|| FormatError::malformed(path, "contains no sfm_data.json"))?;
    let (photographs, linked) = read_and_parse(&file, |bytes| parse_openmvg(bytes)?.linked())?;
    let root = file.parent().unwrap_or(Path::new("."));
    let locate = |name: &str| {
        let image = find_image(&photographs.join(name));
        image.or_else(|| locate_image(root, &IMAGE_FOLDERS, name))
    };
    Ok(linked.dataset("OpenMVG", root, downscale, "no pose or no camera", &locate))
}

/// Parses an `sfm_data.json`.
///
/// # Errors
/// When it is not JSON of that structure; with line and column.
pub fn parse_openmvg(bytes: &[u8]) -> Result<SfmData, Malformed> {
    parse_json(bytes, "sfm_data file")
}

impl SfmData {
    /// The folder of the photographs, and the reconstruction.
    fn linked(self) -> Result<(PathBuf, Linked<u32>), Malformed> {
        if self.extrinsics.is_empty() {
            let message =
                "has no poses; name the sfm_data.json of the reconstruction, or convert its sfm_data.bin to it";
            return Err(Malformed(message.into()));
        }
        let cameras = self.intrinsics.iter().map(|entry| {
            let camera = entry.value.ptr_wrapper.data.camera()?;
            Ok((entry.key, camera))
        });
        let cameras = cameras.collect::<Result<_, Malformed>>()?;
        let views = self.views.iter().map(|entry| {
            let view = &entry.value.ptr_wrapper.data;
            LinkedView {
                key: view.id_view,
                pose: Some(view.id_pose),
                camera: Some(view.id_intrinsic),
                name: view.name(),
            }
        });
        let tracks = self.structure.into_iter().map(|entry| {
            let views = entry.value.observations.iter().map(|view| view.key).collect();
            (entry.value.position, POINT_COLOR, views)
        });
        let (points, points_seen) = declared_points(tracks);
        let linked = Linked {
            views: views.collect(),
            poses: self
                .extrinsics
                .iter()
                .map(|entry| (entry.key, entry.value.declared()))
                .collect(),
            cameras,
            points,
            points_seen,
        };
        Ok((self.root_path.into(), linked))
    }
}

impl View {
    /// Its path below the folder of the photographs.
    fn name(&self) -> String {
        let folder = self.local_path.replace('\\', "/");
        let path = Path::new(folder.trim_matches('/')).join(self.filename.replace('\\', "/"));
        path.to_string_lossy().into_owned()
    }
}

impl Intrinsics {
    /// A value of its own, or of what it has in common with simpler models.
    fn get<T>(&self, value: fn(&Self) -> Option<T>) -> Option<T> {
        value(self).or_else(|| self.value0.as_deref()?.get(value))
    }

    fn camera(&self) -> Result<DeclaredCamera, Malformed> {
        let size = self.get(|own| own.width).zip(self.get(|own| own.height));
        let Some((width, height)) = size.filter(|(width, height)| *width >= 1.0 && *height >= 1.0) else {
            return Err(Malformed("a camera has no width and height".into()));
        };
        // Panoramas have nothing else.
        let Some(focal) = self.get(|own| own.focal_length) else {
            return Ok(DeclaredCamera::panorama());
        };
        let lens = match (self.disto_k1, self.disto_k3, self.disto_t2, self.fisheye) {
            (Some([k1]), ..) => Lens::brown([k1, 0.0, 0.0], [0.0; 2]),
            (_, Some(k), ..) => Lens::brown(k, [0.0; 2]),
            (_, _, Some([k1, k2, k3, p1, p2]), _) => Lens::brown([k1, k2, k3], [p1, p2]),
            (_, _, _, Some(k)) => Lens::fisheye(k),
            _ => Lens::Pinhole,
        };
        Ok(DeclaredCamera {
            size: Some([width, height]),
            focal: Focal::Pixels([focal; 2]),
            center: self.get(|own| own.principal_point),
            lens: lens_or_pinhole(lens),
        })
    }
}

impl Pose {
    fn declared(&self) -> Option<DeclaredPose> {
        let [right, down, forward] = self.rotation.map(Into::into);
        pose_from_axes(right, down, forward, self.center.into())
    }
}
