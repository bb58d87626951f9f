//! Planar arrays: one contiguous run per component.

use rayon::prelude::*;

/// Values of a parallel task.
const VALUES_PER_TASK: usize = 1 << 14;
/// Values in the smallest page of memory, 4 KiB.
const VALUES_PER_PAGE: usize = 1 << 10;

/// Sets `to[k]` to `value(order[k])`.
fn collect(to: &mut [f32], order: &[u32], value: impl Fn(usize) -> f32 + Sync) {
    to.par_chunks_mut(VALUES_PER_TASK)
        .zip(order.par_chunks(VALUES_PER_TASK))
        .for_each(|(to, order)| {
            for (to, i) in to.iter_mut().zip(order) {
                *to = value(*i as usize);
            }
        });
}

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

    /// `count` planes of `len` unspecified values, whose memory the system has already supplied. Supplying it is slow (4.8 s for the
    /// 3.5 GB of a copy of five million splats in training), but can be done on a background thread.
    pub fn resident(count: usize, len: usize) -> Self {
        let mut planes = Self::zeros(count, len);
        planes
            .data
            .iter_mut()
            .step_by(VALUES_PER_PAGE)
            .for_each(|first| *first = 1.0);
        planes
    }

    /// Whether [`Self::copy_from`] `other` needs no further memory.
    pub fn has_room_for(&self, other: &Self) -> bool {
        self.data.capacity() >= other.data.len()
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

    /// The first N planes at once, mutable, including padding; slices beyond the last plane are empty.
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

    /// Gathers the items `indices`, in that order: for cloning, and for items that are edited separately.
    pub fn gather(&self, indices: &[u32]) -> Self {
        let mut out = Self::zeros(self.count, indices.len());
        for c in 0..self.count {
            collect(&mut out.plane_mut(c)[..indices.len()], indices, |i| self.plane(c)[i]);
        }
        out
    }

    /// Replaces the items by those with the indices `order`, in place, with a single plane of working memory in `scratch`: for
    /// pruning, sorting and growing. Indices from [`Planes::len`] on refer to the items of `added`, one array after the other; an
    /// index beyond the last gives zeros.
    ///
    /// # Panics
    /// When the number of planes differs.
    pub fn rearrange(&mut self, order: &[u32], added: &[&Self], scratch: &mut Vec<f32>) {
        assert!(added.iter().all(|other| other.count == self.count), "same components");
        let (old, new) = (self.stride, order.len().next_multiple_of(Self::ALIGN));
        if new > old {
            // Exact, since half a state of spare capacity would cost more than a later move.
            self.data.reserve_exact(self.count * (new - old));
            self.data.resize(self.count * new, 0.0);
        }
        scratch.resize(order.len(), 0.0);
        for turn in 0..self.count {
            // Planes move up or down in memory; in this order, none is overwritten before its turn.
            let c = if new > old { self.count - 1 - turn } else { turn };
            let plane = &self.data[c * old..][..self.len];
            let value = |i: usize| {
                let mut i = i;
                if let Some(value) = plane.get(i) {
                    return *value;
                }
                i -= plane.len();
                for other in added {
                    if i < other.len {
                        return other.data[c * other.stride + i];
                    }
                    i -= other.len;
                }
                0.0
            };
            collect(scratch, order, value);
            let to = &mut self.data[c * new..(c + 1) * new];
            let (to, padding) = to.split_at_mut(order.len());
            to.par_chunks_mut(VALUES_PER_TASK)
                .zip(scratch.par_chunks(VALUES_PER_TASK))
                .for_each(|(to, from)| to.copy_from_slice(from));
            padding.fill(0.0);
        }
        self.data.truncate(self.count * new);
        (self.len, self.stride) = (order.len(), new);
    }

    /// Becomes `len` items of zeros.
    pub fn reset(&mut self, len: usize) {
        self.reshape(self.count, len);
        self.clear();
    }

    /// Becomes a copy of `from`, made by all threads; reuses memory where possible.
    pub fn copy_from(&mut self, from: &Self) {
        if self.data.capacity() < from.data.len() {
            // Fresh pages are zero already: all threads touch them first as they copy.
            self.data = vec![0.0; from.data.len()];
        }
        self.data.resize(from.data.len(), 0.0);
        (self.count, self.len, self.stride) = (from.count, from.len, from.stride);
        self.data
            .par_chunks_mut(VALUES_PER_TASK)
            .zip(from.data.par_chunks(VALUES_PER_TASK))
            .for_each(|(to, from)| to.copy_from_slice(from));
    }

    /// Sets all values to zero, including padding.
    pub fn clear(&mut self) {
        self.data
            .par_chunks_mut(VALUES_PER_TASK)
            .for_each(|piece| piece.fill(0.0));
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
    fn gathered_items_match_interleaved_arrays() {
        let values: Vec<f32> = (0..51).map(|v| v as f32).collect();
        let planes = Planes::from_interleaved(3, &values);
        assert_eq!(
            (planes.len(), planes.stride(), planes.to_interleaved()),
            (17, 32, values)
        );
        let picked = planes.gather(&[16, 0, 3]);
        assert_eq!(
            picked.to_interleaved(),
            [48.0, 49.0, 50.0, 0.0, 1.0, 2.0, 9.0, 10.0, 11.0]
        );
    }

    /// Shrinking, keeping and growing, over several pieces, compared with one item at a time; with 1 and with 2 threads.
    #[test]
    fn rearranging_in_place_gives_what_item_by_item_gives_with_any_number_of_threads() {
        let n = 2 * VALUES_PER_TASK + 40;
        let items = |from: usize, n: usize| -> Vec<f32> { (from..from + 2 * n).map(|v| v as f32).collect() };
        let added = [3, VALUES_PER_TASK + 9].map(|n| Planes::from_interleaved(2, &items(1_000_000, n)));
        let total = n + added[0].len() + added[1].len();
        for (len, apart) in [(n / 3, 2), (n, 7), (total + 5, 11), (0, 1)] {
            // Every kind of index, out of order, with gaps and repetitions; some beyond the last item.
            let order: Vec<u32> = (0..len).map(|i| (i * apart % (total + 3)) as u32).collect();
            let all = [
                items(0, n),
                added[0].to_interleaved(),
                added[1].to_interleaved(),
                vec![0.0; 8],
            ]
            .concat();
            let expected: Vec<f32> = order
                .iter()
                .flat_map(|i| all[2 * *i as usize..][..2].to_vec())
                .collect();
            let mut copy = Planes::zeros(1, 3);
            for threads in [1, 2] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let mut planes = Planes::from_interleaved(2, &items(0, n));
                pool.install(|| planes.rearrange(&order, &[&added[0], &added[1]], &mut Vec::new()));
                assert_eq!(
                    planes,
                    Planes::from_interleaved(2, &expected),
                    "{len}, {threads} threads"
                );
                copy.copy_from(&planes);
                assert_eq!(copy, planes);
            }
        }
    }
}
