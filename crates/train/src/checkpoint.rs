//! A run on disk: the whole state on which the next step depends, so that a resumed run writes the same bytes as an
//! uninterrupted one. This module only serialises and parses bytes; the caller stores them.

mod carried;
mod edited;
#[cfg(test)]
pub(crate) mod tests;

pub use edited::{splats_of, with_splats};

use crate::field_file;
use crate::first_splats::first_count;
use crate::recipe::{Choice, Recipe};
use crate::schedule::{Clock, ConvergenceMonitor};
use crate::socket::Exposure;
use crate::tensor_file::{NamedTensor, TensorSource};
use crate::times::Times;
use crate::trainer::{TrainError, TrainOptions, Trainer};
use crate::transients::Hidden;
use irradia_compute::Planes;
use irradia_scene::Dataset;
use irradia_splat::{COLUMN_NAMES, SplatState, Splats};
use rayon::prelude::*;
use safetensors::tensor::{Dtype, Metadata, SafeTensors, TensorInfo};
use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt::Display;
use std::io::{self, Write};
use std::sync::Arc;

const FORMAT: &str = "irradia-checkpoint-5";
/// The previous format, which is still read ([`carried`]).
const FORMAT_4: &str = "irradia-checkpoint-4";
/// Prefix of the names of a field's tensors.
const FIELD_PREFIX: &str = "field.";
/// The time breakdown; absent from earlier checkpoints.
const TIMES_TENSOR: &str = "times";
/// Recipe steps skipped before the first step; absent if none were.
const SKIPPED_TENSOR: &str = "skipped";
const INITIAL_SPLATS_TENSOR: &str = "initial_splats";
/// Views to train on; absent if no misfits were left out.
const TRAINED_TENSOR: &str = "trained_views";
/// View and block of each block that is hidden as transient.
const HIDDEN_TENSOR: &str = "hidden_blocks";
const COLUMN_OWNERS: [&str; 3] = ["splats", "first_moments", "second_moments"];

/// A training run between two steps, as it is written: the splats' columns are borrowed, or copied to be written while training
/// continues.
pub struct Checkpoint<'a> {
    /// Steps made.
    pub step: u64,
    state: Cow<'a, SplatState>,
    others: Vec<NamedTensor>,
    metadata: HashMap<String, String>,
}

impl<'a> Checkpoint<'a> {
    /// The checkpoint of `trainer` in its current state.
    pub fn of(trainer: &'a Trainer) -> Self {
        let mut others: Vec<NamedTensor> = Vec::new();
        let mut keep = |prefix: &str, owned: Vec<NamedTensor>| {
            others.extend(owned.into_iter().map(|tensor| tensor.prefixed(prefix)));
        };
        if let Some(field) = &trainer.field {
            keep(FIELD_PREFIX, field_file::state_tensors(field.state()));
        }
        for occupant in trainer.sockets.occupants() {
            keep(&format!("{}.", occupant.name()), occupant.tensors());
        }
        let clock = &trainer.clock;
        let integers = [
            clock.step,
            clock.stage as u64,
            clock.stage_step,
            u64::from(clock.was_reset),
            clock.monitor.steps,
        ];
        let reals = [
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
        others.push(NamedTensor::u64s("clock.whole", &integers));
        others.push(NamedTensor::f64s("clock.real", &reals));
        others.push(NamedTensor::f64s(TIMES_TENSOR, &trainer.times.to_array()));
        others.push(NamedTensor::u64s(
            INITIAL_SPLATS_TENSOR,
            &[trainer.initial_splats as u64],
        ));
        if trainer.skipped > 0.0 {
            others.push(NamedTensor::f64s(SKIPPED_TENSOR, &[trainer.skipped]));
        }
        if trainer.trained.len() < trainer.dataset.train.len() {
            let trained: Vec<u64> = trainer.trained.iter().map(|view| *view as u64).collect();
            others.push(NamedTensor::u64s(TRAINED_TENSOR, &trained));
        }
        if trainer.hidden.views() > 0 {
            others.push(NamedTensor::u64s(HIDDEN_TENSOR, &trainer.hidden.to_pairs()));
        }
        let carried = carried::named(&clock.carried);
        others.extend(carried.map(|(name, value)| NamedTensor::f64s(name, &[value])));
        Self {
            step: clock.step,
            state: Cow::Borrowed(trainer.engine.state()),
            others,
            metadata: HashMap::from([
                ("format".to_owned(), FORMAT.to_owned()),
                ("recipe".to_owned(), trainer.recipe.to_toml()),
                ("seed".to_owned(), trainer.options.seed.to_string()),
            ]),
        }
    }

    /// The copied splats; a copy if they are borrowed.
    pub fn into_state(self) -> SplatState {
        self.state.into_owned()
    }

    /// Memory that a copy of the splats takes, bytes.
    pub fn bytes(&self) -> u64 {
        self.state.bytes() as u64
    }

    /// The same checkpoint with a copy of the splats, in the memory of `spare`.
    pub fn copied_into(&self, mut spare: SplatState) -> Checkpoint<'static> {
        spare.copy_from(&self.state);
        Checkpoint {
            step: self.step,
            state: Cow::Owned(spare),
            others: self.others.clone(),
            metadata: self.metadata.clone(),
        }
    }

