//! The subset of Python's pickle protocol 2 that state dicts need, parsed to plain data: imports remain names, and calls are
//! recorded, never executed. Opcodes are those of CPython's `pickletools.py`.

use crate::Malformed;
use crate::bytes::ByteReader;
use std::collections::HashMap;

/// Index of an object. Objects refer to one another by index, so that cycles and deep nesting are cheap.
pub(super) type Id = usize;

/// An object in a pickle.
#[derive(Clone, Debug)]
pub(super) enum Object {
    /// None, true, false, and integers of more than 8 bytes.
    Other,
    Integer(i64),
    Text(String),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// `module.name`.
    Global(String),
    /// An object stored outside the pickle, with its identifier.
    Persistent(Id),
    /// A call with its arguments.
    Call(Id, Id),
}

/// All objects of a pickle.
#[derive(Default)]
pub(super) struct Pickle {
    objects: Vec<Object>,
    /// The pickled object.
    pub(super) root: Id,
}

/// Maximum number of objects of a pickle; VGG16's state dict has a few hundred.
const MAX_OBJECTS: usize = 1 << 20;

impl Pickle {
    pub(super) fn object(&self, id: Id) -> &Object {
        &self.objects[id]
    }

    pub(super) fn text(&self, id: Id) -> Option<&str> {
        match self.object(id) {
            Object::Text(text) => Some(text),
            _ => None,
        }
    }

    pub(super) fn global(&self, id: Id) -> Option<&str> {
        match self.object(id) {
            Object::Global(name) => Some(name),
            _ => None,
        }
    }

    pub(super) fn tuple(&self, id: Id) -> Option<&[Id]> {
        match self.object(id) {
            Object::Tuple(items) => Some(items),
            _ => None,
        }
    }

    /// The items of a list or a tuple.
    pub(super) fn items(&self, id: Id) -> Option<&[Id]> {
        match self.object(id) {
            Object::List(items) => Some(items),
            _ => self.tuple(id),
        }
    }

    pub(super) fn size(&self, id: Id) -> Option<usize> {
        match self.object(id) {
            Object::Integer(value) => usize::try_from(*value).ok(),
            _ => None,
        }
    }

    pub(super) fn objects(&self) -> impl Iterator<Item = &Object> {
        self.objects.iter()
    }
}

/// Reads one pickle, to its end.
pub(super) fn read(bytes: &mut ByteReader) -> Result<Pickle, Malformed> {
    let mut unpickler = Unpickler::default();
    while !unpickler.step(bytes)? {}
    Ok(unpickler.pickle)
}

#[derive(Default)]
struct Unpickler {
    pickle: Pickle,
    stack: Vec<Id>,
    /// Heights of the stack at its marks.
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
    /// Objects, marks, recalls and copies so far.
    object_count: usize,
}

fn malformed(reason: impl std::fmt::Display) -> Malformed {
    Malformed(format!("not a usable PyTorch state dict: {reason}"))
}

