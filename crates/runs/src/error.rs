use irradia_edit::EditError;
use irradia_formats::FormatError;
use irradia_measure::LpipsError;
use irradia_synth::SynthError;
use irradia_train::{RecipeError, TrainError};
use std::io;
use std::path::{Path, PathBuf};

/// Why an operation failed: one line that says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A setting of a request is out of range.
    #[error("{name} {value}: {message}")]
    Setting {
        /// The field of the request.
        name: &'static str,
        /// The given value.
        value: String,
        /// The allowed values.
        message: String,
    },
    /// A recipe that does not exist or is invalid.
    #[error(transparent)]
    Recipe(#[from] RecipeError),
    /// The request conflicts with the content of the folder.
    #[error("{0}")]
    Refused(String),
    /// An edit is invalid, or not possible on this scene.
    #[error(transparent)]
    Edit(#[from] EditError),
    /// A dataset or a scene could not be read or written.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Training could not begin or continue.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A checkpoint or a field is invalid.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: TrainError,
    },
    /// A residual field was given as a scene.
    #[error("{} is a residual field, which only adds to splats: name the scene.ply beside it", _0.display())]
    Residual(PathBuf),
    /// The operating system reported an error.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// `read`, `write`, `create`, ..
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The folder of a run could not be created.
    #[error("cannot create {}: {source}; choose another --out", path.display())]
    NoFolder {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A folder contains no run.
    #[error(
        "{0} holds no run: cannot read {0}/run.json: {source}; if the run was stopped before training began, repeat the \
         command that began it",
        path.display()
    )]
    NoRun {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A file of a run is damaged.
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
    /// Another process, or another run of this one, uses the folder.
    #[error("{} is in use by process{holder}, which trains there: wait for it, stop it, or choose another --out", folder.display())]
    InUse {
        /// The folder.
        folder: PathBuf,
        /// A space and the process id, if known.
        holder: String,
    },
    /// A run's dataset has changed.
    #[error(
        "{} cannot be resumed: its dataset {} has changed: {differences}; restore it, or start again with another --out",
        folder.display(), data.display()
    )]
    DataChanged {
        /// The run.
        folder: PathBuf,
        /// The dataset.
        data: PathBuf,
        /// The differences.
        differences: String,
    },
    /// The evaluation was stopped before it was complete.
    #[error("stopped before all held-out views were evaluated; the scene is saved")]
    EvaluationStopped,
    /// Invalid options of a ray-traced dataset.
    #[error(transparent)]
    Synth(#[from] SynthError),
}

impl RunError {
    /// Whether the request must be changed, rather than files or the machine.
    pub fn is_request(&self) -> bool {
        match self {
            Self::Setting { .. } | Self::Recipe(_) | Self::Refused(_) | Self::Synth(_) | Self::Edit(_) => true,
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

    /// For `map_err` on errors of the operating system.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io {
            action,
            path: path.to_owned(),
            source,
        }
    }
}
