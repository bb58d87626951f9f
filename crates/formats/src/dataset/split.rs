//! Selection of held-out views.

use super::declared::Split;
use crate::FormatError;
use crate::error::read_file;
use crate::text::text;
use irradia_scene::every_eighth;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Files that list the held-out and the training images, one name per line.
const TEST_LISTS: [&str; 2] = ["test_images.txt", "test.txt"];
const TRAIN_LISTS: [&str; 2] = ["train_images.txt", "train.txt"];
/// Folders of these lists: the dataset's own, and the Inria code's location.
const LIST_FOLDERS: [&str; 2] = ["", "sparse/0"];
/// Maximum number of names in a warning.
const MAX_NAMES: usize = 3;

/// Selects the views held out of training.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Holdout {
    /// The dataset's own split; every 8th view if it has none.
    #[default]
    AsDeclared,
    /// Every n-th view in the order of names, including the first; 2 or more. The dataset's own split is ignored.
    Every(usize),
    /// None: all views are training views.
    Nothing,
    /// The views listed in this file, one per line, with or without folder and extension; all others are training views.
    Listed(PathBuf),
}

/// A list of image names.
struct NameList {
    /// The file it was read from.
    file: String,
    names: HashSet<String>,
}

impl NameList {
    fn parse(file: String, text: &str) -> Self {
        let lines = text
            .lines()
            .map(str::trim)
            .filter(|line| !line.is_empty() && !line.starts_with('#'));
        let names = lines
            .map(|line| line.trim_start_matches("./").replace('\\', "/"))
            .collect();
        Self { file, names }
    }

    fn contains(&self, name: &str) -> bool {
        name_variants(name).any(|n| self.names.contains(n))
    }

    /// The warning about names that match none of the views `names`.
    fn missing_warning(&self, names: &[String]) -> Option<String> {
        let known: HashSet<&str> = names.iter().flat_map(|name| name_variants(name)).collect();
        let names = self.names.iter().map(String::as_str);
        let mut missing: Vec<&str> = names.filter(|name| !known.contains(name)).collect();
        missing.sort_unstable();
        let first = missing.iter().take(MAX_NAMES).copied().collect::<Vec<_>>().join(", ");
        (!missing.is_empty()).then(|| {
            format!(
                "{} names in {} are not views of the dataset, such as {first}",
                missing.len(),
                self.file
            )
        })
    }
}

/// Indices of the training and of the held-out views.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Indices {
    pub train: Vec<usize>,
    pub test: Vec<usize>,
    pub warning: Option<String>,
}

/// The split of the usable views `names`; the dataset in `root` declares `splits`.
///
/// # Errors
/// One line, when the file of [`Holdout::Listed`] matches nothing or cannot be read.
pub(super) fn split(
    holdout: &Holdout,
    root: &Path,
    names: &[String],
    mut splits: Vec<Option<Split>>,
) -> Result<Indices, FormatError> {
    let split_by = |held_out: &dyn Fn(usize) -> bool| {
        let (test, train) = (0..names.len()).partition(|i| held_out(*i));
        Indices {
            train,
            test,
            warning: None,
        }
    };
    let mut indices = match holdout {
        Holdout::AsDeclared => {
            let warning = apply_lists(root, names, &mut splits);
            let mut declared = declared_split(&splits);
            declared.warning = warning.or(declared.warning);
            declared
        }
        Holdout::Every(n) => split_by(&|i| i.is_multiple_of(*n)),
        Holdout::Nothing => split_by(&|_| false),
        Holdout::Listed(file) => {
            let list = NameList::parse(file.display().to_string(), &text(&read_file(file)?));
            let listed = split_by(&|i| list.contains(&names[i]));
            if listed.test.is_empty() {
                return Err(FormatError::Option(format!(
                    "holdout {}: the list names none of the {} views, such as {}",
                    list.file,
                    names.len(),
                    names.first().map_or("", String::as_str)
                )));
            }
            Indices {
                warning: list.missing_warning(names),
                ..listed
            }
        }
    };
    if indices.test.is_empty() && *holdout != Holdout::Nothing {
        let line = "no view is held out, so nothing is evaluated; the option holdout selects some";
        indices.warning.get_or_insert_with(|| line.into());
    }
    Ok(indices)
}

