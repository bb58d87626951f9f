use super::{Array, Gpu, Work};
use bytemuck::{Pod, Zeroable};

/// Words on their way from the device to the host. The host waits only for the submission that sent them, not for later ones, so that
/// the device still has work while the host reads.
#[derive(Debug)]
pub struct Readback {
    staging: wgpu::Buffer,
    words: usize,
    /// The submission that sent them and their number of bytes, until they are taken.
    sent: Option<(wgpu::SubmissionIndex, u64)>,
}

impl Readback {
    /// Room for `words`.
    pub fn new(gpu: &Gpu, words: usize) -> Self {
        Self {
            staging: gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("readback"),
                size: 4 * words as u64,
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            }),
            words,
            sent: None,
        }
    }

    /// Capacity in words.
    pub fn words(&self) -> usize {
        self.words
    }

    /// Whether words are on their way.
    pub fn is_pending(&self) -> bool {
        self.sent.is_some()
    }

    /// Waits for the words sent last, which must have the length of `to`. They are zero if the device has failed or nothing was sent.
    pub fn take<T: Pod + Zeroable>(&mut self, gpu: &Gpu, to: &mut [T]) {
        to.fill(T::zeroed());
        let Some((submission, bytes)) = self.sent.take() else {
            return;
        };
        gpu.wait_for(Some(submission));
        match self.staging.get_mapped_range(..bytes) {
            Ok(view) => bytemuck::cast_slice_mut(to).copy_from_slice(&view),
            Err(error) => gpu.fail(&error.to_string()),
        }
        self.staging.unmap();
    }
}

impl Work<'_> {
    /// As [`Work::submit`]; afterwards the words of `array` are copied to `to`.
    pub fn submit_reading(mut self, array: &Array, to: &mut Readback) {
        let bytes = 4 * array.len() as u64;
        if to.sent.take().is_some() {
            to.staging.unmap();
        }
        self.encoder()
            .copy_buffer_to_buffer(array.buffer(), array.offset(0), &to.staging, 0, bytes);
        let submission = self.submit_indexed();
        to.staging.map_async(wgpu::MapMode::Read, ..bytes, |_| {});
        to.sent = Some((submission, bytes));
    }
}
