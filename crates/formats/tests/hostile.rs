//! Broken bytes: valid seeds of every parser, truncated and mutated a few thousand times. Nothing may panic or hang, and
//! sizes in headers may not be allocated unchecked. Most of these entry points are fuzzed in `/fuzz`, too.

use irradia_formats::parse;
use irradia_scene::Rng;
use irradia_testkit::torch::{self, NamedTensor};

const ROUNDS: u32 = 3000;

const TENSORS: [NamedTensor; 2] = [
    ("a.weight", &[2, 2], &[1.0, 2.0, 3.0, 4.0]),
    ("a.bias", &[2], &[0.5; 2]),
];

/// A parser and a file that it accepts.
struct Case {
    name: &'static str,
    seed: Vec<u8>,
    /// Whether the bytes were accepted.
    parse: fn(&[u8]) -> bool,
}

fn f64s(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn cameras_bin() -> Vec<u8> {
    let mut bytes = 2u64.to_le_bytes().to_vec();
    for (id, model, params) in [(1u32, 1u32, 4), (2, 6, 12)] {
        bytes.extend([id.to_le_bytes(), model.to_le_bytes()].concat());
        bytes.extend([640u64.to_le_bytes(), 480u64.to_le_bytes()].concat());
        bytes.extend(f64s(&vec![0.5; params]));
    }
    bytes
}

fn images_bin() -> Vec<u8> {
    let mut bytes = 2u64.to_le_bytes().to_vec();
    for id in 0..2u32 {
        bytes.extend(id.to_le_bytes());
        bytes.extend(f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0]));
        bytes.extend(1u32.to_le_bytes());
        bytes.extend(b"image one.png\0");
        bytes.extend(2u64.to_le_bytes());
        for point in [7, u64::MAX] {
            bytes.extend(f64s(&[1.0, 2.0]));
            bytes.extend(point.to_le_bytes());
        }
    }
    bytes
}

fn exr() -> Vec<u8> {
    use exr::prelude::{Image, SpecificChannels, Vec2, WritableImage};
    let shade = |Vec2(x, y): Vec2<usize>| (x as f32 / 8.0, y as f32 / 8.0, 0.5f32, 1.0f32);
    let mut bytes = std::io::Cursor::new(Vec::new());
    let image = Image::from_channels((8, 8), SpecificChannels::rgba(shade));
    image.write().non_parallel().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

fn points_bin() -> Vec<u8> {
    let mut bytes = 2u64.to_le_bytes().to_vec();
    for id in 0..2u64 {
        bytes.extend(id.to_le_bytes());
        bytes.extend(f64s(&[1.0, 2.0, 3.0]));
        bytes.extend([1, 2, 3]);
        bytes.extend(f64s(&[0.1]));
        bytes.extend(1u64.to_le_bytes());
        bytes.extend([0; 8]);
    }
    bytes
}

fn poses_bounds() -> Vec<u8> {
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 17), }        \n";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    bytes.extend(f64s(&[0.5; 34]));
    bytes
}

fn points_ply(format: &str) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat {format} 1.0\nelement face 2\nproperty list uchar int vertex_indices\nelement vertex 2\n\
         property float x\nproperty float y\nproperty double z\nproperty list uint uchar junk\nproperty uchar red\n\
         property uchar green\nproperty uchar blue\nend_header\n"
    )
    .into_bytes();
    if format == "ascii" {
        bytes.extend(b"3 0 1 2\n0\n1 2 3 2 9 9 1 2 3\n-1e3 inf 0 0 4 5 6\n");
        return bytes;
    }
    bytes.extend([1, 0, 0, 0, 0, 0]);
    for _ in 0..2 {
        bytes.extend([0; 16]);
        bytes.extend([0, 0, 0, 0, 1, 2, 3]);
    }
    bytes
}

fn splat_ply() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let cloud = irradia_scene::GaussianCloud {
        means: vec![[1.0, 2.0, 3.0]; 3],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
        log_scales: vec![[-3.0; 3]; 3],
        opacity_logits: vec![0.1; 3],
        sh: vec![0.2; 3 * 12],
        sh_degree: 1,
        antialiased: true,
        ..irradia_scene::GaussianCloud::default()
    };
    irradia_formats::write_splats(&path, &cloud).unwrap();
    std::fs::read(path).unwrap()
}

