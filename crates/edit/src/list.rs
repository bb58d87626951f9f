//! Edits as data: a list that can be written, read, replayed and shortened.

use crate::EditError;
use crate::shape::{SelectStep, check_direction, check_finite, check_positive};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The version of the layout that is written and read.
const VERSION: u32 = 1;

/// Edits in the order of application. Each is in the coordinates of the scene after the edits before it.
///
/// ```
/// use irradia_edit::EditList;
///
/// let list = EditList::parse(r#"
///     version = 1
///
///     [[edits]]
///     op = "delete"
///     select = [
///         { shape = "sphere", center = [0, 0, 0], radius = 2 },
///         { mode = "subtract", shape = "box", center = [0, 0, 0], size = [1, 1, 1] },
///     ]
///
///     [[edits]]
///     op = "rotate"
///     axis = [0, 0, 1]
///     degrees = 90
/// "#)?;
/// assert_eq!(list.edits[1].to_string(), "rotate axis=0,0,1 degrees=90");
/// assert_eq!(EditList::parse(&list.to_toml())?, list);
/// # Ok::<(), irradia_edit::EditError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditList {
    /// Version of the layout: 1.
    pub version: u32,
    /// The edits.
    #[serde(default)]
    pub edits: Vec<Edit>,
}

/// An operation on what is selected.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Edit {
    /// The operation.
    #[serde(flatten)]
    pub op: Operation,
    /// Steps that select the splats; the whole scene if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub select: Option<Vec<SelectStep>>,
}

/// An operation on splats. Hidden and locked splats are not selected, but move with the whole scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "op", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Operation {
    /// Removes the selection.
    Delete {},
    /// Removes everything but the selection.
    Keep {},
    /// Moves by a vector.
    Move {
        /// The vector.
        by: [f64; 3],
    },
    /// Rotates about an axis, counter-clockwise if the axis points at the viewer.
    Rotate {
        /// The axis.
        axis: [f64; 3],
        /// The angle.
        degrees: f64,
        /// A point on the axis; if absent, the origin for the whole scene, otherwise the selection's centre.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        about: Option<[f64; 3]>,
    },
    /// Scales about a point.
    Scale {
        /// The factor.
        factor: f64,
        /// The point; if absent, the origin for the whole scene, otherwise the selection's centre.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        about: Option<[f64; 3]>,
    },
    /// Adds a copy.
    Duplicate {
        /// The vector by which the copy is moved.
        #[serde(default)]
        by: [f64; 3],
    },
    /// Adds the splats of another scene.
    Merge {
        /// Its name: for files, a path.
        file: String,
    },
    /// Turns the scene so that a direction points up, and moves it so that the ground is at height 0.
    Upright {
        /// The direction that points up; if absent, found from the cameras and the densest plane.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        up: Option<[f64; 3]>,
        /// A point on the ground. If absent, a point of the densest plane; if only `up` is given, the scene turns but does not move.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        ground: Option<[f64; 3]>,
        /// The axis that points up afterwards.
        #[serde(default)]
        axis: UpAxis,
    },
    /// Scales the scene about the origin such that a distance becomes known.
    SetLength {
        /// One end of the distance.
        from: [f64; 3],
        /// The other end.
        to: [f64; 3],
        /// The distance after scaling.
        length: f64,
    },
    /// Changes colours, in this order: exposure, temperature and tint as gains of the encoded colour, saturation, contrast.
    Recolor {
        /// Stops; 1 doubles the light.
        #[serde(default, skip_serializing_if = "is_zero")]
        exposure: f64,
        /// -1 (blue) to 1 (yellow).
        #[serde(default, skip_serializing_if = "is_zero")]
        temperature: f64,
        /// -1 (green) to 1 (magenta).
        #[serde(default, skip_serializing_if = "is_zero")]
        tint: f64,
        /// Factor on the distance to grey; 0 is grey, 1 changes nothing.
        #[serde(default = "one", skip_serializing_if = "is_one")]
        saturation: f64,
        /// Factor on the distance to middle grey; 1 changes nothing.
        #[serde(default = "one", skip_serializing_if = "is_one")]
        contrast: f64,
    },
    /// Multiplies opacities, which stay below 1.
    Opacity {
        /// The factor.
        factor: f64,
    },
    /// Keeps only the most important splats.
    Reduce {
        /// Number of splats to keep.
        count: usize,
    },
    /// Hides the selection: it is neither drawn nor written until it is shown again.
    Hide {},
    /// Shows hidden splats.
    Show {},
    /// Locks the selection: it cannot be selected until it is unlocked.
    Lock {},
    /// Unlocks locked splats.
    Unlock {},
    /// Moves the selection into a new scene.
    Split {
        /// Its name, without a folder.
        name: String,
    },
}

