//! Folders of photographs without poses.

use exif::{Field, In, Tag, Value};
use glam::DVec3;
use irradia_formats::{ColmapCamera, ColmapImage, ColmapModel, PosedImage, write_colmap};
use irradia_formats::{
    DatasetOptions, find_panoramas, photo_files, read_chosen_photos, read_dataset, read_photo_folder,
    read_photo_folders,
};
use std::fs;
use std::path::Path;

fn picture(width: u32, height: u32, red: u8) -> image::RgbImage {
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb([red, (x * 5) as u8, (y * 5) as u8]))
}

/// A JPEG whose EXIF block holds nothing but its orientation.
fn save_turned(path: &Path, picture: &image::RgbImage, orientation: u8) {
    picture.save(path).unwrap();
    add_exif(
        path,
        &exif_block(&[(Tag::Orientation, Value::Short(vec![orientation.into()]))]),
    );
}

/// An EXIF block with these tags.
fn exif_block(tags: &[(Tag, Value)]) -> Vec<u8> {
    let field = |(tag, value): &(Tag, Value)| Field {
        tag: *tag,
        ifd_num: In::PRIMARY,
        value: value.clone(),
    };
    let fields: Vec<Field> = tags.iter().map(field).collect();
    let mut writer = exif::experimental::Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut block = std::io::Cursor::new(Vec::new());
    writer.write(&mut block, false).unwrap();
    block.into_inner()
}

/// Writes `block` as EXIF into the JPEG at `path`.
fn add_exif(path: &Path, block: &[u8]) {
    add_segment(path, &[b"Exif\0\0", block].concat());
}

/// Writes the application segment 1 of a JPEG at `path`.
fn add_segment(path: &Path, payload: &[u8]) {
    let length = (payload.len() + 2) as u16;
    let mut segment = [&b"\xff\xe1"[..], &length.to_be_bytes(), payload].concat();
    let mut bytes = fs::read(path).unwrap();
    segment.extend(bytes.split_off(2));
    bytes.extend(segment);
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_drone_tells_where_up_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.jpg");
    picture(40, 30, 10).save(&path).unwrap();
    let packet = br#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description drone-dji:GimbalPitchDegree="-90.00"
        drone-dji:GimbalRollDegree="+0.00"/></rdf:RDF></x:xmpmeta>"#;
    add_segment(&path, &[&b"http://ns.adobe.com/xap/1.0/\0"[..], packet].concat());
    let found = read_photo_folder(folder.path()).unwrap();
    let up = found.photos[0].up.expect("known");
    assert!((up - DVec3::NEG_Z).length() < 1e-9, "{up}");
    // If the image is stored on its side, it is unknown whether the gimbal's angles refer to it as stored or as displayed.
    add_exif(&path, &exif_block(&[(Tag::Orientation, Value::Short(vec![6]))]));
    let found = read_photo_folder(folder.path()).unwrap();
    assert_eq!(found.photos[0].up, None);
}

#[test]
fn two_forms_of_one_photograph_count_once() {
    let folder = tempfile::tempdir().unwrap();
    let save = |name: &str, red: u8, time: &str| {
        let path = folder.path().join(name);
        picture(40, 30, red).save(&path).unwrap();
        let taken = (Tag::DateTimeOriginal, Value::Ascii(vec![time.into()]));
        add_exif(&path, &exif_block(&[taken]));
    };
    save("1.jpeg", 10, "2026:05:31 12:00:00");
    save("1.jpg", 11, "2026:05:31 12:00:00");
    // The same name at another time, and another name at the same time.
    save("2.jpeg", 12, "2026:05:31 12:00:00");
    save("2.jpg", 13, "2026:05:31 12:00:01");
    // Nothing shows that these are the same photograph.
    picture(40, 30, 14).save(folder.path().join("3.jpg")).unwrap();
    picture(40, 30, 15).save(folder.path().join("3.png")).unwrap();
    let found = read_photo_folder(folder.path()).unwrap();
    let names: Vec<&str> = found.photos.iter().map(|photo| photo.name.as_str()).collect();
    assert_eq!(names, ["1.jpeg", "2.jpeg", "2.jpg", "3.jpg", "3.png"]);
    assert_eq!(
        found.repeated,
        [("1.jpg".to_owned(), "another form of 1.jpeg".to_owned())]
    );
}

