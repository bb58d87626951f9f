//! Planar arrays: one contiguous run per component.

/// Components ("planes") of `len` items each, planar: `[planes, stride]` with `stride >= len` a multiple of
/// [`Planes::ALIGN`], so that every plane can be read in whole vectors. Values past `len` are padding, initially zero.
///
/// Planar, because sixteen neighbours of one component are then a single load; an interleaved `[N, 3]` needs a gather.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Planes {
    data: Vec<f32>,
    count: usize,
    len: usize,
    stride: usize,
}

impl Planes {
    /// The stride is a multiple of this, the width of the widest vector.
    pub const ALIGN: usize = 16;

    /// `count` planes of `len` zeros.
    pub fn zeros(count: usize, len: usize) -> Self {
        let stride = len.next_multiple_of(Self::ALIGN);
        Self {
            data: vec![0.0; count * stride],
            count,
            len,
            stride,
        }
    }

    /// Converts from interleaved `[N, count]` values.
    ///
    /// # Panics
    /// When the length is not a multiple of `count`.
    pub fn from_interleaved(count: usize, values: &[f32]) -> Self {
        assert_eq!(values.len() % count, 0, "whole items");
        let mut planes = Self::zeros(count, values.len() / count);
        for (i, item) in values.chunks_exact(count).enumerate() {
            for (c, value) in item.iter().enumerate() {
                planes.data[c * planes.stride + i] = *value;
            }
        }
        planes
    }

    /// Converts to interleaved `[N, count]` values.
    pub fn to_interleaved(&self) -> Vec<f32> {
        let mut values = Vec::with_capacity(self.len * self.count);
        for i in 0..self.len {
            values.extend((0..self.count).map(|c| self.data[c * self.stride + i]));
        }
        values
    }

    /// Items per plane.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no items.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of planes.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Length of a plane including padding.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// Plane `c`, including padding.
    pub fn plane(&self, c: usize) -> &[f32] {
        &self.data[c * self.stride..(c + 1) * self.stride]
    }

    /// Plane `c`, mutable, including padding.
    pub fn plane_mut(&mut self, c: usize) -> &mut [f32] {
        &mut self.data[c * self.stride..(c + 1) * self.stride]
    }

    /// The first N planes at once, mutable, including padding; beyond the last plane empty slices.
    pub fn planes_mut<const N: usize>(&mut self) -> [&mut [f32]; N] {
        let mut planes = self.data.chunks_mut(self.stride.max(1));
        std::array::from_fn(|_| planes.next().unwrap_or_default())
    }

    /// All planes in order, `[count, stride]`.
    pub fn as_slice(&self) -> &[f32] {
        &self.data
    }

    /// All planes in order, mutable; `chunks_mut(stride)` yields the planes.
    pub fn as_mut_slice(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// Component `c` of item `i`.
    pub fn get(&self, c: usize, i: usize) -> f32 {
        debug_assert!(i < self.len);
        self.data[c * self.stride + i]
    }

    /// Sets component `c` of item `i`.
    pub fn set(&mut self, c: usize, i: usize, value: f32) {
        debug_assert!(i < self.len);
        self.data[c * self.stride + i] = value;
    }

    /// Gathers the items `indices`, in that order: for pruning, sorting and cloning.
    pub fn gather(&self, indices: &[u32]) -> Self {
        let mut out = Self::zeros(self.count, indices.len());
        for c in 0..self.count {
            let from = self.plane(c);
            for (to, i) in out.plane_mut(c).iter_mut().zip(indices) {
                *to = from[*i as usize];
            }
        }
        out
    }

    /// Appends the items of `other`.
    ///
    /// # Panics
    /// When the number of planes differs.
    pub fn append(&mut self, other: &Self) {
        assert_eq!(self.count, other.count, "same components");
        let mut out = Self::zeros(self.count, self.len + other.len);
        for c in 0..self.count {
            let to = out.plane_mut(c);
            to[..self.len].copy_from_slice(&self.plane(c)[..self.len]);
            to[self.len..self.len + other.len].copy_from_slice(&other.plane(c)[..other.len]);
        }
        *self = out;
    }

    /// Sets all values to zero, including padding.
    pub fn clear(&mut self) {
        self.data.fill(0.0);
    }

    /// Changes the shape, leaving values unspecified; reuses memory where possible.
    pub fn reshape(&mut self, count: usize, len: usize) {
        let stride = len.next_multiple_of(Self::ALIGN);
        if (self.count, self.len) != (count, len) {
            self.data.resize(count * stride, 0.0);
            (self.count, self.len, self.stride) = (count, len, stride);
        }
    }

    /// Memory used, bytes.
    pub fn bytes(&self) -> usize {
        self.data.capacity() * size_of::<f32>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gather_and_append_match_interleaved_arrays() {
        let values: Vec<f32> = (0..51).map(|v| v as f32).collect();
        let mut planes = Planes::from_interleaved(3, &values);
        assert_eq!(
            (planes.len(), planes.stride(), planes.to_interleaved()),
            (17, 32, values)
        );
        let picked = planes.gather(&[16, 0, 3]);
        assert_eq!(
            picked.to_interleaved(),
            [48.0, 49.0, 50.0, 0.0, 1.0, 2.0, 9.0, 10.0, 11.0]
        );
        planes.append(&picked);
        assert_eq!((planes.len(), planes.get(1, 17), planes.get(2, 19)), (20, 49.0, 11.0));
        assert!(planes.plane(0)[20..].iter().all(|v| *v == 0.0), "padding stays zero");
    }
}
