use std::io;
use std::path::{Path, PathBuf};

/// Why bytes could not be parsed: one line without the file's name, which the caller adds.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Malformed(pub String);

/// Why a file or a folder could not be read or written: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// A read error of the operating system.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A write error of the operating system; the target is unchanged.
    #[error("cannot write {}: {source}; nothing was changed there", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file was read, but its content is invalid or not supported.
    #[error("{}: {source}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Malformed,
    },
    /// The extension is not one of a splat format.
    #[error("{}: not a splat file by its extension; known extensions: {known}", path.display())]
    UnknownSplatFormat {
        /// The file.
        path: PathBuf,
        /// The known extensions.
        known: String,
    },
    /// A folder without a scene.
    #[error(
        "{} contains no scene (scene.ply, or meta.json of SOG); a run writes its scene at its end: continue it with irradia train --resume",
        .0.display()
    )]
    NoScene(PathBuf),
    /// A file where a folder is needed.
    #[error(
        "{} is a file: name the folder of a dataset or of photographs; an archive must be unpacked first",
        .0.display()
    )]
    NotAFolder(PathBuf),
    /// The folder is not a dataset, or not of the requested kind.
    #[error("{}: no dataset found there; expected {expected}", path.display())]
    NotADataset {
        /// The folder.
        path: PathBuf,
        /// The files that a dataset would contain.
        expected: String,
    },
    /// Fewer usable views than a scene requires.
    #[error("{}: {usable} usable views of {declared}, at least 3 are needed{reasons}", path.display())]
    TooFewViews {
        /// The dataset.
        path: PathBuf,
        /// Usable views.
        usable: usize,
        /// Declared views.
        declared: usize,
        /// `; ` and the reasons, or empty.
        reasons: String,
    },
    /// All usable views are held out.
    #[error(
        "{}: no view is left to train on: all {held_out} usable views are held out{reasons}; put the training images back, or \
         choose another holdout",
        path.display()
    )]
    NothingToTrainOn {
        /// The dataset.
        path: PathBuf,
        /// Views held out.
        held_out: usize,
        /// `; ` and the reasons, or empty.
        reasons: String,
    },
    /// An invalid option.
    #[error("{0}")]
    Option(String),
}

impl FormatError {
    pub(crate) fn malformed(path: &Path, message: impl Into<String>) -> Self {
        Self::Malformed {
            path: path.to_owned(),
            source: Malformed(message.into()),
        }
    }
}

/// Reads a whole file.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>, FormatError> {
    std::fs::read(path).map_err(|source| FormatError::Read {
        path: path.to_owned(),
        source,
    })
}

/// Reads a whole file and parses it, adding the file's name to the parser's error.
pub(crate) fn read_and_parse<T>(
    path: &Path,
    parse: impl FnOnce(&[u8]) -> Result<T, Malformed>,
) -> Result<T, FormatError> {
    parse(&read_file(path)?).map_err(|source| FormatError::Malformed {
        path: path.to_owned(),
        source,
    })
}
