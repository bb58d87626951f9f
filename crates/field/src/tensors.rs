//! A field's parameters by name, for files.

use crate::field::FieldError;
use crate::net::NetParameters;

/// Name, shape and row-major values.
pub type Tensors<'a> = Vec<(String, Vec<usize>, &'a [f32])>;

/// Names of the parameter lists that are not part of a network.
const LIST_NAMES: [&str; 2] = ["codes", "background"];

/// All tensors that are not empty, with `prefix` before their names; `lists` are in the order of [`LIST_NAMES`].
pub(crate) fn named<'a>(prefix: &str, nets: &'a [NetParameters<f32>], lists: [&'a [f32]; 2]) -> Tensors<'a> {
    let mut list = Vec::new();
    for (i, net) in nets.iter().enumerate() {
        for (part, values) in [("table", &net.table), ("density", &net.density), ("color", &net.color)] {
            if !values.is_empty() {
                list.push((format!("{prefix}net{i}.{part}"), vec![values.len()], &values[..]));
            }
        }
    }
    for (name, values) in LIST_NAMES.into_iter().zip(lists) {
        if !values.is_empty() {
            list.push((format!("{prefix}{name}"), vec![values.len()], values));
        }
    }
    list
}

pub(crate) fn fill(
    prefix: &str,
    nets: &mut [NetParameters<f32>],
    lists: [&mut [f32]; 2],
    get: &mut impl FnMut(&str) -> Option<Vec<f32>>,
) -> Result<(), FieldError> {
    for (i, net) in nets.iter_mut().enumerate() {
        let parts = [
            ("table", &mut net.table),
            ("density", &mut net.density),
            ("color", &mut net.color),
        ];
        for (part, values) in parts {
            fill_one(&format!("{prefix}net{i}.{part}"), values, get)?;
        }
    }
    for (name, values) in LIST_NAMES.into_iter().zip(lists) {
        fill_one(&format!("{prefix}{name}"), values, get)?;
    }
    Ok(())
}

pub(crate) fn fill_one(
    name: &str,
    values: &mut [f32],
    get: &mut impl FnMut(&str) -> Option<Vec<f32>>,
) -> Result<(), FieldError> {
    if values.is_empty() {
        return Ok(());
    }
    match get(name) {
        Some(found) if found.len() == values.len() => values.copy_from_slice(&found),
        found => {
            return Err(FieldError::Tensor {
                name: name.into(),
                found: found.map_or(0, |f| f.len()),
                expected: values.len(),
            });
        }
    }
    Ok(())
}
