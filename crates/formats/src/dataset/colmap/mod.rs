//! COLMAP's sparse models: <https://colmap.github.io/format.html>. Its pixel convention is ours: the centre of the first
//! pixel is at (0.5, 0.5). Its poses are camera-from-world.

pub mod binary;
pub mod text;
mod write;

use super::declared::{
    DeclaredCamera, DeclaredDataset, DeclaredPoints, DeclaredPose, DeclaredView, Focal, lens_or_pinhole,
};
use super::files::{ImageFolder, choose_image_folder, find_image, locate_image, relative_name};
use super::sibling_folder::SiblingFolder;
use crate::error::read_and_parse;
use crate::{FormatError, Malformed};
use glam::{DQuat, DVec3};
use irradia_scene::Lens;
use std::collections::HashMap;
use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};
pub use write::{ColmapModel, PosedImage, TrackedPoint, write_colmap};

/// A row of `cameras`.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapCamera {
    /// Its id.
    pub id: u32,
    /// COLMAP's name of the model: `PINHOLE`, `OPENCV`, ..
    pub model: String,
    /// Width in pixels.
    pub width: u64,
    /// Height in pixels.
    pub height: u64,
    /// The model's parameters, in COLMAP's order.
    pub params: Vec<f64>,
}

/// A row of `images`.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapImage {
    /// Rotation camera-from-world, `w, x, y, z`.
    pub rotation: [f64; 4],
    /// Translation camera-from-world.
    pub translation: [f64; 3],
    /// [`ColmapCamera::id`].
    pub camera_id: u32,
    /// Path below the folder of images.
    pub name: String,
    /// [`ColmapPoint::id`] of the points seen.
    pub points: Vec<u64>,
}

/// A row of `points3D`.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapPoint {
    /// Its id.
    pub id: u64,
    /// World.
    pub position: [f64; 3],
    /// sRGB.
    pub color: [u8; 3],
}

/// The models by COLMAP's number, with their names and numbers of parameters (`models.h` of COLMAP).
const CAMERA_MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// Maximum number of models of one folder that are considered.
const MAX_MODELS: usize = 1000;
/// Folders with a subfolder per model: COLMAP's own, and that of nerfstudio's layout of COLMAP's models.
const MODELS_FOLDERS: [&str; 2] = ["sparse", "colmap/sparse"];

/// The folder of a model and its format.
pub(super) struct ModelFiles {
    folder: PathBuf,
    binary: bool,
}

/// The model in `folder`, if it is complete; binary before text.
fn model_in(folder: &Path) -> Option<ModelFiles> {
    [true, false].into_iter().find_map(|binary| {
        let files = ModelFiles {
            folder: folder.to_owned(),
            binary,
        };
        (files.path("cameras").is_file() && files.path("images").is_file()).then_some(files)
    })
}

/// The complete models of the numbered subfolders of the first of [`MODELS_FOLDERS`] that has some, in order: COLMAP writes one for each
/// part of a scene that it cannot connect, of which users delete some.
fn numbered_models(root: &Path) -> Vec<ModelFiles> {
    let models_in = |folder: &str| -> Vec<ModelFiles> {
        let folder = root.join(folder);
        let entries = std::fs::read_dir(&folder).into_iter().flatten().flatten();
        let number = |entry: std::fs::DirEntry| entry.file_name().to_str()?.parse::<u32>().ok();
        let mut numbers: Vec<u32> = entries.filter_map(number).collect();
        numbers.sort_unstable();
        let model = |number: u32| model_in(&folder.join(number.to_string()));
        numbers.into_iter().filter_map(model).take(MAX_MODELS).collect()
    };
    let mut found = MODELS_FOLDERS.into_iter().map(models_in);
    found.find(|models| !models.is_empty()).unwrap_or_default()
}

