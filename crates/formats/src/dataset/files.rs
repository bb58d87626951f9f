//! Finding image files: by the names that datasets use, in their folders of full-size and smaller images.

use crate::FormatError;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

const IMAGE_EXTENSIONS: [&str; 20] = [
    "png", "jpg", "jpeg", "PNG", "JPG", "JPEG", "webp", "tif", "tiff", "WEBP", "TIF", "TIFF", "heic", "heif", "hif",
    "HEIC", "HEIF", "HIF", "exr", "EXR",
];

/// The image file for a dataset's `path`: that file, or that name with an extension added or replaced.
pub(super) fn find_image(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    let name = path.file_name()?;
    let added = IMAGE_EXTENSIONS.iter().map(|extension| {
        let mut name = name.to_owned();
        name.push(".");
        name.push(extension);
        path.with_file_name(name)
    });
    let replaced = IMAGE_EXTENSIONS.iter().map(|extension| path.with_extension(extension));
    added.chain(replaced).find(|candidate| candidate.is_file())
}

/// A path that a dataset names, then its ends, the longest first: datasets are moved, and absolute paths are those of another machine.
pub(super) fn path_ends(name: &str) -> impl Iterator<Item = PathBuf> {
    let name = PathBuf::from(name.replace('\\', "/"));
    let count = name.components().count();
    let end = move |first| name.components().skip(first).collect();
    (0..count).map(end)
}

/// `path` below `root`, with forward slashes and without `./`.
pub(super) fn relative_name(root: &Path, path: &Path) -> String {
    let below = path.strip_prefix(root).unwrap_or(path);
    let parts = below
        .components()
        .filter(|part| !matches!(part, Component::CurDir | Component::RootDir));
    let parts: Vec<_> = parts.map(|part| part.as_os_str().to_string_lossy()).collect();
    parts.join("/")
}

/// Whether a file's name is that of an image.
pub fn is_image_name(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    extension.is_some_and(|e| IMAGE_EXTENSIONS.contains(&e.as_str()))
}

/// The images directly in a folder, sorted by name.
pub(super) fn list_images(folder: &Path) -> Result<Vec<PathBuf>, FormatError> {
    list_files(folder, is_image_name)
}

/// The files directly in a folder that are not hidden and that `keep` accepts by their names, sorted.
pub(crate) fn list_files(folder: &Path, keep: impl Fn(&Path) -> bool) -> Result<Vec<PathBuf>, FormatError> {
    let read_error = |source| FormatError::Read {
        path: folder.to_owned(),
        source,
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(read_error)? {
        let path = entry.map_err(read_error)?.path();
        let hidden = path
            .file_name()
            .is_some_and(|name| name.to_string_lossy().starts_with('.'));
        if keep(&path) && !hidden && path.is_file() {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// The folder of the photographs.
pub(super) struct ImageFolder {
    /// `images`, `images_4`, ..
    pub name: String,
    /// Factor by which its images must still be downscaled.
    pub downscale: f32,
    /// A warning about the choice.
    pub warning: Option<String>,
}

/// `images_N` if the downscale is N and it exists; else the largest available: `images`, then `images_2`, ..
pub(super) fn choose_image_folder(root: &Path, downscale: f32) -> Option<ImageFolder> {
    if downscale > 1.0 && downscale.fract() == 0.0 {
        let name = format!("images_{downscale}");
        if root.join(&name).is_dir() {
            return Some(ImageFolder {
                name,
                downscale: 1.0,
                warning: None,
            });
        }
    }
    if root.join("images").is_dir() {
        return Some(ImageFolder {
            name: "images".into(),
            downscale,
            warning: None,
        });
    }
    let entries = std::fs::read_dir(root).ok()?.flatten();
    let factors = entries.filter(|entry| entry.path().is_dir()).filter_map(|entry| {
        let name = entry.file_name().into_string().ok()?;
        name.strip_prefix("images_")?.parse::<u32>().ok()
    });
    let name = format!("images_{}", factors.min()?);
    let warning = format!(
        "there is no folder `images`; the photographs are taken from `{name}`, and any downscale is relative to it"
    );
    Some(ImageFolder {
        name,
        downscale,
        warning: Some(warning),
    })
}

/// The photograph `name` of a dataset in one of `folders` below `root`: by its path, or by the longest of its ends.
pub(super) fn locate_image(root: &Path, folders: &[&str], name: &str) -> Option<PathBuf> {
    let find_in_folders = |end: PathBuf| {
        folders
            .iter()
            .find_map(|folder| find_image(&root.join(folder).join(&end)))
    };
    path_ends(name).find_map(find_in_folders)
}

/// `path` itself if it is a file of that name, or the file `name` in it.
pub(super) fn file_named(path: &Path, name: &str) -> Option<PathBuf> {
    let is_named = path.is_file() && path.file_name() == Path::new(name).file_name();
    let file = if is_named { path.to_owned() } else { path.join(name) };
    file.is_file().then_some(file)
}

/// `path` itself if it is a file that `keep` accepts, or the first such file in it.
pub(super) fn first_file(path: &Path, keep: impl Fn(&Path) -> bool) -> Option<PathBuf> {
    if path.is_file() {
        return keep(path).then(|| path.to_owned());
    }
    list_files(path, keep).ok()?.into_iter().next()
}

/// Whether `predicate` accepts the first bytes of a file.
pub(super) fn start_matches(file: &Path, predicate: impl Fn(&[u8]) -> bool) -> bool {
    const MAX_START_BYTES: u64 = 4096;
    let mut start = Vec::new();
    let read = std::fs::File::open(file).and_then(|file| file.take(MAX_START_BYTES).read_to_end(&mut start));
    read.is_ok() && predicate(&start)
}
