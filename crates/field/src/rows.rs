//! Lists that begin on a cache line.

use std::ops::{Deref, DerefMut};

/// Bytes of a cache line, and of the widest vector.
const LINE: usize = 64;

/// A list whose first value lies on a cache line, so that no vector of a panel's row spans two: with 64-byte vectors every load
/// of an ordinary list does, and costs twice. Memory is kept when it gets shorter. A clone has the values, and may have them elsewhere.
#[derive(Clone, Debug)]
pub struct Rows<T> {
    data: Vec<T>,
    start: usize,
    len: usize,
}

impl<T: Copy + Default> Rows<T> {
    /// No values, the memory kept.
    pub fn clear(&mut self) {
        self.len = 0;
    }

    /// The first `len` values, new ones being `value`.
    pub fn resize(&mut self, len: usize, value: T) {
        let spare = LINE / size_of::<T>();
        if self.start + len > self.data.len() {
            let mut data = vec![value; len + len / 2 + spare];
            // Where the address tells nothing (it may not), 0 is as right as any.
            let start = data.as_ptr().align_offset(LINE).min(spare);
            data[start..start + self.len].copy_from_slice(self);
            (self.data, self.start) = (data, start);
        }
        let old = self.len;
        self.len = len;
        if old < len {
            self[old..].fill(value);
        }
    }

    /// The first `len` values.
    pub fn truncate(&mut self, len: usize) {
        self.len = self.len.min(len);
    }

    /// Adds values behind.
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
    fn grows_and_shrinks_as_a_list_does_and_stays_on_the_line() {
        let mut rows = Rows::default();
        for len in [3usize, 1000, 17, 5000] {
            rows.clear();
            rows.resize(len, 1.5f32);
            assert_eq!((rows.len(), rows.iter().sum::<f32>()), (len, 1.5 * len as f32));
            assert_eq!(rows.as_ptr() as usize % LINE, 0);
        }
        rows.truncate(2);
        rows.extend_from_slice(&[7.0]);
        assert_eq!(*rows.clone(), [1.5, 1.5, 7.0]);
    }
}
