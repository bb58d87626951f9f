use std::io;
use std::path::{Path, PathBuf};

/// Why bytes could not be understood: one line without the file's name, which the caller adds.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Malformed(pub String);

/// Why a file or a folder could not be read or written: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The operating system refused to read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The operating system refused to write; the target is as it was before.
    #[error("cannot write {}: {source}; nothing was changed there", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file was read, but its contents make no sense or are not supported.
    #[error("{}: {source}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Malformed,
    },
    /// The extension names no splat format.
    #[error("{}: not a splat file by its extension; known are {known}", path.display())]
    UnknownSplatFormat {
        /// The file.
        path: PathBuf,
        /// The extensions that would do.
        known: String,
    },
    /// The folder is no dataset, or not of the kind that was asked for.
    #[error("{}: no dataset found there; looked for {looked_for}", path.display())]
    NotADataset {
        /// The folder.
        path: PathBuf,
        /// The files that would have made it one.
        looked_for: String,
    },
    /// Fewer views are left than a scene can be made from.
    #[error("{}: {usable} usable views of {declared}, at least 3 are needed{reasons}", path.display())]
    TooFewViews {
        /// The dataset.
        path: PathBuf,
        /// Views left.
        usable: usize,
        /// Views the dataset names.
        declared: usize,
        /// `; ` and what was left out, or nothing.
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
        /// `; ` and what was left out, or nothing.
        reasons: String,
    },
    /// An option cannot be meant.
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

/// Reads a whole file and parses it, adding the file's name to what the parser says.
pub(crate) fn read_and_parse<T>(
    path: &Path,
    parse: impl FnOnce(&[u8]) -> Result<T, Malformed>,
) -> Result<T, FormatError> {
    parse(&read_file(path)?).map_err(|source| FormatError::Malformed {
        path: path.to_owned(),
        source,
    })
}
