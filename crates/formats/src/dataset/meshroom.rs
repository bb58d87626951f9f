//! `.sfm` files of Meshroom, such as `cameras.sfm`: AliceVision's JSON, in which numbers are texts. Poses are a camera-from-world rotation,
//! column by column, and the camera's centre. Focal lengths are in pixels, or in mm on a sensor (from version 1.2.2); the principal point
//! is counted from the corner, or from the centre (from version 1.2.1). As in `jsonIO.cpp` of AliceVision, by which it reads its files.

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredPose, Focal, lens_or_pinhole, pose_from_axes};
use super::files::{first_file, locate_image};
use super::linked::{Linked, LinkedView};
use super::tracks::declared_points;
use crate::error::read_and_parse;
use crate::json::parse_json;
use crate::{FormatError, Malformed};
use glam::DVec3;
use irradia_scene::Lens;
use serde::Deserialize;
use serde_json::Value;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Where the photographs are, relative to the file, if not where it says.
const IMAGE_FOLDERS: [&str; 3] = ["", "images", "../images"];
/// Text that only a file with poses contains.
const POSES_KEY: &[u8] = b"\"poses\"";
/// The sensor's width if a file has none, mm.
const SENSOR_WIDTH_MM: f64 = 36.0;

/// The file.
#[derive(Clone, Debug, Deserialize)]
pub struct SfmFile {
    #[serde(default)]
    version: Numbers,
    views: Vec<View>,
    #[serde(default)]
    intrinsics: Vec<Intrinsics>,
    #[serde(default)]
    poses: Vec<PoseEntry>,
    #[serde(default)]
    structure: Vec<Landmark>,
}

