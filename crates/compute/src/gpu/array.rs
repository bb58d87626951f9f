use super::Gpu;
use crate::DeviceError;
use bytemuck::{NoUninit, Pod};

/// Memory on the device, in words of 32 bits, that grows and never shrinks.
#[derive(Debug)]
pub struct Array {
    label: &'static str,
    buffer: wgpu::Buffer,
    words: usize,
}

impl Array {
    /// `words` zeros.
    pub fn zeros(gpu: &Gpu, label: &'static str, words: usize) -> Self {
        Self {
            label,
            buffer: buffer(gpu, label, words),
            words,
        }
    }

    /// With the words of `values`.
    pub fn of<T: NoUninit>(gpu: &Gpu, label: &'static str, values: &[T]) -> Self {
        let array = Self::zeros(gpu, label, size_of_val(values) / 4);
        array.write(gpu, 0, values);
        array
    }

    /// Words that it has room for.
    pub fn len(&self) -> usize {
        self.words
    }

    /// Whether it has no room.
    pub fn is_empty(&self) -> bool {
        self.words == 0
    }

    /// Makes room for `words`. If there was too little, its words are zero now.
    pub fn reserve(&mut self, gpu: &Gpu, words: usize) {
        if words > self.words {
            // A quarter more: the number of intersections changes from frame to frame.
            let limit = (gpu.info.largest_array / 4) as usize;
            self.words = (words + words / 4).min(limit.max(words));
            self.buffer = buffer(gpu, self.label, self.words);
        }
    }

    /// Writes `values` from word `at` on, before whatever is submitted later.
    pub fn write<T: NoUninit>(&self, gpu: &Gpu, at: usize, values: &[T]) {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        if !bytes.is_empty() {
            gpu.queue.write_buffer(&self.buffer, 4 * at as u64, bytes);
        }
    }

    /// Reads words from `at` on into `to`, after everything submitted so far. Where the device has failed, they are zero.
    pub fn read<T: Pod>(&self, gpu: &Gpu, at: usize, to: &mut [T]) {
        let bytes = size_of_val(to) as u64;
        if bytes == 0 {
            return;
        }
        let staging = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(self.label),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&self.buffer, 4 * at as u64, &staging, 0, bytes);
        gpu.queue.submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        gpu.wait();
        match staging.get_mapped_range(..) {
            Ok(view) => bytemuck::cast_slice_mut(to).copy_from_slice(&view),
            Err(error) => {
                gpu.fail(&error.to_string());
                to.fill(T::zeroed());
            }
        }
    }

    /// As [`Array::read`], all of the first `words`.
    pub fn to_vec<T: Pod>(&self, gpu: &Gpu, words: usize) -> Vec<T> {
        let mut values = vec![T::zeroed(); 4 * words / size_of::<T>()];
        self.read(gpu, 0, &mut values);
        values
    }

    /// Whether an array of so many words can be bound.
    ///
    /// # Errors
    /// When it cannot: the device's limit is said.
    pub fn check(gpu: &Gpu, label: &'static str, words: usize) -> Result<(), DeviceError> {
        let (needed, limit) = (4 * words as u64, gpu.info.largest_array);
        match needed <= limit {
            true => Ok(()),
            false => Err(DeviceError::TooLarge {
                name: gpu.info.name.clone(),
                label,
                needed: needed.div_ceil(1_000_000),
                limit: limit / 1_000_000,
            }),
        }
    }

    pub(super) fn buffer(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}

fn buffer(gpu: &Gpu, label: &'static str, words: usize) -> wgpu::Buffer {
    if let Err(error) = Array::check(gpu, label, words) {
        gpu.fail(&error.to_string());
    }
    gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        // A binding is never empty.
        size: 4 * words.max(4) as u64,
        usage: wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::UNIFORM
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}