/// The first complete model of `sparse/0`, `sparse`, the folder itself, `colmap/sparse/0` and other numbered folders.
pub(super) fn find_model(root: &Path) -> Option<ModelFiles> {
    let mut usual = ["sparse/0", "sparse", "", "colmap/sparse/0"].into_iter();
    usual
        .find_map(|below| model_in(&root.join(below)))
        .or_else(|| numbered_models(root).into_iter().next())
}

/// The model to read, which is the one with the most photographs, and a warning if there are several.
fn largest_model(root: &Path) -> Result<Option<(ModelFiles, Option<String>)>, FormatError> {
    let mut models = numbered_models(root);
    if models.len() < 2 {
        return Ok(find_model(root).map(|model| (model, None)));
    }
    let counts: Vec<usize> = models
        .iter()
        .map(|model| Ok(model.images()?.len()))
        .collect::<Result<_, FormatError>>()?;
    let (max_count, total) = (counts.iter().copied().max().unwrap_or(0), counts.iter().sum::<usize>());
    let largest = counts.iter().position(|count| *count == max_count).unwrap_or(0);
    let warning = format!(
        "COLMAP made {} models that it could not connect; {} is used, with {max_count} of their {total} photographs",
        models.len(),
        relative_name(root, &models[largest].folder)
    );
    Ok(Some((models.swap_remove(largest), Some(warning))))
}

impl ModelFiles {
    fn path(&self, table: &str) -> PathBuf {
        self.folder
            .join(format!("{table}.{}", if self.binary { "bin" } else { "txt" }))
    }

    fn read<T>(
        &self,
        table: &str,
        binary: fn(&[u8]) -> Result<T, Malformed>,
        text: fn(&[u8]) -> Result<T, Malformed>,
    ) -> Result<T, FormatError> {
        read_and_parse(&self.path(table), if self.binary { binary } else { text })
    }

    /// The points, which may be in the other format than the cameras.
    fn points(&self) -> Result<Option<Vec<ColmapPoint>>, FormatError> {
        let other = Self {
            folder: self.folder.clone(),
            binary: !self.binary,
        };
        let existing = [self, &other]
            .into_iter()
            .find(|files| files.path("points3D").is_file());
        existing
            .map(|files| files.read("points3D", binary::parse_points, text::parse_points))
            .transpose()
    }

    fn images(&self) -> Result<Vec<ColmapImage>, FormatError> {
        self.read("images", binary::parse_images, text::parse_images)
    }
}

/// The folder of the model in `root` (of several, the one with the most images), its cameras and its images.
///
/// # Errors
/// When there is no complete model, or its files are damaged.
pub fn read_colmap_poses(root: &Path) -> Result<(PathBuf, Vec<ColmapCamera>, Vec<ColmapImage>), FormatError> {
    let (files, _) =
        largest_model(root)?.ok_or_else(|| FormatError::malformed(root, "contains no COLMAP model (sparse/0)"))?;
    let cameras = files.read("cameras", binary::parse_cameras, text::parse_cameras)?;
    let images = files.images()?;
    Ok((files.folder, cameras, images))
}

/// The photograph that a model names, and its path below `folder`, the folder of the photographs in `root`. The name may begin with that
/// folder, or be a path on another computer.
fn locate_photograph(root: &Path, folder: &str, name: String) -> (Option<PathBuf>, String) {
    let photographs = root.join(folder);
    if let Some(file) = find_image(&photographs.join(&name)) {
        return (Some(file), name);
    }
    let mut folders = [folder, ""].into_iter();
    let file = folders.find_map(|folder| locate_image(root, &[folder], &name));
    let below = file.as_ref().and_then(|file| file.strip_prefix(&photographs).ok());
    let name = below.map_or(name, |below| relative_name(Path::new(""), below));
    (file, name)
}