#[test]
fn what_is_no_photograph_or_a_copy_is_named_with_its_reason() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    assert!(photo_files(root).is_empty());
    picture(40, 30, 10).save(root.join("b.jpg")).unwrap();
    picture(40, 30, 20).save(root.join("a.png")).unwrap();
    fs::copy(root.join("b.jpg"), root.join("c.jpg")).unwrap();
    fs::write(root.join("d.jpg"), "not a picture").unwrap();
    fs::write(root.join("e.jpg"), &fs::read(root.join("b.jpg")).unwrap()[..400]).unwrap();
    fs::write(root.join("f.HEIC"), "\0\0\0\x10ftypheic\0\0\0\0").unwrap();
    fs::write(root.join("g.dng"), "II*").unwrap();
    fs::write(root.join("b.CR3"), "what b.jpg was made of").unwrap();
    fs::write(root.join("notes.txt"), "ignored").unwrap();
    fs::write(root.join(".hidden.jpg"), "ignored").unwrap();
    let found = read_photo_folder(root).unwrap();
    let names: Vec<&str> = found.photos.iter().map(|photo| photo.name.as_str()).collect();
    assert_eq!(names, ["a.png", "b.jpg"]);
    let repeated = [
        ("b.CR3", "another form of a photograph that is read"),
        ("c.jpg", "a copy of b.jpg, byte for byte"),
    ];
    assert_eq!(
        found.repeated,
        repeated.map(|(name, what)| (name.to_owned(), what.to_owned()))
    );
    let reasons: Vec<(&str, &str)> = found.left_out.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
    assert_eq!(reasons.len(), 4, "{reasons:?}");
    for ((name, reason), (expected, word)) in reasons.iter().zip([
        ("d.jpg", "not a readable"),
        ("e.jpg", "truncated"),
        ("f.HEIC", "not a readable"),
        ("g.dng", "convert"),
    ]) {
        assert!(*name == expected && reason.contains(word), "{name}: {reason}");
    }
    assert_eq!(photo_files(root).len(), 6);
    // Photographs in `images` are found from the folder above.
    let below = tempfile::tempdir().unwrap();
    fs::create_dir(below.path().join("images")).unwrap();
    fs::copy(root.join("a.png"), below.path().join("images/a.png")).unwrap();
    assert_eq!(photo_files(below.path()).len(), 1);
    assert_eq!(read_photo_folder(below.path()).unwrap().photos.len(), 1);
    assert!(read_photo_folder(&root.join("none")).is_err());
}

#[test]
fn other_kinds_of_pictures_and_masks_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    fs::create_dir(root.join("masks")).unwrap();
    for (i, name) in ["a.webp", "b.tif", "c.TIFF"].into_iter().enumerate() {
        picture(40, 30, 10 + i as u8).save(root.join(name)).unwrap();
    }
    // COLMAP's convention, at half the size.
    let half = image::GrayImage::from_fn(20, 15, |x, _| image::Luma([if x < 10 { 0 } else { 255 }]));
    half.save(root.join("masks/b.tif.png")).unwrap();
    fs::create_dir(root.join("depths")).unwrap();
    half.save(root.join("depths/b.png")).unwrap();
    let found = read_photo_folder(root).unwrap();
    assert!(found.left_out.is_empty(), "{:?}", found.left_out);
    assert_eq!(found.photos.len(), 3);
    for (i, photo) in found.photos.iter().enumerate() {
        let pixels = photo.read(1).unwrap();
        assert_eq!((pixels.width, pixels.height), (40, 30));
        let expected = picture(40, 30, 10 + i as u8).into_raw();
        assert!(pixels.data == expected, "{}", photo.name);
        let mask = photo.read_mask(40, 30).unwrap();
        assert_eq!(mask.is_some(), i == 1, "{}", photo.name);
        assert_eq!(photo.depth.is_some(), i == 1, "{}", photo.name);
        if let Some(mask) = mask {
            assert!((0..1200).all(|p| mask[p] == if p % 40 < 20 { 0 } else { 255 }));
        }
    }
    // Another mask makes it another photograph: its features are not reused.
    fs::remove_file(root.join("masks/b.tif.png")).unwrap();
    assert_ne!(read_photo_folder(root).unwrap().photos[1].hash, found.photos[1].hash);
}