    /// Writes a safetensors file: columns `[components, N]` of splats and moments, statistics, and the clock. Columns are encoded
    /// piece by piece as they are written.
    ///
    /// # Errors
    /// The errors of `out`.
    pub fn write(&self, out: &mut (impl Write + ?Sized)) -> io::Result<()> {
        let state = &*self.state;
        let mut tensors: Vec<Tensor> = Vec::new();
        for (owner, splats) in COLUMN_OWNERS
            .iter()
            .zip([&state.splats, &state.moments[0], &state.moments[1]])
        {
            let columns = COLUMN_NAMES.iter().zip(splats.columns());
            tensors.extend(columns.map(|(name, planes)| Tensor::of_planes(format!("{owner}.{name}"), planes)));
        }
        tensors.push(Tensor::of_planes("statistics".into(), &state.statistics));
        tensors.push(Tensor::of_planes("filter".into(), &state.filter));
        tensors.extend(self.others.iter().map(|tensor| Tensor {
            name: tensor.name.clone(),
            dtype: tensor.dtype(),
            shape: tensor.shape.clone(),
            content: Content::Bytes(tensor.bytes()),
        }));
        write_tensors(tensors, &self.metadata, out)
    }
}

/// Writes a safetensors file.
fn write_tensors(
    mut tensors: Vec<Tensor>,
    metadata: &HashMap<String, String>,
    out: &mut (impl Write + ?Sized),
) -> io::Result<()> {
    // Larger types first, so that all are aligned (the format's own order).
    tensors.sort_by(|a, b| b.dtype.cmp(&a.dtype).then(a.name.cmp(&b.name)));
    let mut at = 0;
    let infos = tensors.iter().map(|tensor| {
        let from = at;
        at += tensor.content.len();
        let info = TensorInfo {
            dtype: tensor.dtype,
            shape: tensor.shape.clone(),
            data_offsets: (from, at),
        };
        (tensor.name.clone(), info)
    });
    let header = Metadata::new(Some(metadata.clone()), infos.collect()).map_err(io::Error::other)?;
    let mut header = serde_json::to_vec(&header)?;
    header.resize(header.len().next_multiple_of(8), b' ');
    out.write_all(&(header.len() as u64).to_le_bytes())?;
    out.write_all(&header)?;
    let mut encoded = Vec::new();
    for tensor in &tensors {
        match tensor.content {
            Content::Bytes(bytes) => out.write_all(bytes)?,
            Content::Planes(planes) => {
                for c in 0..planes.count() {
                    for piece in planes.plane(c)[..planes.len()].chunks(VALUES_PER_CHUNK) {
                        encoded.resize(4 * piece.len(), 0);
                        for (to, value) in encoded.as_chunks_mut().0.iter_mut().zip(piece) {
                            *to = value.to_le_bytes();
                        }
                        out.write_all(&encoded)?;
                    }
                }
            }
        }
    }
    Ok(())
}

/// The error of a checkpoint that cannot be read, for the reason `why`.
fn damaged(why: impl Display) -> TrainError {
    TrainError::Checkpoint(format!("the checkpoint is damaged: {why}"))
}