/// Sets the split of views without one from lists beside the dataset. Returns a warning when a list matches nothing, or has names that match
/// nothing.
fn apply_lists(root: &Path, names: &[String], splits: &mut [Option<Split>]) -> Option<String> {
    if splits.iter().any(Option::is_some) {
        return None;
    }
    let (test, train) = (read_list(root, TEST_LISTS), read_list(root, TRAIN_LISTS));
    let is_in = |list: &Option<NameList>, name: &str| list.as_ref().is_some_and(|list| list.contains(name));
    let in_test: Vec<bool> = names.iter().map(|name| is_in(&test, name)).collect();
    let in_train: Vec<bool> = names.iter().map(|name| is_in(&train, name)).collect();
    for (list, matched) in [(&test, &in_test), (&train, &in_train)] {
        if let Some(list) = list
            && !matched.contains(&true)
        {
            return Some(format!(
                "{} names none of the images and is ignored; every 8th view is held out",
                list.file
            ));
        }
    }
    if test.is_none() && train.is_none() {
        return None;
    }
    for (i, split) in splits.iter_mut().enumerate() {
        *split = Some(match (in_test[i], in_train[i]) {
            (true, _) => Split::Test,
            (_, true) => Split::Train,
            _ if train.is_none() => Split::Train,
            _ if test.is_none() => Split::Test,
            _ => Split::Unlisted,
        });
    }
    let missing = [&test, &train].into_iter().flatten();
    let missing: Vec<String> = missing.filter_map(|list| list.missing_warning(names)).collect();
    (!missing.is_empty()).then(|| missing.join("; "))
}

/// The dataset's own split; every 8th view is held out if it has none.
fn declared_split(splits: &[Option<Split>]) -> Indices {
    if splits.iter().all(Option::is_none) {
        let (train, test) = every_eighth(splits.len());
        return Indices {
            train,
            test,
            warning: None,
        };
    }
    let indices_of = |wanted: &[Option<Split>]| {
        (0..splits.len())
            .filter(|i| wanted.contains(&splits[*i]))
            .collect::<Vec<_>>()
    };
    Indices {
        train: indices_of(&[Some(Split::Train), None]),
        test: indices_of(&[Some(Split::Test)]),
        warning: None,
    }
}

/// The forms in which lists may give a view's name: complete or below the folder of images, each with and without the extension,
/// or its last part with and without the extension.
fn name_variants(name: &str) -> impl Iterator<Item = &str> {
    let below = name.split_once('/').map_or(name, |(_, below)| below);
    let last = name.rsplit('/').next().unwrap_or(name);
    let stem = |name| Path::new(name).file_stem().and_then(|s| s.to_str()).unwrap_or(name);
    let bare = name.rsplit_once('.').map_or(name, |(bare, _)| bare);
    let bare_below = below.rsplit_once('.').map_or(below, |(bare, _)| bare);
    [name, below, bare, bare_below, last, stem(last)].into_iter()
}

