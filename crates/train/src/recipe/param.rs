//! Values that change over time in a run, and their curves.

use super::table::{Group, Param, ROWS, Row};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;
use std::ops::{Index, IndexMut};
use std::sync::LazyLock;

/// Curves by parameter.
pub type Params = BTreeMap<Param, Knob>;

/// Names by [`Param::ALL`].
static NAMES: LazyLock<[&str; Param::ALL.len()]> = LazyLock::new(|| Param::ALL.map(Param::name));

impl Param {
    /// The parameter's row in the table.
    pub fn row(self) -> &'static Row {
        &ROWS[self as usize]
    }

    /// Its name in recipes.
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// The parameter with the name `name` in recipes.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|param| param.name() == name)
    }

    /// Whether it belongs to a loss.
    pub fn is_loss_param(self) -> bool {
        matches!(self.row().group, Group::Loss | Group::PartOf(_))
    }
}

impl Serialize for Param {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Param {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        Self::named(&name).ok_or_else(|| D::Error::unknown_variant(&name, &*NAMES))
    }
}

/// A value of each parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Values([f64; Param::ALL.len()]);

impl Values {
    /// `value(param)` for each parameter.
    pub fn from_fn(value: impl FnMut(Param) -> f64) -> Self {
        Self(Param::ALL.map(value))
    }

    /// The defaults.
    pub fn default_values() -> Self {
        Self::from_fn(|param| param.row().default)
    }

    /// The value in effect: `photo_weight` is the weight of L1, what `ssim_weight` leaves, and `ssim_weight` that of 1 - SSIM; all
    /// others are unchanged.
    pub fn in_effect(&self, param: Param) -> f64 {
        let ssim = || self[Param::SsimWeight] * self[Param::PhotoWeight];
        match param {
            Param::PhotoWeight => self[Param::PhotoWeight] - ssim(),
            Param::SsimWeight => ssim(),
            _ => self[param],
        }
    }
}

impl IndexMut<Param> for Values {
    fn index_mut(&mut self, param: Param) -> &mut f64 {
        &mut self.0[param as usize]
    }
}

impl Index<Param> for Values {
    type Output = f64;

    fn index(&self, param: Param) -> &f64 {
        &self.0[param as usize]
    }
}

/// A parameter's value over time.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Knob {
    /// Constant.
    Const(f64),
    /// From one value to another over the stage (or the run).
    Ramp {
        /// Value at the start; continues from the value in effect when absent.
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<f64>,
        /// Value at the end.
        to: f64,
        /// Interpolation from one to the other.
        shape: Shape,
    },
    /// `[at, value]` pairs: `value` holds from recipe step `at` of the stage (or run) on.
    Steps {
        /// In ascending order of `at`.
        steps: Vec<(u64, f64)>,
    },
}

impl Knob {
    /// Raises values below `min` to it.
    pub(super) fn raise_to(&mut self, min: f64) {
        match self {
            Self::Const(value) => *value = value.max(min),
            Self::Ramp { from, to, .. } => {
                *from = from.map(|from| from.max(min));
                *to = to.max(min);
            }
            Self::Steps { steps } => steps.iter_mut().for_each(|(_, value)| *value = value.max(min)),
        }
    }
}

/// Interpolation of a ramp.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Shape {
    /// Linear.
    #[default]
    Linear,
    /// Linear in the logarithm; both ends must be positive.
    Log,
    /// Half a cosine.
    Cosine,
}

/// The raw form of a knob in a file; serde's own message for an untagged enum would not say what is wrong.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawKnob {
    from: Option<f64>,
    to: Option<f64>,
    shape: Option<Shape>,
    steps: Option<Vec<(u64, f64)>>,
}

impl<'de> Deserialize<'de> for Knob {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        match toml::Value::deserialize(deserializer)? {
            toml::Value::Integer(v) => Ok(Knob::Const(v as f64)),
            toml::Value::Float(v) => Ok(Knob::Const(v)),
            table @ toml::Value::Table(_) => {
                let raw = RawKnob::deserialize(table).map_err(|e| D::Error::custom(e.message()))?;
                match (raw.to, raw.steps) {
                    (Some(to), None) => Ok(Knob::Ramp {
                        from: raw.from,
                        to,
                        shape: raw.shape.unwrap_or_default(),
                    }),
                    (None, Some(steps)) if raw.from.is_none() && raw.shape.is_none() => Ok(Knob::Steps { steps }),
                    _ => Err(D::Error::custom(
                        "expected a number, { from, to, shape } or { steps = [[at, value], ..] }",
                    )),
                }
            }
            other => Err(D::Error::custom(format!(
                "expected a number or a table, not {}",
                other.type_str()
            ))),
        }
    }
}

/// Validates `knob` for `param`.
pub(super) fn check_knob(param: Param, knob: &Knob) -> Result<(), String> {
    let values: Vec<f64> = match knob {
        Knob::Const(v) => vec![*v],
        Knob::Ramp { from, to, shape } => {
            let ends: Vec<f64> = from.iter().copied().chain([*to]).collect();
            if *shape == Shape::Log && ends.iter().any(|v| *v <= 0.0) {
                return Err("a log ramp needs ends above 0".into());
            }
            ends
        }
        Knob::Steps { steps } => {
            if steps.is_empty() || steps[0].0 != 0 || steps.windows(2).any(|w| w[0].0 >= w[1].0) {
                return Err("steps must start at 0 and ascend".into());
            }
            steps.iter().map(|(_, v)| *v).collect()
        }
    };
    let bounds = &param.row().bounds;
    match values.iter().find(|v| !bounds.contains(*v)) {
        Some(v) if *bounds.end() == f64::MAX => Err(format!("{v} is below {}", bounds.start())),
        Some(v) => Err(format!("{v} is not within {} to {}", bounds.start(), bounds.end())),
        None => Ok(()),
    }
}
