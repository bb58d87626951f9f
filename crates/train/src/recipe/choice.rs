//! What a recipe may leave to the data.

use serde::{Deserialize, Serialize};

/// Whether to do something, or let the data decide: `true`, `false` or `"auto"` in a recipe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "BoolOrAuto", into = "BoolOrAuto")]
pub enum Choice {
    /// No.
    #[default]
    No,
    /// Yes.
    Yes,
    /// The data decide.
    Auto,
}

impl Choice {
    pub(super) fn is_disabled(&self) -> bool {
        *self == Self::No
    }
}

/// How a [`Choice`] is written.
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "expected true, false or \"auto\"")]
enum BoolOrAuto {
    Bool(bool),
    Word(Auto),
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Auto {
    Auto,
}

impl From<BoolOrAuto> for Choice {
    fn from(written: BoolOrAuto) -> Self {
        match written {
            BoolOrAuto::Bool(false) => Self::No,
            BoolOrAuto::Bool(true) => Self::Yes,
            BoolOrAuto::Word(Auto::Auto) => Self::Auto,
        }
    }
}

impl From<Choice> for BoolOrAuto {
    fn from(choice: Choice) -> Self {
        match choice {
            Choice::No => Self::Bool(false),
            Choice::Yes => Self::Bool(true),
            Choice::Auto => Self::Word(Auto::Auto),
        }
    }
}