fn read_list(root: &Path, files: [&str; 2]) -> Option<NameList> {
    let candidates = LIST_FOLDERS
        .iter()
        .flat_map(|folder| files.iter().map(move |file| Path::new(folder).join(file)));
    for candidate in candidates {
        if let Ok(bytes) = std::fs::read(root.join(&candidate)) {
            return Some(NameList::parse(candidate.display().to_string(), &text(&bytes)));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Vec<String> {
        (0..4).map(|i| format!("images/{i}.png")).collect()
    }

    /// Training and held-out views of four views without a declared split.
    fn indices_for(holdout: Holdout, root: &Path) -> (Vec<usize>, Vec<usize>) {
        let indices = split(&holdout, root, &names(), vec![None; 4]).unwrap();
        (indices.train, indices.test)
    }

    #[test]
    fn lists_name_images_with_and_without_folder_and_extension() {
        for line in ["images/2.png", "2.png", "images/2", "2", "./2.png\n"] {
            let root = tempfile::tempdir().unwrap();
            std::fs::write(root.path().join("test.txt"), format!("# held out\n{line}\n")).unwrap();
            assert_eq!(indices_for(Holdout::AsDeclared, root.path()), (vec![0, 1, 3], vec![2]));
            let listed = Holdout::Listed(root.path().join("test.txt"));
            assert_eq!(indices_for(listed, Path::new("elsewhere")), (vec![0, 1, 3], vec![2]));
        }
    }

    #[test]
    fn a_file_name_matches_in_any_folder_and_names_without_a_view_are_reported() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("list.txt");
        // In Windows-1252.
        std::fs::write(&file, b"1\xfc.jpg\nx.jpg\ny\n").unwrap();
        let names = ["images/cam0/1ü.jpg", "images/cam1/1ü.jpg", "images/cam1/2.jpg"].map(String::from);
        let indices = split(&Holdout::Listed(file), root.path(), &names, vec![None; 3]).unwrap();
        assert_eq!((indices.train, indices.test), (vec![2], vec![0, 1]));
        let warning = indices.warning.unwrap();
        assert!(
            warning.starts_with("2 names in") && warning.ends_with("such as x.jpg, y"),
            "{warning}"
        );
    }

    #[test]
    fn an_unmatched_list_is_ignored_with_a_warning_or_rejected_if_requested() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("test.txt"), "x.png\n").unwrap();
        let indices = split(&Holdout::AsDeclared, root.path(), &names(), vec![None; 4]).unwrap();
        assert_eq!(indices.test, [0]);
        assert!(indices.warning.unwrap().contains("test.txt"));
        let listed = Holdout::Listed(root.path().join("test.txt"));
        let error = split(&listed, root.path(), &names(), vec![None; 4])
            .unwrap_err()
            .to_string();
        assert!(error.contains("test.txt") && error.contains("images/0.png"), "{error}");
    }

    #[test]
    fn with_both_lists_views_in_neither_are_skipped() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("test.txt"), "0").unwrap();
        std::fs::write(root.path().join("train.txt"), "1\n3").unwrap();
        assert_eq!(indices_for(Holdout::AsDeclared, root.path()), (vec![1, 3], vec![0]));
        std::fs::write(root.path().join("test.txt"), "0\nimages/9.png").unwrap();
        let indices = split(&Holdout::AsDeclared, root.path(), &names(), vec![None; 4]).unwrap();
        assert_eq!((indices.train, indices.test), (vec![1, 3], vec![0]));
        let warning = indices.warning.unwrap();
        assert!(
            warning.starts_with("1 names in test.txt") && warning.ends_with("such as images/9.png"),
            "{warning}"
        );
    }

    #[test]
    fn a_requested_split_overrides_the_declared_one() {
        let root = tempfile::tempdir().unwrap();
        let declared = vec![Some(Split::Train), Some(Split::Test), Some(Split::Unlisted), None];
        let indices_for = |holdout: Holdout| split(&holdout, root.path(), &names(), declared.clone()).unwrap();
        let indices = indices_for(Holdout::AsDeclared);
        assert_eq!((indices.train, indices.test), (vec![0, 3], vec![1]));
        let indices = indices_for(Holdout::Every(3));
        assert_eq!((indices.train, indices.test), (vec![1, 2], vec![0, 3]));
        let indices = indices_for(Holdout::Nothing);
        assert_eq!((indices.train, indices.warning), (vec![0, 1, 2, 3], None));
    }

    #[test]
    fn a_split_without_held_out_views_is_kept() {
        let root = Path::new("photos");
        let indices = split(&Holdout::AsDeclared, root, &names(), vec![Some(Split::Train); 4]).unwrap();
        assert_eq!((indices.train.len(), indices.test.len()), (4, 0));
        assert!(indices.warning.unwrap().contains("nothing is evaluated"));
    }
}