#[test]
fn labels_colours_depths_and_alpha_are_masks() {
    use image::{GrayImage, ImageBuffer, Luma, Rgb, RgbImage, Rgba, RgbaImage};
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    fs::create_dir(root.join("masks")).unwrap();
    picture(40, 30, 90).save(root.join("a.png")).unwrap();
    let path = root.join("masks/a.png");
    let kept = || {
        let found = read_photo_folder(root).unwrap();
        let mask = found.photos[0].read_mask(40, 30).unwrap().unwrap();
        mask.iter().filter(|value| **value >= 128).count()
    };
    let grey = |values: [u8; 3]| GrayImage::from_fn(40, 30, |x, _| Luma([values[x as usize * 3 / 42]]));
    grey([0, 1, 2]).save(&path).unwrap();
    assert_eq!(kept(), 26 * 30, "labels");
    grey([0, 100, 255]).save(&path).unwrap();
    assert_eq!(kept(), 12 * 30, "a soft edge");
    grey([0; 3]).save(&path).unwrap();
    assert_eq!(kept(), 0, "black");
    let deep = |value: u16| ImageBuffer::from_fn(40, 30, |x, _| Luma([if x < 20 { 0 } else { value }]));
    for value in [1, 255, u16::MAX] {
        deep(value).save(&path).unwrap();
        assert_eq!(kept(), 20 * 30, "16 bits, {value}");
    }
    let colors = [[0, 0, 0], [128, 0, 0], [0, 0, 64], [255, 255, 255]];
    RgbImage::from_fn(40, 30, |x, _| Rgb(colors[x as usize / 10]))
        .save(&path)
        .unwrap();
    assert_eq!(kept(), 30 * 30, "colours");
    let alpha = |x: u32| if x < 10 { 255 } else { 0 };
    RgbaImage::from_fn(40, 30, |x, _| Rgba([255, 255, 255, alpha(x)]))
        .save(&path)
        .unwrap();
    assert_eq!(kept(), 10 * 30, "alpha");
}

#[test]
fn masks_of_turned_photographs_are_turned_with_them() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    fs::create_dir(root.join("masks")).unwrap();
    // Stored as landscape, displayed as portrait: 30 x 40. The left half of the displayed image is hidden, which is the lower half of the
    // stored one.
    save_turned(&root.join("a.jpg"), &picture(40, 30, 9), 6);
    let half = |hides: fn(u32, u32) -> bool, width, height| {
        image::GrayImage::from_fn(width, height, |x, y| image::Luma([if hides(x, y) { 0 } else { 255 }]))
    };
    let hidden = || {
        let found = read_photo_folder(root).unwrap();
        let mask = found.photos[0].read_mask(30, 40).unwrap().unwrap();
        (0..1200).all(|p| mask[p] == if p % 30 < 15 { 0 } else { 255 })
    };
    half(|_, y| y >= 15, 40, 30).save(root.join("masks/a.png")).unwrap();
    assert!(hidden(), "as stored");
    half(|x, _| x < 15, 30, 40).save(root.join("masks/a.png")).unwrap();
    assert!(hidden(), "as seen");
    // A folder of masks with other names is reported.
    fs::rename(root.join("masks/a.png"), root.join("masks/mask_a.png")).unwrap();
    let found = read_photo_folder(root).unwrap();
    assert!(found.photos[0].mask.is_none());
    assert!(
        matches!(&found.repeated[..], [(name, why)] if name == "masks" && why.contains("nothing is masked")),
        "{found:?}"
    );
}

