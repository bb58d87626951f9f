//! Folders of photographs without poses: which photographs there are, and which camera took them.

mod exif;
mod gimbal;
mod panorama;

use crate::dataset::{Beside, is_image_name, list_files, oriented_size, turned_as_stored};
use crate::error::read_file;
use crate::image_file::{Colour, decode, decode_jpeg_at, decode_mask, read_header, read_metadata};
use crate::{FormatError, Pixels};
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
const UNREAD: [&str; 15] = [
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

    /// The pixels, with 3 or 4 channels; a large JPEG is decoded at a half, quarter or eighth of its size if its longer side still has
    /// at least `side` pixels.
    ///
    /// # Errors
    /// When the file cannot be read or decoded.
    pub fn read(&self, side: u32) -> Result<Pixels, FormatError> {
        let long = self.width.max(self.height);
        let fraction = [8, 4, 2]
            .into_iter()
            .find(|divisor| self.jpeg && long / divisor >= side);
        match fraction {
            Some(divisor) => decode_jpeg_at(&self.path, divisor, self.orientation),
            None => decode(&self.path, self.orientation, Colour::Keep),
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
        let orientation = read_header(path)?.turned_with(self.orientation, (self.width, self.height));
        let mask = decode_mask(path, orientation)?;
        Ok(Some(resize_area(
            &mask.data,
            1,
            [mask.width, mask.height],
            [width, height],
        )))
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

    /// The index of each photograph's group: photographs of a group have the same make, model, focal length and size.
    pub fn groups(&self) -> Vec<usize> {
        let mut known = Vec::new();
        let group = |photo: &PhotoEntry| {
            let tags = &photo.tags;
            let key = (
                tags.make.clone(),
                tags.model.clone(),
                tags.focal.map(f64::to_bits),
                [photo.width, photo.height],
            );
            known.iter().position(|other| *other == key).unwrap_or_else(|| {
                known.push(key);
                known.len() - 1
            })
        };
        self.photos.iter().map(group).collect()
    }
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
    let mut files: Vec<Found> = Vec::new();
    let mut found = PhotoFolder::default();
    for folder in folders.iter().map(AsRef::as_ref) {
        let before = files.len();
        let Pictures {
            root,
            images,
            files: here,
        } = pictures_of(folder)?;
        let beside = [
            Beside::masks(&root, &images),
            Beside::depths(&root),
            Beside::normals(&root),
        ];
        files.extend(here.into_iter().map(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let files = beside
                .each_ref()
                .map(|beside| beside.as_ref().and_then(|beside| beside.of(&name)));
            let [mask, depth, normals] = files;
            Found {
                path,
                name,
                mask,
                depth,
                normals,
            }
        }));
        let here = &files[before..];
        if let [Some(masks), ..] = &beside
            && !here.is_empty()
            && here.iter().all(|file| file.mask.is_none())
        {
            let why = "none of its files has the name of a photograph, so nothing is masked";
            found.repeated.push((masks.folder().to_owned(), why.to_owned()));
        }
    }
    let read: HashSet<PathBuf> = (files.iter().map(|file| &file.path))
        .filter(|path| is_unread(path).is_none())
        .map(|path| path.with_extension(""))
        .collect();
    let is_other_form = |file: &Found| is_unread(&file.path).is_some() && read.contains(&file.path.with_extension(""));
    let (forms, files): (Vec<Found>, Vec<Found>) = files.into_iter().partition(is_other_form);
    let repeats = |file: Found| (file.name, "another form of a photograph that is read".to_owned());
    found.repeated.extend(forms.into_iter().map(repeats));
    let mut places = HashSet::new();
    let (mut files, again): (Vec<Found>, Vec<Found>) = files.into_iter().partition(|file| {
        let place = file.path.canonicalize().unwrap_or_else(|_| file.path.clone());
        places.insert((place, file.name.clone()))
    });
    let given = |file: Found| (file.name, "given twice".to_owned());
    found.repeated.extend(again.into_iter().map(given));
    tell_apart(&mut files);
    files.sort_by(|a, b| a.name.cmp(&b.name).then_with(|| a.path.cmp(&b.path)));
    let entries: Vec<(String, Result<PhotoEntry, String>)> = files
        .par_iter()
        .map(|file| (file.name.clone(), read_entry(file)))
        .collect();
    let mut first_with: BTreeMap<u64, String> = BTreeMap::new();
    let mut first_taken: HashMap<(PathBuf, String), String> = HashMap::new();
    for (name, entry) in entries {
        let photo = match entry {
            Ok(photo) => photo,
            Err(reason) => {
                found.left_out.push((name, reason));
                continue;
            }
        };
        let time = photo.tags.time.clone();
        let taken = time.map(|time| (photo.path.with_extension(""), time));
        if let Some(first) = first_with.get(&photo.hash) {
            found.repeated.push((name, format!("a copy of {first}, byte for byte")));
        } else if let Some(first) = taken.as_ref().and_then(|taken| first_taken.get(taken)) {
            found.repeated.push((name, format!("another form of {first}")));
        } else if found.photos.last().is_some_and(|other| other.name == name) {
            let reason = "another photograph has this name: rename it".to_owned();
            found.left_out.push((name, reason));
        } else {
            first_with.insert(photo.hash, name.clone());
            first_taken.extend(taken.map(|taken| (taken, name)));
            found.photos.push(photo);
        }
    }
    Ok(found)
}

/// Prefixes photographs of the same name with the name of their folder, and of the folders around it if these have the same name as well.
fn tell_apart(files: &mut [Found]) {
    let mut folders = vec![0; files.len()];
    for _ in 0..MOST_FOLDERS {
        let mut known: HashMap<String, usize> = HashMap::new();
        for file in files.iter() {
            *known.entry(file.name.clone()).or_default() += 1;
        }
        for (file, folders) in files.iter_mut().zip(&mut folders) {
            let around = file.path.ancestors().nth(*folders + 1).and_then(Path::file_name);
            if let (true, Some(folder)) = (known[&file.name] > 1, around) {
                file.name = format!("{}_{}", folder.to_string_lossy(), file.name);
                *folders += 1;
            }
        }
    }
}

/// The files in the folder `path` or its `images` whose extension is that of a supported image format; none if `path` is not a folder.
pub fn photo_files(path: &Path) -> Vec<PathBuf> {
    let mut files = pictures_of(path).map_or(Vec::new(), |pictures| pictures.files);
    files.retain(|file| is_image_name(file));
    files
}

/// Maximum number of enclosing folders by which photographs of the same name are distinguished.
const MOST_FOLDERS: usize = 4;
/// Subfolders of a capture that hold photographs: at full size, or at a fraction of it as in benchmarks.
const IMAGES: [&str; 5] = ["images", "images_1", "images_2", "images_4", "images_8"];

/// The image files of a capture.
struct Pictures {
    /// The folder that holds the masks and maps, beside `images`.
    root: PathBuf,
    /// The name of the folder of the files, `images` if they lie in `root` itself.
    images: String,
    files: Vec<PathBuf>,
}

/// The image files in `folder` itself, else in the first of its [`IMAGES`] that has some.
fn pictures_of(folder: &Path) -> Result<Pictures, FormatError> {
    let files = list_pictures(folder)?;
    let own = folder
        .file_name()
        .and_then(|name| IMAGES.into_iter().find(|images| name == *images));
    if let (false, Some(images), Some(root)) = (files.is_empty(), own, folder.parent()) {
        return Ok(Pictures {
            root: root.to_owned(),
            images: images.to_owned(),
            files,
        });
    }
    let mut found = Pictures {
        root: folder.to_owned(),
        images: IMAGES[0].to_owned(),
        files,
    };
    for images in IMAGES {
        let below = folder.join(images);
        if found.files.is_empty() && below.is_dir() {
            found = Pictures {
                images: images.to_owned(),
                files: list_pictures(&below)?,
                ..found
            };
        }
    }
    Ok(found)
}

/// A photograph and the files that belong to it, before any of them is opened.
struct Found {
    path: PathBuf,
    /// Its name among all photographs.
    name: String,
    mask: Option<PathBuf>,
    depth: Option<PathBuf>,
    normals: Option<PathBuf>,
}

/// The files with an image's extension, sorted.
fn list_pictures(folder: &Path) -> Result<Vec<PathBuf>, FormatError> {
    list_files(folder, |path| is_image_name(path) || is_unread(path).is_some())
}

/// The file's extension if it is that of an unsupported image format.
fn is_unread(path: &Path) -> Option<&'static str> {
    let extension = path.extension()?.to_str()?.to_ascii_lowercase();
    UNREAD.into_iter().find(|unread| *unread == extension)
}

fn read_entry(file: &Found) -> Result<PhotoEntry, String> {
    let (path, mask) = (&file.path, &file.mask);
    if let Some(kind) = is_unread(path) {
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
    let (orientation, turned) = turned_as_stored(&header);
    let up = match (turned, header.orientation) {
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