impl Unpickler {
    /// Executes one opcode; returns whether it was the last.
    fn step(&mut self, bytes: &mut ByteReader) -> Result<bool, Malformed> {
        let code = bytes.u8()?;
        match code {
            0x80 => {
                let protocol = bytes.u8()?;
                if protocol != 2 {
                    return Err(malformed(format_args!("pickle protocol {protocol}, not 2")));
                }
            }
            b'N' | 0x88 | 0x89 => self.push(Object::Other)?,
            b'K' => self.push_integer(bytes.u8()?)?,
            b'M' => self.push_integer(bytes.u16()?)?,
            b'J' => self.push_integer(bytes.u32()? as i32)?,
            0x8a => {
                let length = bytes.u8()?;
                let digits = bytes.take(length.into())?;
                self.push(parse_long(digits))?;
            }
            b'X' | b'T' => {
                let length = bytes.u32()?;
                self.push_text(bytes.take(length as usize)?)?;
            }
            b'U' => {
                let length = bytes.u8()?;
                self.push_text(bytes.take(length.into())?)?;
            }
            b'c' => {
                let [module, name] = [bytes.line()?, bytes.line()?];
                self.push(Object::Global(format!("{module}.{name}")))?;
            }
            b'(' => {
                self.count_objects(1)?;
                self.marks.push(self.stack.len());
            }
            b')' => self.push(Object::Tuple(Vec::new()))?,
            b']' => self.push(Object::List(Vec::new()))?,
            b'}' => self.push(Object::Dict(Vec::new()))?,
            b't' => {
                let items = self.pop_to_mark()?;
                self.push(Object::Tuple(items))?;
            }
            0x85..=0x87 => {
                let count = usize::from(code - 0x84);
                let at = self.stack.len().checked_sub(count);
                let items = self
                    .stack
                    .split_off(at.ok_or_else(|| malformed("it pops from an empty stack"))?);
                self.push(Object::Tuple(items))?;
            }
            b'a' => {
                let item = self.pop()?;
                self.append(&[item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.append(&items)?;
            }
            b's' => {
                let [value, key] = [self.pop()?, self.pop()?];
                self.set(&[key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.set(&items)?;
            }
            b'q' => self.memo_put(bytes.u8()?.into())?,
            b'r' => {
                let key = bytes.u32()?;
                self.memo_put(key)?;
            }
            b'h' => self.memo_get(bytes.u8()?.into())?,
            b'j' => {
                let key = bytes.u32()?;
                self.memo_get(key)?;
            }
            b'Q' => {
                let id = self.pop()?;
                self.push(Object::Persistent(id))?;
            }
            b'R' => {
                let [arguments, function] = [self.pop()?, self.pop()?];
                let result = self.call(function, arguments)?;
                self.push(result)?;
            }
            // Attributes of an object, such as the versions of a state dict's modules: not needed.
            b'b' => drop(self.pop()?),
            b'.' => {
                self.pickle.root = self.pop()?;
                return Ok(true);
            }
            _ => {
                return Err(malformed(format_args!(
                    "it has pickle opcode {code:#04x}, which state dicts do not use"
                )));
            }
        }
        Ok(false)
    }

    /// The result of a call: ordered dicts, as Python 2 (with a list of pairs) and 3 (empty) build them, become dicts.
    fn call(&mut self, function: Id, arguments: Id) -> Result<Object, Malformed> {
        let call = Object::Call(function, arguments);
        if self.pickle.global(function) != Some("collections.OrderedDict") {
            return Ok(call);
        }
        match self.pickle.tuple(arguments) {
            Some([]) => Ok(Object::Dict(Vec::new())),
            Some([pairs]) => {
                let pairs = *pairs;
                self.count_objects(self.pickle.items(pairs).map_or(0, <[Id]>::len))?;
                let pair = |id: &Id| match self.pickle.items(*id) {
                    Some([key, value]) => Some((*key, *value)),
                    _ => None,
                };
                let pairs = self.pickle.items(pairs).unwrap_or_default().iter().map(pair);
                Ok(pairs.collect::<Option<_>>().map_or(call, Object::Dict))
            }
            _ => Ok(call),
        }
    }

    /// Counts `count` more objects and checks the sum against [`MAX_OBJECTS`].
    fn count_objects(&mut self, count: usize) -> Result<(), Malformed> {
        self.object_count += count;
        if self.object_count > MAX_OBJECTS {
            return Err(malformed("it makes too many objects"));
        }
        Ok(())
    }

    fn push(&mut self, object: Object) -> Result<(), Malformed> {
        self.count_objects(1)?;
        self.stack.push(self.pickle.objects.len());
        self.pickle.objects.push(object);
        Ok(())
    }

    fn push_integer(&mut self, value: impl Into<i64>) -> Result<(), Malformed> {
        self.push(Object::Integer(value.into()))
    }

    fn push_text(&mut self, text: &[u8]) -> Result<(), Malformed> {
        self.push(Object::Text(String::from_utf8_lossy(text).into_owned()))
    }

    fn pop(&mut self) -> Result<Id, Malformed> {
        let low = self.marks.last().copied().unwrap_or(0);
        let popped = if self.stack.len() > low { self.stack.pop() } else { None };
        popped.ok_or_else(|| malformed("it pops from an empty stack"))
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Id>, Malformed> {
        let mark = self
            .marks
            .pop()
            .ok_or_else(|| malformed("it has no mark where one is needed"))?;
        Ok(self.stack.split_off(mark.min(self.stack.len())))
    }

    fn append(&mut self, items: &[Id]) -> Result<(), Malformed> {
        match self.stack.last().map(|top| &mut self.pickle.objects[*top]) {
            Some(Object::List(list)) => list.extend(items),
            _ => return Err(malformed("it appends to an object that is not a list")),
        }
        Ok(())
    }

    fn set(&mut self, items: &[Id]) -> Result<(), Malformed> {
        match self.stack.last().map(|top| &mut self.pickle.objects[*top]) {
            Some(Object::Dict(dict)) => dict.extend(items.as_chunks().0.iter().map(|[key, value]| (*key, *value))),
            _ => return Err(malformed("it sets keys of an object that is not a dict")),
        }
        Ok(())
    }

    fn memo_put(&mut self, key: u32) -> Result<(), Malformed> {
        let top = *self
            .stack
            .last()
            .ok_or_else(|| malformed("it memoises an empty stack"))?;
        self.count_objects(1)?;
        self.memo.insert(key, top);
        Ok(())
    }

    fn memo_get(&mut self, key: u32) -> Result<(), Malformed> {
        self.count_objects(1)?;
        let id = self
            .memo
            .get(&key)
            .ok_or_else(|| malformed("it recalls an unknown memo"))?;
        self.stack.push(*id);
        Ok(())
    }
}

/// Little-endian, two's complement.
fn parse_long(digits: &[u8]) -> Object {
    if digits.len() > 8 {
        return Object::Other;
    }
    let negative = digits.last().is_some_and(|last| last & 0x80 != 0);
    let mut bytes = [if negative { 0xff } else { 0 }; 8];
    bytes[..digits.len()].copy_from_slice(digits);
    Object::Integer(i64::from_le_bytes(bytes))
}