/// A photograph.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    view_id: Id,
    pose_id: Option<Id>,
    /// Set for cameras of a rig, whose poses are relative to it.
    rig_id: Option<Id>,
    intrinsic_id: Option<Id>,
    path: String,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Intrinsics {
    intrinsic_id: Id,
    width: Numbers,
    height: Numbers,
    #[serde(default)]
    sensor_width: Numbers,
    /// Before version 1.2.8, the distortion as well.
    #[serde(rename = "type")]
    kind: String,
    distortion_type: Option<String>,
    #[serde(default)]
    px_focal_length: Numbers,
    #[serde(default)]
    focal_length: Numbers,
    #[serde(default)]
    pixel_ratio: Numbers,
    #[serde(default)]
    principal_point: Numbers,
    #[serde(default)]
    distortion_params: Numbers,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct PoseEntry {
    pose_id: Id,
    pose: CameraPose,
}

#[derive(Clone, Debug, Deserialize)]
struct CameraPose {
    transform: Transform,
}

#[derive(Clone, Debug, Deserialize)]
struct Transform {
    rotation: Numbers,
    center: Numbers,
}

#[derive(Clone, Debug, Deserialize)]
struct Landmark {
    #[serde(rename = "X")]
    position: Numbers,
    #[serde(default)]
    color: Numbers,
    #[serde(default)]
    observations: Vec<Observation>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Observation {
    /// The view.
    observation_id: Id,
}

/// A number that identifies an object.
#[derive(Clone, Debug, Hash, PartialEq, Eq, Deserialize)]
#[serde(from = "Value")]
struct Id(String);

/// A number, or a list of them; none if the text is empty. What is not a number is NaN.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(from = "Value")]
struct Numbers(Vec<f64>);

impl From<Value> for Id {
    fn from(value: Value) -> Self {
        Self(value.as_str().map_or_else(|| value.to_string(), str::to_owned))
    }
}

impl From<Value> for Numbers {
    fn from(value: Value) -> Self {
        let number = |value: &Value| {
            let text = || value.as_str()?.parse().ok();
            value.as_f64().or_else(text).unwrap_or(f64::NAN)
        };
        Self(match &value {
            Value::Array(values) => values.iter().map(number).collect(),
            Value::String(text) if text.is_empty() => Vec::new(),
            other => vec![number(other)],
        })
    }
}

impl Numbers {
    fn first(&self) -> Option<f64> {
        self.0.first().copied()
    }

    /// The numbers, if there are as many.
    fn array<const N: usize>(&self) -> Option<[f64; N]> {
        self.0.as_slice().try_into().ok()
    }
}

pub(super) fn find(path: &Path) -> Option<PathBuf> {
    // `cameraInit.sfm` has no poses.
    let has_poses = |file: &Path| {
        let bytes = std::fs::read(file).unwrap_or_default();
        bytes.windows(POSES_KEY.len()).any(|word| word == POSES_KEY)
    };
    first_file(path, |file| {
        file.extension().is_some_and(|e| e.eq_ignore_ascii_case("sfm")) && has_poses(file)
    })
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = find(path).ok_or_else(|| FormatError::malformed(path, "contains no .sfm file with poses"))?;
    let linked = read_and_parse(&file, |bytes| parse_meshroom(bytes)?.linked())?;
    let root = file.parent().unwrap_or(Path::new("."));
    let locate = |name: &str| locate_image(root, &IMAGE_FOLDERS, name);
    let lack = "no pose, or one relative to a rig,";
    Ok(linked.dataset("Meshroom", root, downscale, lack, &locate))
}

/// Parses an `.sfm` file.
///
/// # Errors
/// When it is not JSON of that structure; with line and column.
pub fn parse_meshroom(bytes: &[u8]) -> Result<SfmFile, Malformed> {
    parse_json(bytes, ".sfm file")
}

impl SfmFile {
    fn version(&self) -> [u32; 3] {
        self.version.array().unwrap_or_default().map(|part: f64| part as u32)
    }

    fn linked(self) -> Result<Linked<Id>, Malformed> {
        let version = self.version();
        let mut cameras = HashMap::new();
        for intrinsics in self.intrinsics {
            let camera = intrinsics.camera(version)?;
            cameras.insert(intrinsics.intrinsic_id, camera);
        }
        let poses = self.poses.into_iter();
        let views = self.views.into_iter().map(|view| LinkedView {
            key: view.view_id,
            pose: view.pose_id.filter(|_| view.rig_id.is_none()),
            camera: view.intrinsic_id,
            name: view.path.replace('\\', "/"),
        });
        let tracks = self.structure.into_iter().map(|landmark| {
            let position = landmark.position.array().unwrap_or([f64::NAN; 3]);
            let color = landmark.color.array().unwrap_or([128.0; 3]);
            let views = landmark.observations.into_iter().map(|view| view.observation_id);
            (position, color.map(|value| value as u8), views.collect())
        });
        let (points, points_seen) = declared_points(tracks);
        Ok(Linked {
            views: views.collect(),
            poses: poses
                .map(|entry| (entry.pose_id, entry.pose.transform.pose()))
                .collect(),
            cameras,
            points,
            points_seen,
        })
    }
}

impl Transform {
    fn pose(&self) -> Option<DeclaredPose> {
        let rotation: [f64; 9] = self.rotation.array()?;
        let [right, down, forward] =
            [0, 1, 2].map(|row| DVec3::new(rotation[row], rotation[3 + row], rotation[6 + row]));
        let center: [f64; 3] = self.center.array()?;
        pose_from_axes(right, down, forward, center.into())
    }
}

impl Intrinsics {
    fn camera(&self, version: [u32; 3]) -> Result<DeclaredCamera, Malformed> {
        let size = self.width.first().zip(self.height.first());
        let Some((width, height)) = size.filter(|(width, height)| *width >= 1.0 && *height >= 1.0) else {
            return Err(Malformed("an intrinsic has no width and height".into()));
        };
        let focal = match self.px_focal_length.0[..] {
            [focal] => [focal; 2],
            [fx, fy] => [fx, fy],
            _ => {
                let sensor = self.sensor_width.first().unwrap_or(SENSOR_WIDTH_MM);
                let fx = self.focal_length.first().unwrap_or(f64::NAN) / sensor * width;
                let ratio = self.pixel_ratio.first().unwrap_or(1.0);
                // Earlier versions wrote the ratio of the focal lengths.
                [fx, if version < [1, 2, 5] { fx / ratio } else { fx * ratio }]
            }
        };
        let middle = [0.5 * width, 0.5 * height];
        let principal = self.principal_point.array().map(|[x, y]: [f64; 2]| {
            if version < [1, 2, 1] {
                [x, y]
            } else {
                [middle[0] + x, middle[1] + y]
            }
        });
        Ok(DeclaredCamera {
            size: Some([width, height]),
            focal: Focal::Pixels(focal),
            center: principal,
            lens: lens_or_pinhole(self.lens()?),
        })
    }

    fn lens(&self) -> Result<Lens, Malformed> {
        let distortion = match (self.kind.as_str(), self.distortion_type.as_deref()) {
            ("pinhole", distortion) => distortion.unwrap_or("none"),
            (kind, _) => kind,
        };
        Ok(match (distortion, &self.distortion_params.0[..]) {
            ("none" | "pinhole", _) => Lens::Pinhole,
            ("radial1" | "radialk1", &[k1]) => Lens::brown([k1, 0.0, 0.0], [0.0; 2]),
            ("radial3" | "radialk3", &[k1, k2, k3]) => Lens::brown([k1, k2, k3], [0.0; 2]),
            ("brown", &[k1, k2, k3, p1, p2]) => Lens::brown([k1, k2, k3], [p1, p2]),
            ("fisheye4" | "fisheye", &[k1, k2, k3, k4]) => Lens::fisheye([k1, k2, k3, k4]),
            (other, parameters) => {
                return Err(Malformed(format!(
                    "the camera type `{other}` with {} parameters is not supported; use pinhole, radial1, radial3, brown or fisheye4, or \
                     undistort the photographs",
                    parameters.len()
                )));
            }
        })
    }
}
