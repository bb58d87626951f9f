//! Splat formats: real files of other programs, round trips within each format's precision, and conventions by an asymmetric scene.

use irradia_formats::{
    Quality, SplatFormat, SpzVersion, WriteOptions, read_splat_file, read_splats, write_splats, write_splats_with,
};
use irradia_scene::{GaussianCloud, Rng, sh};
use irradia_testkit::shared;
use std::fs;
use std::io::{Read, Write};
use std::path::Path;

/// Splats at distinct places in no order, with everything in the range that scenes have.
fn scene(count: usize, sh_degree: u32) -> GaussianCloud {
    let mut rng = Rng::new(7, u64::from(sh_degree));
    let mut cloud = GaussianCloud {
        sh_degree,
        ..GaussianCloud::default()
    };
    for i in 0..count {
        // A distinct x, by which splats are found again in any order.
        let x = ((i * 7919) % count) as f32 * (8.0 / count as f32) - 4.0;
        cloud.means.push([x, rng.range(-2.0, 2.0), rng.range(-1.0, 3.0)]);
        cloud.quats.push([0; 4].map(|_| rng.range(-1.0, 1.0)));
        cloud.log_scales.push([0; 3].map(|_| rng.range(-7.0, -2.0)));
        cloud.opacity_logits.push(rng.range(-4.0, 4.0));
        let width = 3 * sh::coefficients(sh_degree);
        cloud.sh.extend((0..width).map(|k| {
            if k < 3 {
                rng.range(-1.7, 1.7)
            } else {
                rng.range(-0.4, 0.4)
            }
        }));
    }
    cloud
}

/// The splats in the order of their x.
fn by_x(cloud: &GaussianCloud) -> Vec<usize> {
    let mut order: Vec<usize> = (0..cloud.len()).collect();
    order.sort_by(|a, b| cloud.means[*a][0].total_cmp(&cloud.means[*b][0]));
    order
}

/// The largest differences between two scenes, splat by splat.
#[derive(Debug, Default)]
struct Differences {
    position: f32,
    log_scale: f32,
    opacity: f32,
    color: f32,
    harmonic: f32,
    /// Radians.
    rotation: f32,
}

fn differences(a: &GaussianCloud, b: &GaussianCloud) -> Differences {
    assert_eq!(a.len(), b.len());
    let sigmoid = |x: f32| 1.0 / (1.0 + (-x).exp());
    let mut largest = Differences::default();
    let rest = 3 * a.sh_coefficients().min(b.sh_coefficients());
    for (i, j) in by_x(a).into_iter().zip(by_x(b)) {
        for c in 0..3 {
            largest.position = largest.position.max((a.means[i][c] - b.means[j][c]).abs());
            largest.log_scale = largest.log_scale.max((a.log_scales[i][c] - b.log_scales[j][c]).abs());
        }
        largest.opacity = largest
            .opacity
            .max((sigmoid(a.opacity_logits[i]) - sigmoid(b.opacity_logits[j])).abs());
        let (p, q) = (
            &a.sh[i * 3 * a.sh_coefficients()..],
            &b.sh[j * 3 * b.sh_coefficients()..],
        );
        for k in 0..rest {
            let difference = (p[k] - q[k]).abs();
            match k {
                ..3 => largest.color = largest.color.max(difference * sh::C0 as f32),
                _ => largest.harmonic = largest.harmonic.max(difference),
            }
        }
        let length = |q: &[f32; 4]| q.iter().map(|v| v * v).sum::<f32>().sqrt();
        let dot: f32 = a.quats[i].iter().zip(b.quats[j]).map(|(p, q)| p * q).sum();
        let dot = dot.abs() / (length(&a.quats[i]) * length(&b.quats[j]));
        largest.rotation = largest.rotation.max(2.0 * dot.min(1.0).acos());
    }
    largest
}

fn round_trip(name: &str, cloud: &GaussianCloud, options: WriteOptions) -> GaussianCloud {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    write_splats_with(&path, cloud, &options).unwrap();
    let file = read_splat_file(&path).unwrap();
    assert_eq!((file.format, file.left_out), (SplatFormat::of(&path).unwrap(), 0));
    assert!(file.cloud.is_consistent() && file.unread.is_empty());
    file.cloud
}

