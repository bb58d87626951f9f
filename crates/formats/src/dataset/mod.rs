//! Datasets of posed photographs. A new layout is one file here and one arm in each `match` below.
//!
//! A layout's reader returns what the files declare ([`declared::DeclaredDataset`]); [`assemble`] then reads the image headers, skips
//! unusable views, and creates the [`Dataset`] with undistorted cameras at the requested size.

mod assemble;
mod blender;
pub(crate) mod bundler;
pub(crate) mod colmap;
mod declared;
mod files;
mod images;
mod linked;
pub(crate) mod llff;
pub(crate) mod meshroom;
pub(crate) mod metashape;
pub(crate) mod nerfies;
mod nerfstudio;
mod npy;
pub(crate) mod nvm;
pub(crate) mod openmvg;
pub(crate) mod opensfm;
mod panoramas;
pub(crate) mod phone;
mod readout;
pub(crate) mod realitycapture;
mod sibling_folder;
mod split;
mod tokens;
mod tracks;
pub(crate) mod transforms;
mod visible;
mod world;

use crate::FormatError;
pub(crate) use assemble::{colmap_orientation, oriented_size};
use declared::DeclaredDataset;
pub(crate) use declared::DeclaredPoints;
pub use files::is_image_name;
pub(crate) use files::list_files;
use irradia_scene::Dataset;
pub(crate) use npy::parse_table;
pub use panoramas::{PANORAMA_MASKS, PANORAMAS};
pub use readout::Readout;
use serde::{Deserialize, Serialize};
pub use sibling_folder::SiblingFolder;
pub use split::Holdout;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// The layouts of datasets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DatasetFormat {
    /// `cameras`, `images` and `points3D` as `.bin` or `.txt` in `sparse/N`, `sparse`, the folder itself or `colmap/sparse/N`.
    Colmap,
    /// nerfstudio's and instant-ngp's `transforms.json`.
    Nerfstudio,
    /// `transforms_train.json` and `transforms_test.json`, like NeRF's synthetic scenes.
    Blender,
    /// `poses_bounds.npy`.
    Llff,
    /// `dataset.json` and a folder `camera`: Nerfies, HyperNeRF.
    Nerfies,
    /// `reconstruction.json` of OpenSfM and OpenDroneMap.
    Opensfm,
    /// `sfm_data.json`.
    Openmvg,
    /// Meshroom's `.sfm` files with poses.
    Meshroom,
    /// Cameras exported by Metashape as XML.
    Metashape,
    /// A CSV of cameras, or an XMP beside each photograph, by RealityCapture.
    RealityCapture,
    /// `keyframes` of Polycam.
    Polycam,
    /// `metadata.json` and a folder `rgb`.
    Record3d,
    /// VisualSfM's `.nvm`.
    Nvm,
    /// `bundle.out` with a list of photographs.
    Bundler,
}

