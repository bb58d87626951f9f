//! Malicious files: false lengths, decompression bombs, values that are not numbers, paths out of the folder. Each is refused with one
//! line that says what and where.

use irradia_formats::{SplatFormat, parse, read_splat_file, read_splats, write_splats};
use irradia_scene::GaussianCloud;
use irradia_testkit::torch::zip;
use std::io::Write;
use std::path::Path;

fn small_cloud() -> GaussianCloud {
    GaussianCloud {
        means: vec![[1.0, 2.0, 3.0]; 3],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
        log_scales: vec![[-3.0; 3]; 3],
        opacity_logits: vec![0.1; 3],
        sh: vec![0.2; 36],
        sh_degree: 1,
        ..GaussianCloud::default()
    }
}

fn written_file(name: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    write_splats(&path, &small_cloud()).unwrap();
    std::fs::read(path).unwrap()
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    packed.write_all(bytes).unwrap();
    packed.finish().unwrap()
}

fn assert_refused<T>(result: Result<T, irradia_formats::Malformed>, expected: &str) {
    let Err(error) = result else {
        panic!("accepted; expected `{expected}`")
    };
    let error = error.to_string();
    assert!(
        error.contains(expected) && !error.contains('\n') && error.len() < 400,
        "{error}"
    );
}

#[test]
fn lengths_that_lie() {
    let write_word = |bytes: &mut [u8], at: usize, word: u32| bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
    // SPZ: a header that declares four billion splats, and one that declares more than follow.
    let mut header = b"NGSP\x03\x00\x00\x00\xff\xff\xff\xff\x03\x0c\x00\x00".to_vec();
    assert_refused(parse::spz(&gzip(&header)), "4294967295 splats");
    assert_refused(parse::spz(&header), "4294967295 splats");
    write_word(&mut header, 8, 100);
    assert_refused(parse::spz(&gzip(&header)), "gzip stream ends after 0");
    header[12] = 9;
    assert_refused(parse::spz(&gzip(&header)), "degree 9");
    let mut version_4 = b"NGSP\x04\x00\x00\x00\xff\xff\xff\xff\x03\x0c\x00\x06\x20\x00\x00\x00".to_vec();
    version_4.resize(200, 0);
    assert_refused(parse::spz(&version_4), "4294967295 splats");
    write_word(&mut version_4, 8, 10);
    assert_refused(parse::spz(&version_4), "stream 0 declares 0 bytes");
    write_word(&mut version_4, 16, 0xffff_fff0);
    assert_refused(parse::spz(&version_4), "outside of the file");

    let ksplat = written_file("a.ksplat");
    for (at, word, expected) in [
        (4, u32::MAX, "ends too early"),
        (4096, u32::MAX, "splats in the space of 3"),
        (4096 + 4, u32::MAX, "ends too early"),
        (4096 + 12, u32::MAX, "ends too early"),
        (4096 + 36, 0, "buckets hold fewer"),
        (4096 + 40, 7, "degree 7"),
        (16, 4, "declares 4 splats"),
        (20, 3, "level is 3"),
    ] {
        let mut bytes = ksplat.clone();
        write_word(&mut bytes, at, word);
        assert_refused(parse::ksplat(&bytes), expected);
    }
    assert_refused(parse::splat(&[0; 33]), "multiple of 32");

    let text = |header: &str| format!("ply\nformat binary_little_endian 1.0\n{header}end_header\n").into_bytes();
    let bounds: String = ["", "scale_"]
        .iter()
        .flat_map(|kind| ["min", "max"].map(|end| [*kind, end].map(str::to_owned)))
        .flat_map(|[kind, end]| ["x", "y", "z"].map(|axis| format!("property float {end}_{kind}{axis}\n")))
        .collect();
    let packed: String = ["position", "rotation", "scale", "color"]
        .map(|name| format!("property uint packed_{name}\n"))
        .concat();
    let ply = |chunks: u64, vertices: u64| {
        let header = format!("element chunk {chunks}\n{bounds}element vertex {vertices}\n{packed}");
        [text(&header), vec![0; 48 + 16 * 300]].concat()
    };
    assert_refused(parse::splat_ply(&ply(1, 300)), "need 2 chunks");
    assert_refused(parse::splat_ply(&ply(1, 1 << 60)), "declares 1152921504606846976 rows");
    assert_refused(parse::splat_ply(&ply(1 << 60, 1)), "declares 1152921504606846976 rows");
}

