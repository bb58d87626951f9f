//! A run on disk: the whole state on which the next step depends, so that a resumed run writes the same bytes as an
//! uninterrupted one. This module only serialises and parses bytes; the caller stores them.

mod carried;
#[cfg(test)]
mod tests;

use crate::field_file;
use crate::recipe::Recipe;
use crate::schedule::{Clock, ConvergenceMonitor};
use crate::tensor_file::{NamedTensor, TensorSource};
use crate::times::Times;
use crate::trainer::{TrainError, TrainOptions, Trainer};
use irradia_compute::Planes;
use irradia_scene::Dataset;
use irradia_splat::{COLUMN_NAMES, SplatState, Splats};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;
use std::sync::Arc;

const FORMAT: &str = "irradia-checkpoint-5";
/// The previous format, which is still read ([`carried`]).
const FORMAT_4: &str = "irradia-checkpoint-4";
/// Prefix of the names of a field's tensors.
const FIELD: &str = "field.";
/// The time breakdown; absent from earlier checkpoints.
const TIMES: &str = "times";
const OWNERS: [&str; 3] = ["splats", "first_moments", "second_moments"];

/// `trainer` as a safetensors file: columns `[components, N]` of splats and moments, statistics, and the clock.
pub fn to_bytes(trainer: &Trainer) -> Vec<u8> {
    let state = trainer.engine.state();
    let mut arrays: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
    for (owner, splats) in OWNERS.iter().zip([&state.splats, &state.moments[0], &state.moments[1]]) {
        for (name, planes) in COLUMN_NAMES.iter().zip(splats.columns()) {
            arrays.push((
                format!("{owner}.{name}"),
                Dtype::F32,
                vec![planes.count(), planes.len()],
                plane_bytes(planes),
            ));
        }
    }
    let statistics = &state.statistics;
    arrays.push((
        "statistics".into(),
        Dtype::F32,
        vec![statistics.count(), statistics.len()],
        plane_bytes(statistics),
    ));
    arrays.push((
        "filter".into(),
        Dtype::F32,
        vec![1, state.filter.len()],
        plane_bytes(&state.filter),
    ));
    let mut tensors: Vec<NamedTensor> = Vec::new();
    let mut keep = |prefix: &str, owned: Vec<NamedTensor>| {
        tensors.extend(owned.into_iter().map(|tensor| tensor.prefixed(prefix)));
    };
    if let Some(field) = &trainer.field {
        keep(FIELD, field_file::state_tensors(field));
    }
    for occupant in trainer.sockets.occupants() {
        keep(&format!("{}.", occupant.name()), occupant.tensors());
    }
    let clock = &trainer.clock;
    let whole = [
        clock.step,
        clock.stage as u64,
        clock.stage_step,
        u64::from(clock.was_reset),
        clock.monitor.steps,
    ];
    let real = [
        clock.time,
        clock.stage_time,
        clock.progress,
        clock.stretch,
        clock.monitor.mean,
        clock.monitor.start,
        clock.monitor.best,
        clock.monitor.best_time,
        trainer.pace,
        trainer.seconds,
        trainer.cpu_seconds,
    ];
    arrays.push((
        "clock.whole".into(),
        Dtype::U64,
        vec![whole.len()],
        whole.iter().flat_map(|v| v.to_le_bytes()).collect(),
    ));
    arrays.push((
        "clock.real".into(),
        Dtype::F64,
        vec![real.len()],
        real.iter().flat_map(|v| v.to_le_bytes()).collect(),
    ));
    let times = trainer.times.to_array();
    arrays.push((
        TIMES.into(),
        Dtype::F64,
        vec![times.len()],
        times.iter().flat_map(|v| v.to_le_bytes()).collect(),
    ));
    for (name, value) in carried::named(&clock.carried) {
        arrays.push((name, Dtype::F64, vec![1], value.to_le_bytes().to_vec()));
    }
    let views = arrays.iter().map(|(name, dtype, shape, bytes)| {
        let view = TensorView::new(*dtype, shape.clone(), bytes).expect("shape and bytes agree");
        (name.as_str(), view)
    });
    let views = views.chain(tensors.iter().map(NamedTensor::view));
    let metadata = HashMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("recipe".to_owned(), trainer.recipe.to_toml()),
        ("seed".to_owned(), trainer.options.seed.to_string()),
    ]);
    safetensors::serialize(views, Some(metadata)).expect("in memory")
}

/// The recipe and the seed of a checkpoint.
///
/// # Errors
/// When the bytes are not a checkpoint of this program.
pub fn recipe_of(bytes: &[u8]) -> Result<(Recipe, u64), TrainError> {
    let wrong = |why: &str| TrainError::Checkpoint(format!("not a checkpoint of this program: {why}"));
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| wrong(&e.to_string()))?;
    let metadata = header.metadata().as_ref().ok_or_else(|| wrong("no metadata"))?;
    let format = metadata.get("format").map_or("", String::as_str);
    if ![FORMAT, FORMAT_4].contains(&format) {
        return Err(wrong(&format!("its format is not {FORMAT}")));
    }
    let text = metadata.get("recipe").ok_or_else(|| wrong("no recipe"))?;
    let recipe = Recipe::parse("in the checkpoint", text, &[]).map_err(|e| TrainError::Checkpoint(e.to_string()))?;
    let seed = metadata
        .get("seed")
        .and_then(|s| s.parse().ok())
        .ok_or_else(|| wrong("no seed"))?;
    Ok((recipe, seed))
}