impl DatasetFormat {
    /// All of them, in the order in which a folder is tested.
    ///
    /// The layout that was prepared last takes precedence: `transforms.json` is made from a COLMAP model that may be beside it. But
    /// `poses_bounds.npy` comes last, since it contains less than the COLMAP model that it is made from.
    pub const ALL: [Self; 14] = [
        Self::Blender,
        Self::Nerfstudio,
        Self::Nerfies,
        Self::Colmap,
        Self::Opensfm,
        Self::Openmvg,
        Self::Meshroom,
        Self::Metashape,
        Self::RealityCapture,
        Self::Polycam,
        Self::Record3d,
        Self::Nvm,
        Self::Bundler,
        Self::Llff,
    ];

    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Colmap => "colmap",
            Self::Nerfstudio => "nerfstudio",
            Self::Blender => "blender",
            Self::Llff => "llff",
            Self::Nerfies => "nerfies",
            Self::Opensfm => "opensfm",
            Self::Openmvg => "openmvg",
            Self::Meshroom => "meshroom",
            Self::Metashape => "metashape",
            Self::RealityCapture => "realitycapture",
            Self::Polycam => "polycam",
            Self::Record3d => "record3d",
            Self::Nvm => "nvm",
            Self::Bundler => "bundler",
        }
    }

    fn expected_files(self) -> &'static str {
        match self {
            Self::Colmap => "{cameras,images}.{bin,txt} in sparse/0, sparse, the folder or colmap/sparse/0 (COLMAP)",
            Self::Nerfstudio => "transforms.json (nerfstudio, instant-ngp)",
            Self::Blender => "transforms_train.json (Blender)",
            Self::Llff => "poses_bounds.npy (LLFF)",
            Self::Nerfies => "dataset.json and a folder camera (Nerfies)",
            Self::Opensfm => "reconstruction.json (OpenSfM)",
            Self::Openmvg => "sfm_data.json (OpenMVG)",
            Self::Meshroom => "an .sfm file with poses (Meshroom)",
            Self::Metashape => "an .xml of cameras (Metashape)",
            Self::RealityCapture => "a .csv of cameras or .xmp files (RealityCapture)",
            Self::Polycam => "keyframes (Polycam)",
            Self::Record3d => "metadata.json and a folder rgb (Record3D)",
            Self::Nvm => "an .nvm file (VisualSfM)",
            Self::Bundler => "bundle.out and list.txt (Bundler)",
        }
    }

    fn is_in(self, path: &Path) -> bool {
        match self {
            Self::Colmap => colmap::find_model(path).is_some(),
            Self::Nerfstudio => nerfstudio::find(path).is_some(),
            Self::Blender => path.join("transforms_train.json").is_file(),
            Self::Llff => path.join("poses_bounds.npy").is_file(),
            Self::Nerfies => nerfies::is_in(path),
            Self::Opensfm => opensfm::find(path).is_some(),
            Self::Openmvg => openmvg::find(path).is_some(),
            Self::Meshroom => meshroom::find(path).is_some(),
            Self::Metashape => metashape::find(path).is_some(),
            Self::RealityCapture => realitycapture::find(path).is_some(),
            Self::Polycam => phone::find_polycam(path).is_some(),
            Self::Record3d => phone::find_record3d(path).is_some(),
            Self::Nvm => nvm::find(path).is_some(),
            Self::Bundler => bundler::find(path).is_some(),
        }
    }

    /// The layout that `path` has, if any. `path` is a folder, or a nerfstudio JSON file.
    pub fn recognise(path: &Path) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.is_in(path))
    }
}

impl fmt::Display for DatasetFormat {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for DatasetFormat {
    type Err = FormatError;

    fn from_str(text: &str) -> Result<Self, FormatError> {
        let found = Self::ALL
            .into_iter()
            .find(|format| format.name().eq_ignore_ascii_case(text));
        found.ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            FormatError::Option(format!("`{text}` is not a dataset format; known formats: {known}"))
        })
    }
}

/// How to read a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct DatasetOptions {
    /// The layout; detected from the files when `None`.
    pub format: Option<DatasetFormat>,
    /// Factor by which photographs are downscaled, at least 1. A matching folder of smaller images (`images_4` for 4) is used
    /// directly; if only such folders exist, other factors are relative to the largest of them.
    pub downscale: f32,
    /// Photographs are downscaled until the longer side has at most this many pixels.
    pub max_side: Option<u32>,
    /// Which views are held out.
    pub holdout: Holdout,
    /// The folder of the photographs, if it is not where the layout expects it.
    pub images: Option<PathBuf>,
    /// How distorted photographs are used.
    pub lenses: Lenses,
    /// The rolling shutter of the film whose frames the photographs are; the camera's motion follows from the poses of neighbouring frames.
    pub readout: Option<Readout>,
}

/// How photographs by lenses that are not pinholes are used. If they keep their distortion, [`irradia_scene::Intrinsics::lens`] is the
/// lens.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lenses {
    /// Each is undistorted, or cut into the faces of a cube if one pinhole image would show too little of it.
    #[default]
    Undistorted,
    /// Those that would be cut into faces keep their distortion, the others are undistorted.
    Whole,
    /// Each keeps its distortion.
    Distorted,
}

impl Lenses {
    const ALL: [Self; 3] = [Self::Undistorted, Self::Whole, Self::Distorted];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Undistorted => "undistorted",
            Self::Whole => "whole",
            Self::Distorted => "distorted",
        }
    }
}

impl FromStr for Lenses {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let named = Self::ALL.into_iter().find(|lenses| lenses.name() == name);
        named.ok_or_else(|| "expected undistorted, whole or distorted".to_owned())
    }
}

/// The default limit on the longer side, in pixels, to which larger photographs are downscaled, as by the authors' code of 3DGS
/// with its default `--resolution -1` (Kerbl et al. 2023).
pub const DEFAULT_MAX_SIDE: u32 = 1600;

impl Default for DatasetOptions {
    fn default() -> Self {
        Self {
            format: None,
            downscale: 1.0,
            max_side: None,
            holdout: Holdout::AsDeclared,
            images: None,
            lenses: Lenses::default(),
            readout: None,
        }
    }
}

