//! The files of photographs that are imported into the dataset, and the record of those that an earlier call imported.

use crate::RunError;
use crate::folder::to_json;
use crate::scene_file::same_file;
use irradia_formats::{PANORAMA_MASKS, PANORAMAS, PhotoEntry, write_atomic};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path};

/// The record of what was imported, in the folder of the dataset.
const RECORD_FILE: &str = "files.json";
/// Folder for files that the capture no longer has: they may be the last copies.
const UNUSED_FOLDER: &str = "unused";
/// Folder of photographs.
pub(super) const IMAGES_FOLDER: &str = "images";
/// Folder of masks.
pub(super) const MASKS_FOLDER: &str = "masks";

/// Paths relative to the folder of the dataset, with `/`.
type Files = BTreeSet<String>;

/// A file that belongs to a photograph, and its place in the dataset.
struct PhotoFile<'a> {
    from: &'a Path,
    folder: &'static str,
    name: String,
}

/// The files of a photograph: itself, and its mask and its maps of depth and normals, under its name with their own extension appended.
fn associated_files(photo: &PhotoEntry) -> impl Iterator<Item = PhotoFile<'_>> {
    let beside = [
        (&photo.mask, MASKS_FOLDER),
        (&photo.depth, "depths"),
        (&photo.normals, "normals"),
    ];
    let image = PhotoFile {
        from: &photo.path,
        folder: IMAGES_FOLDER,
        name: photo.name.clone(),
    };
    std::iter::once(image).chain(beside.into_iter().filter_map(|(file, folder)| {
        let from = file.as_deref()?;
        let extension = from.extension().unwrap_or_default().to_string_lossy();
        Some(PhotoFile {
            from,
            folder,
            name: format!("{}.{extension}", photo.name),
        })
    }))
}

impl PhotoFile<'_> {
    fn relative_path(&self) -> String {
        format!("{}/{}", self.folder, self.name)
    }

    /// Whether it already is the file `to`, and not a hard link or copy of it.
    fn is_same_file(&self, to: &Path) -> bool {
        same_file(self.from, to)
    }

    /// Imports the file into `folder`, which is created: as a hard link if the file system allows it, otherwise as a copy. Masks are always
    /// copied, since users edit them in a dataset. Another file of that name is moved to `unused`: it may be the only copy.
    fn import(&self, out: &Path, folder: &str) -> Result<(), RunError> {
        let name = format!("{folder}/{}", self.name);
        let to = &out.join(&name);
        if self.is_same_file(to) || (to.exists() && has_same_content(to, self.from)?) {
            return Ok(());
        }
        move_to_unused(out, std::iter::once(name))?;
        let around = to.parent().unwrap_or(out);
        fs::create_dir_all(around).map_err(RunError::io("create", around))?;
        if self.folder == MASKS_FOLDER || fs::hard_link(self.from, to).is_err() {
            fs::copy(self.from, to).map_err(RunError::io("write", to))?;
        }
        Ok(())
    }
}

/// Whether two files have the same content. Files of equal size and modification time count as links of one file; others are compared.
fn has_same_content(one: &Path, other: &Path) -> Result<bool, RunError> {
    let metadata = |path: &Path| fs::metadata(path).map_err(RunError::io("read", path));
    let bytes = |path: &Path| fs::read(path).map_err(RunError::io("read", path));
    let [a, b] = [metadata(one)?, metadata(other)?];
    let is_link = a.modified().ok().zip(b.modified().ok()).is_some_and(|(a, b)| a == b);
    Ok(a.len() == b.len() && (is_link || bytes(one)? == bytes(other)?))
}

/// Imports a photograph, its mask and its maps of depth and normals into the folders `images`, `masks`, `depths` and `normals` of the
/// dataset.
pub(super) fn import_photo(out: &Path, photo: &PhotoEntry) -> Result<(), RunError> {
    associated_files(photo).try_for_each(|file| file.import(out, file.folder))
}

/// Imports a panorama and its mask into the dataset, where training finds them beside their faces.
pub(super) fn import_panorama(out: &Path, panorama: &PhotoEntry) -> Result<(), RunError> {
    associated_files(panorama).try_for_each(|file| match file.folder {
        IMAGES_FOLDER => file.import(out, PANORAMAS),
        MASKS_FOLDER => file.import(out, PANORAMA_MASKS),
        _ => Ok(()),
    })
}

/// Moves to `unused` masks and maps that an earlier call imported and `photos` no longer have: masks removed by the user would still hide
/// pixels.
pub(super) fn clear_stale(out: &Path, photos: &[PhotoEntry]) -> Result<(), RunError> {
    let has: Files = photos
        .iter()
        .flat_map(associated_files)
        .map(|file| file.relative_path())
        .collect();
    let stale = read_record(out).into_iter();
    move_to_unused(
        out,
        stale.filter(|file| !file.starts_with(IMAGES_FOLDER) && !has.contains(file)),
    )
}

