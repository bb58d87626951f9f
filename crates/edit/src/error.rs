/// Why an edit cannot be read or applied: one line that says what, where and what to do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EditError {
    /// A list of edits is not TOML, or not of this layout.
    #[error("the list of edits cannot be read: {0}")]
    List(String),
    /// One edit of a list is wrong.
    #[error("edit {number}: {reason}")]
    InList {
        /// Its place in the list, from 1.
        number: usize,
        /// What is wrong with it.
        reason: Box<EditError>,
    },
    /// The words of an edit are not understood.
    #[error("{0}")]
    Syntax(String),
    /// A number is out of range.
    #[error("{name}: {message}")]
    Value {
        /// The operation or shape and its key.
        name: String,
        /// What is allowed.
        message: String,
    },
    /// An operation and its selection do not fit together.
    #[error("{0}")]
    Selection(String),
    /// The cameras are not known.
    #[error("{0} needs the training cameras, which are not known: edit a run, or a scene with cameras.json beside it")]
    NoCameras(&'static str),
    /// Another scene cannot be read.
    #[error("merge: {0}")]
    Source(String),
    /// The scene itself does not allow the edit.
    #[error("{0}")]
    Scene(String),
}

impl EditError {
    pub(crate) fn value(name: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Value {
            name: name.into(),
            message: message.into(),
        }
    }
}
