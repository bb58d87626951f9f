//! Which views are held out.

use super::declared::Split;
use irradia_scene::every_eighth;
use std::collections::HashSet;
use std::path::Path;

/// Files that list the held-out and the training images, one name a line.
const TEST_LISTS: [&str; 2] = ["test_images.txt", "test.txt"];
const TRAIN_LISTS: [&str; 2] = ["train_images.txt", "train.txt"];
/// Beside the images, or where the Inria code keeps them.
const FOLDERS: [&str; 2] = ["", "sparse/0"];

/// Sets the split of views that have none from lists beside the dataset. Returns a warning when a list fits nothing.
pub(super) fn apply_lists(root: &Path, names: &[String], splits: &mut [Option<Split>]) -> Option<String> {
    if splits.iter().any(Option::is_some) {
        return None;
    }
    let (test, train) = (read_list(root, TEST_LISTS), read_list(root, TRAIN_LISTS));
    let is_in = |list: &Option<(String, HashSet<String>)>, name: &str| {
        list.as_ref()
            .is_some_and(|(_, listed)| names_of(name).any(|n| listed.contains(n)))
    };
    let in_test: Vec<bool> = names.iter().map(|name| is_in(&test, name)).collect();
    let in_train: Vec<bool> = names.iter().map(|name| is_in(&train, name)).collect();
    for (list, found) in [(&test, &in_test), (&train, &in_train)] {
        if let Some((file, _)) = list
            && !found.contains(&true)
        {
            return Some(format!(
                "{file} names none of the images and is ignored; every 8th view is held out"
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
            _ => Split::Left,
        });
    }
    None
}

/// Indices of the training and of the held-out views, and a warning where the dataset's own split cannot be used.
pub(super) fn indices(splits: &[Option<Split>]) -> (Vec<usize>, Vec<usize>, Option<String>) {
    if splits.iter().all(Option::is_none) {
        let (train, test) = every_eighth(splits.len());
        return (train, test, None);
    }
    let with = |wanted: &[Option<Split>]| {
        (0..splits.len())
            .filter(|i| wanted.contains(&splits[*i]))
            .collect::<Vec<_>>()
    };
    let (train, test) = (with(&[Some(Split::Train), None]), with(&[Some(Split::Test)]));
    let why = match (train.is_empty(), test.is_empty()) {
        (false, false) => return (train, test, None),
        (true, _) => "the dataset's split leaves no view to train on",
        (_, true) => "the dataset's split holds out no view",
    };
    let (train, test) = every_eighth(splits.len());
    (train, test, Some(format!("{why}; every 8th view is held out instead")))
}

/// A view's name as lists may write it: whole, below the folder of images, and both without the extension.
fn names_of(name: &str) -> impl Iterator<Item = &str> {
    let below = name.split_once('/').map_or(name, |(_, below)| below);
    let stem = |name| Path::new(name).file_stem().and_then(|s| s.to_str()).unwrap_or(name);
    [name, below, stem(below)].into_iter()
}

fn read_list(root: &Path, files: [&str; 2]) -> Option<(String, HashSet<String>)> {
    let candidates = FOLDERS
        .iter()
        .flat_map(|folder| files.iter().map(move |file| Path::new(folder).join(file)));
    for candidate in candidates {
        if let Ok(text) = std::fs::read_to_string(root.join(&candidate)) {
            let lines = text
                .lines()
                .map(str::trim)
                .filter(|line| !line.is_empty() && !line.starts_with('#'));
            let listed = lines
                .map(|line| line.trim_start_matches("./").replace('\\', "/"))
                .collect();
            return Some((candidate.display().to_string(), listed));
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

    #[test]
    fn lists_name_images_with_and_without_folder_and_extension() {
        for line in ["images/2.png", "2.png", "2", "./2.png\n"] {
            let root = tempfile::tempdir().unwrap();
            std::fs::write(root.path().join("test.txt"), format!("# held out\n{line}\n")).unwrap();
            let mut splits = vec![None; 4];
            assert_eq!(apply_lists(root.path(), &names(), &mut splits), None);
            assert_eq!(indices(&splits), (vec![0, 1, 3], vec![2], None));
        }
    }

    #[test]
    fn a_list_of_strangers_is_ignored_and_said() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("test.txt"), "x.png\n").unwrap();
        let mut splits = vec![None; 4];
        assert!(
            apply_lists(root.path(), &names(), &mut splits)
                .unwrap()
                .contains("test.txt")
        );
        assert_eq!(indices(&splits).1, [0]);
    }

    #[test]
    fn both_lists_leave_out_who_is_in_neither() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("test.txt"), "0").unwrap();
        std::fs::write(root.path().join("train.txt"), "1\n3").unwrap();
        let mut splits = vec![None; 4];
        assert_eq!(apply_lists(root.path(), &names(), &mut splits), None);
        assert_eq!(indices(&splits), (vec![1, 3], vec![0], None));
    }

    #[test]
    fn a_split_without_training_views_is_replaced() {
        let (train, test, warning) = indices(&[Some(Split::Test); 9]);
        assert_eq!((train.len(), test), (7, vec![0, 8]));
        assert!(warning.unwrap().contains("no view to train on"));
    }
}