/// A column of a checkpoint.
fn read_planes(tensors: TensorSource, name: &str) -> Result<Planes, String> {
    let view = tensors.view(name, Dtype::F32)?;
    let [count, len] = view.shape()[..] else {
        return Err(format!("{name} has {} dimensions", view.shape().len()));
    };
    let mut planes = Planes::zeros(count, len);
    for c in 0..count {
        let from = view.data()[4 * c * len..4 * (c + 1) * len].as_chunks().0;
        let to = planes.plane_mut(c)[..len].par_iter_mut().with_min_len(VALUES_PER_CHUNK);
        to.zip(from).for_each(|(to, from)| *to = f32::from_le_bytes(*from));
    }
    Ok(planes)
}

/// The columns of `owner`, one of [`COLUMN_OWNERS`].
fn read_columns(tensors: TensorSource, owner: &str) -> Result<Splats, String> {
    let mut splats = Splats::default();
    for (name, planes) in COLUMN_NAMES.iter().zip(splats.columns_mut()) {
        *planes = read_planes(tensors, &format!("{owner}.{name}"))?;
    }
    Ok(splats)
}

/// Numbers of components and lengths of the columns.
fn column_shapes(splats: &Splats) -> [(usize, usize); COLUMN_NAMES.len()] {
    splats.columns().map(|planes| (planes.count(), planes.len()))
}

/// Whether all columns of `splats` have the same length, and the number of components for their SH bands.
fn has_consistent_columns(splats: &Splats) -> bool {
    column_shapes(splats) == column_shapes(&Splats::zeros(splats.len(), splats.sh_degree()))
}

/// Number of values that are encoded at a time, so that they are still in the cache when they are written.
const VALUES_PER_CHUNK: usize = 1 << 16;

/// A tensor of the file.
struct Tensor<'a> {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    content: Content<'a>,
}

enum Content<'a> {
    Planes(&'a Planes),
    Bytes(&'a [u8]),
}

impl Content<'_> {
    /// Encoded length, bytes.
    fn len(&self) -> usize {
        match self {
            Content::Planes(planes) => 4 * planes.count() * planes.len(),
            Content::Bytes(bytes) => bytes.len(),
        }
    }
}

impl<'a> Tensor<'a> {
    fn of_planes(name: String, planes: &'a Planes) -> Self {
        Self {
            name,
            dtype: Dtype::F32,
            shape: vec![planes.count(), planes.len()],
            content: Content::Planes(planes),
        }
    }
}

/// A [`Checkpoint`] in memory.
pub fn to_bytes(trainer: &Trainer) -> Vec<u8> {
    let mut bytes = Vec::new();
    Checkpoint::of(trainer).write(&mut bytes).expect("in memory");
    bytes
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
    let (recipe, seed) = recipe_of(bytes)?;
    let file = SafeTensors::deserialize(bytes).map_err(damaged)?;
    let tensors = TensorSource::new(&file, "");
    let state = read_state(tensors).map_err(damaged)?;
    let progress = read_progress(&file)?;
    let mut trainer = Trainer::with_empty_state(dataset, recipe, TrainOptions { seed, ..options }, state.len())?;
    // Not in the checkpoints of earlier versions.
    trainer.initial_splats = match tensors.required_u64s(INITIAL_SPLATS_TENSOR).as_deref() {
        Ok([initial]) => *initial as usize,
        _ => first_count(&trainer.dataset, &trainer.recipe).min(state.len()),
    };
    *trainer.engine.state_mut() = state;
    restore_field(&mut trainer, &file)?;
    restore_occupants(&mut trainer, &file)?;
    restore_views(&mut trainer, tensors)?;
    trainer.pace = progress.pace;
    trainer.seconds = progress.seconds;
    trainer.cpu_seconds = progress.cpu_seconds;
    if let Ok(times) = tensors.required_f64s(TIMES_TENSOR) {
        let times = times.try_into();
        trainer.times = Times::from_array(times.map_err(|_| damaged(format!("{TIMES_TENSOR} has the wrong length")))?);
    }
    if let Ok([skipped]) = tensors.required_f64s(SKIPPED_TENSOR).as_deref() {
        trainer.skipped = *skipped;
    }
    trainer.clock = progress.clock;
    trainer.restore_filter();
    Ok(trainer)
}

