//! The values carried by the clock, by parameter name, so that a new parameter leaves old checkpoints readable.

use super::damaged;
use crate::recipe::{Param, Values};
use crate::tensor_file::TensorSource;
use crate::trainer::TrainError;
use safetensors::tensor::SafeTensors;

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
            return Err(damaged("its clock has the wrong length"));
        }
        for (param, value) in FORMAT_4_PARAMS.into_iter().zip(unnamed) {
            values[param] = *value;
        }
    }
    let tensors = TensorSource::new(file, PREFIX);
    for (name, _) in file.iter() {
        let Some(name) = name.strip_prefix(PREFIX) else {
            continue;
        };
        let param = Param::named(name).ok_or_else(|| {
            TrainError::Checkpoint(format!(
                "the checkpoint carries a value of `{name}`, which this version does not know: resume it with the version that \
                 wrote it"
            ))
        })?;
        let numbers = tensors.required_f64s(name).unwrap_or_default();
        let [value] = numbers[..] else {
            return Err(damaged(format!("{PREFIX}{name} is not one number")));
        };
        values[param] = value;
    }
    Ok(values)
}