#[test]
fn every_format_round_trips_within_its_precision() {
    let [low, normal, high] = [Quality::Low, Quality::Normal, Quality::High];
    let byte = 0.5 / 255.0 + 1e-6;
    // Tolerances of half a step of each format; these scenes have no harmonics as large as 1.0.
    #[rustfmt::skip]
    let cases = [
        // name, quality, version, position, ln scale, opacity and colour, harmonics, rotation
        ("a.ply", normal, SpzVersion::V3, 0.0, 0.0, 0.0, 0.0, 2e-3),
        ("a.spz", low, SpzVersion::V3, 1.3e-4, 0.032, byte, 0.13, 5e-3),
        ("a.spz", normal, SpzVersion::V3, 6.5e-5, 0.032, byte, 0.067, 5e-3),
        ("a.spz", high, SpzVersion::V4, 1e-6, 0.032, byte, 0.004, 5e-3),
        ("a.splat", normal, SpzVersion::V3, 0.0, 1e-6, byte, 0.0, 0.03),
        ("a.ksplat", high, SpzVersion::V3, 0.0, 1e-6, byte, 0.0, 2e-3),
        ("a.ksplat", normal, SpzVersion::V3, 4e-5, 1e-3, byte, 2e-4, 2e-3),
        ("a.ksplat", low, SpzVersion::V3, 4e-5, 1e-3, byte, 0.002, 2e-3),
        ("a.compressed.ply", normal, SpzVersion::V3, 5e-3, 3e-3, byte, 0.016, 5e-3),
        ("a.sog", high, SpzVersion::V3, 1.3e-4, 0.02, 0.003, 0.005, 0.02),
        ("a.glb", normal, SpzVersion::V3, 0.0, 1e-6, 1e-6, 0.0, 2e-3),
        ("a.gltf", normal, SpzVersion::V3, 0.0, 1e-6, 1e-6, 0.0, 2e-3),
        // Three components of 8 bits determine the fourth poorly if it is small.
        ("a.spz.glb", high, SpzVersion::V3, 1e-6, 0.032, byte, 0.004, 0.25),
    ];
    let mut failures = Vec::new();
    for (name, quality, spz_version, position, scale, color, harmonic, rotation) in cases {
        for degree in 0..=4 {
            let cloud = scene(600, degree);
            let options = WriteOptions {
                quality,
                spz_version,
                sog: None,
            };
            let back = round_trip(name, &cloud, options);
            let format = SplatFormat::of(Path::new(name)).unwrap();
            assert_eq!(back.sh_degree, degree.min(format.max_degree()), "{name}");
            let largest = differences(&cloud, &back);
            let holds = largest.position <= position
                && largest.log_scale <= scale
                && largest.opacity <= color
                && largest.color
                    <= if format == SplatFormat::Spz || format == SplatFormat::GlbSpz {
                        0.0037
                    } else {
                        color
                    }
                && largest.harmonic <= harmonic
                && largest.rotation <= rotation;
            if !holds {
                failures.push(format!("{name} {quality:?} degree {degree}: {largest:?}"));
            }
            // A second trip finds every value on its step.
            if !matches!(
                format,
                SplatFormat::Sog | SplatFormat::Ksplat | SplatFormat::CompressedPly
            ) {
                let again = differences(&back, &round_trip(name, &back, options));
                if again.position > 1e-6 || again.harmonic > 1e-6 || again.opacity > 1e-6 {
                    failures.push(format!("{name}, again: {again:?}"));
                }
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn lossless_formats_are_equal_to_the_bit_and_empty_scenes_stay_empty() {
    let mut cloud = scene(500, 3);
    cloud.antialiased = true;
    assert_eq!(round_trip("a.ply", &cloud, WriteOptions::default()), cloud);
    for name in ["a.spz", "a.sog", "a.ply", "a.spz.glb"] {
        assert!(round_trip(name, &cloud, WriteOptions::default()).antialiased, "{name}");
    }
    let empty = scene(0, 1);
    for format in SplatFormat::ALL.into_iter().filter(|format| format.is_readable()) {
        let name = match format {
            SplatFormat::SogFolder => "scene/meta.json".to_owned(),
            _ => format!("a{}", format.suffix()),
        };
        let back = round_trip(&name, &empty, WriteOptions::default());
        assert!(back.is_empty() && back.is_consistent(), "{format}");
    }
}

/// Where the three splats of the asymmetric scene lie in a file's own axes: up means up, right means right.
#[test]
fn an_asymmetric_scene_stands_upright_and_unmirrored_in_every_format() {
    // Ours: right is +x, up is -y, forward is +z. Red is to the right, green is above, blue is in front.
    let mut cloud = scene(3, 1);
    cloud.means = vec![[1.0, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 3.0]];
    cloud.sh = [[1.7f32, -1.7, -1.7], [-1.7, 1.7, -1.7], [-1.7, -1.7, 1.7]]
        .into_iter()
        // Brighter from the right: the coefficient of x is negative in the basis -y, z, -x.
        .flat_map(|dc| [dc, [0.0; 3], [0.0; 3], [-0.25; 3]].concat())
        .collect();
    // Long along an axis between right and up.
    let half_angle = std::f32::consts::FRAC_PI_8;
    cloud.quats = vec![[half_angle.cos(), 0.0, 0.0, -half_angle.sin()]; 3];
    cloud.log_scales = vec![[0.0, -3.0, -3.0]; 3];
    for format in SplatFormat::ALL.into_iter().filter(|format| format.is_readable()) {
        let folder = tempfile::tempdir().unwrap();
        let path = match format {
            SplatFormat::SogFolder => folder.path().join("meta.json"),
            _ => folder.path().join(format!("a{}", format.suffix())),
        };
        write_splats(&path, &cloud).unwrap();
        let back = read_splats(&path).unwrap();
        let largest = differences(&cloud, &back);
        assert!(
            largest.position < 0.01 && largest.rotation < 0.03 && largest.harmonic < 0.03,
            "{format}: {largest:?}"
        );
    }

    // In the file itself: SPZ has y up and z backward, glTF x left and y up.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let options = WriteOptions {
        spz_version: SpzVersion::V2,
        ..WriteOptions::default()
    };
    write_splats_with(&path, &cloud, &options).unwrap();
    let mut bytes = Vec::new();
    let packed = std::fs::read(&path).unwrap();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&packed[..]), &mut bytes).unwrap();
    let unit = 2f32.powi(-i32::from(bytes[13]));
    let fixed = |at: usize| (i32::from_le_bytes([0, bytes[at], bytes[at + 1], bytes[at + 2]]) >> 8) as f32 * unit;
    let mut positions: Vec<[f32; 3]> = (0..3).map(|i| [0, 1, 2].map(|c| fixed(16 + 9 * i + 3 * c))).collect();
    positions.sort_by(|a, b| a.partial_cmp(b).unwrap());
    assert_eq!(positions, [[0.0, 0.0, -3.0], [0.0, 2.0, 0.0], [1.0, 0.0, 0.0]]);

    let path = folder.path().join("a.glb");
    write_splats(&path, &cloud).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let json = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let float = |i: usize| f32::from_le_bytes(bytes[28 + json + 4 * i..][..4].try_into().unwrap());
    let positions: Vec<f32> = (0..9).map(float).collect();
    assert_eq!(positions, [-1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 3.0]);
}

#[test]
fn what_a_format_cannot_hold_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = scene(10, 3);
    cloud.antialiased = true;
    cloud.opacity_logits[4] = f32::NAN;
    let path = folder.path().join("a.splat");
    let notes = write_splats_with(&path, &cloud, &WriteOptions::default()).unwrap();
    assert_eq!(notes.len(), 3, "{notes:?}");
    assert!(
        notes[0].starts_with("1 splats left out") && notes[1].contains("degree 0") && notes[2].contains("antialiasing")
    );
    assert_eq!(read_splats(&path).unwrap().len(), 9);
    // PLY keeps every bit, and reading says what cannot be drawn.
    let path = folder.path().join("a.ply");
    assert!(
        write_splats_with(&path, &cloud, &WriteOptions::default())
            .unwrap()
            .is_empty()
    );
    let file = read_splat_file(&path).unwrap();
    assert_eq!((file.cloud.len(), file.left_out), (9, 1));
    assert!(file.warnings()[0].starts_with("1 splats left out"));
    for name in ["a.xyz", "a", "metadata.json"] {
        let error = write_splats(&folder.path().join(name), &cloud).unwrap_err().to_string();
        assert!(
            error.contains(".ksplat") && error.contains("meta.json") && error.contains(".spz.glb"),
            "{error}"
        );
    }
    assert!(
        read_splats(&folder.path().join("a.npz"))
            .unwrap_err()
            .to_string()
            .contains("written, not read")
    );
}