fn cases() -> Vec<Case> {
    let transforms = r#"{"camera_angle_x": 0.7, "w": 10, "h": 10, "k1": 0.1, "ply_file_path": "a.ply", "frames": [
        {"file_path": "a\"NaN.png", "transform_matrix": [[1,0,0,NaN],[0,1,0,-Infinity],[0,0,1,3e300]], "fl_x": 3}]}"#;
    let case = |name, seed, parse| Case { name, seed, parse };
    vec![
        case("cameras.bin", cameras_bin(), |b| {
            parse::colmap_binary::parse_cameras(b).is_ok()
        }),
        case("images.bin", images_bin(), |b| {
            parse::colmap_binary::parse_images(b).is_ok()
        }),
        case("points3D.bin", points_bin(), |b| {
            parse::colmap_binary::parse_points(b).is_ok()
        }),
        case(
            "cameras.txt",
            b"# c\n1 PINHOLE 640 480 500 500.5 320 240\n2 FULL_OPENCV 1 1 1 2 3 4 5 6 7 8 9 10 11 12\n".into(),
            |b| parse::colmap_text::parse_cameras(b).is_ok(),
        ),
        case(
            "images.txt",
            b"# c\n1 1 0 0 0 1 2 3 1 a b.png\n1.5 2.5 7 1 2 -1\n2 1 0 0 0 1 2 3 1 c.png\n\n".into(),
            |b| parse::colmap_text::parse_images(b).is_ok(),
        ),
        case(
            "points3D.txt",
            b"# c\n1 1 2 3 4 5 6 0.5 1 2 3 4\n2 -1e9 nan 3 255 0 6 0.5\n".into(),
            |b| parse::colmap_text::parse_points(b).is_ok(),
        ),
        case("poses_bounds.npy", poses_bounds(), |b| parse::poses_bounds(b).is_ok()),
        case("transforms.json", transforms.into(), |b| parse::transforms(b).is_ok()),
        case("points, ASCII", points_ply("ascii"), |b| parse::points_ply(b).is_ok()),
        case("points, little", points_ply("binary_little_endian"), |b| {
            parse::points_ply(b).is_ok()
        }),
        case("points, big", points_ply("binary_big_endian"), |b| {
            parse::points_ply(b).is_ok()
        }),
        case("state dict, archive", torch::archive(&TENSORS), |b| {
            parse::tensors(b).is_ok()
        }),
        case("state dict, stream", torch::stream(&TENSORS), |b| {
            parse::tensors(b).is_ok()
        }),
        // One tag, the camera's model; a damaged tag counts as absent.
        case(
            "EXIF",
            b"II\x2a\0\x08\0\0\0\x01\0\x10\x01\x02\0\x04\0\0\0One\0\0\0\0\0".into(),
            |b| parse::camera_tags(b, [40, 30]).model.is_some(),
        ),
        case(
            "XMP",
            br#"<a><rdf:Description drone-dji:GimbalPitchDegree="-90.0" drone-dji:GimbalRollDegree="+0"/></a>"#.into(),
            |b| parse::gimbal(b).is_some(),
        ),
        case("splats", splat_ply(), |b| parse::splat_ply(b).is_ok()),
        case(
            "reconstruction.json",
            br#"[{"cameras": {"c": {"projection_type": "brown", "width": 9, "height": 9, "focal": 1}}, "shots": {"a": {"rotation":
            [1, 2, 3], "translation": [1, 2, 3], "camera": "c"}}, "points": {"1": {"color": [1, 2, 3], "coordinates": [1, 2, 3]}}}]"#
                .into(),
            |b| parse::opensfm(b).is_ok(),
        ),
        case(
            "sfm_data.json",
            br#"{"root_path": "", "views": [{"key": 0, "value": {"ptr_wrapper": {"data": {"filename": "a", "id_view": 0, "id_intrinsic": 0,
            "id_pose": 0}}}}], "intrinsics": [{"key": 0, "value": {"ptr_wrapper": {"data": {"value0": {"value0": {"width": 9, "height": 9},
            "focal_length": 9}, "disto_k1": [0.1]}}}}], "extrinsics": [{"key": 0, "value": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "center": [1, 2, 3]}}], "structure": [{"key": 0, "value": {"X": [1, 2, 3], "observations": [{"key": 0}]}}]}"#
                .into(),
            |b| parse::openmvg(b).is_ok(),
        ),
        case(
            "cameras.sfm",
            br#"{"version": ["1", "2", "3"], "views": [{"viewId": "1", "poseId": 1, "intrinsicId": "2", "path": "a"}], "intrinsics": [
            {"intrinsicId": "2", "width": "9", "height": 9, "type": "radial1", "focalLength": "9", "distortionParams": ["0.1"]}], "poses":
            [{"poseId": "1", "pose": {"transform": {"rotation": ["1", "0", "0", "0", "1", "0", "0", "0", "1"], "center": ""}}}]}"#
                .into(),
            |b| parse::meshroom(b).is_ok(),
        ),
        case(
            "bundle.txt",
            b"# Bundle file v0.3\n1 1\n500 0 0\n1 0 0\n0 1 0\n0 0 1\n1 2 3\n1 2 3\n255 0 1\n1 0 17 1.5 -2.5\n".into(),
            |b| parse::bundle(b).is_ok(),
        ),
        case(
            "nvm.txt",
            b"NVM_V3 \n\n1\na b.png 500 1 0 0 0 1 2 3 0.1 0\n\n1\n1 2 3 255 0 1 1 0 17 1.5 -2.5\n0\n".into(),
            |b| parse::nvm(b).is_ok(),
        ),
        case(
            "cameras.xml",
            br#"<?xml version="1.0"?><document><chunk><sensors><sensor id="0" type="frame"><resolution width="9" height="9"/>
            <calibration><f>9</f><b1>0.1</b1></calibration></sensor></sensors><cameras><camera id="0" sensor_id="0" label="a">
            <transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras><transform><rotation>1 0 0 0 1 0 0 0 1</rotation>
            <translation>1 2 3</translation></transform></chunk></document>"#
                .into(),
            |b| parse::metashape(b).is_ok_and(|cameras| cameras == 1),
        ),
        case(
            "cameras.csv.txt",
            b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1\na.png,1,2,3,4,5,6,35,0,0,0.1\n".into(),
            |b| parse::realitycapture_csv(b).is_ok(),
        ),
        case(
            "a.xmp",
            br#"<x><rdf:Description xcr:FocalLength35mm="35" xcr:Position="1 2 3" xcr:Rotation="1 0 0 0 1 0 0 0 1"/></x>"#.into(),
            |b| parse::realitycapture_xmp(b).is_ok(),
        ),
        case(
            "metadata.json",
            br#"{"w": 9, "h": 9, "K": [9, 0, 0, 0, 9, 0, 4, 4, 1], "poses": [[0, 0, 0, 1, 1, 2, 3]]}"#.into(),
            |b| parse::record3d(b).is_ok(),
        ),
        case(
            "camera.json",
            br#"{"orientation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "position": [1, 2, 3], "focal_length": 9,
            "principal_point": [4, 4], "image_size": [9, 9]}"#
                .into(),
            |b| parse::nerfies_camera(b).is_ok(),
        ),
        case("EXR", exr(), |b| parse::exr(b).is_ok()),
    ]
}

