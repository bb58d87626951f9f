//! The values of an accessor as floats.

use super::document::Document;
use crate::Malformed;
use std::borrow::Cow;

/// The buffers of a document, in order.
pub(super) type Buffers<'a> = [Cow<'a, [u8]>];

/// Rows of numbers in a buffer, checked to lie within it.
pub(super) struct Values<'a> {
    bytes: &'a [u8],
    stride: usize,
    component: Component,
    normalized: bool,
    pub count: usize,
}

#[derive(Clone, Copy)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }
}

/// The bytes of a buffer view.
pub(super) fn buffer_view_bytes<'a>(
    document: &Document,
    buffers: &'a Buffers,
    index: usize,
) -> Result<&'a [u8], Malformed> {
    let outside = || Malformed(format!("its bufferView {index} is outside of the buffers"));
    let view = document.buffer_views.get(index).ok_or_else(outside)?;
    let buffer = buffers.get(view.buffer).ok_or_else(outside)?;
    let start = usize::try_from(view.byte_offset).map_err(|_| outside())?;
    let length = usize::try_from(view.byte_length).map_err(|_| outside())?;
    let end = start.checked_add(length).ok_or_else(outside)?;
    buffer.get(start..end).ok_or_else(outside)
}

impl<'a> Values<'a> {
    /// The accessor `index`, which must have `width` numbers per row.
    pub fn find(document: &Document, buffers: &'a Buffers, index: usize, width: usize) -> Result<Self, Malformed> {
        let malformed = |reason: &str| Malformed(format!("its accessor {index} {reason}"));
        let accessor = document
            .accessors
            .get(index)
            .ok_or_else(|| malformed("does not exist"))?;
        let component =
            Component::of(accessor.component_type).ok_or_else(|| malformed("has an unknown component type"))?;
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        if accessor.kind != kind {
            return Err(malformed(&format!("is not of type {kind}")));
        }
        let (Some(index_of_view), true) = (accessor.buffer_view, accessor.sparse.is_null()) else {
            return Err(malformed(
                "is sparse or has no values, which is not supported for splats",
            ));
        };
        let bytes = buffer_view_bytes(document, buffers, index_of_view)?;
        let row = width * component.size();
        let stride = document.buffer_views[index_of_view].byte_stride.unwrap_or(row as u64);
        let needed = match accessor.count {
            0 => 0,
            count => u128::from(count - 1) * u128::from(stride) + row as u128 + u128::from(accessor.byte_offset),
        };
        if stride < row as u64 || needed > bytes.len() as u128 {
            return Err(malformed(&format!(
                "declares {} rows, and its bufferView of {} bytes holds fewer",
                accessor.count,
                bytes.len()
            )));
        }
        Ok(Self {
            // Both fit: at most the length of the view, unless there is no row.
            bytes: bytes.get(accessor.byte_offset as usize..).unwrap_or_default(),
            stride: stride as usize,
            component,
            normalized: accessor.normalized,
            count: accessor.count as usize,
        })
    }

    /// The numbers of row `i`; normalised integers are fractions of their largest value.
    pub fn row<const N: usize>(&self, i: usize) -> [f32; N] {
        let row = &self.bytes[i * self.stride..];
        std::array::from_fn(|c| {
            let at = c * self.component.size();
            let pair = || [row[at], row[at + 1]];
            let four = || [row[at], row[at + 1], row[at + 2], row[at + 3]];
            let (value, max) = match self.component {
                Component::I8 => (f32::from(row[at] as i8), 127.0),
                Component::U8 => (f32::from(row[at]), 255.0),
                Component::I16 => (f32::from(i16::from_le_bytes(pair())), 32767.0),
                Component::U16 => (f32::from(u16::from_le_bytes(pair())), 65535.0),
                Component::U32 => (u32::from_le_bytes(four()) as f32, u32::MAX as f32),
                Component::F32 => return f32::from_le_bytes(four()),
            };
            if self.normalized {
                (value / max).max(-1.0)
            } else {
                value
            }
        })
    }
}
