//! Every splat reader against damaged files: small scenes of every format, truncated and mutated, both as they are and inside their
//! compression, by unpacking and packing again. Nothing may panic, hang or allocate memory for content that does not exist.
//!
//! `IRRADIA_FUZZ_EXECUTIONS=1000000 cargo test --release -p irradia-formats --test splat_mutations` runs each reader that often,
//! deterministically: a failure names the reader and the seed.

use irradia_formats::{Quality, SpzVersion, WriteOptions, parse, write_splats_with};
use irradia_scene::{GaussianCloud, Rng, sh};
use irradia_testkit::shared;
use irradia_testkit::torch::zip;
use std::io::{Read, Write};
use std::time::{Duration, Instant};

/// Executions of each reader in an ordinary test.
const EXECUTIONS: u64 = 3000;
/// Maximum time for a small file; generous, since machines that run tests are slow and busy.
const MAX_DURATION: Duration = Duration::from_secs(5);

type Parse = fn(&[u8]) -> bool;

/// How a file's content is packed; mutated content must be packed again in this way.
#[derive(Clone, Copy)]
enum Packing {
    None,
    Gzip,
    Sog,
    Glb,
}

impl Packing {
    fn unpack(self, bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
        match self {
            Self::None => vec![(String::new(), bytes.to_vec())],
            Self::Gzip => {
                let mut unpacked = Vec::new();
                flate2::read::GzDecoder::new(bytes).read_to_end(&mut unpacked).unwrap();
                vec![(String::new(), unpacked)]
            }
            Self::Sog => stored_files(bytes),
            Self::Glb => {
                let json = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
                let binary = bytes[28 + json..].to_vec();
                vec![("json".into(), bytes[20..20 + json].to_vec()), ("bin".into(), binary)]
            }
        }
    }

    fn pack(self, parts: &[(String, Vec<u8>)]) -> Vec<u8> {
        match self {
            Self::None => parts[0].1.clone(),
            Self::Gzip => {
                let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
                packed.write_all(&parts[0].1).unwrap();
                packed.finish().unwrap()
            }
            Self::Sog => zip(parts),
            Self::Glb => {
                let [json, binary] = [&parts[0].1, &parts[1].1];
                let mut bytes = b"glTF\x02\x00\x00\x00".to_vec();
                bytes.extend((28 + json.len() as u32 + binary.len() as u32).to_le_bytes());
                bytes.extend((json.len() as u32).to_le_bytes());
                bytes.extend(b"JSON");
                bytes.extend(json);
                bytes.extend((binary.len() as u32).to_le_bytes());
                bytes.extend(b"BIN\0");
                bytes.extend(binary);
                bytes
            }
        }
    }
}

/// Names and contents of an archive of stored files, by their local headers.
fn stored_files(mut bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    while let Some(rest) = bytes.strip_prefix(b"PK\x03\x04") {
        let word = |at: usize| u32::from_le_bytes(rest[at..at + 4].try_into().unwrap()) as usize;
        let (size, name) = (word(14), word(22) & 0xffff);
        let content = &rest[26 + name..];
        files.push((
            String::from_utf8(rest[26..26 + name].to_vec()).unwrap(),
            content[..size].to_vec(),
        ));
        bytes = &content[size..];
    }
    files
}

fn scene(count: usize, sh_degree: u32) -> GaussianCloud {
    let mut rng = Rng::new(3, u64::from(sh_degree));
    let mut values = |n: usize| (0..n).map(|_| rng.range(-2.0, 2.0)).collect::<Vec<f32>>();
    GaussianCloud {
        means: values(3 * count).as_chunks().0.to_vec(),
        quats: values(4 * count).as_chunks().0.to_vec(),
        log_scales: values(3 * count).as_chunks().0.to_vec(),
        opacity_logits: values(count),
        sh: values(3 * sh::coefficients(sh_degree) * count),
        sh_degree,
        ..GaussianCloud::default()
    }
}

