//! Splat scenes. A new format is one file here and one arm in each `match` below.
//!
//! Readers return the project's conventions and writers start from them; each format's own conventions are described at the top of its
//! module and, side by side, in `docs/formats.md`.

pub(crate) mod antimatter;
mod axes;
mod compressed_ply;
pub(crate) mod gltf;
pub(crate) mod ksplat;
mod npz;
pub(crate) mod ply;
mod quantize;
mod rows;
pub(crate) mod sog;
pub(crate) mod spz;

use crate::error::{read_and_parse, read_file};
use crate::points_ply::encode_points;
use crate::{FormatError, Malformed, write_atomic};
use irradia_scene::{GaussianCloud, PointCloud, Similarity, sh};
use std::borrow::Cow;
use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// The splat file formats, identified by the end of the file's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SplatFormat {
    /// `.ply` in the layout of the Inria 3DGS code; when reading, any PLY.
    Ply,
    /// `.compressed.ply`, PlayCanvas's compressed PLY.
    CompressedPly,
    /// `.points.ply`, a point cloud of the centres; written only.
    PointsPly,
    /// `.spz`, versions 1 to 4.
    Spz,
    /// `.splat`, of antimatter15's viewer.
    Splat,
    /// `.ksplat`, of mkkellogg's viewer.
    Ksplat,
    /// `.sog`, PlayCanvas's images in a zip archive.
    Sog,
    /// The same as a folder, given by its own path or that of its `meta.json`.
    SogFolder,
    /// `.glb`, binary glTF with `KHR_gaussian_splatting`.
    Glb,
    /// `.spz.glb`, binary glTF whose splats are packed as SPZ.
    GlbSpz,
    /// `.gltf`, glTF as text.
    Gltf,
    /// `.npz`, the columns as NumPy arrays; written only.
    Npz,
}

impl SplatFormat {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::Ply,
        Self::CompressedPly,
        Self::PointsPly,
        Self::Spz,
        Self::Splat,
        Self::Ksplat,
        Self::Sog,
        Self::SogFolder,
        Self::Glb,
        Self::GlbSpz,
        Self::Gltf,
        Self::Npz,
    ];

    /// The end of a file's name: its extension with the dot, or `meta.json`.
    pub fn suffix(self) -> &'static str {
        match self {
            Self::Ply => ".ply",
            Self::CompressedPly => ".compressed.ply",
            Self::PointsPly => ".points.ply",
            Self::Spz => ".spz",
            Self::Splat => ".splat",
            Self::Ksplat => ".ksplat",
            Self::Sog => ".sog",
            Self::SogFolder => sog::META_FILE,
            Self::Glb => ".glb",
            Self::GlbSpz => ".spz.glb",
            Self::Gltf => ".gltf",
            Self::Npz => ".npz",
        }
    }

    /// The format for the end of `path`'s name, ignoring case; a folder of SOG images is [`Self::SogFolder`].
    ///
    /// # Errors
    /// [`FormatError::UnknownSplatFormat`], which lists the known ones.
    pub fn of(path: &Path) -> Result<Self, FormatError> {
        if is_sog_folder(path) {
            return Ok(Self::SogFolder);
        }
        let name = path
            .file_name()
            .map(|name| name.to_string_lossy().to_lowercase())
            .unwrap_or_default();
        let is_named = |format: &Self| match format {
            Self::SogFolder => name == sog::META_FILE,
            _ => name.ends_with(format.suffix()),
        };
        let named = Self::ALL.into_iter().filter(is_named);
        let longest = named.max_by_key(|format| format.suffix().len());
        longest.ok_or_else(|| FormatError::UnknownSplatFormat {
            path: path.to_owned(),
            known: Self::ALL.map(Self::suffix).join(", "),
        })
    }

    /// Like [`SplatFormat::of`], for a file or folder that exists.
    ///
    /// # Errors
    /// In addition, when `path` does not exist, or is a folder without a scene.
    pub(crate) fn of_existing(path: &Path) -> Result<Self, FormatError> {
        Self::of(path).map_err(|unknown| match std::fs::metadata(path) {
            Err(source) => FormatError::Read {
                path: path.to_owned(),
                source,
            },
            Ok(metadata) if metadata.is_dir() => FormatError::NoScene(path.to_owned()),
            Ok(_) => unknown,
        })
    }

    /// Whether the format preserves every bit.
    pub fn is_lossless(self) -> bool {
        matches!(self, Self::Ply | Self::Npz)
    }

    /// Whether the format holds the coordinate system of the splats, and splats that cannot be drawn.
    fn holds_all(self) -> bool {
        self == Self::Ply
    }

    /// Whether the format can be read as splats.
    pub fn is_readable(self) -> bool {
        !matches!(self, Self::PointsPly | Self::Npz)
    }

    /// The highest degree of spherical harmonics that is written.
    pub fn max_degree(self) -> u32 {
        match self {
            Self::Ply | Self::Spz | Self::Npz => 4,
            Self::CompressedPly | Self::Sog | Self::SogFolder | Self::Glb | Self::Gltf | Self::GlbSpz => 3,
            Self::Ksplat => 2,
            Self::Splat | Self::PointsPly => 0,
        }
    }

    /// Whether the format records that a scene was trained with the Mip-Splatting filters.
    fn holds_antialiased(self) -> bool {
        matches!(self, Self::Ply | Self::Spz | Self::GlbSpz | Self::Sog | Self::SogFolder)
    }
}