/// The axis that points up in an upright scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum UpAxis {
    /// +Y
    #[serde(rename = "y")]
    PlusY,
    /// -Y, as in most splat files.
    #[default]
    #[serde(rename = "-y")]
    MinusY,
    /// +Z
    #[serde(rename = "z")]
    PlusZ,
}

fn one() -> f64 {
    1.0
}

fn is_one(value: &f64) -> bool {
    *value == 1.0
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl Default for EditList {
    fn default() -> Self {
        Self {
            version: VERSION,
            edits: Vec::new(),
        }
    }
}

/// The list before its edits are read; they are read one by one, so that an error names the edit.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawList {
    version: u32,
    #[serde(default)]
    edits: Vec<toml::Table>,
}

impl EditList {
    /// Maximum number of edits in a list, and of steps in a selection.
    pub const MAX_ITEMS: usize = 10_000;
    /// Maximum size of a list in bytes.
    pub const MAX_BYTES: usize = 64 << 20;

    /// Reads and checks the content of an `edits.toml`.
    ///
    /// # Errors
    /// One line that names the edit, when it is not TOML of this layout or a number is out of range.
    pub fn parse(text: &str) -> Result<Self, EditError> {
        if text.len() > Self::MAX_BYTES {
            return Err(EditError::List(format!(
                "it has {} bytes, at most {} are read",
                text.len(),
                Self::MAX_BYTES
            )));
        }
        let raw: RawList = toml::from_str(text).map_err(|error| {
            let line = error
                .span()
                .map_or(1, |span| 1 + text[..span.start].matches('\n').count());
            EditError::List(format!("line {line}: {}", error.message().replace('\n', " ")))
        })?;
        if raw.version != VERSION {
            let message = format!("its version is {}, this program reads version {VERSION}", raw.version);
            return Err(EditError::List(message));
        }
        let edits = raw.edits.into_iter().enumerate().map(|(i, table)| {
            Edit::from_table(table).map_err(|reason| EditError::InList {
                number: i + 1,
                reason: Box::new(reason),
            })
        });
        let list = Self {
            version: raw.version,
            edits: edits.collect::<Result<_, _>>()?,
        };
        list.check()?;
        Ok(list)
    }

    /// The content of an `edits.toml`.
    ///
    /// # Panics
    /// Never: a list is representable.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("plain data")
    }

    /// Checks every edit, independently of a scene.
    ///
    /// # Errors
    /// [`EditError::InList`] for the first that is not.
    pub fn check(&self) -> Result<(), EditError> {
        if self.edits.len() > Self::MAX_ITEMS {
            return Err(EditError::List(format!(
                "it has {} edits, at most {} are allowed",
                self.edits.len(),
                Self::MAX_ITEMS
            )));
        }
        for (i, edit) in self.edits.iter().enumerate() {
            edit.check().map_err(|reason| EditError::InList {
                number: i + 1,
                reason: Box::new(reason),
            })?;
        }
        Ok(())
    }
}

impl Edit {
    /// An operation on the whole scene.
    pub fn of_scene(op: Operation) -> Self {
        Self { op, select: None }
    }

    /// An operation on what `steps` select.
    pub fn of(op: Operation, steps: impl Into<Vec<SelectStep>>) -> Self {
        Self {
            op,
            select: Some(steps.into()),
        }
    }

    pub(crate) fn from_table(mut table: toml::Table) -> Result<Self, EditError> {
        let select = table.remove("select");
        let op = from_tagged(table, "op")?;
        let select = match select {
            None => None,
            Some(toml::Value::Array(steps)) => Some(
                steps
                    .into_iter()
                    .map(|step| from_tagged(step, "shape"))
                    .collect::<Result<_, _>>()?,
            ),
            Some(_) => return Err(EditError::Syntax("select is not a list of shapes".into())),
        };
        let edit = Self { op, select };
        edit.check()?;
        Ok(edit)
    }

