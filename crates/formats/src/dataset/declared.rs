//! What a dataset's files declare, before any image is opened: the common form into which all layouts are read.

use super::files::relative_name;
use glam::{DMat3, DQuat, DVec3};
use irradia_scene::{Intrinsics, Lens, PointCloud, Pose, RollingShutter, Similarity};
use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};

pub(super) struct DeclaredDataset {
    /// Display name: `COLMAP (binary)`.
    pub kind: &'static str,
    /// The dataset's folder.
    pub root: PathBuf,
    pub views: Vec<DeclaredView>,
    pub points: Option<DeclaredPoints>,
    /// Factor by which the images must still be downscaled.
    pub downscale: f32,
    pub warnings: Vec<String>,
}

pub(super) struct DeclaredView {
    /// Relative to the root, with forward slashes.
    pub name: String,
    /// `None` when no such file exists.
    pub image: Option<PathBuf>,
    pub mask: Option<PathBuf>,
    /// The depth map.
    pub depth: Option<PathBuf>,
    /// The normal map.
    pub normals: Option<PathBuf>,
    /// `None` when the numbers do not form a pose.
    pub pose: Option<DeclaredPose>,
    pub camera: DeclaredCamera,
    /// Nearest and farthest depth along +Z, world units, as in the file.
    pub depth_bounds: Option<[f64; 2]>,
    /// In the source's own unit.
    pub time: Option<f32>,
    pub points_seen: Vec<u32>,
    /// How the camera moved, in the files' own unit.
    pub shutter: Option<RollingShutter>,
    /// `None` when the dataset does not declare it.
    pub split: Option<Split>,
}

impl DeclaredView {
    /// A view of which only these values are declared; its name is the image's path below `root`, or `name` if there is no image.
    pub fn posed(
        root: &Path,
        name: &str,
        image: Option<PathBuf>,
        pose: Option<DeclaredPose>,
        camera: DeclaredCamera,
    ) -> Self {
        let name = relative_name(root, image.as_deref().unwrap_or(Path::new(name)));
        Self {
            // Photographs may lie in a folder beside `root`.
            name: name.trim_start_matches("../").to_owned(),
            image,
            mask: None,
            depth: None,
            normals: None,
            pose,
            camera,
            depth_bounds: None,
            time: None,
            points_seen: Vec::new(),
            shutter: None,
            split: None,
        }
    }

    /// Its name below the folder of the photographs: `a/b.jpg` of `images/a/b.jpg`.
    pub fn name_without_folder(&self) -> &str {
        self.name.split_once('/').map_or(&self.name, |(_, below)| below)
    }
}

/// A pose in the files' own coordinates, which may be too large for `f32`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DeclaredPose {
    /// World from camera (x right, y down, z forward).
    pub rotation: DQuat,
    /// Camera centre.
    pub position: DVec3,
}

impl DeclaredPose {
    /// The pose, if its numbers form one.
    pub fn checked(self) -> Option<Self> {
        self.in_world(&Similarity::IDENTITY).is_valid().then_some(self)
    }

    /// The pose in the world of `world_from_dataset`.
    pub fn in_world(&self, world_from_dataset: &Similarity) -> Pose {
        Pose {
            rotation: self.rotation.as_quat(),
            position: world_from_dataset.apply(self.position).as_vec3(),
        }
    }
}

/// Coloured points in the files' own coordinates.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct DeclaredPoints {
    /// `[N]`, finite in `f32` but not exactly representable.
    pub positions: Vec<DVec3>,
    /// `[N]` sRGB, 8 bits.
    pub colors: Vec<[u8; 3]>,
}

impl DeclaredPoints {
    /// Adds a point; false if its coordinates are not finite in `f32`.
    pub fn push(&mut self, position: DVec3, color: [u8; 3]) -> bool {
        let finite = position.as_vec3().is_finite();
        if finite {
            self.positions.push(position);
            self.colors.push(color);
        }
        finite
    }

