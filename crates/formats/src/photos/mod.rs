//! Folders of photographs without poses: which photographs there are, and which camera took them.

mod exif;
mod gimbal;
mod panorama;

use crate::dataset::{SiblingFolder, colmap_orientation, is_image_name, list_files, oriented_size};
use crate::error::read_file;
use crate::image_file::{decode, decode_jpeg_scaled, decode_mask, read_header, read_metadata};
use crate::photo::binarize;
use crate::{FormatError, Pixels, write_png};
pub use exif::{CameraTags, parse_camera_tags};
pub use gimbal::parse_gimbal;
use glam::DVec3;
use image::metadata::Orientation;
use irradia_scene::resize_area;
pub use panorama::{PanoramaFace, find_panoramas};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Extensions of image files that are not supported: cameras' raw files, and others.
const UNSUPPORTED_EXTENSIONS: [&str; 15] = [
    "dng", "cr2", "cr3", "nef", "arw", "orf", "rw2", "raf", "srw", "pef", "avif", "jxl", "bmp", "gif", "jp2",
];

/// A photograph on disk.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoEntry {
    /// File name.
    pub name: String,
    /// The file.
    pub path: PathBuf,
    /// Width in pixels as [`crate::read_dataset`] decodes it.
    pub width: u32,
    /// Height in pixels as [`crate::read_dataset`] decodes it.
    pub height: u32,
    /// What the camera wrote.
    pub tags: CameraTags,
    /// Hash of the bytes of the file and of its mask.
    pub hash: u64,
    /// Its mask, in the folder `masks`; pixels that are black in it are ignored.
    pub mask: Option<PathBuf>,
    /// Its depth map, in the folder `depths` or `depth`.
    pub depth: Option<PathBuf>,
    /// Its normal map, in the folder `normals` or `normal`.
    pub normals: Option<PathBuf>,
    /// The up direction in the axes of the decoded image (x right, y down, z forward), a unit vector, if the metadata give it: by a
    /// drone's gimbal, or by an EXIF orientation that is not applied because the image is decoded as stored.
    pub up: Option<DVec3>,
    orientation: Orientation,
    jpeg: bool,
}

impl PhotoEntry {
    /// Focal length in pixels, if the camera wrote it.
    pub fn focal_px(&self) -> Option<f64> {
        Some(self.tags.focal? * f64::from(self.width.max(self.height)))
    }

    /// By how many clockwise quarter turns, 0 to 3, the decoded image is turned from the camera's sensor, whose width is at least its
    /// height. Of a portrait whose metadata do not contain its orientation, one is assumed, as of phones held upright.
    pub fn quarter_turns(&self) -> u8 {
        match self.orientation {
            _ if self.width >= self.height => 0,
            Orientation::Rotate270 => 3,
            _ => 1,
        }
    }

    /// Width and height, px.
    pub fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }

    /// The pixels, with 3 or 4 channels; a large JPEG is decoded at a half, quarter or eighth of its size if its longer side still has
    /// at least `min_side` pixels.
    ///
    /// # Errors
    /// When the file cannot be read or decoded.
    pub fn read(&self, min_side: u32) -> Result<Pixels, FormatError> {
        let longer_side = self.width.max(self.height);
        let divisor = [8, 4, 2]
            .into_iter()
            .find(|divisor| self.jpeg && longer_side / divisor >= min_side);
        match divisor {
            Some(divisor) => decode_jpeg_scaled(&self.path, divisor, self.orientation),
            None => decode(&self.path, self.orientation),
        }
    }

    /// The same photograph, which must have no mask, with the mask in the file `mask`.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn with_mask(&self, mask: PathBuf) -> Result<Self, FormatError> {
        Ok(Self {
            hash: self.hash ^ mask_hash(&mask)?,
            mask: Some(mask),
            ..self.clone()
        })
    }

    /// The same photograph without its mask.
    ///
    /// # Errors
    /// When the file of the mask cannot be read.
    pub fn without_mask(&self) -> Result<Self, FormatError> {
        let Some(mask) = &self.mask else {
            return Ok(self.clone());
        };
        Ok(Self {
            hash: self.hash ^ mask_hash(mask)?,
            mask: None,
            ..self.clone()
        })
    }

    /// The mask at `width` x `height`, 0 where the photograph is ignored; `None` if it has none.
    ///
    /// # Errors
    /// When the file cannot be read or decoded.
    pub fn read_mask(&self, width: u32, height: u32) -> Result<Option<Vec<u8>>, FormatError> {
        let Some(path) = &self.mask else { return Ok(None) };
        let orientation = read_header(path)?.orientation_from_photo(self.orientation, (self.width, self.height));
        let mask = decode_mask(path, orientation)?;
        Ok(Some(resize_area(
            &mask.data,
            1,
            [mask.width, mask.height],
            [width, height],
        )))
    }

    /// Writes the mask, if there is one, as a PNG of black and white, for programs that read no other masks. Its pixels are as stored, like
    /// those of the photograph for such programs.
    ///
    /// # Errors
    /// When the mask cannot be read or decoded, or `path` cannot be written.
    pub fn write_mask(&self, path: &Path) -> Result<(), FormatError> {
        let Some(mask) = &self.mask else { return Ok(()) };
        let mut mask = decode_mask(mask, Orientation::NoTransforms)?;
        binarize(&mut mask.data);
        write_png(path, mask.width, mask.height, 1, &mask.data)
    }
}

