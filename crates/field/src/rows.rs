//! Lists aligned to a cache line.

use std::ops::{Deref, DerefMut};

/// Bytes per cache line, and per widest vector.
const CACHE_LINE: usize = 64;

/// A list aligned to a cache line, so that no vector of a panel's row spans two lines: with 64-byte vectors every load from an
/// unaligned list does, and costs twice. Shrinking keeps the memory. A clone has the same values, not necessarily aligned.
#[derive(Clone, Debug)]
pub struct Rows<T> {
    data: Vec<T>,
    start: usize,
    len: usize,
}

impl<T: Copy + Default> Rows<T> {
    /// Removes all values, keeping the memory.
    pub fn clear(&mut self) {
        self.len = 0;
    }

    /// Resizes to `len` values, filling new ones with `value`.
    pub fn resize(&mut self, len: usize, value: T) {
        let spare = CACHE_LINE / size_of::<T>();
        if self.start + len > self.data.len() {
            let mut data = vec![value; len + len / 2 + spare];
            // `align_offset` may decline to answer; any offset is then correct.
            let start = data.as_ptr().align_offset(CACHE_LINE).min(spare);
            data[start..start + self.len].copy_from_slice(self);
            (self.data, self.start) = (data, start);
        }
        let old = self.len;
        self.len = len;
        if old < len {
            self[old..].fill(value);
        }
    }

    /// Keeps the first `len` values.
    pub fn truncate(&mut self, len: usize) {
        self.len = self.len.min(len);
    }

    /// Appends values.
    pub fn extend_from_slice(&mut self, values: &[T]) {
        let old = self.len;
        self.resize(old + values.len(), T::default());
        self[old..].copy_from_slice(values);
    }
}

impl<T> Deref for Rows<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        &self.data[self.start..self.start + self.len]
    }
}

impl<T> DerefMut for Rows<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.data[self.start..self.start + self.len]
    }
}

impl<T> Default for Rows<T> {
    fn default() -> Self {
        Self {
            data: Vec::new(),
            start: 0,
            len: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resizes_like_a_vec_and_stays_aligned() {
        let mut rows = Rows::default();
        for len in [3usize, 1000, 17, 5000] {
            rows.clear();
            rows.resize(len, 1.5f32);
            assert_eq!((rows.len(), rows.iter().sum::<f32>()), (len, 1.5 * len as f32));
            assert_eq!(rows.as_ptr() as usize % CACHE_LINE, 0);
        }
        rows.truncate(2);
        rows.extend_from_slice(&[7.0]);
        assert_eq!(*rows.clone(), [1.5, 1.5, 7.0]);
    }
}
