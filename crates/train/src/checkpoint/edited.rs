//! Checkpoints of edited scenes: the optimiser's state follows the splats.

use super::{
    COLUMN_NAMES, COLUMN_OWNERS, Content, Tensor, damaged, has_consistent_columns, read_columns, read_planes,
    recipe_of, write_tensors,
};
use crate::tensor_file::TensorSource;
use crate::trainer::TrainError;
use irradia_compute::Planes;
use irradia_splat::Splats;
use safetensors::tensor::SafeTensors;

/// The splats of a checkpoint, in its order and in the world of its training.
///
/// # Errors
/// When the bytes are not a checkpoint of this program.
pub fn splats_of(bytes: &[u8]) -> Result<Splats, TrainError> {
    recipe_of(bytes)?;
    let file = SafeTensors::deserialize(bytes).map_err(damaged)?;
    let splats = read_columns(TensorSource::new(&file, ""), COLUMN_OWNERS[0]).map_err(damaged)?;
    if has_consistent_columns(&splats) {
        Ok(splats)
    } else {
        Err(damaged("its columns have different lengths"))
    }
}

/// The checkpoint with other splats. Splat i was number `sources[i]` and keeps its moments, statistics and filter; without a source they
/// are zero.
///
/// # Errors
/// When the bytes are not a checkpoint of this program.
///
/// # Panics
/// If there is not a source for every splat, or the splats' SH bands are not those of the checkpoint.
pub fn with_splats(bytes: &[u8], splats: &Splats, sources: &[Option<u32>]) -> Result<Vec<u8>, TrainError> {
    let before = splats_of(bytes)?;
    assert_eq!(splats.len(), sources.len(), "a source for every splat");
    assert_eq!(splats.sh.count(), before.sh.count(), "the bands of the checkpoint");
    let file = SafeTensors::deserialize(bytes).map_err(damaged)?;
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(damaged)?;
    let of_splats: Vec<String> = COLUMN_NAMES
        .iter()
        .map(|name| format!("{}.{name}", COLUMN_OWNERS[0]))
        .collect();
    let followers = COLUMN_OWNERS[1..]
        .iter()
        .flat_map(|owner| COLUMN_NAMES.map(|name| format!("{owner}.{name}")));
    let followers: Vec<String> = followers
        .chain(["statistics".to_owned(), "filter".to_owned()])
        .collect();
    let mut followed = Vec::new();
    for name in &followers {
        let planes = read_planes(TensorSource::new(&file, ""), name).map_err(damaged)?;
        if planes.len() != before.len() {
            return Err(damaged("its columns have different lengths"));
        }
        let mut moved = Planes::zeros(planes.count(), splats.len());
        for c in 0..planes.count() {
            let (from, to) = (planes.plane(c), moved.plane_mut(c));
            for (to, source) in to.iter_mut().zip(sources) {
                *to = source.map_or(0.0, |source| from[source as usize]);
            }
        }
        followed.push(moved);
    }
    let mut tensors: Vec<Tensor> = Vec::new();
    for (name, view) in file.iter() {
        let is_column = |list: &[String]| list.iter().position(|known| known == name);
        tensors.push(match (is_column(&of_splats), is_column(&followers)) {
            (Some(column), _) => Tensor::of_planes(name.to_owned(), splats.columns()[column]),
            (_, Some(column)) => Tensor::of_planes(name.to_owned(), &followed[column]),
            _ => Tensor {
                name: name.to_owned(),
                dtype: view.dtype(),
                shape: view.shape().to_vec(),
                content: Content::Bytes(view.data()),
            },
        });
    }
    let mut edited = Vec::new();
    let metadata = header.metadata().clone().unwrap_or_default();
    write_tensors(tensors, &metadata, &mut edited).expect("in memory");
    Ok(edited)
}
