//! Small generated datasets: layouts, splits, sizes, orientation, masks, and the messages about broken ones.

use glam::Vec3;
use image::{GrayImage, Rgb, RgbImage};
use irradia_formats::{DatasetFormat, DatasetOptions, Kind, Lenses, describe, detect, read_dataset};
use irradia_scene::{Dataset, View};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const IDENTITY: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";

fn read(path: &Path) -> Result<Dataset, String> {
    read_dataset(path, &DatasetOptions::default()).map_err(|error| error.to_string())
}

fn error_of(path: &Path) -> String {
    let error = read(path).err().expect("an error");
    assert!(!error.contains('\n'), "{error}");
    error
}

/// Red grows to the right and green downwards, so that orientations can be distinguished.
fn picture(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        Rgb([(x * 255 / width) as u8, (y * 255 / height) as u8, 0])
    })
}

/// `count` pictures `images/00.png` .. in a new folder.
fn pictures(count: usize, width: u32, height: u32) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("images")).unwrap();
    for i in 0..count {
        picture(width, height)
            .save(folder.path().join(format!("images/{i:02}.png")))
            .unwrap();
    }
    folder
}

#[test]
fn distorted_photographs_stay_as_they_are_on_request() {
    let as_they_are = |folder: &TempDir| {
        let options = DatasetOptions {
            lenses: Lenses::Distorted,
            ..DatasetOptions::default()
        };
        read_dataset(folder.path(), &options).expect("a dataset")
    };
    let folder = pictures(4, 40, 30);
    let keys = r#""w": 40, "h": 30, "fl_x": 30, "fl_y": 30, "cx": 20, "cy": 15, "k1": -0.05"#;
    fs::write(folder.path().join("transforms.json"), transforms(4, keys)).unwrap();
    let whole = as_they_are(&folder);
    let (view, k) = (&whole.views[0], whole.views[0].camera.intrinsics);
    assert_eq!((k.width, k.height), (40, 30));
    assert!(matches!(k.lens, irradia_scene::Lens::Opencv { .. }));
    let photo = view.photo.load().unwrap();
    assert_eq!((photo.data, photo.mask), (picture(40, 30).into_raw(), None));
    let straight = read(folder.path()).unwrap();
    assert_eq!(straight.views[0].camera.intrinsics.lens, irradia_scene::Lens::Pinhole);

    // A fisheye's photograph is not cut into faces; what is beyond its circle is masked.
    let keys = r#""camera_model": "OPENCV_FISHEYE", "w": 40, "h": 30, "fl_x": 8, "fl_y": 8, "cx": 20, "cy": 15"#;
    fs::write(folder.path().join("transforms.json"), transforms(4, keys)).unwrap();
    for i in 0..4 {
        let round = |x: u32, y: u32| (f64::from(x) - 19.5).hypot(f64::from(y) - 14.5) < 14.0;
        let lit = RgbImage::from_fn(40, 30, |x, y| Rgb(if round(x, y) { [200; 3] } else { [0; 3] }));
        lit.save(folder.path().join(format!("images/{i:02}.png"))).unwrap();
    }
    let cut = read(folder.path()).unwrap();
    assert!(cut.views.iter().all(|view| view.name.ends_with("/front")));
    let round = as_they_are(&folder);
    assert_eq!(round.views.len(), 4);
    let mask = round.views[0].photo.load().unwrap().mask.expect("a circle");
    let kept = mask.iter().filter(|value| **value > 0).count() as f64 / mask.len() as f64;
    assert!(
        (0.40..0.52).contains(&kept),
        "{kept}: a circle of 13.7 pixels covers half"
    );
    assert_eq!((mask[0], mask[40 * 15 + 20]), (0, 255));

    // Panoramas are not cut either; their poles and edges are masked.
    let keys = r#""camera_model": "EQUIRECTANGULAR", "w": 80, "h": 40"#;
    let folder = pictures(4, 80, 40);
    fs::write(folder.path().join("transforms.json"), transforms(4, keys)).unwrap();
    let whole = as_they_are(&folder);
    assert_eq!((whole.views.len(), read(folder.path()).unwrap().views.len()), (4, 24));
    let mask = whole.views[0].photo.load().unwrap().mask.expect("a band");
    assert_eq!([0, 80 * 20, 80 * 20 + 40].map(|at: usize| mask[at]), [0, 0, 255]);
}