/// The splats, their moments, statistics and filter.
fn read_state(tensors: TensorSource) -> Result<SplatState, String> {
    let [splats, first_moments, second_moments] = COLUMN_OWNERS;
    let state = SplatState {
        splats: read_columns(tensors, splats)?,
        moments: [
            read_columns(tensors, first_moments)?,
            read_columns(tensors, second_moments)?,
        ],
        statistics: read_planes(tensors, "statistics")?,
        filter: read_planes(tensors, "filter")?,
    };
    let shapes = column_shapes(&state.splats);
    let is_consistent = has_consistent_columns(&state.splats)
        && state.moments.iter().all(|moments| column_shapes(moments) == shapes)
        && state.statistics.len() == state.splats.len()
        && state.statistics.count() == SplatState::STATISTICS
        && state.filter.len() == state.splats.len();
    if is_consistent {
        Ok(state)
    } else {
        Err("its columns have different lengths".into())
    }
}

/// How far a run has come.
struct Progress {
    clock: Clock,
    pace: f64,
    seconds: f64,
    cpu_seconds: f64,
}

fn read_progress(file: &SafeTensors) -> Result<Progress, TrainError> {
    let tensors = TensorSource::new(file, "");
    let integers = tensors.required_u64s("clock.whole").map_err(damaged)?;
    let reals = tensors.required_f64s("clock.real").map_err(damaged)?;
    let (
        [step, stage, stage_step, was_reset, monitor_steps],
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
    ) = (&integers[..], &reals[..])
    else {
        return Err(damaged("its clock has the wrong length"));
    };
    let clock = Clock {
        step: *step,
        time: *time,
        progress: *progress,
        stretch: *stretch,
        stage: *stage as usize,
        stage_time: *stage_time,
        stage_step: *stage_step,
        carried: carried::read(file, unnamed)?,
        was_reset: *was_reset != 0,
        monitor: ConvergenceMonitor {
            mean: *mean,
            steps: *monitor_steps,
            start: *start,
            best: *best,
            best_time: *best_time,
        },
    };
    Ok(Progress {
        clock,
        pace: *pace,
        seconds: *seconds,
        cpu_seconds: *cpu_seconds,
    })
}

/// The field, if a stage of the run trains one.
fn restore_field(trainer: &mut Trainer, file: &SafeTensors) -> Result<(), TrainError> {
    let tensors = TensorSource::new(file, FIELD_PREFIX);
    if tensors.u64s("whole").is_none() {
        return Ok(());
    }
    if trainer.recipe.field.is_none() {
        return Err(damaged("its field and its recipe do not agree"));
    }
    let fresh = trainer.first_field()?.field;
    let state = field_file::state_from(fresh.config, fresh.space, tensors);
    trainer.set_field(state.map_err(|why| damaged(format!("{FIELD_PREFIX}{why}")))?)
}

/// The trained components other than splats and field.
fn restore_occupants(trainer: &mut Trainer, file: &SafeTensors) -> Result<(), TrainError> {
    trainer.sockets = trainer.first_sockets()?;
    // The run may have decided to learn exposures.
    let exposure = TensorSource::new(file, "exposure.");
    if trainer.recipe.exposure == Choice::Auto && exposure.u64s("steps").is_some() {
        trainer.sockets.exposure = Some(Exposure::new(trainer.dataset.views.len(), &trainer.dataset.train));
    }
    for occupant in trainer.sockets.occupants_mut() {
        let prefix = format!("{}.", occupant.name());
        let restored = occupant.restore(TensorSource::new(file, &prefix));
        restored.map_err(|why| damaged(format!("{prefix}{why}")))?;
    }
    Ok(())
}

/// The photographs, and parts of them, that the run has left out.
fn restore_views(trainer: &mut Trainer, tensors: TensorSource) -> Result<(), TrainError> {
    if let Some(trained) = tensors.u64s(TRAINED_TENSOR) {
        let known = |view: &u64| trainer.dataset.train.contains(&(*view as usize));
        if trained.is_empty() || !trained.iter().all(known) {
            return Err(damaged(format!("{TRAINED_TENSOR} and the dataset do not agree")));
        }
        trainer.train_on(trained.iter().map(|view| *view as usize).collect());
    }
    if let Some(pairs) = tensors.u64s(HIDDEN_TENSOR) {
        let camera = |view: usize| trainer.dataset.views.get(view).map(|view| &view.camera);
        trainer.hidden = Hidden::from_pairs(&pairs, camera)
            .ok_or_else(|| damaged(format!("{HIDDEN_TENSOR} and the dataset do not agree")))?;
    }
    Ok(())
}
