//! State dicts as `torch.save` writes them: since PyTorch 1.6 a zip archive with a pickle of names and shapes and one file of
//! values per storage; before that, a stream of pickles followed by the storages (`torch/serialization.py`).

use super::pickle::{self, Id, Object, Pickle};
use super::{Tensor, floats};
use crate::Malformed;
use crate::bytes::ByteReader;
use crate::zip;
use std::collections::{BTreeMap, HashMap};

type Wanted<'a> = &'a dyn Fn(&str) -> bool;

fn malformed(reason: impl std::fmt::Display) -> Malformed {
    Malformed(format!("not a usable PyTorch state dict: {reason}"))
}

/// From the zip archive.
pub(super) fn from_archive(bytes: &[u8], wanted: Wanted) -> Result<BTreeMap<String, Tensor>, Malformed> {
    // PyTorch compresses nothing, so that no file is larger than the archive.
    let mut files = BTreeMap::new();
    for (name, entry) in zip::files(bytes)? {
        let content = entry.stored();
        let content = content.ok_or_else(|| {
            malformed(format!(
                "{} is compressed, which PyTorch does not do",
                zip::printable(&name)
            ))
        })?;
        files.insert(name, content);
    }
    let folder = files.keys().find_map(|name| name.strip_suffix("data.pkl"));
    let folder = folder.ok_or_else(|| malformed("the archive contains no data.pkl"))?;
    let order = files.get(&format!("{folder}byteorder"));
    if order.is_some_and(|order| *order != b"little") {
        return Err(malformed("its values are not little-endian"));
    }
    let pickle = pickle::read(&mut ByteReader::new(files[&format!("{folder}data.pkl")]))?;
    let storage = |key: &str| files.get(&format!("{folder}data/{key}")).copied();
    tensors(&pickle, bytes.len(), wanted, &storage)
}

/// From the stream of pickles: a magic number, a version, the system that wrote it, the state dict, the storages' keys.
pub(super) fn from_stream(bytes: &[u8], wanted: Wanted) -> Result<BTreeMap<String, Tensor>, Malformed> {
    const MAGIC: &[u8] = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.";
    let total = bytes.len();
    let stream = bytes.strip_prefix(MAGIC);
    let mut bytes = ByteReader::new(stream.ok_or_else(|| malformed("it does not begin like a PyTorch file"))?);
    let version = pickle::read(&mut bytes)?;
    if version.size(version.root) != Some(1001) {
        return Err(malformed("its version is not 1001"));
    }
    pickle::read(&mut bytes)?;
    let pickle = pickle::read(&mut bytes)?;
    let keys = pickle::read(&mut bytes)?;
    let kinds: HashMap<&str, &str> = pickle
        .objects()
        .filter_map(|o| Storage::of(&pickle, o))
        .map(|s| (s.key, s.kind))
        .collect();
    let mut storages = HashMap::new();
    for key in keys
        .items(keys.root)
        .ok_or_else(|| malformed("it has no list of storages"))?
    {
        let key = keys.text(*key).ok_or_else(|| malformed("a storage has no name"))?;
        let size = kinds.get(key).and_then(|kind| value_size(kind));
        let size = size.ok_or_else(|| malformed(format_args!("storage {key} has an unknown type")))?;
        let count = bytes.count(size, "values")?;
        storages.insert(key, bytes.take(count * size)?);
    }
    let storage = |key: &str| storages.get(key).copied();
    tensors(&pickle, total, wanted, &storage)
}

/// Bytes per value in a storage.
fn value_size(kind: &str) -> Option<usize> {
    Some(match kind.strip_prefix("torch.")?.strip_suffix("Storage")? {
        "Double" | "Long" => 8,
        "Float" | "Int" => 4,
        "Half" | "BFloat16" | "Short" => 2,
        "Byte" | "Char" | "Bool" => 1,
        _ => return None,
    })
}

/// The identifier of a storage: `("storage", type, key, device, number of values, ..)`.
struct Storage<'a> {
    kind: &'a str,
    key: &'a str,
}