#[test]
fn phones_photographs_are_read_with_what_the_camera_wrote() {
    let folder = tempfile::tempdir().unwrap();
    // Only the container declares the rotation (none here): EXIF orientation must not rotate the image.
    let tags = [(Tag::FocalLengthIn35mmFilm, 27), (Tag::Orientation, 6)];
    let block = exif_block(&tags.map(|(tag, value)| (tag, Value::Short(vec![value]))));
    let seen = picture(40, 30, 10);
    let mut pixels = heifer::Image::filled(40, 30, 8, [0, 0, 0, 255]);
    for (to, from) in pixels.data.chunks_exact_mut(4).zip(seen.pixels()) {
        (0..3).for_each(|channel| to[channel] = from.0[channel].into());
    }
    let metadata = heifer::Metadata {
        exif: Some(block),
        ..heifer::Metadata::default()
    };
    let bytes = heifer::encode_with_metadata(&pixels, &metadata, &heifer::EncodeOptions::default()).unwrap();
    fs::write(folder.path().join("IMG_0001.HEIC"), &bytes).unwrap();
    fs::write(folder.path().join("IMG_0002.HEIC"), &bytes[..bytes.len() - 9]).unwrap();
    let found = read_photo_folder(folder.path()).unwrap();
    assert_eq!(
        (found.photos.len(), found.left_out.len()),
        (1, 1),
        "{:?}",
        found.left_out
    );
    assert!(found.left_out[0].1.contains("not a readable"), "{:?}", found.left_out);
    let photo = &found.photos[0];
    assert_eq!((photo.width, photo.height, photo.up), (40, 30, None));
    assert!(
        (photo.tags.focal.unwrap() - 0.78).abs() < 1e-3,
        "{:?}",
        photo.tags.focal
    );
    let read = photo.read(1).unwrap();
    assert_eq!((read.width, read.height, read.channels), (40, 30, 3));
    let off: u32 = read
        .data
        .iter()
        .zip(seen.as_raw())
        .map(|(a, b)| u32::from(a.abs_diff(*b)))
        .sum();
    assert!(off < 4 * 3600, "{off}");
}

#[test]
fn photographs_are_as_read_dataset_decodes_them() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    // Upright, quarter turns, a half turn, and quarter turns of squares.
    for (name, size, orientation) in [
        ("a.jpg", [60, 40], 1),
        ("b.jpg", [60, 40], 6),
        ("c.jpg", [60, 40], 8),
        ("d.jpg", [60, 40], 3),
        ("e.jpg", [50, 50], 6),
        ("f.jpg", [50, 50], 8),
    ] {
        save_turned(&images.join(name), &picture(size[0], size[1], 90), orientation);
    }
    let found = read_photo_folder(folder.path()).unwrap();
    assert_eq!(found.groups(), [0, 1, 2, 0, 3, 3]);
    assert_eq!(found.cameras(), [0, 0, 0, 0, 1, 1]);
    let turns: Vec<u8> = found.photos.iter().map(|photo| photo.quarter_turns()).collect();
    assert_eq!(turns, [0, 1, 3, 0, 0, 0]);
    let up: Vec<Option<DVec3>> = found.photos.iter().map(|photo| photo.up).collect();
    let [left, right, under] = [DVec3::NEG_X, DVec3::X, DVec3::Y].map(Some);
    assert_eq!(up, [None, None, None, under, left, right]);
    let sparse = folder.path().join("sparse/0");
    fs::create_dir_all(&sparse).unwrap();
    let model = ColmapModel {
        cameras: (1u32..)
            .zip(&found.photos)
            .map(|(id, photo)| ColmapCamera {
                id,
                model: "SIMPLE_RADIAL".into(),
                width: photo.width.into(),
                height: photo.height.into(),
                params: vec![50.0, 0.5 * f64::from(photo.width), 0.5 * f64::from(photo.height), 0.0],
            })
            .collect(),
        images: (1u32..)
            .zip(&found.photos)
            .map(|(camera_id, photo)| PosedImage {
                image: ColmapImage {
                    rotation: [1.0, 0.0, 0.0, 0.0],
                    translation: [f64::from(camera_id), 0.0, 0.0],
                    camera_id,
                    name: photo.name.clone(),
                    points: Vec::new(),
                },
                keypoints: Vec::new(),
            })
            .collect(),
        points: Vec::new(),
    };
    write_colmap(&sparse, &model).unwrap();
    let dataset = read_dataset(folder.path(), &DatasetOptions::default()).unwrap();
    assert_eq!(dataset.views.len(), found.photos.len());
    for (view, photo) in dataset.views.iter().zip(&found.photos) {
        assert!(view.name.ends_with(&photo.name), "{} {}", view.name, photo.name);
        let (pixels, own) = (view.photo.load().unwrap(), photo.read(1600).unwrap());
        assert_eq!(
            (pixels.width, pixels.height),
            (photo.width, photo.height),
            "{}",
            photo.name
        );
        assert!(pixels.data == own.data, "{}", photo.name);
    }
}