impl fmt::Display for SplatFormat {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Ply => "PLY",
            Self::CompressedPly => "compressed PLY",
            Self::PointsPly => "point cloud PLY",
            Self::Spz => "SPZ",
            Self::Splat => ".splat",
            Self::Ksplat => ".ksplat",
            Self::Sog | Self::SogFolder => "SOG",
            Self::Glb | Self::GlbSpz | Self::Gltf => "glTF",
            Self::Npz => "NumPy archive",
        })
    }
}

/// How much a lossy format may lose, if it leaves a choice.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// Smaller: fewer bits or palette entries for the harmonics, `.ksplat` of level 2.
    Low,
    /// The format's own default; `.ksplat` of level 1.
    #[default]
    Normal,
    /// The most that the format allows; `.ksplat` of level 0.
    High,
}

/// The version of an SPZ file to write.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SpzVersion {
    /// The version within glTF.
    V2,
    /// gzip; what most programs read.
    #[default]
    V3,
    /// zstd.
    V4,
}

/// Options of [`write_splats_with`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WriteOptions {
    /// How much a lossy format may lose.
    pub quality: Quality,
    /// The version of SPZ files.
    pub spz_version: SpzVersion,
    /// Precision of SOG's numbers; chosen by the quality if `None`.
    pub sog: Option<SogDetail>,
}

/// Precision of SOG's numbers, which may be coarser than the format allows: coarser numbers take fewer bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SogDetail {
    /// Entries of the palette of harmonics, 2 to 65,536.
    pub palette: usize,
    /// Bits of each coordinate of a position, 1 to 16.
    pub position_bits: u32,
    /// Bits of each component of a rotation, 1 to 8.
    pub rotation_bits: u32,
    /// Entries of the codebooks of scales and colours, 2 to 256.
    pub codebook: usize,
}

impl SogDetail {
    /// For `count` splats: the finest, except for the palette, whose size is a power of two below `count` (or `count` if that is small).
    pub fn of(quality: Quality, count: usize) -> Self {
        let max_palette = match quality {
            Quality::Low => 4096,
            Quality::Normal => 16_384,
            Quality::High => 65_536,
        };
        Self {
            palette: match count {
                ..=1024 => count,
                _ => (count.next_power_of_two() / 2).min(max_palette),
            },
            position_bits: 16,
            rotation_bits: 8,
            codebook: 256,
        }
    }
}

/// A splat scene as read from a file, and what was left out.
#[derive(Clone, Debug)]
pub struct SplatFile {
    /// The file's format; for PLY, as its header shows.
    pub format: SplatFormat,
    /// The splats.
    pub cloud: GaussianCloud,
    /// Splats that were left out because a position, rotation, size, opacity or colour is not a number.
    pub left_out: usize,
    /// Properties of the splats that were neither read nor kept.
    pub unread: Vec<String>,
}

impl SplatFile {
    /// The splats in the bytes of a single file; a `.ply` may be compressed. Splats that cannot be drawn are left out.
    ///
    /// # Errors
    /// When the format cannot be read, or the bytes are damaged or refer to another file.
    pub fn parse(format: SplatFormat, bytes: &[u8]) -> Result<Self, Malformed> {
        let cloud = parse(format, bytes)?;
        Ok(match format {
            SplatFormat::Ply | SplatFormat::CompressedPly | SplatFormat::PointsPly => {
                let format = if ply::is_compressed(bytes) {
                    SplatFormat::CompressedPly
                } else {
                    SplatFormat::Ply
                };
                Self {
                    unread: ply::unread_properties(bytes),
                    ..Self::of(format, cloud)
                }
            }
            _ => Self::of(format, cloud),
        })
    }