/// Reads a dataset: poses, cameras, points and the headers of the images. Pixels are loaded later, view by view.
///
/// Views are sorted by name and split by [`DatasetOptions::holdout`]. Skipped views (missing images, invalid poses) are listed in
/// [`Dataset::warnings`].
///
/// World: that of the files, unless the cameras are far from its origin or its unit is unusual, such as UTM coordinates or
/// millimetres. Then origin and unit are changed in `f64`, which [`Dataset::world_from_dataset`] records.
///
/// EXIF orientation: poses belong to the pixels as the tool that made them saw them. If the declared size has the aspect of the
/// stored image only, no orientation is applied; if it has the aspect of the upright image, it is applied; if both match (half
/// turns, square images) or none is declared, it is not, since COLMAP, nerfstudio and instant-ngp ignore it.
///
/// # Errors
/// When the folder is not a dataset (the error says what was expected), a file is unreadable or malformed, cameras have no
/// intrinsics or an unknown model, fewer than 3 views are usable, or none of them is left to train on.
pub fn read_dataset(path: &Path, options: &DatasetOptions) -> Result<Dataset, FormatError> {
    if !(options.downscale >= 1.0 && options.downscale.is_finite()) {
        return Err(FormatError::Option(format!(
            "downscale is {}; must be 1 or more",
            options.downscale
        )));
    }
    if options.holdout == Holdout::Every(0) || options.holdout == Holdout::Every(1) {
        return Err(FormatError::Option(
            "every view would be held out; hold out every 2nd or fewer".into(),
        ));
    }
    if options.max_side == Some(0) {
        return Err(FormatError::Option(
            "the longest side is 0 pixels; must be 1 or more".into(),
        ));
    }
    let format = match options.format {
        Some(format) if format.is_in(path) => Some(format),
        Some(_) => None,
        None => DatasetFormat::recognise(path),
    };
    let Some(format) = format else {
        // For a missing folder, report the system's error.
        let metadata = std::fs::metadata(path).map_err(|source| FormatError::Read {
            path: path.to_owned(),
            source,
        })?;
        if metadata.is_file() {
            return Err(FormatError::NotAFolder(path.to_owned()));
        }
        let requested = options
            .format
            .map_or(DatasetFormat::ALL.to_vec(), |format| vec![format]);
        return Err(FormatError::NotADataset {
            path: path.to_owned(),
            expected: requested
                .into_iter()
                .map(DatasetFormat::expected_files)
                .collect::<Vec<_>>()
                .join("; "),
        });
    };
    let mut declared: DeclaredDataset = match format {
        DatasetFormat::Colmap => colmap::read(path, options.downscale)?,
        DatasetFormat::Nerfstudio => nerfstudio::read(path, options.downscale)?,
        DatasetFormat::Blender => blender::read(path, options.downscale)?,
        DatasetFormat::Llff => llff::read(path, options.downscale)?,
        DatasetFormat::Nerfies => nerfies::read(path, options.downscale)?,
        DatasetFormat::Opensfm => opensfm::read(path, options.downscale)?,
        DatasetFormat::Openmvg => openmvg::read(path, options.downscale)?,
        DatasetFormat::Meshroom => meshroom::read(path, options.downscale)?,
        DatasetFormat::Metashape => metashape::read(path, options.downscale)?,
        DatasetFormat::RealityCapture => realitycapture::read(path, options.downscale)?,
        DatasetFormat::Polycam => phone::read_polycam(path, options.downscale)?,
        DatasetFormat::Record3d => phone::read_record3d(path, options.downscale)?,
        DatasetFormat::Nvm => nvm::read(path, options.downscale)?,
        DatasetFormat::Bundler => bundler::read(path, options.downscale)?,
    };
    if let Some(folder) = &options.images {
        images::relocate(&mut declared, folder, options.downscale)?;
    }
    // COLMAP and LLFF have searched masks beside the folder of photographs that they chose; Blender scenes have none.
    if !matches!(
        format,
        DatasetFormat::Colmap | DatasetFormat::Llff | DatasetFormat::Blender
    ) {
        sibling_folder::find_masks(&mut declared);
    }
    // Maps of rendered scenes are ground truth for comparisons, not input.
    match format {
        DatasetFormat::Blender => {
            for view in &mut declared.views {
                (view.depth, view.normals) = (None, None);
            }
        }
        _ => sibling_folder::find_maps(&mut declared),
    }
    assemble::assemble(declared, options)
}