pub(super) fn read(root: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let Some((files, model_warning)) = largest_model(root)? else {
        return Err(FormatError::malformed(root, "contains no COLMAP model"));
    };
    let mut cameras = HashMap::new();
    for camera in files.read("cameras", binary::parse_cameras, text::parse_cameras)? {
        let declared = declared_camera(&camera).map_err(|source| FormatError::Malformed {
            path: files.path("cameras"),
            source,
        })?;
        cameras.insert(camera.id, declared);
    }
    let images = files.images()?;
    let (points, index_of) = files.points()?.map(point_cloud).unwrap_or_default();

    let folder = choose_image_folder(root, downscale).unwrap_or(ImageFolder {
        name: String::new(),
        downscale,
        warning: None,
    });
    let masks = SiblingFolder::masks(root, &folder.name);
    let mut views = Vec::with_capacity(images.len());
    for image in images {
        let camera = *cameras.get(&image.camera_id).ok_or_else(|| {
            let message = format!(
                "{} uses camera {}, which cameras does not list",
                image.name, image.camera_id
            );
            FormatError::malformed(&files.path("images"), message)
        })?;
        let (file, name) = locate_photograph(root, &folder.name, image.name.replace('\\', "/"));
        let mut points_seen: Vec<u32> = image.points.iter().filter_map(|id| index_of.get(id)).copied().collect();
        points_seen.sort_unstable();
        points_seen.dedup();
        views.push(DeclaredView {
            image: file,
            mask: masks.as_ref().and_then(|masks| masks.file_of(&name)),
            name: if folder.name.is_empty() {
                name
            } else {
                format!("{}/{name}", folder.name)
            },
            pose: pose(&image),
            camera,
            depth_bounds: None,
            time: None,
            points_seen,
            shutter: None,
            split: None,
            depth: None,
            normals: None,
        });
    }
    let mut warnings: Vec<String> = folder.warning.into_iter().chain(model_warning).collect();
    let masked = views.iter().filter(|view| view.mask.is_some()).count();
    warnings.extend(masks.and_then(|masks| masks.mask_warning(views.len(), masked)));
    Ok(DeclaredDataset {
        kind: if files.binary {
            "COLMAP (binary)"
        } else {
            "COLMAP (text)"
        },
        root: root.to_owned(),
        views,
        points: Some(points),
        downscale: folder.downscale,
        warnings,
    })
}

fn pose(image: &ColmapImage) -> Option<DeclaredPose> {
    let [w, x, y, z] = image.rotation;
    let camera_from_world = DQuat::from_xyzw(x, y, z, w);
    let length = camera_from_world.length();
    if !(length.is_finite() && length > 1e-6) {
        return None;
    }
    let world_from_camera = (camera_from_world / length).inverse();
    DeclaredPose {
        rotation: world_from_camera,
        position: -(world_from_camera * DVec3::from(image.translation)),
    }
    .checked()
}

fn point_cloud(points: Vec<ColmapPoint>) -> (DeclaredPoints, HashMap<u64, u32>) {
    let mut cloud = DeclaredPoints::default();
    let mut index_of = HashMap::with_capacity(points.len());
    for point in points {
        let index = cloud.positions.len() as u32;
        if cloud.push(point.position.into(), point.color) {
            index_of.insert(point.id, index);
        }
    }
    (cloud, index_of)
}

