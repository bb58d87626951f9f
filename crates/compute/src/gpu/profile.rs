use super::Gpu;
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

/// Maximum number of kernels measured per submission.
const MAX_KERNELS: u32 = 1024;

/// Seconds of each kernel by the device's own clock. While profiling, the host waits for every submission.
#[derive(Debug)]
pub(super) struct Profile {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    /// Seconds per tick.
    tick: f64,
    /// Seconds and calls, by kernel.
    pub spent: Mutex<BTreeMap<&'static str, (f64, u64)>>,
}

impl Profile {
    pub fn new(device: &wgpu::Device, queue: &wgpu::Queue) -> Self {
        let size = u64::from(2 * MAX_KERNELS) * 8;
        let buffer = |usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("times"),
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        Self {
            queries: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("times"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * MAX_KERNELS,
            }),
            resolved: buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC),
            staging: buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST),
            tick: f64::from(queue.get_timestamp_period()) * 1e-9,
            spent: Mutex::default(),
        }
    }

    /// Where kernel `i` of a submission writes its times, if there is room.
    pub fn writes(&self, i: usize) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let i = i as u32;
        (i < MAX_KERNELS).then_some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(2 * i),
            end_of_pass_write_index: Some(2 * i + 1),
        })
    }

    /// Submits, waits, and adds the times of the kernels `names`.
    pub fn submit(
        &self,
        gpu: &Gpu,
        mut encoder: wgpu::CommandEncoder,
        names: &[&'static str],
    ) -> wgpu::SubmissionIndex {
        let names = &names[..names.len().min(MAX_KERNELS as usize)];
        let count = 2 * names.len() as u32;
        encoder.resolve_query_set(&self.queries, 0..count, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, 8 * u64::from(count));
        let submission = gpu.queue.submit([encoder.finish()]);
        self.staging.map_async(wgpu::MapMode::Read, .., |_| {});
        gpu.wait();
        if let Ok(view) = self.staging.get_mapped_range(..) {
            let ticks: &[u64] = bytemuck::cast_slice(&view);
            let mut spent = self.spent.lock().unwrap_or_else(PoisonError::into_inner);
            for (name, ticks) in names.iter().zip(ticks.chunks_exact(2)) {
                let (seconds, calls) = spent.entry(name).or_default();
                *seconds += ticks[1].saturating_sub(ticks[0]) as f64 * self.tick;
                *calls += 1;
            }
        }
        self.staging.unmap();
        submission
    }
}
