//! Reads and writes files: datasets of posed photographs, splat scenes, point clouds, images, and other programs' tensors.
//!
//! Foreign conventions are converted in this crate: however a file defines poses, pixels or colours, results follow the
//! conventions of [`irradia_scene`]. The parsers in [`parse`] take bytes and are fuzzed; no input makes them panic, and no
//! size that a file declares is allocated before it is compared with the size of the file.
#![forbid(unsafe_code)]

mod atomic;
mod bytes;
mod complete;
mod dataset;
mod describe;
mod error;
mod faces;
mod heic;
mod image_file;
mod json;
mod map_file;
mod open_exr;
mod pack;
pub mod parse;
mod photo;
mod photos;
mod ply;
mod points_ply;
mod splats;
mod tensors;
mod text;
mod undistort;
mod unpack;
mod valid_region;
mod xml;
mod zip;

pub use atomic::{StagedFile, folder_of, write_atomic};
pub use dataset::colmap::{
    ColmapCamera, ColmapImage, ColmapModel, ColmapPoint, PosedImage, TrackedPoint, read_colmap_poses, write_colmap,
};
pub use dataset::{
    DEFAULT_MAX_SIDE, DatasetFormat, DatasetOptions, Holdout, Lenses, PANORAMA_MASKS, PANORAMAS, Readout,
    SiblingFolder, is_image_name, read_dataset,
};
pub use describe::{Description, Kind, describe, detect};
pub use error::{FormatError, Malformed};
pub use image_file::{Pixels, read_image, write_png, write_png_16};
pub use pack::gzip;
pub use photos::{
    CameraTags, PanoramaFace, PhotoEntry, PhotoFolder, find_panoramas, photo_files, read_chosen_photos,
    read_photo_folder, read_photo_folders,
};
pub use points_ply::{read_points_ply, write_points_ply};
pub use splats::{
    Quality, SogDetail, SplatFile, SplatFormat, SpzVersion, WriteOptions, encode_splats, is_sog_folder,
    read_splat_file, read_splats, round_trip, splat_file_size, write_splats, write_splats_with,
};
pub use tensors::{Tensor, read_tensors};