/// An equirectangular image of a world of patches, whose colours depend on the direction.
fn panorama(width: u32) -> image::RgbImage {
    use std::f32::consts::{PI, TAU};
    let height = width / 2;
    image::RgbImage::from_fn(width, height, |x, y| {
        let (longitude, latitude) = (
            (x as f32 + 0.5) / width as f32 * TAU - PI,
            (y as f32 + 0.5) / height as f32 * PI - 0.5 * PI,
        );
        let d = [
            latitude.cos() * longitude.sin(),
            latitude.sin(),
            latitude.cos() * longitude.cos(),
        ];
        image::Rgb([0, 1, 2].map(|c| (128.0 + 60.0 * d[c] + 60.0 * (7.0 * d[c] + 3.0 * d[(c + 1) % 3]).sin()) as u8))
    })
}

#[test]
fn panoramas_are_found_and_cut_into_faces() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let round = panorama(1024);
    round.save(root.join("a.png")).unwrap();
    // Of the same aspect ratio, but not panoramas: a crop, a thumbnail, an object on white.
    image::imageops::crop_imm(&round, 100, 100, 600, 300)
        .to_image()
        .save(root.join("b.png"))
        .unwrap();
    image::imageops::thumbnail(&round, 400, 200)
        .save(root.join("c.png"))
        .unwrap();
    let object = image::RgbImage::from_fn(800, 400, |x, y| match (x.abs_diff(400) < 150, y.abs_diff(200) < 120) {
        (true, true) => *round.get_pixel(x, y),
        _ => image::Rgb([250; 3]),
    });
    object.save(root.join("d.png")).unwrap();
    // Some programs miss the aspect ratio by a few pixels; an image that misses it by more is a photograph.
    let resized = |width: u32, name: &str| {
        let filter = image::imageops::FilterType::Triangle;
        image::imageops::resize(&round, width, 512, filter)
            .save(root.join(name))
            .unwrap();
    };
    resized(1026, "e.png");
    resized(1036, "f.png");
    let photos = read_photo_folder(root).unwrap().photos;
    assert_eq!(find_panoramas(&photos), [true, false, false, false, true, false]);

    let out = root.join("faces");
    let faces = photos[0].cut_panorama(&out).unwrap();
    let names: Vec<&str> = faces.iter().map(|face| face.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "a_back.jpg",
            "a_down.jpg",
            "a_front.jpg",
            "a_left.jpg",
            "a_right.jpg",
            "a_up.jpg"
        ]
    );
    // A face's centre looks along its axis: the front at the panorama's centre, the right a quarter of a turn further.
    for (face, x) in [(&faces[2], 512), (&faces[4], 768), (&faces[3], 256)] {
        let picture = image::open(out.join("images").join(&face.name)).unwrap().into_rgb8();
        assert_eq!(
            (picture.width(), picture.height()),
            (face.camera.width, face.camera.height)
        );
        let (here, there) = (
            picture.get_pixel(picture.width() / 2, picture.height() / 2),
            round.get_pixel(x, 256),
        );
        let apart = here.0.iter().zip(there.0).map(|(a, b)| a.abs_diff(b)).max().unwrap();
        assert!(apart < 8, "{}: {here:?} {there:?}", face.name);
    }
}