#[test]
fn a_scene_far_from_the_origin_keeps_its_shape() {
    let mut cloud = scene(10, 0);
    cloud.world_from_dataset = irradia_scene::Similarity {
        scale: 1e-3,
        center: glam::DVec3::new(5e8, 0.0, 0.0),
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    let notes = write_splats_with(&path, &cloud, &WriteOptions::default()).unwrap();
    assert!(notes[0].contains("relative to (500000000, 0, 0)"), "{notes:?}");
    let back = read_splats(&path).unwrap();
    for i in 0..10 {
        assert!((back.means[i][0] - 1000.0 * cloud.means[i][0]).abs() < 1e-3);
        assert!((back.log_scales[i][0] - cloud.log_scales[i][0] - 1000f32.ln()).abs() < 1e-5);
    }
    // NumPy archives cannot hold a second coordinate system either.
    let write = |name: &str, cloud: &GaussianCloud| {
        let path = folder.path().join(name);
        let notes = write_splats_with(&path, cloud, &WriteOptions::default()).unwrap();
        (notes, std::fs::read(path).unwrap())
    };
    let (notes, far) = write("far.npz", &cloud);
    assert!(notes[0].contains("relative to (500000000, 0, 0)"), "{notes:?}");
    let world = std::mem::take(&mut cloud.world_from_dataset);
    let (unit, log_unit) = (1.0 / world.scale, world.scale.ln());
    let scaled = |v: &mut f32| *v = (f64::from(*v) * unit) as f32;
    cloud.means.as_flattened_mut().iter_mut().for_each(scaled);
    let grown = |v: &mut f32| *v = (f64::from(*v) - log_unit) as f32;
    cloud.log_scales.as_flattened_mut().iter_mut().for_each(grown);
    assert!(write("near.npz", &cloud).1 == far, "in the dataset's unit");
}

#[test]
fn every_real_file_has_its_count_and_degree() {
    let Some(folder) = shared("data/splats") else { return };
    let lod = |level: u32| {
        let text = std::fs::read_to_string(folder.join(format!("playbot_sog_v2/{level}_0/meta.json"))).unwrap();
        let count = text.split("\"count\":").nth(1).unwrap().split(',').next().unwrap();
        count.parse::<usize>().unwrap()
    };
    #[rustfmt::skip]
    let files = [
        ("biker.compressed.ply", 152_746, 0, "compressed PLY"),
        ("biker.spz", 152_746, 0, "SPZ"),
        ("guitar.compressed.ply", 90_854, 0, "compressed PLY"),
        ("playcanvas-logo_sog_v1", 307_128, 0, "SOG"),
        ("playbot_sog_v2/3_0", lod(3), 2, "SOG"),
        ("playbot_sog_v2/4_0/meta.json", lod(4), 2, "SOG"),
        ("playbot_sog_v2/5_0", lod(5), 2, "SOG"),
        ("playbot_sog_v2/6_0", 1873, 2, "SOG"),
        ("khr/khr_conformance_matrix.glb", 15, 3, "glTF"),
        ("fixtures_metalsplatter/test-splat.3-points-from-train.ply", 3, 3, "PLY"),
        ("fixtures_metalsplatter/test-splat.3-points-from-train.splat", 3, 0, ".splat"),
        ("fixtures_metalsplatter/test-splat.3-points-from-train.spz", 3, 3, "SPZ"),
        ("fixtures_splat-transform/minimal-raw.spz", 4, 0, "SPZ"),
        ("fixtures_splat-transform/minimal-v2.spz", 4, 0, "SPZ"),
        ("fixtures_splat-transform/minimal-v3.spz", 4, 0, "SPZ"),
        ("fixtures_splat-transform/minimal-v4.spz", 4, 0, "SPZ"),
        ("fixtures_splat-transform/minimal.ksplat", 4, 0, ".ksplat"),
        ("fixtures_splat-transform/minimal.splat", 4, 0, ".splat"),
    ];
    for (name, count, degree, format) in files {
        let file = read_splat_file(&folder.join(name)).unwrap();
        let found = (
            file.cloud.len(),
            file.cloud.sh_degree,
            file.format.to_string(),
            file.left_out,
        );
        assert_eq!(found, (count, degree, format.to_owned(), 0), "{name}");
        assert!(file.cloud.is_consistent());
        assert!(
            file.cloud
                .log_scales
                .as_flattened()
                .iter()
                .all(|s| (-40.0..20.0).contains(s)),
            "{name}"
        );
    }
}

#[test]
fn the_same_scene_in_two_formats_is_the_same() {
    let Some(folder) = shared("data/splats") else { return };
    let read = |name: &str| read_splats(&folder.join(name)).unwrap();
    // The biker was written from one source by two programs in one order.
    let (ply, spz) = (read("biker.compressed.ply"), read("biker.spz"));
    let sigmoid = |x: f32| 1.0 / (1.0 + (-x).exp());
    let mut sums = [0f64; 4];
    for i in 0..ply.len() {
        for c in 0..3 {
            sums[0] += f64::from((ply.means[i][c] - spz.means[i][c]).abs());
            sums[1] += f64::from((ply.log_scales[i][c] - spz.log_scales[i][c]).abs());
            sums[2] += f64::from((ply.sh[3 * i + c] - spz.sh[3 * i + c]).abs());
        }
        sums[3] += f64::from((sigmoid(ply.opacity_logits[i]) - sigmoid(spz.opacity_logits[i])).abs());
    }
    let [position, scale, color, opacity] = sums.map(|sum| sum / ply.len() as f64);
    assert!(
        position < 2e-3 && scale < 0.2 && color < 0.1 && opacity < 0.01,
        "{sums:?}"
    );

    // Three splats of a training run, as PLY and as two programs converted it.
    let ply = read("fixtures_metalsplatter/test-splat.3-points-from-train.ply");
    let spz = differences(&ply, &read("fixtures_metalsplatter/test-splat.3-points-from-train.spz"));
    assert!(
        spz.position < 3e-4 && spz.log_scale < 0.04 && spz.harmonic < 0.07 && spz.rotation < 0.03,
        "{spz:?}"
    );
    let splat = differences(
        &ply,
        &read("fixtures_metalsplatter/test-splat.3-points-from-train.splat"),
    );
    assert!(
        splat.position < 1e-6 && splat.log_scale < 1e-4 && splat.opacity < 0.005 && splat.rotation < 0.03,
        "{splat:?}"
    );

    // Four splats of one colour each in every format of one writer.
    let versions = [
        "minimal-raw.spz",
        "minimal-v2.spz",
        "minimal-v3.spz",
        "minimal-v4.spz",
        "minimal.ksplat",
    ];
    let splat = read("fixtures_splat-transform/minimal.splat");
    for name in versions {
        let other = read(&format!("fixtures_splat-transform/{name}"));
        let mut colors: Vec<[i32; 3]> = other
            .sh
            .chunks_exact(3)
            .map(|dc| [0, 1, 2].map(|c| (dc[c] * 2.8 + 5.0) as i32))
            .collect();
        let mut expected: Vec<[i32; 3]> = splat
            .sh
            .chunks_exact(3)
            .map(|dc| [0, 1, 2].map(|c| (dc[c] * 2.8 + 5.0) as i32))
            .collect();
        colors.sort_unstable();
        expected.sort_unstable();
        assert_eq!(colors.len(), expected.len(), "{name}");
    }
}

/// The splats in a text PLY with `properties` of these types and names, and `rows` of their values.
fn text_ply(properties: &str, rows: &[&str]) -> GaussianCloud {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let properties: String = properties.split(", ").map(|p| format!("property {p}\n")).collect();
    let header = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\n{properties}end_header\n",
        rows.len()
    );
    fs::write(&path, header + &rows.join("\n") + "\n").unwrap();
    read_splats(&path).unwrap()
}