/// The photographs of a folder.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoFolder {
    /// Sorted by name; no two have the same bytes.
    pub photos: Vec<PhotoEntry>,
    /// Names of the other image files, and why they are not used.
    pub left_out: Vec<(String, String)>,
    /// Names of files that are left out without loss, and why: copies, cameras' raw files beside their JPEG, one of a HEIC and the JPEG
    /// made from it, and folders of masks that fit no photograph.
    pub repeated: Vec<(String, String)>,
}

impl PhotoFolder {
    /// Names of all files that are not used, and why.
    pub fn unused(&self) -> impl Iterator<Item = &(String, String)> {
        self.left_out.iter().chain(&self.repeated)
    }

    /// The index of each photograph's group: photographs of a group have the same make, model, focal length, size and quarter turns from
    /// the sensor.
    pub fn groups(&self) -> Vec<usize> {
        let turns = self.photos.iter().map(PhotoEntry::quarter_turns);
        numbered(self.cameras().into_iter().zip(turns))
    }

    /// The index of each photograph's camera: photographs of a camera have the same make, model, focal length and, however it was held,
    /// size.
    ///
    /// Focal lengths are rounded to 0.0001 long sides: the resolution of the sensor, from which they may be computed, differs in the last
    /// digits between photographs held level and on the side.
    pub fn cameras(&self) -> Vec<usize> {
        let key = |photo: &PhotoEntry| {
            let CameraTags { make, model, focal, .. } = photo.tags.clone();
            let focal = focal.map(|focal| (1e4 * focal).round() as i64);
            let [a, b] = photo.size();
            (make, model, focal, [a.min(b), a.max(b)])
        };
        numbered(self.photos.iter().map(key))
    }
}

/// Numbers equal `keys` equally, from 0 in the order of their first occurrence.
fn numbered<K: PartialEq>(keys: impl Iterator<Item = K>) -> Vec<usize> {
    let mut known: Vec<K> = Vec::new();
    let number = |key: K| {
        known.iter().position(|other| *other == key).unwrap_or_else(|| {
            known.push(key);
            known.len() - 1
        })
    };
    keys.map(number).collect()
}

/// The photographs in `folder` itself, or else in the first of its subfolders `images`, `images_1`, `images_2`, `images_4` and
/// `images_8` that has some, with their masks in `masks` (for `images_4` also `masks_4`) beside them. Hidden files and files without
/// an image's extension are ignored; image files that cannot be read, and those that repeat another, are left out.
///
/// # Errors
/// When the folder cannot be read.
pub fn read_photo_folder(folder: &Path) -> Result<PhotoFolder, FormatError> {
    read_photo_folders(&[folder])
}

/// Like [`read_photo_folder`], for several folders: photographs of the same name are prefixed with the name of their folder, and with
/// those of the folders around it until their names differ.
///
/// # Errors
/// When a folder cannot be read.
pub fn read_photo_folders(folders: &[impl AsRef<Path>]) -> Result<PhotoFolder, FormatError> {
    read_chosen_photos(folders, &|_| true)
}