impl<'a> Storage<'a> {
    fn of(pickle: &'a Pickle, object: &'a Object) -> Option<Self> {
        let Object::Persistent(id) = object else { return None };
        match pickle.tuple(*id)? {
            [tag, kind, key, ..] if pickle.text(*tag)? == "storage" => Some(Self {
                kind: pickle.global(*kind)?,
                key: pickle.text(*key)?,
            }),
            _ => None,
        }
    }
}

/// Maximum number of dimensions of a tensor.
const MAX_DIMENSIONS: usize = 8;

/// A tensor as the pickle rebuilds it.
struct RebuiltTensor<'a> {
    storage: Storage<'a>,
    offset: usize,
    shape: Vec<usize>,
    strides: Vec<usize>,
}

impl<'a> RebuiltTensor<'a> {
    /// `None` if the object is not a tensor.
    fn of(pickle: &'a Pickle, id: Id) -> Option<Self> {
        let call = |id: Id| match pickle.object(id) {
            Object::Call(function, arguments) => Some((pickle.global(*function)?, pickle.tuple(*arguments)?)),
            _ => None,
        };
        let (mut function, mut arguments) = call(id)?;
        if function == "torch._utils._rebuild_parameter" {
            (function, arguments) = call(*arguments.first()?)?;
        }
        let ("torch._utils._rebuild_tensor" | "torch._utils._rebuild_tensor_v2", [storage, offset, shape, strides, ..]) =
            (function, arguments)
        else {
            return None;
        };
        let sizes = |id: &Id| {
            let sizes = pickle.tuple(*id).filter(|sizes| sizes.len() <= MAX_DIMENSIONS)?;
            sizes.iter().map(|id| pickle.size(*id)).collect::<Option<Vec<_>>>()
        };
        Some(Self {
            storage: Storage::of(pickle, pickle.object(*storage))?,
            offset: pickle.size(*offset)?,
            shape: sizes(shape)?,
            strides: sizes(strides)?,
        })
    }

    /// Number of values, if stored contiguously, row-major.
    fn count(&self) -> Option<usize> {
        let mut count = 1usize;
        for (size, stride) in self.shape.iter().zip(&self.strides).rev() {
            if *size > 1 && *stride != count {
                return None;
            }
            count = count.checked_mul(*size)?;
        }
        (self.shape.len() == self.strides.len()).then_some(count)
    }
}

/// The wanted tensors of the state dict. Together they must not have more values than fit in the file's `total` bytes.
fn tensors<'a>(
    pickle: &Pickle,
    total: usize,
    wanted: Wanted,
    storage: &dyn Fn(&str) -> Option<&'a [u8]>,
) -> Result<BTreeMap<String, Tensor>, Malformed> {
    let Object::Dict(entries) = pickle.object(pickle.root) else {
        return Err(malformed(
            "it does not contain a state dict; save the model's state_dict()",
        ));
    };
    let mut remaining = total / size_of::<f32>();
    let mut tensors = BTreeMap::new();
    for (name, value) in entries {
        let Some(name) = pickle.text(*name).filter(|name| wanted(name)) else {
            continue;
        };
        let tensor_error = |reason: &str| malformed(format_args!("tensor {name} {reason}"));
        let tensor = RebuiltTensor::of(pickle, *value).ok_or_else(|| tensor_error("is of an unsupported kind"))?;
        if tensor.storage.kind != "torch.FloatStorage" {
            return Err(tensor_error(&format!(
                "is in a {}; only 32-bit floats are supported",
                tensor.storage.kind
            )));
        }
        let count = tensor.count().ok_or_else(|| tensor_error("is not contiguous"))?;
        let (values, _) = storage(tensor.storage.key)
            .ok_or_else(|| tensor_error("has no values"))?
            .as_chunks::<4>();
        let end = tensor.offset.checked_add(count);
        let values = end.and_then(|end| values.get(tensor.offset..end));
        let values = values.ok_or_else(|| tensor_error("is larger than its storage; the file is truncated"))?;
        remaining = remaining
            .checked_sub(count)
            .ok_or_else(|| malformed("its tensors are larger than the file"))?;
        let tensor = Tensor {
            shape: tensor.shape,
            values: floats(values.as_flattened()),
        };
        tensors.insert(name.to_owned(), tensor);
    }
    Ok(tensors)
}