/// Changes, inserts, removes or doubles a few bytes; often to values that break arithmetic, and often digits.
fn mutate(bytes: &mut Vec<u8>, rng: &mut Rng) {
    for _ in 0..=rng.below(4) {
        if bytes.is_empty() {
            return;
        }
        let at = rng.below(bytes.len() as u32) as usize;
        match rng.below(7) {
            0 => bytes[at] = rng.next_u32() as u8,
            1 => bytes[at] = [0, 0xFF, 0x7F, 0x80, b'9', b' ', b'\n', b'-'][rng.below(8) as usize],
            2 => bytes[at] ^= 1 << rng.below(8),
            3 => bytes.insert(at, b'0' + rng.below(10) as u8),
            4 => drop(bytes.remove(at)),
            5 => {
                let end = (at + rng.below(40) as usize).min(bytes.len());
                let copy = bytes[at..end].to_vec();
                bytes.splice(at..at, copy);
            }
            _ => {
                let end = (at + 8).min(bytes.len());
                bytes[at..end].fill(if rng.below(2) == 0 { 0xFF } else { 0 });
            }
        }
    }
}

#[test]
fn seeds_are_accepted() {
    for case in cases() {
        assert!((case.parse)(&case.seed), "{}", case.name);
    }
}

#[test]
fn every_truncated_binary_seed_is_rejected_and_no_other_panics() {
    for case in cases() {
        for length in 0..case.seed.len() {
            let accepted = (case.parse)(&case.seed[..length]);
            let text = case.name.ends_with(".txt") || case.name.ends_with("ASCII");
            assert!(
                !accepted || text,
                "{} cut to {length} of {} bytes",
                case.name,
                case.seed.len()
            );
        }
    }
}

#[test]
fn mutated_seeds_never_panic() {
    for (stream, case) in cases().into_iter().enumerate() {
        for round in 0..ROUNDS {
            let mut bytes = case.seed.clone();
            mutate(&mut bytes, &mut Rng::new(u64::from(round), stream as u64));
            let outcome = std::panic::catch_unwind(|| (case.parse)(&bytes));
            assert!(outcome.is_ok(), "{}: seed {round}, stream {stream} panics", case.name);
        }
    }
}