    /// Checks that every number is in range, and that the operation and its selection fit together.
    ///
    /// # Errors
    /// One line that names the key.
    pub fn check(&self) -> Result<(), EditError> {
        let name = self.op.name();
        match (&self.select, self.op.scope()) {
            (None, Scope::Selection) => {
                let example = "such as in \"delete sphere center=0,0,0 radius=1\"";
                return Err(EditError::Selection(format!("{name} needs a selection, {example}")));
            }
            (Some(_), Scope::Scene) => {
                return Err(EditError::Selection(format!(
                    "{name} applies to the whole scene and takes no selection"
                )));
            }
            _ => {}
        }
        let steps = self.select.as_deref().unwrap_or_default();
        if steps.len() > EditList::MAX_ITEMS {
            let most = EditList::MAX_ITEMS;
            let message = format!("has {} steps, at most {most} are allowed", steps.len());
            return Err(EditError::value(format!("{name} select"), message));
        }
        steps.iter().try_for_each(SelectStep::check)?;
        match &self.op {
            Operation::Move { by } | Operation::Duplicate { by } => check_finite(&format!("{name} by"), by),
            Operation::Rotate { axis, degrees, about } => {
                check_direction("rotate axis", axis)?;
                check_finite("rotate degrees", &[*degrees])?;
                check_finite("rotate about", about.as_ref().map_or(&[], |v| v))
            }
            Operation::Scale { factor, about } => {
                check_positive("scale factor", *factor)?;
                check_finite("scale about", about.as_ref().map_or(&[], |v| v))
            }
            Operation::Upright { up, ground, .. } => {
                up.as_ref().map_or(Ok(()), |up| check_direction("upright up", up))?;
                check_finite("upright ground", ground.as_ref().map_or(&[], |v| v))
            }
            Operation::SetLength { from, to, length } => {
                check_direction("set-length to - from", &std::array::from_fn(|c| to[c] - from[c]))?;
                check_finite("set-length from", from)?;
                check_positive("set-length length", *length)
            }
            Operation::Recolor {
                exposure,
                temperature,
                tint,
                saturation,
                contrast,
            } => {
                check_within("recolor exposure", *exposure, -20.0, 20.0)?;
                check_within("recolor temperature", *temperature, -1.0, 1.0)?;
                check_within("recolor tint", *tint, -1.0, 1.0)?;
                check_within("recolor saturation", *saturation, 0.0, 100.0)?;
                check_within("recolor contrast", *contrast, 0.0, 100.0)
            }
            Operation::Opacity { factor } => check_within("opacity factor", *factor, 0.0, 1e6),
            Operation::Merge { file } => {
                let is_plain = !file.is_empty() && file.len() <= 4096 && !file.chars().any(char::is_control);
                if is_plain {
                    Ok(())
                } else {
                    Err(EditError::value("merge file", "must be the path of a scene"))
                }
            }
            Operation::Split { name } => {
                let is_plain = !name.is_empty()
                    && name.len() <= 200
                    && !name.starts_with('.')
                    && !name.chars().any(|c| c.is_control() || "/\\:*?\"<>|".contains(c));
                if is_plain {
                    Ok(())
                } else {
                    Err(EditError::value(
                        "split name",
                        "must be the name of a file, without a folder",
                    ))
                }
            }
            Operation::Reduce { count: 0 } => Err(EditError::value("reduce count", "must be 1 or more")),
            Operation::Delete {}
            | Operation::Keep {}
            | Operation::Reduce { .. }
            | Operation::Hide {}
            | Operation::Show {}
            | Operation::Lock {}
            | Operation::Unlock {} => Ok(()),
        }
    }
}

/// An operation or a selection's step from the table whose entry `tag` is its name, with which an error begins.
fn from_tagged<T: DeserializeOwned>(table: impl Into<toml::Value>, tag: &str) -> Result<T, EditError> {
    let table = table.into();
    let name = table.get(tag).and_then(toml::Value::as_str).unwrap_or(tag).to_owned();
    table.try_into().map_err(|error: toml::de::Error| {
        let words = [
            ("\n", " "),
            ("expected usize", "expected a whole number"),
            ("expected u32", "expected a whole number"),
            ("expected f64", "expected a number"),
        ];
        let message = words.iter().fold(error.message().to_owned(), |message, (from, to)| {
            message.replace(from, to)
        });
        EditError::Syntax(format!("{name}: {message}"))
    })
}

fn check_within(name: &str, value: f64, low: f64, high: f64) -> Result<(), EditError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(EditError::value(name, format!("must be {low} to {high}")))
    }
}

/// What an operation applies to.
enum Scope {
    Selection,
    Scene,
    Either,
}

impl Operation {
    /// Its name in lists.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Delete {} => "delete",
            Self::Keep {} => "keep",
            Self::Move { .. } => "move",
            Self::Rotate { .. } => "rotate",
            Self::Scale { .. } => "scale",
            Self::Duplicate { .. } => "duplicate",
            Self::Merge { .. } => "merge",
            Self::Upright { .. } => "upright",
            Self::SetLength { .. } => "set-length",
            Self::Recolor { .. } => "recolor",
            Self::Opacity { .. } => "opacity",
            Self::Reduce { .. } => "reduce",
            Self::Hide {} => "hide",
            Self::Show {} => "show",
            Self::Lock {} => "lock",
            Self::Unlock {} => "unlock",
            Self::Split { .. } => "split",
        }
    }

    fn scope(&self) -> Scope {
        match self {
            Self::Delete {} | Self::Keep {} | Self::Hide {} | Self::Lock {} | Self::Split { .. } => Scope::Selection,
            Self::Merge { .. } | Self::Upright { .. } | Self::SetLength { .. } => Scope::Scene,
            _ => Scope::Either,
        }
    }
}
