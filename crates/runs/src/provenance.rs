//! Fingerprints of a run's data and of the program, to detect changes.

use crate::{RunError, is_film_name};
use irradia_formats::is_image_name;
use irradia_scene::{Dataset, Lens};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::{fs, io};

/// `views.json`: the views of a run's dataset, by name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewList(BTreeMap<String, ViewRecord>);

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct ViewRecord {
    width: u32,
    height: u32,
    part: SplitPart,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum SplitPart {
    Train,
    Test,
    Neither,
}

impl ViewList {
    pub fn of(dataset: &Dataset) -> Self {
        let mut parts = vec![SplitPart::Neither; dataset.views.len()];
        dataset.train.iter().for_each(|i| parts[*i] = SplitPart::Train);
        dataset.test.iter().for_each(|i| parts[*i] = SplitPart::Test);
        let record = |(view, part): (&irradia_scene::View, SplitPart)| {
            let k = &view.camera.intrinsics;
            let (width, height) = (k.width, k.height);
            (view.name.clone(), ViewRecord { width, height, part })
        };
        Self(dataset.views.iter().zip(parts).map(record).collect())
    }

    /// Splits `dataset` as before: by their names, views are held out or left out again, and all others are trained on. Returns how many of
    /// the views that were held out are missing; `None` if no name is known, in which case nothing changes.
    pub fn split(&self, dataset: &mut Dataset) -> Option<usize> {
        let part = |view: usize| self.0.get(&dataset.views[view].name).map(|record| record.part);
        let views = || 0..dataset.views.len();
        views().find_map(part)?;
        let test: Vec<usize> = views().filter(|view| part(*view) == Some(SplitPart::Test)).collect();
        let train = views()
            .filter(|view| !matches!(part(*view), Some(SplitPart::Test | SplitPart::Neither)))
            .collect();
        let found: HashSet<&str> = test.iter().map(|view| dataset.views[*view].name.as_str()).collect();
        let is_missing =
            |(name, record): &(&String, &ViewRecord)| record.part == SplitPart::Test && !found.contains(name.as_str());
        let missing = self.0.iter().filter(is_missing).count();
        (dataset.train, dataset.test) = (train, test);
        Some(missing)
    }

    /// How many of the views that `dataset` holds out were trained on, by their names.
    pub fn trained_on(&self, dataset: &Dataset) -> usize {
        let held_out = dataset.test.iter().map(|view| &dataset.views[*view].name);
        let is_trained = |name: &&String| self.0.get(*name).is_some_and(|record| record.part == SplitPart::Train);
        held_out.filter(is_trained).count()
    }

    /// Differences from `now`: one phrase per kind of difference, each with the first view concerned.
    pub fn differences(&self, now: &Self) -> Vec<String> {
        let phrase = |what: &str, names: Vec<&String>| {
            let first = names.first()?;
            Some(format!("{} {what}, such as {first}", names.len()))
        };
        let missing_from = |of: &Self, from: &Self| -> Vec<String> {
            of.0.keys()
                .filter(|name| !from.0.contains_key(*name))
                .cloned()
                .collect()
        };
        let (gone, new) = (missing_from(self, now), missing_from(now, self));
        let both = || {
            self.0
                .iter()
                .filter_map(|(name, then)| Some((name, then, now.0.get(name)?)))
        };
        let sizes = both().filter(|(_, a, b)| (a.width, a.height) != (b.width, b.height));
        let parts = both().filter(|(_, a, b)| a.part != b.part);
        [
            phrase("views are gone", gone.iter().collect()),
            phrase("views are new", new.iter().collect()),
            phrase("views have another size", sizes.map(|(name, ..)| name).collect()),
            phrase(
                "views changed between training and held out",
                parts.map(|(name, ..)| name).collect(),
            ),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// FNV-1a, 64 bits.
struct Hash(u64);

impl Hash {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    fn hex(&self) -> String {
        format!("{:016x}", self.0)
    }
}

/// Maximum depth of the search for files, which a link back to a parent would otherwise make endless.
const MAX_DEPTH: u32 = 6;

/// A hash of the data in `folders`, the dataset's and those of photographs elsewhere, as training uses it: names and sizes of all photographs,
/// masks, maps and films, and, if they have poses, names, split, sizes, cameras and number of points of `dataset`. The pixels are not read.
pub fn data_fingerprint(dataset: Option<&Dataset>, folders: &[&Path]) -> String {
    let mut hash = Hash::new();
    for folder in folders {
        let mut files = Vec::new();
        add_files(folder, MAX_DEPTH, &mut files);
        files.sort();
        for (path, bytes) in files {
            hash.add(
                path.strip_prefix(folder)
                    .unwrap_or(&path)
                    .as_os_str()
                    .as_encoded_bytes(),
            );
            hash.add(&bytes.to_le_bytes());
        }
    }
    if let Some(dataset) = dataset {
        add_dataset(&mut hash, dataset);
    }
    hash.hex()
}

/// Adds the images and films at `path`, or below it and outside the folders of runs, and their sizes.
fn add_files(path: &Path, depth: u32, files: &mut Vec<(PathBuf, u64)>) {
    if let Ok(entries) = fs::read_dir(path) {
        let is_shown = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            !name.starts_with('.') && !path.join("run.json").is_file()
        };
        let below = entries.flatten().map(|entry| entry.path()).filter(is_shown);
        if depth > 0 {
            below.for_each(|path| add_files(&path, depth - 1, files));
        }
        return;
    }
    let is_map = path
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("npy"));
    if (is_image_name(path) || is_map || is_film_name(path))
        && let Ok(file) = fs::metadata(path)
    {
        files.push((path.to_owned(), file.len()));
    }
}

fn add_dataset(hash: &mut Hash, dataset: &Dataset) {
    hash.add(&serde_json::to_vec(&ViewList::of(dataset)).expect("plain data"));
    for view in &dataset.views {
        let k = &view.camera.intrinsics;
        let pose = &view.camera.pose;
        let numbers = [k.fx, k.fy, k.cx, k.cy].into_iter();
        let numbers = numbers.chain(pose.position.to_array()).chain(pose.rotation.to_array());
        numbers.for_each(|number| hash.add(&number.to_bits().to_le_bytes()));
        if k.lens != Lens::Pinhole {
            hash.add(format!("{:?}", k.lens).as_bytes());
        }
        if let Some(shutter) = &view.camera.shutter {
            hash.add(format!("{shutter:?}").as_bytes());
        }
    }
    let points = dataset.points.as_ref().map_or(0, |points| points.len());
    hash.add(&(points as u64).to_le_bytes());
}

/// A hash of this program's file, which differs between builds.
///
/// # Errors
/// When the file cannot be read.
pub fn program_fingerprint() -> io::Result<String> {
    Ok(hash_of(&fs::read(std::env::current_exe()?)?))
}

/// A hash of the content of the file `path`.
pub(crate) fn file_fingerprint(path: &Path) -> Result<String, RunError> {
    Ok(hash_of(&fs::read(path).map_err(RunError::io("read", path))?))
}

fn hash_of(bytes: &[u8]) -> String {
    let mut hash = Hash::new();
    hash.add(bytes);
    hash.hex()
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_synth::{SynthOptions, dataset};

    #[test]
    fn each_kind_of_difference_is_described() {
        let data = data();
        let then = ViewList::of(&data);
        let changed = |change: &dyn Fn(&mut Dataset)| {
            let mut data = data.clone();
            change(&mut data);
            let fingerprint = |data: &Dataset| data_fingerprint(Some(data), &[]);
            assert_ne!(fingerprint(&data), fingerprint(&self::data()));
            then.differences(&ViewList::of(&data)).join("; ")
        };
        assert!(then.differences(&ViewList::of(&data)).is_empty());
        let renamed = changed(&|data| data.views[0].name = "other".into());
        assert!(
            renamed.contains("1 views are gone") && renamed.contains("new, such as other"),
            "{renamed}"
        );
        assert!(changed(&|data| data.views[1].camera.intrinsics.width = 23).contains("another size"));
        let moved = changed(&|data| {
            let view = data.train.pop().unwrap();
            data.test.push(view);
        });
        assert!(moved.contains("held out"), "{moved}");
    }

    #[test]
    fn photographs_masks_and_films_count_wherever_they_are() {
        let [data, elsewhere] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let fingerprint = || data_fingerprint(None, &[data.path(), elsewhere.path()]);
        let mut known = vec![fingerprint()];
        for file in ["a.JPG", "masks/a.png", "depths/b/a.npy", "walk.mp4"] {
            for folder in [&data, &elsewhere] {
                let path = folder.path().join(file);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                for size in [1, 2] {
                    fs::write(&path, vec![0; size]).unwrap();
                    let now = fingerprint();
                    assert!(!known.contains(&now), "{file} of {size} bytes");
                    known.push(now);
                }
            }
        }
        // Notes, and what a run in the folder writes.
        fs::create_dir_all(data.path().join("run/eval")).unwrap();
        for file in ["notes.txt", "run/run.json", "run/eval/a.png"] {
            fs::write(data.path().join(file), "x").unwrap();
        }
        assert_eq!(known.last(), Some(&fingerprint()));
    }

    #[test]
    fn held_out_views_are_missing_by_name_however_many_have_that_name() {
        let mut then = data();
        (then.train, then.test) = (vec![0, 1], vec![2, 3]);
        let list = ViewList::of(&then);
        // Two photographs of the name of one that was held out, and none of the other's.
        let mut now = data();
        let name = now.views[2].name.clone();
        now.views[3].name.clone_from(&name);
        now.views[1].name = name;
        assert_eq!(list.split(&mut now), Some(1));
        assert_eq!((now.train, now.test), (vec![0], vec![1, 2, 3]));
    }

    fn data() -> Dataset {
        let options = SynthOptions {
            views: 4,
            width: 24,
            height: 16,
            seed: 1,
            ..SynthOptions::default()
        };
        dataset(&options).unwrap()
    }
}