/// Focal lengths and principal point, px, and the lens.
///
/// # Errors
/// When the model is not supported, or the number of parameters is wrong.
fn intrinsics(camera: &ColmapCamera) -> Result<([f64; 2], [f64; 2], Lens), Malformed> {
    let opencv = |k: [f64; 6], p: [f64; 2]| Lens::Opencv { k, p };
    Ok(match (camera.model.as_str(), &camera.params[..]) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Lens::Pinhole),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Lens::Pinhole),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => ([f, f], [cx, cy], opencv([k1, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], opencv([k1, k2, 0.0, 0.0, 0.0, 0.0], [0.0; 2])),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            ([fx, fy], [cx, cy], opencv([k1, k2, 0.0, 0.0, 0.0, 0.0], [p1, p2]))
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            ([fx, fy], [cx, cy], opencv([k1, k2, k3, k4, k5, k6], [p1, p2]))
        }
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => ([fx, fy], [cx, cy], Lens::fisheye([k1, k2, k3, k4])),
        ("SIMPLE_FISHEYE", &[f, cx, cy]) => ([f, f], [cx, cy], Lens::fisheye([0.0; 4])),
        ("FISHEYE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Lens::fisheye([0.0; 4])),
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k1]) => ([f, f], [cx, cy], Lens::fisheye([k1, 0.0, 0.0, 0.0])),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], Lens::fisheye([k1, k2, 0.0, 0.0])),
        ("THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1]) => {
            let lens = Lens::Fisheye {
                k: [k1, k2, k3, k4],
                p: [p1, p2],
                s: [sx1, sy1],
            };
            ([fx, fy], [cx, cy], lens)
        }
        ("FOV", &[fx, fy, cx, cy, omega]) => ([fx, fy], [cx, cy], Lens::Fov { omega }),
        ("EQUIRECTANGULAR", &[w, h]) => ([w / TAU, h / PI], [0.5 * w, 0.5 * h], Lens::Equirectangular),
        (model, params) => {
            let count = CAMERA_MODELS
                .iter()
                .find(|(name, _)| *name == model)
                .map(|(_, count)| *count);
            return Err(Malformed(match count {
                Some(count) if count != params.len() => {
                    format!(
                        "camera {} of model {model} has {} parameters, not {count}",
                        camera.id,
                        params.len()
                    )
                }
                _ => format!(
                    "camera {} has the model {model}, which is not supported; run COLMAP's image_undistorter, or calibrate \
                     with OPENCV, FULL_OPENCV or OPENCV_FISHEYE",
                    camera.id
                ),
            }));
        }
    })
}

impl ColmapCamera {
    /// `fx, fy, cx, cy, k1, k2, p1, p2` of OpenCV's lens; `None` for other lenses.
    pub fn opencv(&self) -> Option<[f64; 8]> {
        let ([fx, fy], [cx, cy], lens) = intrinsics(self).ok()?;
        let [k1, k2, p1, p2] = match lens {
            Lens::Pinhole => [0.0; 4],
            Lens::Opencv {
                k: [k1, k2, 0.0, 0.0, 0.0, 0.0],
                p: [p1, p2],
            } => [k1, k2, p1, p2],
            _ => return None,
        };
        Some([fx, fy, cx, cy, k1, k2, p1, p2])
    }

    /// `fx, fy, cx, cy, k1, k2, k3, k4` of OpenCV's fisheye; `None` for other lenses.
    pub fn fisheye(&self) -> Option<[f64; 8]> {
        let ([fx, fy], [cx, cy], lens) = intrinsics(self).ok()?;
        match lens {
            Lens::Fisheye {
                k: [k1, k2, k3, k4],
                p: [0.0, 0.0],
                s: [0.0, 0.0],
            } => Some([fx, fy, cx, cy, k1, k2, k3, k4]),
            _ => None,
        }
    }
}

