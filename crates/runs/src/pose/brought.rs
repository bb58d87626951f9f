//! The files of photographs that are brought into the dataset, and the record of those that an earlier call brought.

use crate::RunError;
use crate::folder::to_json;
use crate::scene_file::same_file;
use irradia_formats::{PANORAMA_MASKS, PANORAMAS, PhotoEntry, write_atomic};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path};

/// The record of what was brought, in the folder of the dataset.
const RECORD: &str = "files.json";
/// Folder for files that the capture no longer has: they may be the last copies.
const UNUSED: &str = "unused";
/// Folder of photographs.
pub(super) const IMAGES: &str = "images";
/// Folder of masks.
pub(super) const MASKS: &str = "masks";

/// Paths relative to the folder of the dataset, with `/`.
type Files = BTreeSet<String>;

/// A file that belongs to a photograph, and its place in the dataset.
struct Belonging<'a> {
    from: &'a Path,
    folder: &'static str,
    name: String,
}

/// The files of a photograph: itself, and its mask and its maps of depth and normals, under its name with their own extension appended.
fn belongings(photo: &PhotoEntry) -> impl Iterator<Item = Belonging<'_>> {
    let beside = [
        (&photo.mask, MASKS),
        (&photo.depth, "depths"),
        (&photo.normals, "normals"),
    ];
    let image = Belonging {
        from: &photo.path,
        folder: IMAGES,
        name: photo.name.clone(),
    };
    std::iter::once(image).chain(beside.into_iter().filter_map(|(file, folder)| {
        let from = file.as_deref()?;
        let extension = from.extension().unwrap_or_default().to_string_lossy();
        Some(Belonging {
            from,
            folder,
            name: format!("{}.{extension}", photo.name),
        })
    }))
}

impl Belonging<'_> {
    fn file(&self) -> String {
        format!("{}/{}", self.folder, self.name)
    }

    /// Whether it already is the file `to`, and not a hard link or copy of it.
    fn is(&self, to: &Path) -> bool {
        same_file(self.from, to)
    }

    /// Brings the file into `folder`, which is created: as a hard link if the file system allows it, otherwise as a copy. Masks are always
    /// copied, since users edit them in a dataset. Another file of that name is put away: it may be the only copy.
    fn bring(&self, out: &Path, folder: &str) -> Result<(), RunError> {
        let name = format!("{folder}/{}", self.name);
        let to = &out.join(&name);
        if self.is(to) || (to.exists() && has_bytes_of(to, self.from)?) {
            return Ok(());
        }
        put_away(out, std::iter::once(name))?;
        let around = to.parent().unwrap_or(out);
        fs::create_dir_all(around).map_err(RunError::io("create", around))?;
        if self.folder == MASKS || fs::hard_link(self.from, to).is_err() {
            fs::copy(self.from, to).map_err(RunError::io("write", to))?;
        }
        Ok(())
    }
}

/// Whether two files have the same content. Files of equal size and modification time count as links of one file; others are compared.
fn has_bytes_of(one: &Path, other: &Path) -> Result<bool, RunError> {
    let metadata = |path: &Path| fs::metadata(path).map_err(RunError::io("read", path));
    let bytes = |path: &Path| fs::read(path).map_err(RunError::io("read", path));
    let [a, b] = [metadata(one)?, metadata(other)?];
    let is_link = a.modified().ok().zip(b.modified().ok()).is_some_and(|(a, b)| a == b);
    Ok(a.len() == b.len() && (is_link || bytes(one)? == bytes(other)?))
}

/// Brings a photograph, its mask and its maps of depth and normals into the folders `images`, `masks`, `depths` and `normals` of the
/// dataset.
pub(super) fn bring_photo(out: &Path, photo: &PhotoEntry) -> Result<(), RunError> {
    belongings(photo).try_for_each(|file| file.bring(out, file.folder))
}

/// Brings a panorama and its mask into the dataset, where training finds them beside their faces.
pub(super) fn bring_panorama(out: &Path, panorama: &PhotoEntry) -> Result<(), RunError> {
    belongings(panorama).try_for_each(|file| match file.folder {
        IMAGES => file.bring(out, PANORAMAS),
        MASKS => file.bring(out, PANORAMA_MASKS),
        _ => Ok(()),
    })
}

