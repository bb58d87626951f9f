use irradia_runs::RunError;
use std::io;
use std::path::PathBuf;

/// Why a viewer could not start: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// A scene, a run or a dataset could not be read.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A run has not written a scene yet.
    #[error("{0} holds no scene yet: wait for its end, or resume it with irradia train --resume {0} --view", path.display())]
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
    /// The operating system refused a thread or random numbers.
    #[error("cannot start the viewer: {0}")]
    Start(String),
}