#[test]
fn archives_that_unfold_without_end() {
    // A gzip stream of 64 MiB of zeros behind a header of three splats costs no more than three splats.
    let mut header = b"NGSP\x03\x00\x00\x00\x03\x00\x00\x00\x00\x0c\x00\x00".to_vec();
    header.resize(64 << 20, 0);
    assert_eq!(parse::spz(&gzip(&header)).unwrap().len(), 3);
    // A zip directory that declares four gigabytes of deflated nothing.
    let mut archive = zip(&[("meta.json".to_owned(), vec![0; 10])]);
    let directory = archive.windows(4).rposition(|w| w == b"PK\x01\x02").unwrap();
    archive[directory + 10] = 8;
    archive[directory + 24..directory + 28].fill(0xff);
    assert_refused(parse::sog(&archive), "meta.json: declares 4294967295 bytes");
    // One mesh placed a hundred thousand times.
    let glb = written_file("a.glb");
    let json = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let text = String::from_utf8(glb[20..20 + json].to_vec()).unwrap();
    let nodes = vec!["{\"mesh\":0}"; 100_000].join(",");
    let numbers: Vec<String> = (0..100_000).map(|i| i.to_string()).collect();
    let text = text
        .replace("\"nodes\":[{\"mesh\":0}]", &format!("\"nodes\":[{nodes}]"))
        .replace(
            "\"scenes\":[{\"nodes\":[0]}]",
            &format!("\"scenes\":[{{\"nodes\":[{}]}}]", numbers.join(",")),
        );
    let mut bytes = b"glTF\x02\0\0\0".to_vec();
    bytes.extend(((20 + text.len() + glb[20 + json..].len()) as u32).to_le_bytes());
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend(b"JSON");
    bytes.extend(text.bytes());
    bytes.extend(&glb[20 + json..]);
    assert_eq!(parse::glb(&bytes).map(|cloud| cloud.len()), Ok(300_000));
    // What follows the declared length is not part of the file.
    bytes.extend([7; 13]);
    assert_eq!(parse::glb(&bytes).map(|cloud| cloud.len()), Ok(300_000));
}

#[test]
fn scenes_of_images_with_wrong_sizes_and_indices() {
    let folder = tempfile::tempdir().unwrap();
    let meta = folder.path().join("scene/meta.json");
    let mut cloud = small_cloud();
    // Two colours, so that one of their indices is not 0.
    cloud.sh[0] = -1.0;
    write_splats(&meta, &cloud).unwrap();
    assert_eq!(read_splats(&meta).unwrap().len(), 3);
    let text = std::fs::read_to_string(&meta).unwrap();
    let edit = |from: &str, to: &str| {
        assert!(text.contains(from), "{from} is not in {text}");
        std::fs::write(&meta, text.replacen(from, to, 1)).unwrap();
        let error = read_splats(&meta).unwrap_err().to_string();
        assert!(!error.contains('\n') && error.contains("scene"), "{error}");
        error
    };
    assert!(edit("\"count\":3", "\"count\":99999999999").contains("99999999999 splats"));
    assert!(edit("\"count\":3", "\"count\":200").contains("does not match"));
    assert!(edit("\"version\":2", "\"version\":7").contains("version 7"));
    for path in ["../../secret.webp", "/etc/passwd", "..", "c:\\secret"] {
        let escaped = path.replace('\\', "\\\\");
        assert!(edit("quats.webp", &escaped).contains("not a file beside it"));
    }
    assert!(edit("quats.webp", "absent.webp").contains("absent.webp"));
    assert!(edit("\"bands\":1", "\"bands\":3").contains("pixels wide"));
    let start = text.find("\"sh0\":{\"codebook\":[").unwrap() + 19;
    let end = start + text[start..].find(']').unwrap();
    std::fs::write(&meta, format!("{}0.5{}", &text[..start], &text[end..])).unwrap();
    let error = read_splats(&meta).unwrap_err().to_string();
    assert!(error.contains("beyond the end of the codebook"), "{error}");
    std::fs::write(meta.with_file_name("quats.webp"), b"RIFF").unwrap();
    std::fs::write(&meta, &text).unwrap();
    assert!(
        read_splats(&meta)
            .unwrap_err()
            .to_string()
            .contains("quats.webp: not a usable WebP")
    );
}