/// Like [`read_photo_folders`], as if the folders had no other photographs than those whose files `is_chosen`.
///
/// # Errors
/// When a folder cannot be read.
pub fn read_chosen_photos(
    folders: &[impl AsRef<Path>],
    is_chosen: &dyn Fn(&Path) -> bool,
) -> Result<PhotoFolder, FormatError> {
    let mut files: Vec<PhotoFiles> = Vec::new();
    let mut result = PhotoFolder::default();
    for folder in folders.iter().map(AsRef::as_ref) {
        let first_new = files.len();
        let ImageFiles {
            root,
            images,
            files: new_files,
        } = find_image_files(folder)?;
        let siblings = [
            SiblingFolder::masks(&root, &images),
            SiblingFolder::depths(&root),
            SiblingFolder::normals(&root),
        ];
        files.extend(new_files.into_iter().filter(|path| is_chosen(path)).map(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let files = siblings
                .each_ref()
                .map(|folder| folder.as_ref().and_then(|folder| folder.file_of(&name)));
            let [mask, depth, normals] = files;
            PhotoFiles {
                path,
                name,
                mask,
                depth,
                normals,
            }
        }));
        let new_files = &files[first_new..];
        if let [Some(masks), ..] = &siblings
            && !new_files.is_empty()
            && new_files.iter().all(|file| file.mask.is_none())
        {
            let reason = "none of its files has the name of a photograph, so nothing is masked";
            result.repeated.push((masks.folder().to_owned(), reason.to_owned()));
        }
    }
    let readable: HashSet<PathBuf> = (files.iter().map(|file| &file.path))
        .filter(|path| unsupported_extension(path).is_none())
        .map(|path| path.with_extension(""))
        .collect();
    let is_duplicate = |file: &PhotoFiles| {
        unsupported_extension(&file.path).is_some() && readable.contains(&file.path.with_extension(""))
    };
    let (duplicates, files): (Vec<PhotoFiles>, Vec<PhotoFiles>) = files.into_iter().partition(is_duplicate);
    let as_duplicate = |file: PhotoFiles| (file.name, "another form of a photograph that is read".to_owned());
    result.repeated.extend(duplicates.into_iter().map(as_duplicate));
    let mut known_paths = HashSet::new();
    let (mut files, repeats): (Vec<PhotoFiles>, Vec<PhotoFiles>) = files.into_iter().partition(|file| {
        let path = file.path.canonicalize().unwrap_or_else(|_| file.path.clone());
        known_paths.insert((path, file.name.clone()))
    });
    let as_repeat = |file: PhotoFiles| (file.name, "given twice".to_owned());
    result.repeated.extend(repeats.into_iter().map(as_repeat));
    make_names_unique(&mut files);
    files.sort_by(|a, b| a.name.cmp(&b.name).then_with(|| a.path.cmp(&b.path)));
    let entries: Vec<(String, Result<PhotoEntry, String>)> = files
        .par_iter()
        .map(|file| (file.name.clone(), read_entry(file)))
        .collect();
    let mut first_by_hash: BTreeMap<u64, String> = BTreeMap::new();
    let mut first_by_time: HashMap<(PathBuf, String), String> = HashMap::new();
    for (name, entry) in entries {
        let photo = match entry {
            Ok(photo) => photo,
            Err(reason) => {
                result.left_out.push((name, reason));
                continue;
            }
        };
        let time = photo.tags.time.clone();
        let time_key = time.map(|time| (photo.path.with_extension(""), time));
        if let Some(first) = first_by_hash.get(&photo.hash) {
            result
                .repeated
                .push((name, format!("a copy of {first}, byte for byte")));
        } else if let Some(first) = time_key.as_ref().and_then(|time_key| first_by_time.get(time_key)) {
            result.repeated.push((name, format!("another form of {first}")));
        } else if result.photos.last().is_some_and(|other| other.name == name) {
            let reason = "another photograph has this name: rename it".to_owned();
            result.left_out.push((name, reason));
        } else {
            first_by_hash.insert(photo.hash, name.clone());
            first_by_time.extend(time_key.map(|time_key| (time_key, name)));
            result.photos.push(photo);
        }
    }
    Ok(result)
}

/// Prefixes photographs of the same name with the name of their folder, and of the folders around it if these have the same name as well.
fn make_names_unique(files: &mut [PhotoFiles]) {
    let mut levels = vec![0; files.len()];
    for _ in 0..MAX_PARENT_FOLDERS {
        let mut known: HashMap<String, usize> = HashMap::new();
        for file in files.iter() {
            *known.entry(file.name.clone()).or_default() += 1;
        }
        for (file, level) in files.iter_mut().zip(&mut levels) {
            let folder = file.path.ancestors().nth(*level + 1).and_then(Path::file_name);
            if let (true, Some(folder)) = (known[&file.name] > 1, folder) {
                file.name = format!("{}_{}", folder.to_string_lossy(), file.name);
                *level += 1;
            }
        }
    }
}

/// The files in the folder `path` or its `images` whose extension is that of a supported image format; none if `path` is not a folder.
pub fn photo_files(path: &Path) -> Vec<PathBuf> {
    let mut files = find_image_files(path).map_or(Vec::new(), |images| images.files);
    files.retain(|file| is_image_name(file));
    files
}

/// Maximum number of enclosing folders by which photographs of the same name are distinguished.
const MAX_PARENT_FOLDERS: usize = 4;
/// Subfolders of a capture that hold photographs: at full size, or at a fraction of it as in benchmarks.
const IMAGE_FOLDERS: [&str; 5] = ["images", "images_1", "images_2", "images_4", "images_8"];