/// The inverse of [`to_bytes`], on the same `dataset`.
///
/// # Errors
/// When the bytes are not a complete checkpoint.
pub fn from_bytes(bytes: &[u8], dataset: Arc<Dataset>, options: TrainOptions) -> Result<Trainer, TrainError> {
    let wrong = |why: String| TrainError::Checkpoint(format!("the checkpoint is damaged: {why}"));
    let (recipe, seed) = recipe_of(bytes)?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| wrong(e.to_string()))?;
    let array = |name: &str, dtype: Dtype| -> Result<(Vec<usize>, &[u8]), TrainError> {
        let view = file.tensor(name).map_err(|e| wrong(e.to_string()))?;
        if view.dtype() != dtype {
            return Err(wrong(format!("{name} is not {dtype:?}")));
        }
        Ok((view.shape().to_vec(), view.data()))
    };
    let planes = |name: &str| -> Result<Planes, TrainError> {
        let (shape, bytes) = array(name, Dtype::F32)?;
        let [count, len] = shape[..] else {
            return Err(wrong(format!("{name} has {} dimensions", shape.len())));
        };
        let mut planes = Planes::zeros(count, len);
        let values = bytes
            .as_chunks()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect::<Vec<_>>();
        for c in 0..count {
            planes.plane_mut(c)[..len].copy_from_slice(&values[c * len..(c + 1) * len]);
        }
        Ok(planes)
    };
    let splats = |owner: &str| -> Result<Splats, TrainError> {
        Ok(Splats {
            means: planes(&format!("{owner}.means"))?,
            quats: planes(&format!("{owner}.quats"))?,
            log_scales: planes(&format!("{owner}.log_scales"))?,
            opacity_logits: planes(&format!("{owner}.opacity_logits"))?,
            sh: planes(&format!("{owner}.sh"))?,
        })
    };
    let state = SplatState {
        splats: splats(OWNERS[0])?,
        moments: [splats(OWNERS[1])?, splats(OWNERS[2])?],
        statistics: planes("statistics")?,
        filter: planes("filter")?,
    };
    let like = |s: &Splats| s.columns().map(|c| (c.count(), c.len()));
    let shape = like(&state.splats);
    let expected = like(&Splats::zeros(state.splats.len(), state.splats.sh_degree()));
    if state.moments.iter().any(|m| like(m) != shape)
        || shape != expected
        || state.statistics.len() != state.splats.len()
        || state.statistics.count() != SplatState::STATISTICS
        || state.filter.len() != state.splats.len()
    {
        return Err(wrong("its columns have different lengths".into()));
    }
    let whole = words(array("clock.whole", Dtype::U64)?.1);
    let real = reals(array("clock.real", Dtype::F64)?.1);
    let (
        [step, stage, stage_step, was_reset, watched],
        [
            time,
            stage_time,
            progress,
            stretch,
            mean,
            start,
            best,
            best_time,
            pace,
            seconds,
            cpu_seconds,
            unnamed @ ..,
        ],
    ) = (&whole[..], &real[..])
    else {
        return Err(wrong("its clock has the wrong length".into()));
    };
    let carried = carried::read(&file, unnamed)?;
    let mut trainer = Trainer::unfilled(dataset, recipe, TrainOptions { seed, ..options }, state.len())?;
    *trainer.engine.state_mut() = state;
    let tensors = |prefix| TensorSource::new(&file, prefix);
    if tensors(FIELD).whole("whole").is_some() {
        if trainer.recipe.field.is_none() {
            return Err(wrong("its field and its recipe do not agree".into()));
        }
        let fresh = trainer.first_field()?.field;
        let state = field_file::state_from(fresh.config, fresh.space, tensors(FIELD));
        trainer.field = Some(state.map_err(|why| wrong(format!("{FIELD}{why}")))?);
    }
    trainer.sockets = trainer.first_sockets()?;
    for occupant in trainer.sockets.occupants_mut() {
        let prefix = format!("{}.", occupant.name());
        let restored = occupant.restore(TensorSource::new(&file, &prefix));
        restored.map_err(|why| wrong(format!("{prefix}{why}")))?;
    }
    (trainer.pace, trainer.seconds, trainer.cpu_seconds) = (*pace, *seconds, *cpu_seconds);
    if let Ok((_, bytes)) = array(TIMES, Dtype::F64) {
        let times = reals(bytes).try_into();
        trainer.times = Times::from_array(times.map_err(|_| wrong(format!("{TIMES} has the wrong length")))?);
    }
    trainer.clock = Clock {
        step: *step,
        time: *time,
        progress: *progress,
        stretch: *stretch,
        stage: *stage as usize,
        stage_time: *stage_time,
        stage_step: *stage_step,
        carried,
        was_reset: *was_reset != 0,
        monitor: ConvergenceMonitor {
            mean: *mean,
            steps: *watched,
            start: *start,
            best: *best,
            best_time: *best_time,
        },
    };
    trainer.restore_filter();
    Ok(trainer)
}

/// Little-endian integers.
fn words(bytes: &[u8]) -> Vec<u64> {
    bytes.as_chunks().0.iter().map(|b| u64::from_le_bytes(*b)).collect()
}

/// Little-endian double-precision numbers.
fn reals(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
}

fn plane_bytes(planes: &Planes) -> Vec<u8> {
    (0..planes.count())
        .flat_map(|c| &planes.plane(c)[..planes.len()])
        .flat_map(|v| v.to_le_bytes())
        .collect()
}