    /// Leaves out the splats of `cloud` that cannot be drawn.
    fn of(format: SplatFormat, mut cloud: GaussianCloud) -> Self {
        let left_out = rows::remove_invalid(&mut cloud);
        rows::define_rotations(&mut cloud);
        Self {
            format,
            cloud,
            left_out,
            unread: Vec::new(),
        }
    }

    /// What the user should know about the file, one line each.
    pub fn warnings(&self) -> Vec<String> {
        let left_out = (self.left_out > 0).then(|| left_out_message(self.left_out));
        let unread = (!self.unread.is_empty()).then(|| format!("properties not read: {}", self.unread.join(", ")));
        left_out.into_iter().chain(unread).collect()
    }
}

fn left_out_message(count: usize) -> String {
    format!("{count} splats left out: a position, rotation, size, opacity or colour is not a number")
}

/// Reads a splat scene; the end of the name selects the format. Splats that cannot be drawn are left out.
///
/// # Errors
/// When the format is unknown, or the file cannot be read, is damaged or is shorter than its header declares.
pub fn read_splats(path: &Path) -> Result<GaussianCloud, FormatError> {
    Ok(read_splat_file(path)?.cloud)
}

/// Like [`read_splats`], and reports what was left out.
///
/// # Errors
/// The same.
pub fn read_splat_file(path: &Path) -> Result<SplatFile, FormatError> {
    let format = SplatFormat::of_existing(path)?;
    match format {
        SplatFormat::SogFolder => Ok(SplatFile::of(format, sog::read_folder(&sog_meta(path))?)),
        SplatFormat::Gltf => {
            let cloud = read_and_parse(path, |text| {
                gltf::parse_gltf(text, &|name| read_sibling_file(path, name))
            })?;
            Ok(SplatFile::of(format, cloud))
        }
        // Refused before the file is read.
        SplatFormat::Npz => Err(FormatError::malformed(path, "NumPy archives are written, not read")),
        _ => read_and_parse(path, |bytes| SplatFile::parse(format, bytes)),
    }
}

/// The splats in the bytes of a single file.
fn parse(format: SplatFormat, bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    match format {
        SplatFormat::Ply | SplatFormat::CompressedPly | SplatFormat::PointsPly => ply::parse_splat_ply(bytes),
        SplatFormat::Spz => spz::parse(bytes),
        SplatFormat::Splat => antimatter::parse(bytes),
        SplatFormat::Ksplat => ksplat::parse(bytes),
        SplatFormat::Sog | SplatFormat::SogFolder => sog::parse(bytes),
        SplatFormat::Glb | SplatFormat::GlbSpz => gltf::parse_glb(bytes),
        SplatFormat::Gltf => gltf::parse_gltf(bytes, &|name| {
            Err(Malformed(format!("needs the file {}", crate::zip::printable(name))))
        }),
        SplatFormat::Npz => Err(Malformed("NumPy archives are written, not read".into())),
    }
}

/// The bytes of a splat file. A folder of SOG images becomes one archive.
///
/// # Errors
/// When the format cannot hold the cloud.
///
/// # Panics
/// When the cloud's columns have unequal lengths: a bug in the caller.
pub fn encode_splats(format: SplatFormat, cloud: &GaussianCloud, options: &WriteOptions) -> io::Result<Vec<u8>> {
    assert!(cloud.is_consistent(), "the columns of the cloud have unequal lengths");
    let prepared = if format.holds_all() {
        Cow::Borrowed(cloud)
    } else {
        prepare_export(cloud, &mut Vec::new())
    };
    let mut bytes = Vec::new();
    encode(format, &mut bytes, &prepared, options)?;
    Ok(bytes)
}

/// `cloud` after it was written and read again, and the number of bytes written. A folder of SOG images becomes one archive.
///
/// # Errors
/// When the format cannot hold the cloud, or cannot be read.
///
/// # Panics
/// When the cloud's columns have unequal lengths: a bug in the caller.
pub fn round_trip(
    format: SplatFormat,
    cloud: &GaussianCloud,
    options: &WriteOptions,
) -> Result<(GaussianCloud, usize), FormatError> {
    let name = Path::new(format.suffix());
    let bytes = encode_splats(format, cloud, options).map_err(|source| FormatError::Write {
        path: name.to_owned(),
        source,
    })?;
    let read = SplatFile::parse(format, &bytes).map_err(|source| FormatError::Malformed {
        path: name.to_owned(),
        source,
    })?;
    Ok((read.cloud, bytes.len()))
}