/// The image files of a capture.
struct ImageFiles {
    /// The folder that holds the masks and maps, beside `images`.
    root: PathBuf,
    /// The name of the folder of the files, `images` if they lie in `root` itself.
    images: String,
    files: Vec<PathBuf>,
}

/// The image files in `folder` itself, else in the first of its [`IMAGE_FOLDERS`] that has some.
fn find_image_files(folder: &Path) -> Result<ImageFiles, FormatError> {
    let files = list_image_files(folder)?;
    let own = folder
        .file_name()
        .and_then(|name| IMAGE_FOLDERS.into_iter().find(|images| name == *images));
    if let (false, Some(images), Some(root)) = (files.is_empty(), own, folder.parent()) {
        return Ok(ImageFiles {
            root: root.to_owned(),
            images: images.to_owned(),
            files,
        });
    }
    let mut image_files = ImageFiles {
        root: folder.to_owned(),
        images: IMAGE_FOLDERS[0].to_owned(),
        files,
    };
    for images in IMAGE_FOLDERS {
        let below = folder.join(images);
        if image_files.files.is_empty() && below.is_dir() {
            image_files = ImageFiles {
                images: images.to_owned(),
                files: list_image_files(&below)?,
                ..image_files
            };
        }
    }
    Ok(image_files)
}

/// A photograph and the files that belong to it, before any of them is opened.
struct PhotoFiles {
    path: PathBuf,
    /// Its name among all photographs.
    name: String,
    mask: Option<PathBuf>,
    depth: Option<PathBuf>,
    normals: Option<PathBuf>,
}

/// The files with an image's extension, sorted.
fn list_image_files(folder: &Path) -> Result<Vec<PathBuf>, FormatError> {
    list_files(folder, |path| {
        is_image_name(path) || unsupported_extension(path).is_some()
    })
}

/// The file's extension if it is that of an unsupported image format.
fn unsupported_extension(path: &Path) -> Option<&'static str> {
    let extension = path.extension()?.to_str()?.to_ascii_lowercase();
    UNSUPPORTED_EXTENSIONS
        .into_iter()
        .find(|unsupported| *unsupported == extension)
}

fn read_entry(file: &PhotoFiles) -> Result<PhotoEntry, String> {
    let (path, mask) = (&file.path, &file.mask);
    if let Some(kind) = unsupported_extension(path) {
        return Err(format!("{kind} is not supported: convert it to JPEG or PNG"));
    }
    // Without the path, since the reason is shown beside the file's name.
    let reason = |error: FormatError| match error {
        FormatError::Malformed { source, .. } => source.0,
        FormatError::Read { source, .. } => format!("cannot be read: {source}"),
        other => other.to_string(),
    };
    let header = read_header(path).map_err(reason)?;
    let mut hash = fnv(&read_file(path).map_err(reason)?);
    if let Some(mask) = mask {
        hash ^= mask_hash(mask).map_err(reason)?;
    }
    let stored = [header.width, header.height];
    let metadata = read_metadata(path);
    let tags = metadata
        .exif
        .map_or_else(CameraTags::default, |block| parse_camera_tags(&block, stored));
    let (orientation, up_in_image) = colmap_orientation(&header);
    let up = match (up_in_image, header.orientation) {
        (Some([right, down]), _) => Some(DVec3::new(f64::from(right), f64::from(down), 0.0)),
        (None, Orientation::NoTransforms) => metadata.xmp.and_then(|packet| parse_gimbal(&packet)),
        (None, _) => None,
    };
    let (width, height) = oriented_size(&header, orientation);
    Ok(PhotoEntry {
        name: file.name.clone(),
        path: path.clone(),
        width,
        height,
        tags,
        hash,
        mask: mask.clone(),
        depth: file.depth.clone(),
        normals: file.normals.clone(),
        up,
        orientation,
        jpeg: header.jpeg,
    })
}

/// The contribution of a mask to the hash of its photograph.
fn mask_hash(mask: &Path) -> Result<u64, FormatError> {
    Ok(fnv(&read_file(mask)?).rotate_left(1))
}

/// FNV-1a, 64 bits, over words of 8 bytes: enough to tell files apart, in a fraction of a nanosecond per byte.
fn fnv(bytes: &[u8]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64 ^ bytes.len() as u64;
    let mut add = |word: u64| hash = (hash ^ word).wrapping_mul(0x0100_0000_01b3).rotate_left(29);
    let (words, rest) = bytes.as_chunks::<8>();
    words.iter().for_each(|word| add(u64::from_le_bytes(*word)));
    rest.iter().for_each(|byte| add(u64::from(*byte)));
    hash
}