const SHAPE: &str =
    "float opacity, float scale_0, float scale_1, float scale_2, float rot_0, float rot_1, float rot_2, float rot_3";

#[test]
fn colours_in_place_of_harmonics_and_rotations_of_length_zero_are_read() {
    // Nerfstudio's export without harmonics.
    let cloud = text_ply(
        &format!("float x, float y, float z, {SHAPE}, uchar red, uchar green, uchar blue, float label"),
        &["1 2 3 0 -1 -1 -1 0 0 0 0 255 0 51 7"],
    );
    assert_eq!(cloud.quats, [[1.0, 0.0, 0.0, 0.0]]);
    let colors: Vec<f32> = cloud.sh.iter().map(|dc| sh::color_from_dc(*dc)).collect();
    for (color, expected) in colors.iter().zip([1.0, 0.0, 0.2]) {
        assert!((color - expected).abs() < 1e-6, "{colors:?}");
    }
    assert_eq!(
        cloud.extra.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(),
        ["label"]
    );
}

#[test]
fn doubles_of_other_programs_far_from_the_origin_keep_their_precision() {
    let properties = format!("double x, double y, double z, float f_dc_0, float f_dc_1, float f_dc_2, {SHAPE}");
    let row = |x: f64, y: f64| format!("{x} {y} 100.5 0 0 0 0 -1 -1 -1 1 0 0 0");
    let (a, b) = (row(400_000.0, 5_200_000.031_25), row(400_001.5, 5_199_999.0));
    let cloud = text_ply(&properties, &[&a, &b]);
    let at = |cloud: &GaussianCloud, i: usize| {
        cloud
            .world_from_dataset
            .invert(glam::DVec3::from(cloud.means[i].map(f64::from)))
    };
    assert_eq!(at(&cloud, 0), glam::DVec3::new(400_000.0, 5_200_000.031_25, 100.5));
    // Also after it was written and read.
    let again = round_trip("a.ply", &cloud, WriteOptions::default());
    assert_eq!(at(&again, 1), glam::DVec3::new(400_001.5, 5_199_999.0, 100.5));
    // Near the origin, the coordinates are those of the file.
    let near = text_ply(&properties, &[&row(1.5, 2.0), &row(-2.5, 0.0)]);
    assert_eq!(
        (near.means[0], near.world_from_dataset.is_identity()),
        ([1.5, 2.0, 100.5], true)
    );
}

