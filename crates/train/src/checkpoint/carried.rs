//! The values carried by the clock, by parameter name, so that a new parameter leaves old checkpoints readable.

use super::f64s;
use crate::recipe::{Param, Values};
use crate::trainer::TrainError;
use safetensors::tensor::{Dtype, SafeTensors};

/// Prefix of the names of their tensors; a parameter's name follows.
const PREFIX: &str = "carried.";

/// The order of the values in format 4, in which they follow the numbers of `clock.real` without names.
const FORMAT_4_PARAMS: [Param; 32] = [
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
];

/// A tensor's name and value for each parameter.
pub(super) fn named(values: &Values) -> impl Iterator<Item = (String, f64)> {
    Param::ALL
        .into_iter()
        .map(|param| (format!("{PREFIX}{}", param.name()), values[param]))
}

/// The values of `file`; those that format 4 has without names are in `unnamed`. A parameter newer than the checkpoint gets its
/// default, since the recipe in the checkpoint does not set it.
///
/// # Errors
/// When a name is unknown: this version lacks that parameter, so that the run would not continue as it began.
pub(super) fn read(file: &SafeTensors, unnamed: &[f64]) -> Result<Values, TrainError> {
    let mut values = Values::default_values();
    if !unnamed.is_empty() {
        if unnamed.len() != FORMAT_4_PARAMS.len() {
            return Err(TrainError::Checkpoint(
                "the checkpoint is damaged: its clock has the wrong length".into(),
            ));
        }
        for (param, value) in FORMAT_4_PARAMS.into_iter().zip(unnamed) {
            values[param] = *value;
        }
    }
    for (name, view) in file.iter() {
        let Some(name) = name.strip_prefix(PREFIX) else {
            continue;
        };
        let param = Param::named(name).ok_or_else(|| {
            TrainError::Checkpoint(format!(
                "the checkpoint carries a value of `{name}`, which this version does not know: resume it with the version that \
                 wrote it"
            ))
        })?;
        let ([value], Dtype::F64) = (&f64s(view.data())[..], view.dtype()) else {
            return Err(TrainError::Checkpoint(format!(
                "the checkpoint is damaged: {PREFIX}{name} is not one number"
            )));
        };
        values[param] = *value;
    }
    Ok(values)
}
