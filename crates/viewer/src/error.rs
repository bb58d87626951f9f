use irradia_runs::RunError;
use std::io;
use std::path::PathBuf;

/// Why a viewer could not start: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// A scene, a run or a dataset could not be read.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A file could not be written.
    #[error(transparent)]
    Format(#[from] irradia_runs::formats::FormatError),
    /// A run has not written a scene yet.
    #[error("{0} has no scene yet: wait until the run ends, or resume it with irradia train --resume {0} --view", path.display())]
    Unfinished {
        /// The folder.
        path: PathBuf,
    },
    /// No address could be listened on.
    #[error("cannot listen on {address}: {source}; choose another --host or --port")]
    Listen {
        /// Host and port.
        address: String,
        /// The system's reason.
        source: io::Error,
    },
    /// The scene to share is a radiance field, without splats.
    #[error("a shared page draws splats, and a radiance field has none; train splats, or share a film of it")]
    NoSplats,
    /// The scene to share is empty.
    #[error("the scene has no splats: there is nothing to show")]
    Empty,
    /// No scene fits into a limit of bytes.
    #[error("no scene fits into {bytes} bytes: the page around it takes {around}; choose a larger --max")]
    TooSmall {
        /// The limit.
        bytes: u64,
        /// Bytes of the page without a scene.
        around: u64,
    },
    /// A folder could not be created.
    #[error("cannot create {}: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The operating system refused a thread or random numbers.
    #[error("cannot start the viewer: {0}")]
    Start(String),
}
