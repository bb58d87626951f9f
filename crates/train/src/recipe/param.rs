//! What changes over time in a run, and how.

use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;

/// Knobs by name.
pub type Params = BTreeMap<Param, Knob>;

/// What can change over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Param {
    /// Size of the training images relative to the data's.
    ImageScale,
    /// SH bands in use.
    ShDegree,
    /// How many splats there may be, as a share of the recipe's cap.
    CountShare,
    /// Share of the visible splats whose place and shape are trained, the largest first; of the others opacity and colour are.
    TrainedShare,
    /// Weight of the photometric loss, (1 - w) L1 + w (1 - SSIM).
    PhotoWeight,
    /// w in it.
    SsimWeight,
    /// Weight of the mean squared error.
    MseWeight,
    /// Weight of the mean squared error of images shrunk by `coarse_factor`.
    CoarseWeight,
    /// By how much they are shrunk, pixels to one.
    CoarseFactor,
    /// Weight of LPIPS, on a patch of the image; needs its weights.
    PerceptualWeight,
    /// Weight of the mean |alpha - alpha of the photograph|, where it has one.
    AlphaWeight,
    /// Weight of the mean |depth - depth of the points that the view sees|, relative to that depth; for a field of the mean
    /// squared difference of distance, in the units in which its samples are spread, at pixels where such points lie.
    DepthWeight,
    /// Weight of the edge-aware smoothness of depth.
    SmoothWeight,
    /// From 0.5 on, photographs with alpha are laid over a new random colour in each step, and so is the scene.
    RandomBackground,
    /// Weight of the mean opacity.
    OpacityReg,
    /// Weight of the mean squared opacity.
    OpacitySquareReg,
    /// Weight of the mean standard deviation, in units of the scene's extent.
    ScaleReg,
    /// Weight of the mean squared Frobenius norm of the covariance, in those units to the fourth.
    CovarianceReg,
    /// Largest condition number of a covariance; 0 for none.
    ConditionCap,
    /// Noise on the means of faint splats, times the means' rate (3DGS-MCMC).
    Noise,
    /// Learning rate of the means, in units of the scene's extent.
    RateMeans,
    /// Learning rate of the quaternions.
    RateQuats,
    /// Learning rate of the ln scales.
    RateScales,
    /// Learning rate of the opacity logits.
    RateOpacities,
    /// Learning rate of the SH's DC coefficients.
    RateShDc,
    /// Learning rate of the other SH coefficients.
    RateShRest,
    /// Learning rate of a field's tables.
    RateTables,
    /// Learning rate of a field's networks.
    RateNets,
    /// Learning rate of a field's appearance codes.
    RateCodes,
    /// Weight of the interlevel loss, where a field's samples are proposed (mip-NeRF 360).
    InterlevelWeight,
    /// Weight of the distortion loss of a field (mip-NeRF 360).
    DistortionWeight,
    /// From 0.5 on, for the rest of the run, the residual field of a recipe that has one adds to the splats' colours.
    Residual,
    /// Learning rate of the photographs' exposures, where the recipe has `exposure`.
    RateExposure,
    /// Weight of the mean squared difference of a photograph's exposure from none.
    ExposureReg,
    /// Learning rate of the poses, radians and units of the scene's extent, where the recipe has `refine_poses`.
    RatePoses,
}

impl Param {
    /// All of them, in order.
    pub const ALL: [Param; 35] = [
        Param::ImageScale,
        Param::ShDegree,
        Param::CountShare,
        Param::TrainedShare,
        Param::PhotoWeight,
        Param::SsimWeight,
        Param::MseWeight,
        Param::CoarseWeight,
        Param::CoarseFactor,
        Param::PerceptualWeight,
        Param::AlphaWeight,
        Param::DepthWeight,
        Param::SmoothWeight,
        Param::RandomBackground,
        Param::OpacityReg,
        Param::OpacitySquareReg,
        Param::ScaleReg,
        Param::CovarianceReg,
        Param::ConditionCap,
        Param::Noise,
        Param::RateMeans,
        Param::RateQuats,
        Param::RateScales,
        Param::RateOpacities,
        Param::RateShDc,
        Param::RateShRest,
        Param::RateTables,
        Param::RateNets,
        Param::RateCodes,
        Param::InterlevelWeight,
        Param::DistortionWeight,
        Param::Residual,
        Param::RateExposure,
        Param::ExposureReg,
        Param::RatePoses,
    ];

    /// As recipes write it.
    pub fn name(self) -> String {
        let name = toml::Value::try_from(self).expect("a name is plain text");
        name.as_str().unwrap_or_default().to_owned()
    }

    /// The value where no recipe says anything.
    pub fn default_value(self) -> f64 {
        match self {
            Param::ImageScale | Param::CountShare | Param::TrainedShare | Param::PhotoWeight | Param::Residual => 1.0,
            Param::CoarseFactor => 4.0,
            _ => 0.0,
        }
    }

    /// Values that make sense.
    fn range(self) -> std::ops::RangeInclusive<f64> {
        match self {
            Param::ImageScale => 0.01..=1.0,
            Param::CountShare => 0.001..=1.0,
            Param::TrainedShare => 0.001..=1.0,
            Param::ShDegree => 0.0..=3.0,
            Param::SsimWeight | Param::RandomBackground | Param::Residual => 0.0..=1.0,
            Param::CoarseFactor => 1.0..=64.0,
            _ => 0.0..=f64::MAX,
        }
    }
}

/// A value over time.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Knob {
    /// Always the same.
    Const(f64),
    /// From one value to another over the stage (or the run).
    Ramp {
        /// At the start; goes on from the value in force when absent.
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<f64>,
        /// At the end.
        to: f64,
        /// How it goes from one to the other.
        shape: Shape,
    },
    /// `[at, value]` pairs: `value` holds from recipe step `at` of the stage (or run) on.
    Steps {
        /// In ascending order of `at`.
        steps: Vec<(u64, f64)>,
    },
}

/// How a ramp runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Shape {
    /// Straight.
    #[default]
    Linear,
    /// Straight in the logarithm; both ends must be positive.
    Log,
    /// Half a cosine.
    Cosine,
}

/// What a file may say for a knob; serde's own message for an untagged enum would name nothing.
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
        use serde::de::Error;
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
                        "a knob is a number, { from, to, shape } or { steps = [[at, value], ..] }",
                    )),
                }
            }
            other => Err(D::Error::custom(format!(
                "a knob is a number or a table, not {}",
                other.type_str()
            ))),
        }
    }
}

/// Whether `knob` makes sense for `param`.
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
    let range = param.range();
    match values.iter().find(|v| !range.contains(*v)) {
        Some(v) if *range.end() == f64::MAX => Err(format!("{v} is below 0")),
        Some(v) => Err(format!("{v} is not within {} to {}", range.start(), range.end())),
        None => Ok(()),
    }
}