#[test]
fn documents_that_refer_to_what_is_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    write_splats(&path, &small_cloud()).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    for (from, to, expected) in [
        ("\"nodes\":[0]", "\"nodes\":[7]", "node 7 does not exist"),
        ("\"nodes\":[0]", "\"nodes\":[0,0]", "two parents"),
        ("{\"mesh\":0}", "{\"mesh\":3}", "mesh of its node 0"),
        ("{\"mesh\":0}", "{\"mesh\":0,\"scale\":[1,-1,1]}", "mirrors"),
        ("\"count\":3", "\"count\":9999999999999", "holds fewer"),
        ("\"buffer\":0", "\"buffer\":9", "outside of the buffers"),
        (
            "\"byteOffset\":0",
            "\"byteOffset\":18446744073709551615",
            "outside of the buffers",
        ),
        (
            "\"componentType\":5126",
            "\"componentType\":1",
            "unknown component type",
        ),
        (
            "KHR_gaussian_splatting:OPACITY",
            "OPACITY",
            "lack the attribute KHR_gaussian_splatting:OPACITY",
        ),
        (
            "\"asset\"",
            "\"extensionsRequired\":[\"EXT_magic\"],\"asset\"",
            "EXT_magic",
        ),
        ("base64,", "base64,?", "not valid base64"),
        (
            "data:application/octet-stream;base64,",
            "../secret.bin?",
            "not in its folder",
        ),
        (
            "data:application/octet-stream;base64,",
            "https://example.com/",
            "not in its folder",
        ),
    ] {
        assert!(text.contains(from), "{from} is not in {text}");
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
        let error = read_splats(&path).unwrap_err().to_string();
        assert!(
            error.contains(expected) && !error.contains('\n'),
            "{from} to {to}: {error}"
        );
    }
    // A buffer in a file beside it is read.
    let (start, end) = (
        text.find("data:").unwrap(),
        text.find("\"}],\"extensionsUsed").or(text.find("\"}]")).unwrap(),
    );
    let encoded = text[start..end].split(',').nth(1).unwrap();
    std::fs::write(
        folder.path().join("a.bin"),
        irradia_scene::base64::decode(encoded).unwrap(),
    )
    .unwrap();
    std::fs::write(&path, format!("{}a.bin{}", &text[..start], &text[end..])).unwrap();
    assert_eq!(read_splats(&path).unwrap().len(), 3);
}

#[test]
fn splats_that_are_no_numbers_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.splat");
    let mut bytes = written_file("a.splat");
    bytes[4..8].copy_from_slice(&f32::NAN.to_le_bytes());
    bytes[32 + 12..32 + 16].copy_from_slice(&(-1f32).to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let file = read_splat_file(&path).unwrap();
    assert_eq!((file.cloud.len(), file.left_out), (1, 2));
    assert!(file.warnings()[0].contains("2 splats left out"));
}

#[test]
fn a_failed_write_leaves_nothing_under_the_final_name() {
    for format in SplatFormat::ALL
        .into_iter()
        .filter(|format| *format != SplatFormat::SogFolder)
    {
        let path = Path::new("/proc/irradia-cannot-write-here").with_file_name(format!("a{}", format.suffix()));
        let error = write_splats(&path, &small_cloud()).unwrap_err().to_string();
        assert!(error.contains("cannot write") && !path.exists(), "{error}");
    }
}