/// Files of the format whose name ends with `suffix`: as this crate writes them, and by other programs.
fn seeds(suffix: &str, options: &[WriteOptions], fixtures: &[&str]) -> Vec<Vec<u8>> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(format!("a{suffix}"));
    let mut seeds = Vec::new();
    for options in options {
        for (count, degree) in [(5, 0), (3, 1), (300, 2), (2, 3)] {
            write_splats_with(&path, &scene(count, degree), options).unwrap();
            seeds.push(std::fs::read(&path).unwrap());
        }
    }
    for name in fixtures {
        if let Some(path) = shared(&format!("data/splats/{name}")) {
            seeds.push(std::fs::read(path).unwrap());
        }
    }
    seeds
}

/// Values that break arithmetic, as text.
const NUMBER_WORDS: [&str; 12] = [
    "0",
    "-1",
    "1e999",
    "-1e38",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "99999999999999999999999",
    "null",
    "\"a\"",
    "[]",
    "0.5",
];

fn mutate(bytes: &mut Vec<u8>, rng: &mut Rng) {
    for _ in 0..=rng.below(4) {
        if bytes.is_empty() {
            return;
        }
        // The first bytes decide most.
        let region = if rng.below(2) == 0 {
            bytes.len().min(64)
        } else {
            bytes.len()
        };
        let at = rng.below(region as u32) as usize;
        match rng.below(10) {
            0 => bytes[at] = rng.next_u32() as u8,
            1 => bytes[at] = [0, 0xFF, 0x7F, 0x80, b'9', b'-', b'\n', 1][rng.below(8) as usize],
            2 => bytes[at] ^= 1 << rng.below(8),
            3 => bytes.insert(at, rng.next_u32() as u8),
            4 => drop(bytes.remove(at)),
            5 => {
                let end = (at + rng.below(40) as usize).min(bytes.len());
                let copy = bytes[at..end].to_vec();
                bytes.splice(at..at, copy);
            }
            6 => bytes.truncate(at),
            7 => {
                // A number of four bytes, in place.
                let end = (at + 4).min(bytes.len());
                let value = [0, 1, 0x7fff_ffff, u32::MAX, 0x7fc0_0000, 0x1000_0000, 255, 65536][rng.below(8) as usize];
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
            8 => {
                let end = (at + 8).min(bytes.len());
                bytes[at..end].fill(if rng.below(2) == 0 { 0xFF } else { 0 });
            }
            _ => {
                // Replaces a number in text by another one.
                let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit).map(|i| at + i) else {
                    continue;
                };
                let length = bytes[start..]
                    .iter()
                    .take_while(|b| b.is_ascii_digit() || **b == b'.')
                    .count();
                bytes.splice(start..start + length, NUMBER_WORDS[rng.below(12) as usize].bytes());
            }
        }
    }
}

/// Runs a reader on its seeds and on mutations of them.
fn fuzz(reader: &str, packing: Packing, parse: Parse, seeds: &[Vec<u8>]) {
    let executions = std::env::var("IRRADIA_FUZZ_EXECUTIONS").map_or(EXECUTIONS, |count| count.parse().unwrap());
    let unpacked_seeds: Vec<_> = seeds.iter().map(|seed| packing.unpack(seed)).collect();
    for (seed, unpacked) in seeds.iter().zip(&unpacked_seeds) {
        assert!(parse(seed), "{reader}: a seed is refused");
        assert!(
            parse(&packing.pack(unpacked)),
            "{reader}: a seed that is packed again is refused"
        );
    }
    let (mut accepted, mut slowest) = (0u64, Duration::ZERO);
    for execution in 0..executions {
        let rng = &mut Rng::new(execution, 1);
        let which = rng.below(seeds.len() as u32) as usize;
        let bytes = match rng.below(3) {
            0 => {
                let mut bytes = seeds[which].clone();
                mutate(&mut bytes, rng);
                bytes
            }
            _ => {
                let mut parts = unpacked_seeds[which].clone();
                let part = rng.below(parts.len() as u32) as usize;
                mutate(&mut parts[part].1, rng);
                packing.pack(&parts)
            }
        };
        let started = Instant::now();
        let outcome = std::panic::catch_unwind(|| parse(&bytes));
        slowest = slowest.max(started.elapsed());
        assert!(outcome.is_ok(), "{reader}: execution {execution} panics");
        assert!(
            slowest < MAX_DURATION,
            "{reader}: execution {execution} takes {slowest:?}"
        );
        accepted += u64::from(outcome.unwrap_or(false));
    }
    println!("{reader}: {executions} executions, {accepted} accepted, the slowest {slowest:?}");
    // Mutations that are all refused at once would test nothing.
    assert!(
        accepted * 100 > executions,
        "{reader}: only {accepted} of {executions} accepted"
    );
}