/// Whether the folder `path` is a scene of SOG images; other programs have files named `meta.json`, too.
pub fn is_sog_folder(path: &Path) -> bool {
    let meta = path.join(sog::META_FILE);
    let is_short = fs::metadata(&meta).is_ok_and(|file| file.is_file() && file.len() <= sog::MAX_META_BYTES as u64);
    is_short && fs::read(&meta).is_ok_and(|text| sog::is_meta(&text))
}

/// The `meta.json` that `path` is or contains.
fn sog_meta(path: &Path) -> PathBuf {
    if path.is_dir() {
        path.join(sog::META_FILE)
    } else {
        path.to_owned()
    }
}

/// The content of the file to which the file `path` refers by the URI `uri`; it must be in the folder of `path` or below. A file of the
/// very name of the URI takes precedence, since not all programs escape names.
fn read_sibling_file(path: &Path, uri: &str) -> Result<Vec<u8>, Malformed> {
    let is_below = |name: &str| {
        let mut parts = Path::new(name).components();
        parts.all(|part| matches!(part, std::path::Component::Normal(_))) && !name.contains([':', '\\'])
    };
    let names = [uri.to_owned(), unescaped(uri)];
    if !names.iter().all(|name| is_below(name)) {
        return Err(Malformed(format!(
            "refers to the file {}, which is not in its folder",
            crate::zip::printable(uri)
        )));
    }
    let [literal, unescaped] = names.map(|name| path.with_file_name("").join(name));
    let file = if literal.is_file() { literal } else { unescaped };
    read_file(&file).map_err(|error| Malformed(error.to_string()))
}