/// Puts away masks and maps that an earlier call brought and `photos` no longer have: masks removed by the user would still hide pixels.
pub(super) fn clear_beside(out: &Path, photos: &[PhotoEntry]) -> Result<(), RunError> {
    let has: Files = photos.iter().flat_map(belongings).map(|file| file.file()).collect();
    let stale = before(out).into_iter();
    put_away(
        out,
        stale.filter(|file| !file.starts_with(IMAGES) && !has.contains(file)),
    )
}

/// Puts away files that an earlier call brought and that do not belong to `posed`, unless photographs were `added`, and records the current
/// files.
pub(super) fn record(out: &Path, posed: &[&PhotoEntry], added: bool) -> Result<(), RunError> {
    let before = before(out);
    // Files that were in the dataset from the start are not recorded, and stay.
    let brought = |file: &Belonging| before.contains(&file.file()) || !file.is(&out.join(file.file()));
    let files = posed.iter().flat_map(|photo| belongings(photo));
    let mut now: Files = files.filter(brought).map(|file| file.file()).collect();
    match added {
        true => now.extend(before),
        false => put_away(out, before.difference(&now).cloned())?,
    }
    write_atomic(&out.join(RECORD), |file| file.write_all(&to_json(&now)))?;
    Ok(())
}

fn before(out: &Path) -> Files {
    let record = fs::read(out.join(RECORD)).ok();
    record
        .and_then(|bytes| serde_json::from_slice(&bytes).ok())
        .unwrap_or_default()
}

/// Moves those of the dataset's `files` that exist into [`UNUSED`], where `a.2.png` stands beside an earlier `a.png`, and removes folders
/// that become empty. Paths that lead outside of the dataset are ignored.
pub(super) fn put_away(out: &Path, files: impl Iterator<Item = String>) -> Result<(), RunError> {
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
        let wanted = out.join(UNUSED).join(&file);
        let folder = wanted.parent().expect("in a folder");
        fs::create_dir_all(folder).map_err(RunError::io("create", folder))?;
        let extension = wanted.extension().unwrap_or_default().to_string_lossy();
        let to = std::iter::once(wanted.clone())
            .chain((2u32..).map(|n| wanted.with_extension(format!("{n}.{extension}"))))
            .find(|to| !to.exists() || has_bytes_of(to, &path).unwrap_or(false))
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
    fn what_an_earlier_call_brought_is_put_away_and_nothing_else() {
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
        let bring = |added: bool| {
            let photos = read_photo_folder(&source).unwrap().photos;
            clear_beside(&out, &photos).unwrap();
            photos.iter().try_for_each(|photo| bring_photo(&out, photo)).unwrap();
            record(&out, &photos.iter().collect::<Vec<_>>(), added).unwrap();
        };
        let there = |file: &str| out.join(file).exists();
        bring(false);
        assert!(there("masks/a.png.png") && there("images/b.png"));
        write(out.join("masks/mine.png"), 7);
        fs::remove_dir_all(source.join("masks")).unwrap();
        fs::remove_file(source.join("b.png")).unwrap();
        bring(true);
        assert!(
            !there("masks/a.png.png") && there("images/b.png"),
            "photographs stay where others are added"
        );
        bring(false);
        assert!(there("images/a.png") && !there("images/b.png") && there("masks/mine.png"));
        assert!(
            there("unused/images/b.png") && there("unused/masks/a.png.png"),
            "nothing is lost"
        );
        write(source.join("b.png"), 9);
        bring(true);
        fs::remove_file(source.join("b.png")).unwrap();
        bring(false);
        assert!(
            there("unused/images/b.png") && there("unused/images/b.2.png"),
            "nor replaced by what is put away later"
        );
        fs::write(out.join(RECORD), r#"["../source/a.png", "images/none.png"]"#).unwrap();
        bring(false);
        assert!(source.join("a.png").exists());
        // A dataset that is posed in place: its own files are not recorded.
        let photos = read_photo_folder(&out).unwrap().photos;
        fs::remove_file(out.join(RECORD)).unwrap();
        record(&out, &photos.iter().collect::<Vec<_>>(), false).unwrap();
        record(&out, &[], false).unwrap();
        assert!(there("images/a.png"));
    }
}
