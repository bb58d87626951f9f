use super::{Gpu, Readback, Work};
use crate::DeviceError;
use bytemuck::{NoUninit, Pod};
use std::sync::PoisonError;
use std::sync::atomic::Ordering;

/// Alignment of parts that are bound, words: 256 bytes, which every implementation accepts.
pub const PART_ALIGN: usize = 64;
/// Bytes read at a time, so that reading a large array takes little additional memory.
const READ_CHUNK_BYTES: usize = 32 << 20;

/// Memory on the device, in words of 32 bits, that grows and never shrinks.
#[derive(Debug)]
pub struct Array {
    label: &'static str,
    buffer: wgpu::Buffer,
    /// Start of the array in the buffer, bytes.
    first: u64,
    words: usize,
}

impl Array {
    /// `words` zeros.
    pub fn zeros(gpu: &Gpu, label: &'static str, words: usize) -> Self {
        Self {
            label,
            buffer: buffer(gpu, label, words),
            first: 0,
            words,
        }
    }

    /// `words` words of this array, starting at word `at`, as an array that shares the memory until this one grows. A part that is to be
    /// bound must start at a multiple of [`PART_ALIGN`] words.
    pub fn part(&self, at: usize, words: usize) -> Self {
        assert!(at + words <= self.words, "within {}", self.label);
        Self {
            label: self.label,
            buffer: self.buffer.clone(),
            first: self.first + 4 * at as u64,
            words,
        }
    }

    /// An array with the words of `values`.
    pub fn of<T: NoUninit>(gpu: &Gpu, label: &'static str, values: &[T]) -> Self {
        let array = Self::zeros(gpu, label, size_of_val(values) / 4);
        array.write(gpu, 0, values);
        array
    }

    /// Capacity in words.
    pub fn len(&self) -> usize {
        self.words
    }

    /// Whether the capacity is 0.
    pub fn is_empty(&self) -> bool {
        self.words == 0
    }

    /// Makes room for `words`. If the array has to grow, all its words become zero.
    pub fn reserve(&mut self, gpu: &Gpu, words: usize) {
        if words > self.words {
            // A quarter more: the number of intersections changes from frame to frame.
            let limit = (gpu.info.largest_array / 4) as usize;
            self.words = (words + words / 4).min(limit.max(words));
            self.buffer = buffer(gpu, self.label, self.words);
            self.first = 0;
        }
    }

    /// Writes `values` from word `at` on, before all work submitted later.
    pub fn write<T: NoUninit>(&self, gpu: &Gpu, at: usize, values: &[T]) {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        if !bytes.is_empty() {
            gpu.queue.write_buffer(&self.buffer, self.offset(at), bytes);
        }
    }

    /// Reads words from `at` on into `to`, after all work submitted so far. If the device has failed, they are zero.
    pub fn read<T: Pod>(&self, gpu: &Gpu, at: usize, to: &mut [T]) {
        let to: &mut [u8] = bytemuck::cast_slice_mut(to);
        if to.is_empty() {
            return;
        }
        let mut staging = gpu.staging.lock().unwrap_or_else(PoisonError::into_inner);
        let size = to.len().next_power_of_two().min(READ_CHUNK_BYTES);
        let staging = match &mut *staging {
            Some(staging) if staging.words() * 4 >= size => staging,
            staging => staging.insert(Readback::new(gpu, size / 4)),
        };
        for (i, piece) in to.chunks_mut(READ_CHUNK_BYTES).enumerate() {
            let work = Work::new(gpu);
            work.submit_reading(&self.part(at + i * READ_CHUNK_BYTES / 4, piece.len() / 4), staging);
            staging.take(gpu, piece);
        }
    }

    /// As [`Array::read`], returning the first `words` words.
    pub fn to_vec<T: Pod>(&self, gpu: &Gpu, words: usize) -> Vec<T> {
        let mut values = vec![T::zeroed(); 4 * words / size_of::<T>()];
        self.read(gpu, 0, &mut values);
        values
    }

    /// Checks that an array of `words` words can be bound.
    ///
    /// # Errors
    /// When it cannot; the error contains the device's limit.
    pub fn check(gpu: &Gpu, label: &'static str, words: usize) -> Result<(), DeviceError> {
        let (needed, limit) = (4 * words as u64, gpu.info.largest_array);
        if needed <= limit {
            Ok(())
        } else {
            Err(DeviceError::TooLarge {
                name: gpu.info.name.clone(),
                label,
                needed: needed.div_ceil(1_000_000),
                limit: limit / 1_000_000,
                fitting: None,
            })
        }
    }

    pub(super) fn buffer(&self) -> &wgpu::Buffer {
        &self.buffer
    }

    /// Position of word `at` in the buffer, bytes.
    pub(super) fn offset(&self, at: usize) -> u64 {
        self.first + 4 * at as u64
    }

    /// The whole array, as a binding.
    pub(super) fn binding(&self) -> wgpu::BufferBinding<'_> {
        wgpu::BufferBinding {
            buffer: &self.buffer,
            offset: self.first,
            size: std::num::NonZero::new(bytes(self.words)),
        }
    }
}

/// Bytes of memory for `words` words; never 0, since a binding must not be empty.
fn bytes(words: usize) -> u64 {
    4 * words.max(4) as u64
}

fn buffer(gpu: &Gpu, label: &'static str, words: usize) -> wgpu::Buffer {
    if let Err(error) = Array::check(gpu, label, words) {
        gpu.note(error);
    }
    gpu.memory_generation.fetch_add(1, Ordering::Relaxed);
    let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        size: bytes(words),
        usage: wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::UNIFORM
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    if pollster::block_on(scope.pop()).is_some() {
        gpu.note(DeviceError::OutOfMemory {
            name: gpu.info.name.clone(),
            label,
            needed: bytes(words).div_ceil(1_000_000),
            held: gpu.used_memory() / 1_000_000,
            fitting: None,
        });
    }
    buffer
}
