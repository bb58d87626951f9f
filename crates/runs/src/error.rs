use irradia_formats::FormatError;
use irradia_measure::LpipsError;
use irradia_synth::SynthError;
use irradia_train::{RecipeError, TrainError};
use std::io;
use std::path::{Path, PathBuf};

/// Why something could not be done: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A setting of a request is out of range.
    #[error("{name} {value}: {message}")]
    Setting {
        /// The field of the request.
        name: &'static str,
        /// As given.
        value: String,
        /// What is allowed.
        message: String,
    },
    /// A recipe that does not exist or is not valid.
    #[error(transparent)]
    Recipe(#[from] RecipeError),
    /// The request does not suit what the folder holds.
    #[error("{0}")]
    Refused(String),
    /// A dataset or a scene could not be read or written.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Training could not begin or go on.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A checkpoint or a field is not valid.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: TrainError,
    },
    /// A residual field was named as if it were a scene.
    #[error("{} only adds to splats: name the scene.ply that it lies beside", _0.display())]
    Residual(PathBuf),
    /// The operating system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// `read`, `write`, `make`, ..
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The folder of a run could not be made.
    #[error("cannot make {}: {source}; give another --out", path.display())]
    NoFolder {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A folder holds no run.
    #[error("{0} holds no run to resume: cannot read {0}/run.json: {source}", path.display())]
    NoRun {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A file of a run that this program did not write so.
    #[error("{} is damaged: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The last state of an unfinished run could not be saved.
    #[error("{0}")]
    NotSaved(String),
    /// The weights of LPIPS could not be read.
    #[error("LPIPS weights: {0}")]
    Lpips(#[from] LpipsError),
    /// Another process, or another run of this one, is at work in the folder.
    #[error("{} is in use by process{holder}, which trains there: wait for it, stop it, or give another --out", folder.display())]
    InUse {
        /// The folder.
        folder: PathBuf,
        /// A blank and the number of the process, where it is known.
        holder: String,
    },
    /// A run's dataset is not what it was.
    #[error(
        "{} cannot go on: its dataset {} changed: {differences}; put it back, or begin anew with another --out",
        folder.display(), data.display()
    )]
    DataChanged {
        /// The run.
        folder: PathBuf,
        /// The dataset.
        data: PathBuf,
        /// What differs.
        differences: String,
    },
    /// The evaluation was stopped before its end.
    #[error("stopped before all held-out views were evaluated; the scene is saved")]
    EvaluationStopped,
    /// Options that make no ray-traced dataset.
    #[error(transparent)]
    Synth(#[from] SynthError),
}

impl RunError {
    /// Whether the request is what must be changed, not files or the machine.
    pub fn is_request(&self) -> bool {
        match self {
            Self::Setting { .. } | Self::Recipe(_) | Self::Refused(_) | Self::Synth(_) => true,
            Self::Format(error) => matches!(error, FormatError::Option(_) | FormatError::UnknownSplatFormat { .. }),
            _ => false,
        }
    }

    pub(crate) fn setting(name: &'static str, value: impl ToString, message: impl Into<String>) -> Self {
        Self::Setting {
            name,
            value: value.to_string(),
            message: message.into(),
        }
    }

    /// For `map_err` on what the operating system was asked for.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io {
            action,
            path: path.to_owned(),
            source,
        }
    }
}