const DEFAULT_OPTIONS: &[WriteOptions] = &[WriteOptions {
    quality: Quality::Normal,
    spz_version: SpzVersion::V3,
    sog: None,
}];

#[test]
fn ply() {
    let seeds = seeds(
        ".ply",
        DEFAULT_OPTIONS,
        &["fixtures_metalsplatter/test-splat.3-points-from-train.ply"],
    );
    fuzz("PLY", Packing::None, |b| parse::splat_ply(b).is_ok(), &seeds);
}

#[test]
fn compressed_ply() {
    let seeds = seeds(".compressed.ply", DEFAULT_OPTIONS, &[]);
    fuzz("compressed PLY", Packing::None, |b| parse::splat_ply(b).is_ok(), &seeds);
}

#[test]
fn spz_gzip() {
    let v2 = WriteOptions {
        spz_version: SpzVersion::V2,
        ..DEFAULT_OPTIONS[0]
    };
    let fixtures = [
        "fixtures_splat-transform/minimal-v2.spz",
        "fixtures_splat-transform/minimal-v3.spz",
    ];
    let seeds = seeds(".spz", &[DEFAULT_OPTIONS[0], v2], &fixtures);
    fuzz("SPZ 2 and 3", Packing::Gzip, |b| parse::spz(b).is_ok(), &seeds);
}

#[test]
fn spz_zstd_and_raw() {
    let v4 = WriteOptions {
        spz_version: SpzVersion::V4,
        ..DEFAULT_OPTIONS[0]
    };
    let fixtures = [
        "fixtures_splat-transform/minimal-v4.spz",
        "fixtures_splat-transform/minimal-raw.spz",
    ];
    let seeds = seeds(".spz", &[v4], &fixtures);
    fuzz("SPZ 4", Packing::None, |b| parse::spz(b).is_ok(), &seeds);
}

#[test]
fn splat() {
    let seeds = seeds(".splat", DEFAULT_OPTIONS, &["fixtures_splat-transform/minimal.splat"]);
    fuzz(".splat", Packing::None, |b| parse::splat(b).is_ok(), &seeds);
}

#[test]
fn ksplat() {
    let levels = [Quality::High, Quality::Normal, Quality::Low].map(|quality| WriteOptions {
        quality,
        ..DEFAULT_OPTIONS[0]
    });
    let seeds = seeds(".ksplat", &levels, &["fixtures_splat-transform/minimal.ksplat"]);
    fuzz(".ksplat", Packing::None, |b| parse::ksplat(b).is_ok(), &seeds);
}

#[test]
fn sog() {
    fuzz(
        "SOG",
        Packing::Sog,
        |b| parse::sog(b).is_ok(),
        &seeds(".sog", DEFAULT_OPTIONS, &[]),
    );
}

#[test]
fn glb() {
    let mut seeds = seeds(".glb", DEFAULT_OPTIONS, &["khr/khr_conformance_matrix.glb"]);
    seeds.extend(self::seeds(".spz.glb", DEFAULT_OPTIONS, &[]));
    fuzz("glb", Packing::Glb, |b| parse::glb(b).is_ok(), &seeds);
}

#[test]
fn gltf() {
    fuzz(
        "gltf",
        Packing::None,
        |b| parse::gltf(b).is_ok(),
        &seeds(".gltf", DEFAULT_OPTIONS, &[]),
    );
}