    /// The points in the world of `world_from_dataset`.
    pub fn in_world(self, world_from_dataset: &Similarity) -> PointCloud {
        let positions = self.positions.into_iter();
        PointCloud {
            positions: positions.map(|p| world_from_dataset.apply(p).as_vec3()).collect(),
            colors: self.colors,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Split {
    Train,
    Test,
    /// In neither list.
    Unlisted,
}

/// Intrinsics as declared: size and principal point may be taken from the image file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DeclaredCamera {
    /// The size, in pixels, to which the other numbers refer; the image file's if `None`.
    pub size: Option<[f64; 2]>,
    pub focal: Focal,
    /// The image's centre if `None`.
    pub center: Option<[f64; 2]>,
    pub lens: Lens,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Focal {
    /// `fx, fy`.
    Pixels([f64; 2]),
    /// Horizontal and vertical field of view, radians; square pixels if one is `None`.
    Angles([Option<f64>; 2]),
    /// Of a panorama: a full turn wide and half a turn high.
    Panorama,
}

impl DeclaredCamera {
    /// The camera of equirectangular panoramas.
    pub fn panorama() -> Self {
        Self {
            size: None,
            focal: Focal::Panorama,
            center: None,
            lens: Lens::Equirectangular,
        }
    }

    /// The camera of an image file of `width` x `height` pixels.
    pub fn at_size(&self, width: u32, height: u32) -> Intrinsics {
        let actual = [f64::from(width), f64::from(height)];
        let declared = self.size.unwrap_or(actual);
        let from_angle = |side: usize, angle: f64| 0.5 * declared[side] / (0.5 * angle).tan();
        let focal = match self.focal {
            Focal::Pixels(focal) => focal,
            Focal::Panorama => [declared[0] / TAU, declared[1] / PI],
            Focal::Angles([Some(x), Some(y)]) => [from_angle(0, x), from_angle(1, y)],
            Focal::Angles([Some(x), None]) => [from_angle(0, x); 2],
            Focal::Angles([None, y]) => [from_angle(1, y.unwrap_or(f64::NAN)); 2],
        };
        let center = self.center.unwrap_or([0.5 * declared[0], 0.5 * declared[1]]);
        let scale = [actual[0] / declared[0], actual[1] / declared[1]];
        Intrinsics {
            width,
            height,
            fx: (focal[0] * scale[0]) as f32,
            fy: (focal[1] * scale[1]) as f32,
            cx: (center[0] * scale[0]) as f32,
            cy: (center[1] * scale[1]) as f32,
            lens: self.lens,
        }
    }
}

/// A distortion model whose coefficients are all zero is a pinhole.
pub(super) fn lens_or_pinhole(lens: Lens) -> Lens {
    let distorts = match lens {
        Lens::Pinhole => false,
        Lens::Opencv { k, p } => k.iter().chain(&p).any(|v| *v != 0.0),
        Lens::Fov { omega } => omega != 0.0,
        // The fisheye model distorts even with zeros.
        Lens::Fisheye { .. } | Lens::Equirectangular => true,
    };
    if distorts { lens } else { Lens::Pinhole }
}

/// A pose from the camera's axes (right, down, forward; any length) and centre in the world; `None` when they are not
/// finite, not roughly perpendicular, or left-handed.
pub(super) fn pose_from_axes(right: DVec3, down: DVec3, forward: DVec3, position: DVec3) -> Option<DeclaredPose> {
    let axes = [right, down, forward].map(DVec3::try_normalize);
    let [Some(x), Some(y), Some(z)] = axes else {
        return None;
    };
    // Files have few digits; more than this (3 degrees) is not rounding.
    let skew = x.dot(y).abs().max(y.dot(z).abs()).max(z.dot(x).abs());
    if !(skew < 0.05 && x.cross(y).dot(z) > 0.0) {
        return None;
    }
    let z = z.normalize();
    let x = (x - z * x.dot(z)).normalize();
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z));
    DeclaredPose {
        rotation: rotation.normalize(),
        position,
    }
    .checked()
}