fn declared_camera(camera: &ColmapCamera) -> Result<DeclaredCamera, Malformed> {
    let (focal, center, lens) = intrinsics(camera)?;
    if camera.width == 0 || camera.height == 0 {
        return Err(Malformed(format!(
            "camera {} has a size of {}x{} pixels",
            camera.id, camera.width, camera.height
        )));
    }
    Ok(DeclaredCamera {
        size: Some([camera.width as f64, camera.height as f64]),
        focal: Focal::Pixels(focal),
        center: Some(center),
        lens: lens_or_pinhole(lens),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(model: &str, params: &[f64]) -> Result<DeclaredCamera, Malformed> {
        declared_camera(&ColmapCamera {
            id: 7,
            model: model.into(),
            width: 100,
            height: 80,
            params: params.to_vec(),
        })
    }

    #[test]
    fn each_model_assigns_its_parameters() {
        let numbers: Vec<f64> = (1..=12).map(f64::from).collect();
        let full = camera("FULL_OPENCV", &numbers).unwrap();
        assert_eq!(
            full.lens,
            Lens::Opencv {
                k: [5.0, 6.0, 9.0, 10.0, 11.0, 12.0],
                p: [7.0, 8.0]
            }
        );
        assert_eq!((full.focal, full.center), (Focal::Pixels([1.0, 2.0]), Some([3.0, 4.0])));
        let opencv = camera("OPENCV", &numbers[..8]).unwrap();
        assert_eq!(
            opencv.lens,
            Lens::Opencv {
                k: [5.0, 6.0, 0.0, 0.0, 0.0, 0.0],
                p: [7.0, 8.0]
            }
        );
        let fisheye = camera("OPENCV_FISHEYE", &numbers[..8]).unwrap();
        assert_eq!(fisheye.lens, Lens::fisheye([5.0, 6.0, 7.0, 8.0]));
        let radial = camera("RADIAL", &numbers[..5]).unwrap();
        assert_eq!(
            (radial.focal, radial.center),
            (Focal::Pixels([1.0, 1.0]), Some([2.0, 3.0]))
        );
        assert_eq!(
            radial.lens,
            Lens::Opencv {
                k: [4.0, 5.0, 0.0, 0.0, 0.0, 0.0],
                p: [0.0; 2]
            }
        );
        assert_eq!(
            camera("SIMPLE_RADIAL", &[9.0, 50.0, 40.0, 0.0]).unwrap().lens,
            Lens::Pinhole
        );
        assert_eq!(
            camera("THIN_PRISM_FISHEYE", &numbers).unwrap().lens,
            Lens::Fisheye {
                k: [5.0, 6.0, 9.0, 10.0],
                p: [7.0, 8.0],
                s: [11.0, 12.0]
            }
        );
        let panorama = camera("EQUIRECTANGULAR", &[100.0, 80.0]).unwrap();
        assert_eq!(panorama.lens, Lens::Equirectangular);
        assert_eq!(
            (panorama.focal, panorama.center),
            (Focal::Pixels([100.0 / TAU, 80.0 / PI]), Some([50.0, 40.0]))
        );
        assert_eq!(
            camera("RADIAL_FISHEYE", &numbers[..5]).unwrap().lens,
            Lens::fisheye([4.0, 5.0, 0.0, 0.0])
        );
    }

    #[test]
    fn models_are_found_in_the_layouts_of_colmap_and_of_nerfstudio() {
        let image = |i: usize| PosedImage {
            image: ColmapImage {
                rotation: [1.0, 0.0, 0.0, 0.0],
                translation: [0.0; 3],
                camera_id: 1,
                name: format!("{i}.jpg"),
                points: Vec::new(),
            },
            keypoints: Vec::new(),
        };
        let write = |folder: PathBuf, images: usize| {
            let images = (0..images).map(image).collect();
            let model = ColmapModel {
                images,
                ..ColmapModel::default()
            };
            write_colmap(&folder, &model).unwrap();
        };
        for (parent, place) in [("sparse", "sparse/1"), ("colmap/sparse", "colmap/sparse/1")] {
            let root = tempfile::tempdir().unwrap();
            assert!(find_model(root.path()).is_none());
            for (i, images) in [2, 5].into_iter().enumerate() {
                write(root.path().join(parent).join(i.to_string()), images);
            }
            assert!(find_model(root.path()).is_some());
            let (model, warning) = largest_model(root.path()).unwrap().unwrap();
            assert_eq!(model.images().unwrap().len(), 5);
            let warning = warning.unwrap();
            assert!(
                warning.contains(&format!("; {place} is used, with 5 of their 7")),
                "{warning}"
            );
        }
    }

    #[test]
    fn unknown_models_and_wrong_counts_are_named() {
        let error = camera("EUCM", &[1.0; 6]).unwrap_err().to_string();
        assert!(error.contains("EUCM") && error.contains("image_undistorter"), "{error}");
        let error = camera("PINHOLE", &[1.0; 3]).unwrap_err().to_string();
        assert!(error.contains("has 3 parameters, not 4"), "{error}");
    }
}