/// A URI without escapes: `%20` stands for a space (RFC 3986, section 2.1). What is no escape stays.
fn unescaped(uri: &str) -> String {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let [first, after @ ..] = rest {
        let digit = |at: usize| char::from(*after.get(at)?).to_digit(16);
        match digit(0).zip(digit(1)).filter(|_| *first == b'%') {
            Some((high, low)) => {
                bytes.push((16 * high + low) as u8);
                rest = &after[2..];
            }
            None => {
                bytes.push(*first);
                rest = after;
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Size on disk of the scene `path`, bytes; a file or a folder of SOG images.
///
/// # Errors
/// When it cannot be read.
pub fn splat_file_size(path: &Path) -> Result<u64, FormatError> {
    let read_error = |source| FormatError::Read {
        path: path.to_owned(),
        source,
    };
    if SplatFormat::of(path)? != SplatFormat::SogFolder {
        return Ok(fs::metadata(path).map_err(read_error)?.len());
    }
    // Other images in the folder, such as those of a scene that this one has replaced, are no part of it.
    let meta = sog_meta(path);
    let mut total = fs::metadata(&meta).map_err(read_error)?.len();
    for name in read_and_parse(&meta, sog::image_names)? {
        total += fs::metadata(meta.with_file_name(name)).map_err(read_error)?.len();
    }
    Ok(total)
}

/// Writes a splat scene, atomically, with the format's default quality; the end of the name selects the format.
///
/// # Errors
/// When the format is unknown or the file cannot be written.
///
/// # Panics
/// When the cloud's columns have unequal lengths: a bug in the caller.
pub fn write_splats(path: &Path, cloud: &GaussianCloud) -> Result<(), FormatError> {
    write_splats_with(path, cloud, &WriteOptions::default()).map(drop)
}

/// [`write_splats`] with options; returns what the format could not hold, one line each.
///
/// # Errors
/// The same.
///
/// # Panics
/// The same.
pub fn write_splats_with(
    path: &Path,
    cloud: &GaussianCloud,
    options: &WriteOptions,
) -> Result<Vec<String>, FormatError> {
    assert!(cloud.is_consistent(), "the columns of the cloud have unequal lengths");
    let format = SplatFormat::of(path)?;
    let mut notes = Vec::new();
    let cloud = if format.holds_all() {
        Cow::Borrowed(cloud)
    } else {
        prepare_export(cloud, &mut notes)
    };
    if cloud.sh_degree > format.max_degree() {
        notes.push(format!(
            "spherical harmonics of degree {} become degree {}, the highest that {format} holds",
            cloud.sh_degree,
            format.max_degree()
        ));
    }
    if !cloud.extra.is_empty() && format != SplatFormat::Ply {
        let names: Vec<&str> = cloud.extra.iter().map(|column| column.name.as_str()).collect();
        notes.push(format!("properties that only PLY keeps: {}", names.join(", ")));
    }
    if matches!(format, SplatFormat::Spz | SplatFormat::GlbSpz) {
        let limit = spz::max_coordinate(&cloud.means, options.quality);
        let is_beyond = |mean: &&[f32; 3]| mean.iter().any(|value| value.abs() > limit);
        let beyond = cloud.means.iter().filter(is_beyond).count();
        if beyond > 0 {
            notes.push(format!(
                "{beyond} of {} splats are farther from the origin than the {limit:.0} units that SPZ holds without coarser \
                 positions, and are moved to that distance",
                cloud.len()
            ));
        }
    }
    if cloud.antialiased && !format.holds_antialiased() {
        notes.push(format!(
            "{format} cannot record that the scene was trained with antialiasing"
        ));
    }
    match format {
        SplatFormat::SogFolder => write_folder(&sog_meta(path), &cloud, options)?,
        _ => write_atomic(path, |out| encode(format, out, &cloud, options))?,
    }
    Ok(notes)
}

/// Writes a single file; a folder of SOG images becomes one archive.
fn encode(
    format: SplatFormat,
    out: &mut dyn io::Write,
    cloud: &GaussianCloud,
    options: &WriteOptions,
) -> io::Result<()> {
    let quality = options.quality;
    match format {
        SplatFormat::Ply => ply::write_splat_ply(out, cloud),
        SplatFormat::CompressedPly => compressed_ply::write(out, cloud),
        SplatFormat::PointsPly => out.write_all(&encode_points(&points(cloud))),
        SplatFormat::Spz => spz::write(out, cloud, quality, options.spz_version),
        SplatFormat::Splat => antimatter::write(out, cloud),
        SplatFormat::Ksplat => ksplat::write(out, cloud, quality),
        SplatFormat::Sog | SplatFormat::SogFolder => sog::write(out, cloud, options),
        SplatFormat::Glb => gltf::write_glb(out, cloud),
        SplatFormat::GlbSpz => gltf::write_glb_spz(out, cloud, quality),
        SplatFormat::Gltf => gltf::write_gltf(out, cloud),
        SplatFormat::Npz => npz::write(out, cloud),
    }
}

/// Whether the origin of the cloud's world is too far from that of the dataset for positions in `f32`: more than 200 times the median
/// distance of the splats from it, at which the precision is a hundred-thousandth of that distance.
fn exceeds_f32_precision(cloud: &GaussianCloud) -> bool {
    let world = cloud.world_from_dataset;
    if world.center == glam::DVec3::ZERO {
        return false;
    }
    let mut distances: Vec<f32> = cloud
        .means
        .iter()
        .map(|mean| glam::Vec3::from(*mean).length())
        .filter(|distance| distance.is_finite())
        .collect();
    let middle = distances.len() / 2;
    let median = if distances.is_empty() {
        0.0
    } else {
        *distances.select_nth_unstable_by(middle, f32::total_cmp).1
    };
    world.center.length() > 200.0 * f64::from(median) / world.scale
}

/// The splats that can be drawn, in the dataset's coordinates, relative to the origin of its world if that is far away: formats other
/// than PLY hold neither doubles nor a second coordinate system.
fn prepare_export<'a>(cloud: &'a GaussianCloud, notes: &mut Vec<String>) -> Cow<'a, GaussianCloud> {
    let mut cloud = Cow::Borrowed(cloud);
    let world = cloud.world_from_dataset;
    if !world.is_identity() {
        let is_far = exceeds_f32_precision(&cloud);
        let origin = if is_far { glam::DVec3::ZERO } else { world.center };
        let owned = cloud.to_mut();
        let (unit, log_unit) = (1.0 / world.scale, world.scale.ln());
        for mean in &mut owned.means {
            let position = glam::DVec3::from(mean.map(f64::from)) * unit + origin;
            *mean = position.as_vec3().to_array();
        }
        owned
            .log_scales
            .as_flattened_mut()
            .iter_mut()
            .for_each(|v| *v = (f64::from(*v) - log_unit) as f32);
        owned.world_from_dataset = Similarity::IDENTITY;
        if is_far {
            let glam::DVec3 { x, y, z } = world.center;
            notes.push(format!(
                "positions are relative to ({x}, {y}, {z}), which is too far from the origin for floats"
            ));
        }
    }
    if rows::has_invalid(&cloud) {
        notes.push(left_out_message(rows::remove_invalid(cloud.to_mut())));
    }
    cloud
}

/// Writes a folder of SOG images, `meta.json` last.
fn write_folder(meta: &Path, cloud: &GaussianCloud, options: &WriteOptions) -> Result<(), FormatError> {
    let write_error = |source| FormatError::Write {
        path: meta.to_owned(),
        source,
    };
    let files = sog::encode(cloud, options).map_err(write_error)?;
    // Without it, an interrupted write leaves a folder that is no scene, rather than a mixture of two.
    if meta.exists() {
        fs::remove_file(meta).map_err(write_error)?;
    }
    for (name, content) in files {
        write_atomic(&meta.with_file_name(name), |out| out.write_all(&content))?;
    }
    Ok(())
}

/// The centres and the colours of degree 0.
fn points(cloud: &GaussianCloud) -> PointCloud {
    let colors = cloud.sh.chunks_exact(3 * sh::coefficients(cloud.sh_degree));
    PointCloud {
        positions: cloud.means.iter().map(|mean| (*mean).into()).collect(),
        colors: colors
            .map(|sh| [0, 1, 2].map(|c| quantize::color_byte(sh[c])))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_beside_a_document_are_found_by_escaped_and_plain_names() {
        let folder = tempfile::tempdir().unwrap();
        let document = folder.path().join("a.gltf");
        for name in ["my scene é.bin", "100%25.bin"] {
            fs::write(folder.path().join(name), name).unwrap();
        }
        let read = |uri: &str| read_sibling_file(&document, uri).map(|bytes| String::from_utf8(bytes).unwrap());
        assert_eq!(read("my%20scene%20%C3%A9.bin").unwrap(), "my scene é.bin");
        assert_eq!(read("my scene é.bin").unwrap(), "my scene é.bin");
        assert_eq!(read("100%25.bin").unwrap(), "100%25.bin");
        assert_eq!(unescaped("%zz%2"), "%zz%2");
        for uri in ["%2e%2e/a.bin", "%2Fetc%2Fpasswd", "..%2fa.bin", "C%3A/a.bin", "a%5Cb"] {
            let error = read(uri).unwrap_err().to_string();
            assert!(error.contains("not in its folder"), "{uri}: {error}");
        }
    }

    #[test]
    fn the_size_of_a_folder_of_images_is_that_of_its_scene() {
        let folder = tempfile::tempdir().unwrap();
        let splats = |degree: u32| {
            rows::decode_splats(9, degree, |i, splat| {
                splat.mean[0] = i as f32;
                splat.quat[0] = 1.0;
                splat.sh.fill(0.01 * i as f32);
            })
        };
        let size = |path: &Path| splat_file_size(path).unwrap();
        let [used, new] = ["used", "new"].map(|name| folder.path().join(name).join(sog::META_FILE));
        write_splats(&used, &splats(2)).unwrap();
        let before = size(&used);
        write_splats(&used, &splats(0)).unwrap();
        write_splats(&new, &splats(0)).unwrap();
        fs::write(used.with_file_name("preview.webp"), vec![0; 1000]).unwrap();
        assert!(size(&used) == size(&new) && size(&new) < before);
        assert_eq!(size(used.parent().unwrap()), size(&new));
    }

    #[test]
    fn positions_beyond_the_range_of_a_format_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let notes = |suffix: &str, x: f32| {
            let cloud = rows::decode_splats(3, 0, |i, splat| {
                splat.mean[0] = if i == 1 { x } else { 1.0 };
                splat.quat[0] = 1.0;
            });
            write_splats_with(
                &folder.path().join(format!("a{suffix}")),
                &cloud,
                &WriteOptions::default(),
            )
            .unwrap()
        };
        for suffix in [".spz", ".spz.glb"] {
            assert_eq!(notes(suffix, 4e3), Vec::<String>::new());
            assert!(
                notes(suffix, -1e7)[0].starts_with("1 of 3 splats are farther from the origin than the 4096 units"),
                "{suffix}"
            );
        }
        assert_eq!(notes(".ply", 1e7), Vec::<String>::new());
    }
}