/// A transforms file of `count` frames `images/00.png` .. with `keys` at the top.
fn transforms(count: usize, keys: &str) -> String {
    let frames: Vec<String> = (0..count)
        .map(|i| format!(r#"{{"file_path": "images/{i:02}.png", "transform_matrix": {IDENTITY}}}"#))
        .collect();
    format!("{{{keys}, \"frames\": [{}]}}", frames.join(","))
}

#[test]
fn photographs_of_datasets_that_were_moved_are_found() {
    let folder = pictures(4, 40, 30);
    let keys = r#""w": 40, "h": 30, "fl_x": 30, "fl_y": 30"#;
    let here = transforms(4, keys);
    // Named by another machine, before they were converted.
    for there in [
        "/home/user/scene/images/",
        "C:\\\\scene\\\\images\\\\",
        "../scene/images/",
    ] {
        let text = here.replace("images/", there).replace(".png", ".jpeg");
        fs::write(folder.path().join("transforms.json"), text).unwrap();
        let names: Vec<String> = (read(folder.path()).unwrap().views.iter())
            .map(|view| view.name.clone())
            .collect();
        assert_eq!(
            names,
            ["images/00.png", "images/01.png", "images/02.png", "images/03.png"]
        );
    }
    fs::write(
        folder.path().join("transforms.json"),
        here.replace("images/", "others/"),
    )
    .unwrap();
    assert!(read(folder.path()).is_err());
}

fn write_colmap_text(root: &Path, camera: &str, names: &[&str]) {
    let folder = root.join("sparse/0");
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("cameras.txt"), format!("# cameras\n1 {camera}\n")).unwrap();
    let images: String = names
        .iter()
        .enumerate()
        .map(|(i, n)| format!("{i} 1 0 0 0 0 0 0 1 {n}\n\n"))
        .collect();
    fs::write(folder.join("images.txt"), images).unwrap();
}

#[test]
fn smaller_copies_are_used_and_intrinsics_follow_the_actual_size() {
    let folder = pictures(8, 80, 60);
    let root = folder.path();
    let names: Vec<String> = (0..8).map(|i| format!("{i:02}.png")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    // The model was made from images twice as large as those in `images`.
    write_colmap_text(root, "PINHOLE 160 120 100 110 80 60", &names);
    fs::create_dir(root.join("images_4")).unwrap();
    for name in &names {
        picture(20, 15)
            .save(root.join("images_4").join(name.replace("png", "jpg")))
            .unwrap();
    }
    let camera = |downscale: f32| {
        let dataset = read_dataset(
            root,
            &DatasetOptions {
                downscale,
                ..Default::default()
            },
        )
        .unwrap();
        (dataset.views[0].name.clone(), dataset.views[0].camera.intrinsics)
    };
    let (name, k) = camera(1.0);
    assert_eq!(
        (name.as_str(), k.width, k.fx, k.fy, k.cx, k.cy),
        ("images/00.png", 80, 50.0, 55.0, 40.0, 30.0)
    );
    let (name, k) = camera(4.0);
    assert_eq!(
        (name.as_str(), k.width, k.height, k.fx),
        ("images_4/00.png", 20, 15, 12.5)
    );
    let (name, k) = camera(2.0);
    assert_eq!((name.as_str(), k.width, k.fx), ("images/00.png", 40, 25.0));
    let dataset = read(root).unwrap();
    assert_eq!((dataset.test, dataset.train.len()), (vec![0], 7));
    for downscale in [0.5, f32::NAN, 0.0, f32::INFINITY] {
        assert!(
            read_dataset(
                root,
                &DatasetOptions {
                    downscale,
                    ..Default::default()
                }
            )
            .is_err()
        );
    }
}

#[test]
fn exif_orientation_is_applied_exactly_when_the_poses_include_it() {
    let folder = pictures(3, 60, 80);
    let root = folder.path();
    for i in 0..3 {
        let jpeg = root.join(format!("images/{i:02}.png")).with_extension("jpg");
        picture(80, 60).save(&jpeg).unwrap();
        // Orientation 6: rotate 90 degrees clockwise to see it upright.
        let mut exif =
            b"\xff\xe1\x00\x22Exif\0\0II\x2a\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
        assert_eq!(exif.len(), 2 + 0x22);
        let mut bytes = fs::read(&jpeg).unwrap();
        exif.extend(bytes.split_off(2));
        bytes.extend(exif);
        fs::write(root.join(format!("images/{i:02}.png")), bytes).unwrap();
    }
    let corner = |keys: &str| {
        fs::write(root.join("transforms.json"), transforms(3, keys)).unwrap();
        let view = &read(root).unwrap().views[0];
        let photo = view.photo.load().unwrap();
        assert_eq!(
            (photo.width, photo.height),
            (view.camera.intrinsics.width, view.camera.intrinsics.height)
        );
        // Top right corner: red as stored; rotated clockwise it is the former top left, black.
        let at = (photo.width as usize - 1) * 3;
        (photo.width, photo.data[at] > 128)
    };
    assert_eq!(
        corner(r#""fl_x": 70, "w": 80, "h": 60"#),
        (80, true),
        "poses of the stored picture"
    );
    assert_eq!(
        corner(r#""fl_x": 70, "w": 60, "h": 80"#),
        (60, false),
        "poses of the upright picture"
    );
    assert_eq!(
        corner(r#""fl_x": 35, "w": 30, "h": 40"#),
        (60, false),
        "the same, of a smaller copy"
    );
    assert_eq!(corner(r#""fl_x": 70"#), (80, true), "undeclared: as stored");
    // A half turn fits either way.
    for i in 0..3 {
        let file = root.join(format!("images/{i:02}.png"));
        let mut bytes = fs::read(&file).unwrap();
        bytes[30] = 3;
        fs::write(file, bytes).unwrap();
    }
    assert_eq!(corner(r#""fl_x": 70, "w": 80, "h": 60"#), (80, true), "as stored");
}

#[test]
fn photographs_of_another_shape_than_their_cameras_are_named() {
    let folder = pictures(4, 40, 30);
    let warnings_for = |keys: &str| {
        fs::write(folder.path().join("transforms.json"), transforms(4, keys)).unwrap();
        read(folder.path()).unwrap().warnings.join("\n")
    };
    let exchanged = warnings_for(r#""fl_x": 35, "w": 30, "h": 40"#);
    assert!(
        exchanged.contains("4 of 4 photographs do not have the aspect ratio"),
        "{exchanged}"
    );
    assert!(exchanged.contains("40x30 pixels for 30x40"), "{exchanged}");
    for matching in [
        r#""fl_x": 35, "w": 80, "h": 60"#,
        r#""fl_x": 35, "w": 80, "h": 61"#,
        r#""fl_x": 35"#,
    ] {
        assert_eq!(warnings_for(matching), "");
    }
}

#[test]
fn maps_of_depth_are_found_where_files_name_them_and_in_their_folder() {
    let folder = pictures(4, 120, 90);
    let root = folder.path();
    let keys = r#""fl_x": 100, "fl_y": 100, "w": 120, "h": 90"#;
    let map = |path: &str, value: u8| {
        GrayImage::from_pixel(12, 9, image::Luma([value]))
            .save(root.join(path))
            .unwrap()
    };
    fs::create_dir(root.join("depths")).unwrap();
    map("depths/02.png", 2);
    map("far.png", 7);
    let values = |transforms: String, name: &str| -> Vec<Option<f32>> {
        fs::write(root.join(name), transforms).unwrap();
        let views = read_dataset(root, &DatasetOptions::default()).unwrap().views;
        let first = |view: &View| Some(view.depth_map.as_ref()?.load().unwrap().values[0]);
        views.iter().map(first).collect()
    };
    let plain = transforms(4, keys);
    assert_eq!(values(plain.clone(), "transforms.json"), [None, None, Some(2.0), None]);
    let named = plain.replacen("\"file_path\"", "\"depth_file_path\": \"far.png\", \"file_path\"", 1);
    assert!(values(named.clone(), "transforms.json").iter().flatten().eq([&7.0]));
    // Maps of rendered scenes are ground truth for comparisons, not input.
    fs::remove_file(root.join("transforms.json")).unwrap();
    assert_eq!(values(named, "transforms_train.json"), [None; 4]);
}

#[test]
fn distorted_views_come_out_at_their_camera_size_with_their_masks() {
    let folder = pictures(4, 120, 90);
    let root = folder.path();
    fs::create_dir(root.join("masks")).unwrap();
    for i in 0..3 {
        // Half the size of the picture: white on the left.
        let mask = GrayImage::from_fn(60, 45, |x, _| image::Luma([if x < 30 { 255 } else { 0 }]));
        mask.save(root.join(format!("masks/{i:02}.png"))).unwrap();
    }
    let keys =
        r#""fl_x": 100, "fl_y": 100, "cx": 60, "cy": 45, "w": 120, "h": 90, "k1": -0.2, "camera_model": "OPENCV""#;
    fs::write(root.join("transforms.json"), transforms(4, keys)).unwrap();
    let dataset = read_dataset(
        root,
        &DatasetOptions {
            downscale: 1.5,
            ..Default::default()
        },
    )
    .unwrap();
    assert!(
        dataset.warnings[0].contains("1 of 4 images have no mask"),
        "{:?}",
        dataset.warnings
    );
    for (i, view) in dataset.views.iter().enumerate() {
        let photo = view.photo.load().unwrap();
        let k = view.camera.intrinsics;
        assert_eq!((photo.width, photo.height), (k.width, k.height));
        let Some(mask) = photo.mask else {
            assert_eq!(i, 3);
            continue;
        };
        let middle = (k.height / 2 * k.width) as usize;
        let kept: Vec<bool> = mask[middle..middle + k.width as usize]
            .iter()
            .map(|v| *v == 255)
            .collect();
        let edge = kept.iter().position(|kept| !kept).unwrap();
        assert!(
            (edge as f32 - k.cx).abs() <= 1.0 && kept[edge..].iter().all(|kept| !kept),
            "{edge} {}",
            k.cx
        );
    }
}

#[test]
fn nerfstudio_splits_points_and_frames_with_their_own_camera() {
    let folder = pictures(5, 16, 16);
    let root = folder.path();
    let points = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n\
        1 2 3\n4 5 6\n";
    fs::write(root.join("points.ply"), points).unwrap();
    let keys = r#""fl_x": 20, "ply_file_path": "points.ply", "train_filenames": ["images/00.png", "images/02.png"],
        "val_filenames": ["images/04.png"], "test_filenames": ["images/01.png"]"#;
    let text = transforms(5, keys).replacen("\"file_path\"", "\"fl_x\": 30, \"file_path\"", 1);
    fs::write(root.join("transforms.json"), &text).unwrap();
    let dataset = read(root).unwrap();
    assert_eq!((&dataset.train[..], &dataset.test[..]), (&[0, 2][..], &[1][..]));
    assert_eq!(
        dataset.points.unwrap().positions,
        [Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)]
    );
    assert_eq!(
        (
            dataset.views[0].camera.intrinsics.fx,
            dataset.views[1].camera.intrinsics.fx
        ),
        (30.0, 20.0)
    );
    assert_eq!(
        detect(&root.join("transforms.json")).unwrap(),
        Kind::Dataset(DatasetFormat::Nerfstudio)
    );
    assert_eq!(detect(&root.join("points.ply")).unwrap(), Kind::Points);
    assert!(
        describe(&root.join("points.ply"), &DatasetOptions::default())
            .unwrap()
            .to_string()
            .contains("2 points")
    );
    fs::remove_file(root.join("points.ply")).unwrap();
    let dataset = read(root).unwrap();
    assert!(
        dataset.points.is_none() && dataset.warnings[0].contains("points.ply"),
        "{:?}",
        dataset.warnings
    );
}

#[test]
fn missing_masks_and_maps_are_reported() {
    let folder = pictures(4, 40, 30);
    let with = transforms(4, r#""fl_x": 35"#).replacen(
        r#""transform_matrix""#,
        r#""mask_path": "m/0.png", "depth_file_path": "d/0.png", "transform_matrix""#,
        1,
    );
    fs::write(folder.path().join("transforms.json"), with).unwrap();
    let warnings = read(folder.path()).unwrap().warnings.join("\n");
    assert!(warnings.contains("1 masks are missing, such as m/0.png"), "{warnings}");
    assert!(
        warnings.contains("1 depth maps are missing, such as d/0.png"),
        "{warnings}"
    );
}

#[test]
fn a_photograph_that_is_listed_twice_is_one_view() {
    let folder = pictures(9, 8, 8);
    let root = folder.path();
    let text = transforms(9, r#""camera_angle_x": 0.7"#);
    let first = text[text.find(r#"{"file_path""#).unwrap()..]
        .split_once("},")
        .unwrap()
        .0;
    let others = text.strip_suffix("]}").unwrap();
    fs::write(root.join("transforms.json"), format!("{others},{first}}}]}}")).unwrap();
    let dataset = read(root).unwrap();
    assert_eq!(dataset.views.len(), 9);
    assert!(
        dataset.warnings.iter().any(|w| w.contains("1 of 10 views")),
        "{:?}",
        dataset.warnings
    );
}

#[test]
fn blender_folders_without_a_test_file_hold_out_validation_or_every_eighth() {
    let folder = pictures(9, 8, 8);
    let root = folder.path();
    let without_extension = |text: String| text.replace(".png", "");
    let train = without_extension(transforms(9, r#""camera_angle_x": 0.7"#));
    fs::write(root.join("transforms_train.json"), &train).unwrap();
    let dataset = read(root).unwrap();
    assert_eq!((dataset.kind.as_str(), &dataset.test[..]), ("Blender", &[0, 8][..]));
    assert_eq!(dataset.views[0].name, "images/00.png");
    fs::create_dir(root.join("val")).unwrap();
    picture(8, 8).save(root.join("val/a.png")).unwrap();
    let val = transforms(1, r#""camera_angle_x": 0.7"#).replace("images/00.png", "./val/a");
    fs::write(root.join("transforms_val.json"), val).unwrap();
    let dataset = read(root).unwrap();
    assert_eq!((dataset.train.len(), &dataset.test[..]), (9, &[9][..]));
    fs::write(
        root.join("transforms_test.json"),
        transforms(1, r#""camera_angle_x": 0.7"#),
    )
    .unwrap();
    let dataset = read(root).unwrap();
    assert!(dataset.views.iter().all(|view| !view.name.starts_with("val")));
}

#[test]
fn unusable_views_are_skipped_with_one_line_per_reason() {
    let folder = pictures(8, 8, 8);
    let root = folder.path();
    fs::write(root.join("images/05.png"), b"").unwrap();
    let png = fs::read(root.join("images/06.png")).unwrap();
    fs::write(root.join("images/06.png"), &png[..png.len() - 5]).unwrap();
    fs::remove_file(root.join("images/07.png")).unwrap();
    let text = transforms(8, r#""fl_x": 9"#)
        .replacen("[[1,0,0,0]", "[[NaN,0,0,0]", 1)
        .replacen("[[1,0,0,0]", "[[0,0,0,0]", 1);
    fs::write(root.join("transforms.json"), &text).unwrap();
    let dataset = read(root).unwrap();
    let names: Vec<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["images/02.png", "images/03.png", "images/04.png"]);
    let warnings = dataset.warnings.join("\n");
    assert_eq!(dataset.warnings.len(), 3, "{warnings}");
    assert!(
        warnings.contains("1 of 8 views have no image file (--images names the folder of the photographs) and are skipped: images/07.png"),
        "{warnings}"
    );
    assert!(
        warnings.contains("cannot be read and are skipped: images/05.png, images/06.png"),
        "{warnings}"
    );
    assert!(
        warnings.contains("pose") && warnings.contains("images/00.png, images/01.png"),
        "{warnings}"
    );

    fs::remove_file(root.join("images/04.png")).unwrap();
    let error = error_of(root);
    assert!(
        error.contains("2 usable views of 8, at least 3") && error.contains("have no image file"),
        "{error}"
    );
    fs::write(root.join("transforms.json"), transforms(8, r#""fl_x": -9"#)).unwrap();
    assert!(error_of(root).contains("intrinsics"));
}

#[test]
fn a_photo_that_changes_or_breaks_after_reading_is_an_error_that_names_it() {
    let folder = pictures(3, 8, 8);
    let root = folder.path();
    fs::write(root.join("transforms.json"), transforms(3, r#""fl_x": 9"#)).unwrap();
    let dataset = read(root).unwrap();
    picture(9, 8).save(root.join("images/00.png")).unwrap();
    fs::write(root.join("images/01.png"), b"GIF89a").unwrap();
    fs::remove_file(root.join("images/02.png")).unwrap();
    for (view, expected) in dataset
        .views
        .iter()
        .zip(["is now 9x8, but was 8x8", "not a readable", "cannot read"])
    {
        let error = view.photo.load().unwrap_err().to_string();
        assert!(error.contains(expected) && error.contains(&view.name), "{error}");
    }
}

#[test]
fn errors_say_what_where_and_what_to_do() {
    let folder = pictures(3, 8, 8);
    let root = folder.path();
    assert!(error_of(&root.join("nowhere")).contains("nowhere"));
    assert!(error_of(root).contains("poses_bounds.npy (LLFF)"));
    let options = DatasetOptions {
        format: Some(DatasetFormat::Colmap),
        ..Default::default()
    };
    let error = read_dataset(root, &options).err().unwrap().to_string();
    assert!(error.contains("COLMAP") && !error.contains("LLFF"), "{error}");
    let error = "colmpa".parse::<DatasetFormat>().unwrap_err().to_string();
    assert!(error.contains("colmpa") && error.contains("nerfstudio"), "{error}");
    assert_eq!("LLFF".parse::<DatasetFormat>().unwrap(), DatasetFormat::Llff);

    fs::write(root.join("transforms.json"), transforms(3, r#""w": 8"#)).unwrap();
    let error = error_of(root);
    assert!(
        error.contains("transforms.json") && error.contains("camera_angle_x"),
        "{error}"
    );
    fs::write(root.join("transforms.json"), "{\"frames\": [").unwrap();
    assert!(error_of(root).contains("line 1"));
    fs::remove_file(root.join("transforms.json")).unwrap();

    write_colmap_text(root, "EUCM 8 8 1 1 1 1 0 0", &["00.png"]);
    let error = error_of(root);
    assert!(error.contains("cameras.txt") && error.contains("EUCM"), "{error}");
    write_colmap_text(root, "PINHOLE 8 8 9 9 4 4", &["00.png", "01.png", "02.png"]);
    fs::write(root.join("sparse/0/images.txt"), "1 1 0 0 0 0 0 0 77 00.png\n\n").unwrap();
    assert!(error_of(root).contains("camera 77"));
    fs::remove_dir_all(root.join("sparse")).unwrap();

    let mut npy = b"\x93NUMPY\x01\x00".to_vec();
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 17), }\n";
    npy.extend((header.len() as u16).to_le_bytes());
    npy.extend(header.bytes());
    npy.extend([0u8; 4 * 17 * 8]);
    fs::write(root.join("poses_bounds.npy"), &npy).unwrap();
    let error = error_of(root);
    assert!(error.contains("has 4 poses and `images` has 3 images"), "{error}");
    fs::write(root.join("poses_bounds.npy"), &npy[..200]).unwrap();
    assert!(error_of(root).contains("declares more"));
}