#[test]
fn splats_without_thickness_stay_thin() {
    let mut cloud = scene(300, 0);
    cloud
        .log_scales
        .iter_mut()
        .for_each(|scales| scales[2] = f32::NEG_INFINITY);
    for name in ["a.sog", "a.spz", "a.compressed.ply", "a.ksplat", "a.glb"] {
        let read = round_trip(name, &cloud, WriteOptions::default());
        assert!(read.log_scales.iter().all(|scales| scales[2] < -9.9), "{name}");
    }
}

#[test]
fn splats_that_are_never_seen_do_not_blur_the_colours_of_others() {
    let mut cloud = scene(200, 0);
    let alone = differences(&cloud, &round_trip("a.compressed.ply", &cloud, WriteOptions::default()));
    (cloud.opacity_logits[7], cloud.sh[21]) = (-9.0, 1e4);
    let mut read = round_trip("a.compressed.ply", &cloud, WriteOptions::default());
    let order = by_x(&read);
    let unseen = by_x(&cloud).iter().position(|i| *i == 7).unwrap();
    read.sh[3 * order[unseen]] = cloud.sh[21];
    let both = differences(&cloud, &read);
    assert!(both.color <= 1.1 * alone.color, "{both:?} {alone:?}");
}

#[test]
fn axes_are_also_declared_behind_the_arrays_of_older_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let cloud = scene(50, 1);
    let options = WriteOptions {
        spz_version: SpzVersion::V3,
        ..WriteOptions::default()
    };
    write_splats_with(&path, &cloud, &options).unwrap();
    let mut bytes = Vec::new();
    let packed = fs::read(&path).unwrap();
    flate2::read::GzDecoder::new(&packed[..])
        .read_to_end(&mut bytes)
        .unwrap();
    // The flag, and the Adobe extension with the axes right, down, front.
    bytes[14] |= 2;
    for number in [0xadbe_0003u32, 4, 6] {
        bytes.extend(number.to_le_bytes());
    }
    let plain = read_splats(&path).unwrap();
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(&bytes).unwrap();
    for file in [gzip.finish().unwrap(), bytes] {
        fs::write(&path, file).unwrap();
        let read = read_splats(&path).unwrap();
        for (a, b) in read.means.iter().zip(&plain.means) {
            assert_eq!(*a, [b[0], -b[1], -b[2]]);
        }
    }
}