#[test]
fn folders_are_read_together_and_names_stay_apart() {
    let root = tempfile::tempdir().unwrap();
    let folders = ["first", "second"].map(|name| root.path().join(name));
    let [first, second] = &folders;
    for (folder, red) in [(first, 10), (second, 90)] {
        fs::create_dir(folder).unwrap();
        picture(40, 30, red).save(folder.join("1.png")).unwrap();
    }
    picture(40, 30, 200).save(second.join("2.png")).unwrap();
    fs::copy(first.join("1.png"), second.join("3.png")).unwrap();
    let found = read_photo_folders(&folders).unwrap();
    let names: Vec<&str> = found.photos.iter().map(|photo| photo.name.as_str()).collect();
    assert_eq!(names, ["2.png", "3.png", "second_1.png"]);
    assert!(found.left_out.is_empty());
    assert!(found.repeated[0].0 == "first_1.png" && found.repeated[0].1.contains("copy of 3.png"));
    // Photographs that are not chosen have no influence on the others.
    let found = read_chosen_photos(&folders, &|file| !file.ends_with("second/1.png")).unwrap();
    let names: Vec<&str> = found.photos.iter().map(|photo| photo.name.as_str()).collect();
    assert_eq!(names, ["1.png", "2.png"]);
}

#[test]
fn folders_of_one_name_are_told_apart_by_those_around_them() {
    let root = tempfile::tempdir().unwrap();
    let folders = ["monday/DCIM", "tuesday/DCIM", "spare"].map(|name| root.path().join(name));
    for (folder, red) in folders.iter().zip([10, 90, 200]) {
        fs::create_dir_all(folder).unwrap();
        picture(40, 30, red).save(folder.join("1.png")).unwrap();
    }
    let found = read_photo_folders(&folders).unwrap();
    let names: Vec<&str> = found.photos.iter().map(|photo| photo.name.as_str()).collect();
    assert_eq!(names, ["monday_DCIM_1.png", "spare_1.png", "tuesday_DCIM_1.png"]);
    // The same folder by two paths.
    let again = root.path().join("monday/../monday/DCIM");
    let found = read_photo_folders(&[folders[0].clone(), again]).unwrap();
    assert_eq!(
        (found.photos.len(), found.left_out.len(), found.repeated.len()),
        (1, 0, 1)
    );
}

#[test]
fn photographs_at_a_fraction_of_their_size_have_the_masks_of_that_size() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    for folder in ["images_4", "images_8", "masks", "masks_4"] {
        fs::create_dir(root.join(folder)).unwrap();
    }
    picture(40, 30, 10).save(root.join("images_4/a.png")).unwrap();
    picture(20, 15, 10).save(root.join("images_8/a.png")).unwrap();
    for masks in ["masks", "masks_4"] {
        image::GrayImage::new(40, 30)
            .save(root.join(masks).join("a_mask.png"))
            .unwrap();
    }
    for folder in [root.to_owned(), root.join("images_4")] {
        let found = read_photo_folder(&folder).unwrap();
        assert_eq!(found.photos.len(), 1);
        assert_eq!(found.photos[0].width, 40);
        assert_eq!(found.photos[0].mask, Some(root.join("masks_4/a_mask.png")));
    }
    let smaller = read_photo_folder(&root.join("images_8")).unwrap();
    assert_eq!(smaller.photos[0].mask, Some(root.join("masks/a_mask.png")));
}
