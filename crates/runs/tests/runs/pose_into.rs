//! Photographs that are added to a dataset.

use crate::pose::{photographs, pose_silently};
use irradia_formats::{DatasetOptions, read_dataset};
use irradia_runs::PoseInput;
use std::fs;

#[test]
fn photographs_are_added_to_a_dataset_whose_poses_stay() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for name in ["photos", "more"] {
        fs::create_dir(at(name)).unwrap();
    }
    let truth = photographs(&at("photos"));
    let later = &truth[truth.len() - 5..];
    for (name, _) in later {
        fs::rename(at("photos").join(name), at("more").join(name)).unwrap();
    }
    // One is a portrait.
    let portrait = at("more").join(&later[0].0);
    image::open(&portrait).unwrap().rotate90().save(&portrait).unwrap();
    fs::copy(at("photos").join("00.png"), at("more").join("again.png")).unwrap();
    let data = at("data");
    let first = pose_silently(&PoseInput::new(at("photos"), &data)).unwrap();
    let positions = || {
        let dataset = read_dataset(&data, &DatasetOptions::default()).unwrap();
        let place = |view: &irradia_runs::scene::View| {
            (view.name.clone(), dataset.world_from_dataset, view.camera.pose.position)
        };
        dataset.views.iter().map(place).collect::<Vec<_>>()
    };
    let before = positions();
    let mut input = PoseInput::new(at("more"), &data);
    input.into = true;
    let second = pose_silently(&input).unwrap();
    assert_eq!(second.registered, first.registered + later.len(), "{second:#?}");
    let [level, turned] = &second.cameras[..] else {
        panic!("{second:#?}");
    };
    let [width, height] = level.size;
    assert_eq!((turned.photos, turned.size), (1, [height, width]));
    assert_eq!((turned.focal_px, level.photos), (level.focal_px, first.registered + 4));
    let copy = second.left_out.iter().find(|left| left.name == "again.png").unwrap();
    assert!(copy.reason.contains("already, as 00.png"), "{copy:?}");
    let after = positions();
    assert_eq!(after.len(), before.len() + later.len());
    assert!(before.iter().all(|view| after.contains(view)), "poses stay");
    // If another program made the dataset, its model is put away; other models and files stay.
    fs::remove_file(data.join("pose.json")).unwrap();
    let sparse = data.join("sparse");
    fs::create_dir(sparse.join("1")).unwrap();
    for (file, to) in [("cameras.bin", "1/cameras.bin"), ("images.bin", "1/images.bin")] {
        fs::copy(sparse.join("0").join(file), sparse.join(to)).unwrap();
    }
    fs::write(sparse.join("0/project.ini"), "theirs").unwrap();
    let theirs = fs::read(sparse.join("0/images.bin")).unwrap();
    fs::rename(at("more").join("again.png"), at("photos").join("again.png")).unwrap();
    image::open(at("photos").join("01.png"))
        .unwrap()
        .fliph()
        .save(at("more").join("other.png"))
        .unwrap();
    pose_silently(&input).unwrap();
    assert!(sparse.join("0/project.ini").is_file() && sparse.join("1/images.bin").is_file());
    assert_eq!(fs::read(data.join("unused/sparse/0/images.bin")).unwrap(), theirs);
    assert!(before.iter().all(|view| positions().contains(view)), "poses stay");
    // Photographs in subfolders of `images` are found.
    fs::create_dir(data.join("images/left")).unwrap();
    fs::rename(data.join("images/00.png"), data.join("images/left/00.png")).unwrap();
    let images = sparse.join("0/images.bin");
    let bytes = fs::read(&images).unwrap();
    let name = bytes.windows(7).position(|bytes| bytes == b"00.png\0").unwrap();
    fs::write(&images, [&bytes[..name], b"left/", &bytes[name..]].concat()).unwrap();
    let before = positions();
    assert!(before.iter().any(|view| view.0.contains("left")), "{before:?}");
    pose_silently(&input).unwrap();
    assert!(before.iter().all(|view| positions().contains(view)), "poses stay");
    fs::remove_file(at("more").join("other.png")).unwrap();
    // Having nothing to add, or no dataset at all, is reported in one line.
    let error = pose_silently(&input).unwrap_err().to_string();
    assert!(error.contains("no photograph to add"), "{error}");
    let mut nowhere = PoseInput::new(at("more"), at("photos"));
    nowhere.into = true;
    let error = pose_silently(&nowhere).unwrap_err().to_string();
    assert!(error.contains("no COLMAP model"), "{error}");
}