/// Moves to `unused` files that an earlier call imported and that do not belong to `posed`, unless photographs were `added`, and records
/// the current files.
pub(super) fn record(out: &Path, posed: &[&PhotoEntry], added: bool) -> Result<(), RunError> {
    let before = read_record(out);
    // Files that were in the dataset from the start are not recorded, and stay.
    let is_imported = |file: &PhotoFile| {
        before.contains(&file.relative_path()) || !file.is_same_file(&out.join(file.relative_path()))
    };
    let files = posed.iter().flat_map(|photo| associated_files(photo));
    let mut now: Files = files.filter(is_imported).map(|file| file.relative_path()).collect();
    if added {
        now.extend(before);
    } else {
        move_to_unused(out, before.difference(&now).cloned())?;
    }
    write_atomic(&out.join(RECORD_FILE), |file| file.write_all(&to_json(&now)))?;
    Ok(())
}

fn read_record(out: &Path) -> Files {
    let record = fs::read(out.join(RECORD_FILE)).ok();
    record
        .and_then(|bytes| serde_json::from_slice(&bytes).ok())
        .unwrap_or_default()
}

/// Moves those of the dataset's `files` that exist into [`UNUSED_FOLDER`], where `a.2.png` stands beside an earlier `a.png`, and removes
/// folders that become empty. Paths that lead outside of the dataset are ignored.
pub(super) fn move_to_unused(out: &Path, files: impl Iterator<Item = String>) -> Result<(), RunError> {
    let is_inside = |file: &str| {
        Path::new(file)
            .components()
            .all(|part| matches!(part, Component::Normal(_)))
    };
    for file in files {
        let path = out.join(&file);
        if !is_inside(&file) || !path.is_file() {
            continue;
        }
        let wanted = out.join(UNUSED_FOLDER).join(&file);
        let folder = wanted.parent().expect("in a folder");
        fs::create_dir_all(folder).map_err(RunError::io("create", folder))?;
        let extension = wanted.extension().unwrap_or_default().to_string_lossy();
        let to = std::iter::once(wanted.clone())
            .chain((2u32..).map(|n| wanted.with_extension(format!("{n}.{extension}"))))
            .find(|to| !to.exists() || has_same_content(to, &path).unwrap_or(false))
            .expect("a free name");
        fs::rename(&path, &to).map_err(RunError::io("rename", &path))?;
        // A folder that is not empty stays.
        let _ = path.parent().map(fs::remove_dir);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_formats::{read_photo_folder, write_png};
    use std::path::PathBuf;

    #[test]
    fn what_an_earlier_call_imported_is_moved_to_unused_and_nothing_else() {
        let root = tempfile::tempdir().unwrap();
        let [source, out] = ["source", "out"].map(|name| root.path().join(name));
        let write = |path: PathBuf, value: u8| {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            write_png(&path, 8, 8, 1, &[value; 64]).unwrap();
        };
        for (i, name) in ["a.png", "b.png"].into_iter().enumerate() {
            write(source.join(name), i as u8);
            write(source.join("masks").join(name), 100 + i as u8);
        }
        let import_all = |added: bool| {
            let photos = read_photo_folder(&source).unwrap().photos;
            clear_stale(&out, &photos).unwrap();
            photos.iter().try_for_each(|photo| import_photo(&out, photo)).unwrap();
            record(&out, &photos.iter().collect::<Vec<_>>(), added).unwrap();
        };
        let exists_in_out = |file: &str| out.join(file).exists();
        import_all(false);
        assert!(exists_in_out("masks/a.png.png") && exists_in_out("images/b.png"));
        write(out.join("masks/mine.png"), 7);
        fs::remove_dir_all(source.join("masks")).unwrap();
        fs::remove_file(source.join("b.png")).unwrap();
        import_all(true);
        assert!(
            !exists_in_out("masks/a.png.png") && exists_in_out("images/b.png"),
            "photographs stay where others are added"
        );
        import_all(false);
        assert!(exists_in_out("images/a.png") && !exists_in_out("images/b.png") && exists_in_out("masks/mine.png"));
        assert!(
            exists_in_out("unused/images/b.png") && exists_in_out("unused/masks/a.png.png"),
            "nothing is lost"
        );
        write(source.join("b.png"), 9);
        import_all(true);
        fs::remove_file(source.join("b.png")).unwrap();
        import_all(false);
        assert!(
            exists_in_out("unused/images/b.png") && exists_in_out("unused/images/b.2.png"),
            "nor replaced by what is put away later"
        );
        fs::write(out.join(RECORD_FILE), r#"["../source/a.png", "images/none.png"]"#).unwrap();
        import_all(false);
        assert!(source.join("a.png").exists());
        // A dataset that is posed in place: its own files are not recorded.
        let photos = read_photo_folder(&out).unwrap().photos;
        fs::remove_file(out.join(RECORD_FILE)).unwrap();
        record(&out, &photos.iter().collect::<Vec<_>>(), false).unwrap();
        record(&out, &[], false).unwrap();
        assert!(exists_in_out("images/a.png"));
    }
}
