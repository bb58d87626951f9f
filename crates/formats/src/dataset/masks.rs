use super::files::{is_image_name, relative_name};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Maximum depth of the search; a link back to a parent would not end.
const MAX_DEPTH: u32 = 6;

/// The masks in a separate folder, by the image to which they belong.
pub(crate) struct Masks {
    folder: String,
    /// By path below the folder, lower case, without extension.
    by_stem: HashMap<String, PathBuf>,
}

impl Masks {
    /// The masks of the images in `root/images`: in `masks` with the suffix of `images` in its name (`masks_4` for `images_4`),
    /// else in `masks`.
    pub fn beside(root: &Path, images: &str) -> Option<Self> {
        let suffix = images.strip_prefix("images").unwrap_or("");
        let names = [format!("masks{suffix}"), "masks".to_owned()];
        let folder = names.into_iter().find(|name| root.join(name).is_dir())?;
        let mut by_stem = HashMap::new();
        collect(&root.join(&folder), &root.join(&folder), MAX_DEPTH, &mut by_stem);
        Some(Self { folder, by_stem })
    }

    /// The mask of the image with this path below its folder: the same name, `NAME_mask`, or the full file name with another
    /// extension appended (COLMAP's `0001.jpg.png`).
    pub fn of(&self, image: &str) -> Option<PathBuf> {
        let image = image.to_lowercase();
        let stem = without_extension(&image);
        let keys = [stem, &format!("{stem}_mask"), &image];
        keys.into_iter().find_map(|key| self.by_stem.get(key)).cloned()
    }

    /// The warning if some images have no mask.
    pub fn warning(&self, images: usize, masked: usize) -> Option<String> {
        (masked < images).then(|| {
            format!(
                "{} of {images} images have no mask in `{}`; they are used unmasked",
                images - masked,
                self.folder
            )
        })
    }
}

fn collect(top: &Path, folder: &Path, depth: u32, by_stem: &mut HashMap<String, PathBuf>) {
    // An unreadable folder of masks is treated as empty; the warning about missing masks reports it.
    for path in std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
    {
        if path.is_dir() && depth > 0 {
            collect(top, &path, depth - 1, by_stem);
        } else if is_image_name(&path) {
            let name = relative_name(top, &path).to_lowercase();
            by_stem.insert(without_extension(&name).to_owned(), path);
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
    fn masks_are_found_by_each_convention() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(root.path().join("masks_2/sub")).unwrap();
        for name in ["A.png", "b_mask.JPG", "c.jpg.png", "sub/d.png"] {
            std::fs::write(root.path().join("masks_2").join(name), b"").unwrap();
        }
        let masks = Masks::beside(root.path(), "images_2").unwrap();
        for (image, mask) in [
            ("a.JPG", "A.png"),
            ("b.png", "b_mask.JPG"),
            ("c.jpg", "c.jpg.png"),
            ("sub/d.jpg", "sub/d.png"),
        ] {
            assert!(masks.of(image).unwrap().ends_with(mask), "{image}");
        }
        assert_eq!(masks.of("d.jpg"), None);
        assert!(masks.warning(5, 4).unwrap().contains("1 of 5"));
        assert!(Masks::beside(root.path(), "images").is_none());
    }
}
