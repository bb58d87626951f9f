//! Splat scenes. A new format is one file here and one arm in each `match` below.

pub(crate) mod ply;

use crate::FormatError;
use crate::error::read_and_parse;
use irradia_scene::GaussianCloud;
use std::fmt;
use std::path::Path;

/// The splat file formats, identified by extension.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SplatFormat {
    /// `.ply` in the layout of the Inria 3DGS code.
    Ply,
}

impl SplatFormat {
    /// All of them.
    pub const ALL: [Self; 1] = [Self::Ply];

    /// The extension, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
        }
    }

    /// The format for `path`'s extension, ignoring case.
    ///
    /// # Errors
    /// [`FormatError::UnknownSplatFormat`], which lists the known ones.
    pub fn of(path: &Path) -> Result<Self, FormatError> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        let found = Self::ALL
            .into_iter()
            .find(|format| extension.as_deref() == Some(format.extension()));
        found.ok_or_else(|| FormatError::UnknownSplatFormat {
            path: path.to_owned(),
            known: Self::ALL.map(|format| format!(".{}", format.extension())).join(", "),
        })
    }
}

impl fmt::Display for SplatFormat {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Ply => f.write_str("PLY"),
        }
    }
}

/// Reads a splat scene; the extension selects the format.
///
/// # Errors
/// When the extension is unknown, or the file cannot be read, lacks a property or is shorter than its header declares.
pub fn read_splats(path: &Path) -> Result<GaussianCloud, FormatError> {
    match SplatFormat::of(path)? {
        SplatFormat::Ply => read_and_parse(path, ply::parse_splat_ply),
    }
}

/// Writes a splat scene, atomically; the extension selects the format.
///
/// # Errors
/// When the extension is unknown or the file cannot be written.
///
/// # Panics
/// When the cloud's columns have unequal lengths: a bug in the caller.
pub fn write_splats(path: &Path, cloud: &GaussianCloud) -> Result<(), FormatError> {
    assert!(cloud.is_consistent(), "the columns of the cloud have unequal lengths");
    match SplatFormat::of(path)? {
        SplatFormat::Ply => crate::write_atomic(path, |out| ply::write_splat_ply(out, cloud)),
    }
}
