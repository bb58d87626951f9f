//! Files that each belong to one image, in a folder beside that of the images: masks, depth maps and normal maps.

use super::declared::{DeclaredDataset, DeclaredView};
use super::files::{is_image_name, relative_name};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Maximum depth of the search, which a link back to a parent would otherwise make endless.
const MAX_DEPTH: u32 = 6;

/// The files in a separate folder, by the image that they belong to.
pub struct SiblingFolder {
    folder: String,
    /// By path below the folder, lower case, without extension.
    by_stem: HashMap<String, PathBuf>,
}

impl SiblingFolder {
    /// The masks of the images in `root/images`: in `masks` with the suffix of `images` in its name (`masks_4` for `images_4`),
    /// else in `masks`.
    pub fn masks(root: &Path, images: &str) -> Option<Self> {
        let suffix = images.strip_prefix("images").unwrap_or("");
        let names = [format!("masks{suffix}"), "masks".to_owned()];
        Self::find(root, &names, is_image_name)
    }

    /// The depth maps below `root`: in `depths`, as the authors' code of 3DGS expects them, or in `depth`.
    pub fn depths(root: &Path) -> Option<Self> {
        let is_map = |path: &Path| is_image_name(path) || path.extension().is_some_and(|e| e == "npy");
        Self::find(root, &["depths".to_owned(), "depth".to_owned()], is_map)
    }

    /// The normal maps below `root`: in `normals` or in `normal`.
    pub fn normals(root: &Path) -> Option<Self> {
        Self::find(root, &["normals".to_owned(), "normal".to_owned()], is_image_name)
    }

    /// The files that `keep` accepts in the first of these folders that exists.
    fn find(root: &Path, names: &[String], keep: impl Fn(&Path) -> bool) -> Option<Self> {
        let folder = names.iter().find(|name| root.join(name).is_dir())?;
        Some(Self {
            folder: folder.clone(),
            by_stem: files_below(&root.join(folder), keep),
        })
    }

    /// The folder's name.
    pub fn folder(&self) -> &str {
        &self.folder
    }

    /// The file of the image with this path below its folder: the same name, `NAME_mask`, or the full file name with another
    /// extension appended (COLMAP's `0001.jpg.png`).
    pub fn file_of(&self, image: &str) -> Option<PathBuf> {
        let image = image.to_lowercase();
        let stem = without_extension(&image);
        let keys = [stem, &format!("{stem}_mask"), &image];
        keys.into_iter().find_map(|key| self.by_stem.get(key)).cloned()
    }

    /// The file of `view`, whose name may begin with the folder of the photographs.
    fn file_of_view(&self, view: &DeclaredView) -> Option<PathBuf> {
        self.file_of(&view.name)
            .or_else(|| self.file_of(view.name_without_folder()))
    }

    /// The warning if some images have no mask.
    pub fn mask_warning(&self, images: usize, masked: usize) -> Option<String> {
        (masked < images).then(|| {
            format!(
                "{} of {images} images have no mask in `{}`; they are used unmasked",
                images - masked,
                self.folder
            )
        })
    }
}

/// Gives views without a mask theirs in `masks` below the dataset's folder, if there is one.
pub(super) fn find_masks(declared: &mut DeclaredDataset) {
    let Some(masks) = SiblingFolder::masks(&declared.root, "images") else {
        return;
    };
    for view in declared.views.iter_mut().filter(|view| view.mask.is_none()) {
        view.mask = masks.file_of_view(view);
    }
    let masked = declared.views.iter().filter(|view| view.mask.is_some()).count();
    let warning = masks.mask_warning(declared.views.len(), masked);
    declared.warnings.extend(warning);
}

/// Gives views the depth maps below the dataset's folder if its files declare none, and likewise the normal maps.
pub(super) fn find_maps(declared: &mut DeclaredDataset) {
    let depths =
        SiblingFolder::depths(&declared.root).filter(|_| declared.views.iter().all(|view| view.depth.is_none()));
    let normals =
        SiblingFolder::normals(&declared.root).filter(|_| declared.views.iter().all(|view| view.normals.is_none()));
    for view in &mut declared.views {
        let [depth, normals] = [&depths, &normals].map(|maps| maps.as_ref()?.file_of_view(view));
        view.depth = view.depth.take().or(depth);
        view.normals = view.normals.take().or(normals);
    }
}

/// The files that `keep` accepts in `folder` and its subfolders, by path below it, lower case, without extension.
pub(super) fn files_below(folder: &Path, keep: impl Fn(&Path) -> bool) -> HashMap<String, PathBuf> {
    let mut by_stem = HashMap::new();
    collect(folder, folder, MAX_DEPTH, &keep, &mut by_stem);
    by_stem
}

fn collect(
    top: &Path,
    folder: &Path,
    depth: u32,
    keep: &impl Fn(&Path) -> bool,
    by_stem: &mut HashMap<String, PathBuf>,
) {
    // An unreadable folder is treated as empty; the warning about missing masks reports it.
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    // Of files that differ in their extensions only, the first is taken, on every file system: `.npy` before `.png`.
    paths.sort();
    for path in paths {
        if path.is_dir() && depth > 0 {
            collect(top, &path, depth - 1, keep, by_stem);
        } else if keep(&path) {
            let name = relative_name(top, &path).to_lowercase();
            by_stem.entry(without_extension(&name).to_owned()).or_insert(path);
        }
    }
}

fn without_extension(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, extension)) if !extension.contains('/') => stem,
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depths_are_found_by_name_and_may_be_arrays() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(root.path().join("depths")).unwrap();
        for name in ["a.png", "b.png", "b.npy", "b.tif", "c.txt"] {
            std::fs::write(root.path().join("depths").join(name), b"").unwrap();
        }
        let depths = SiblingFolder::depths(root.path()).unwrap();
        assert!(
            depths.file_of("A.jpg").unwrap().ends_with("a.png") && depths.file_of("b.jpg").unwrap().ends_with("b.npy")
        );
        assert_eq!(depths.file_of("c.jpg"), None);
    }

    #[test]
    fn masks_are_found_by_each_convention() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(root.path().join("masks_2/sub")).unwrap();
        for name in ["A.png", "b_mask.JPG", "c.jpg.png", "sub/d.png"] {
            std::fs::write(root.path().join("masks_2").join(name), b"").unwrap();
        }
        let masks = SiblingFolder::masks(root.path(), "images_2").unwrap();
        for (image, mask) in [
            ("a.JPG", "A.png"),
            ("b.png", "b_mask.JPG"),
            ("c.jpg", "c.jpg.png"),
            ("sub/d.jpg", "sub/d.png"),
        ] {
            assert!(masks.file_of(image).unwrap().ends_with(mask), "{image}");
        }
        assert_eq!(masks.file_of("d.jpg"), None);
        assert!(masks.mask_warning(5, 4).unwrap().contains("1 of 5"));
        assert!(SiblingFolder::masks(root.path(), "images").is_none());
    }
}
