use super::{Array, DRIVER_THREAD, Gpu, Shader};
use std::borrow::Cow;
use std::sync::{Mutex, PoisonError};

/// A compiled shader.
#[derive(Debug)]
pub struct Kernel {
    name: &'static str,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    bound: Mutex<Bound>,
}

/// The sets of arrays on which a kernel was run, kept for the next step.
#[derive(Debug, Default)]
struct Bound {
    /// [`Gpu::memory_generation`] at which they were created: sets of earlier generations may hold memory that is no longer used.
    generation: u64,
    groups: Vec<(Vec<Place>, wgpu::BindGroup)>,
}

/// Buffer, first byte, words.
type Place = (wgpu::Buffer, u64, usize);

/// Maximum number of sets of arrays that a kernel remembers.
const MAX_CACHED_BINDINGS: usize = 16;

impl Kernel {
    /// Compiles `shader`. Drivers cache their results on disk.
    pub fn new(gpu: &Gpu, shader: &Shader) -> Self {
        Self::with_constants(gpu, shader, "")
    }

    /// As [`Kernel::new`], with the text `constants` before the shader's source.
    pub fn with_constants(gpu: &Gpu, shader: &Shader, constants: &str) -> Self {
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some(shader.name),
            source: wgpu::ShaderSource::Wgsl(Cow::Owned(format!("{constants}{}", shader.source()))),
        };
        let pipeline = DRIVER_THREAD.install(|| compile(gpu, shader.name, descriptor));
        Self {
            name: shader.name,
            layout: pipeline.get_bind_group_layout(0),
            pipeline,
            bound: Mutex::default(),
        }
    }

    /// Binds `arrays`; reuses the bind group of an earlier run on the same arrays.
    fn bind(&self, gpu: &Gpu, arrays: &[&Array]) -> wgpu::BindGroup {
        let mut bound = self.bound.lock().unwrap_or_else(PoisonError::into_inner);
        let generation = gpu.memory_generation();
        if bound.generation != generation {
            bound.groups.clear();
            bound.generation = generation;
        }
        let is_same = |places: &[Place]| {
            places.len() == arrays.len()
                && places.iter().zip(arrays).all(|((buffer, first, words), array)| {
                    buffer == array.buffer() && *first == array.offset(0) && *words == array.len()
                })
        };
        if let Some((_, group)) = bound.groups.iter().find(|(places, _)| is_same(places)) {
            return group.clone();
        }
        let entries: Vec<wgpu::BindGroupEntry> = (0..)
            .zip(arrays)
            .map(|(binding, array)| wgpu::BindGroupEntry {
                binding,
                resource: wgpu::BindingResource::Buffer(array.binding()),
            })
            .collect();
        let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(self.name),
            layout: &self.layout,
            entries: &entries,
        });
        let places = arrays
            .iter()
            .map(|array| (array.buffer().clone(), array.offset(0), array.len()));
        if bound.groups.len() == MAX_CACHED_BINDINGS {
            bound.groups.clear();
        }
        bound.groups.push((places.collect(), group.clone()));
        group
    }
}

fn compile(gpu: &Gpu, name: &str, descriptor: wgpu::ShaderModuleDescriptor) -> wgpu::ComputePipeline {
    let mut checks = wgpu::ShaderRuntimeChecks::checked();
    // Loop bounding puts a counter into every loop, which also keeps drivers from unrolling it: without it, an H100 takes 8.0 ms per
    // step instead of 10.9 (`speed -- gpu 1000000@1920x1080`). Array bounds are still checked.
    checks.force_loop_bounding = false;
    // SAFETY: shaders are this project's own, and their loops end: each counts up to a bound, or follows a ray to its end.
    let module = unsafe { gpu.device.create_shader_module_trusted(descriptor, checks) };
    gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(name),
        layout: None,
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions {
            // Kernels write this memory before they read it.
            zero_initialize_workgroup_memory: false,
            ..Default::default()
        },
        cache: None,
    })
}

/// Maximum number of workgroups along one axis (WebGPU's limit).
const MAX_GROUPS_PER_AXIS: u32 = 65_535;

/// Kernels that run one after another, recorded to be submitted together.
pub struct Work<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    /// The pass that kernels are added to.
    pass: Option<wgpu::ComputePass<'static>>,
    /// Names of the kernels, for the profile.
    names: Vec<&'static str>,
}

impl<'a> Work<'a> {
    /// Work without any kernel.
    pub fn new(gpu: &'a Gpu) -> Self {
        Self {
            gpu,
            encoder: gpu.device.create_command_encoder(&Default::default()),
            pass: None,
            names: Vec::new(),
        }
    }

    /// The device.
    pub fn gpu(&self) -> &'a Gpu {
        self.gpu
    }

    /// Runs `kernel` with `groups` workgroups on `arrays`, in the order of its bindings. Groups beyond the limit of one axis are
    /// dispatched in rows, which may add a few: kernels compute the number of a group with `group_index` and ignore those beyond their
    /// data.
    pub fn run(&mut self, kernel: &Kernel, arrays: &[&Array], groups: usize) {
        if groups == 0 {
            return;
        }
        let bindings = kernel.bind(self.gpu, arrays);
        let profile = self.gpu.profile.get();
        if profile.is_some() {
            // Times are measured per pass.
            self.pass = None;
        }
        let encoder = &mut self.encoder;
        let pass = self.pass.get_or_insert_with(|| {
            let timestamp_writes = profile.and_then(|profile| profile.writes(self.names.len()));
            let descriptor = wgpu::ComputePassDescriptor {
                label: Some(kernel.name),
                timestamp_writes,
            };
            encoder.begin_compute_pass(&descriptor).forget_lifetime()
        });
        self.names.push(kernel.name);
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        let rows = (groups as u32).div_ceil(MAX_GROUPS_PER_AXIS);
        pass.dispatch_workgroups((groups as u32).div_ceil(rows), rows, 1);
    }

    /// The encoder, for commands between kernels.
    pub(super) fn encoder(&mut self) -> &mut wgpu::CommandEncoder {
        self.pass = None;
        &mut self.encoder
    }

    /// Sets the first `words` of `array` to zero.
    pub fn clear(&mut self, array: &Array, words: usize) {
        if words > 0 {
            self.encoder()
                .clear_buffer(array.buffer(), array.offset(0), Some(4 * words as u64));
        }
    }

    /// Copies the first `words` of `from` to `to`.
    pub fn copy(&mut self, from: &Array, to: &Array, words: usize) {
        if words > 0 {
            self.encoder().copy_buffer_to_buffer(
                from.buffer(),
                from.offset(0),
                to.buffer(),
                to.offset(0),
                4 * words as u64,
            );
        }
    }

    /// Submits the work to the device, which starts at once.
    pub fn submit(self) {
        self.submit_indexed();
    }

    pub(super) fn submit_indexed(mut self) -> wgpu::SubmissionIndex {
        self.pass = None;
        match self.gpu.profile.get() {
            Some(profile) => profile.submit(self.gpu, self.encoder, &self.names),
            None => self.gpu.queue.submit([self.encoder.finish()]),
        }
    }
}
