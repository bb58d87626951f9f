use super::{Array, Gpu, Shader};
use std::borrow::Cow;

/// A compiled shader.
#[derive(Debug)]
pub struct Kernel {
    name: &'static str,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

impl Kernel {
    /// Compiles. Drivers keep what they compiled on disk.
    pub fn new(gpu: &Gpu, shader: &Shader) -> Self {
        Self::with_constants(gpu, shader, "")
    }

    /// As [`Kernel::new`], with the text `constants` before the shader's.
    pub fn with_constants(gpu: &Gpu, shader: &Shader, constants: &str) -> Self {
        let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(shader.name),
            source: wgpu::ShaderSource::Wgsl(Cow::Owned(format!("{constants}{}", shader.source()))),
        });
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(shader.name),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                // Kernels write before they read.
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        Self {
            name: shader.name,
            layout: pipeline.get_bind_group_layout(0),
            pipeline,
        }
    }
}

/// Workgroups along one axis at most (WebGPU's limit).
const LINE: u32 = 65_535;

/// Kernels that run one after another, recorded to be submitted together.
pub struct Work<'a> {
    gpu: &'a Gpu,
    pub(super) encoder: wgpu::CommandEncoder,
    /// Names of the kernels, for the profile.
    names: Vec<&'static str>,
}

impl<'a> Work<'a> {
    /// Nothing yet.
    pub fn new(gpu: &'a Gpu) -> Self {
        Self {
            gpu,
            encoder: gpu.device.create_command_encoder(&Default::default()),
            names: Vec::new(),
        }
    }

    /// The device.
    pub fn gpu(&self) -> &'a Gpu {
        self.gpu
    }

    /// Runs `kernel` with `groups` workgroups on `arrays`, in the order of its bindings. More groups than fit in a line are put into
    /// rows, and a few more may run: the kernel finds its number with `group_index` and ignores those beyond its data.
    pub fn run(&mut self, kernel: &Kernel, arrays: &[&Array], groups: usize) {
        if groups == 0 {
            return;
        }
        let entries: Vec<wgpu::BindGroupEntry> = (0..)
            .zip(arrays)
            .map(|(binding, array)| wgpu::BindGroupEntry {
                binding,
                resource: wgpu::BindingResource::Buffer(array.binding()),
            })
            .collect();
        let bindings = self.gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(kernel.name),
            layout: &kernel.layout,
            entries: &entries,
        });
        let profile = self.gpu.profile.get();
        let timestamp_writes = profile.and_then(|profile| profile.writes(self.names.len()));
        self.names.push(kernel.name);
        let mut pass = self.encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: Some(kernel.name),
            timestamp_writes,
        });
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        let rows = (groups as u32).div_ceil(LINE);
        pass.dispatch_workgroups((groups as u32).div_ceil(rows), rows, 1);
    }

    /// Sets the first `words` of `array` to zero.
    pub fn clear(&mut self, array: &Array, words: usize) {
        if words > 0 {
            self.encoder
                .clear_buffer(array.buffer(), array.offset(0), Some(4 * words as u64));
        }
    }

    /// Copies the first `words` of `from` to `to`.
    pub fn copy(&mut self, from: &Array, to: &Array, words: usize) {
        if words > 0 {
            self.encoder.copy_buffer_to_buffer(
                from.buffer(),
                from.offset(0),
                to.buffer(),
                to.offset(0),
                4 * words as u64,
            );
        }
    }

    /// Hands it to the device, which begins at once.
    pub fn submit(self) {
        self.hand_over();
    }

    pub(super) fn hand_over(self) -> wgpu::SubmissionIndex {
        match self.gpu.profile.get() {
            Some(profile) => profile.submit(self.gpu, self.encoder, &self.names),
            None => self.gpu.queue.submit([self.encoder.finish()]),
        }
    }
}
