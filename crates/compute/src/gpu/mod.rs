//! Compute on any GPU: WGSL on `wgpu` (Vulkan, Metal, DX12), with no toolkit to install.
//!
//! A [`Gpu`] owns the device; an [`Array`] is memory there, of 32-bit words; a [`Kernel`] is a compiled shader, and [`Work`]
//! records kernels that run one after another. Every stage has a twin on the CPU. Sums are computed in a fixed order, without
//! floating-point atomics, so that results have the same bytes from run to run on the same device.

mod array;
mod kernel;
mod profile;
mod readback;
mod scan;
mod sort;

pub use crate::shaders::{ADAM, GRID, HARMONICS, Shader};
pub use array::{Array, PART_ALIGN};
pub use kernel::{Kernel, Work};
pub use readback::Readback;
pub use scan::Scan;
pub use sort::Sort;

use crate::DeviceError;
use profile::Profile;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, LazyLock, Mutex, OnceLock, PoisonError};

/// Default number of threads per workgroup: the largest that every implementation supports.
pub const WORKGROUP_SIZE: u32 = 256;

/// What kind of processor an adapter is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// On the same chip as the CPU, sharing its memory.
    Integrated,
    /// In a virtual machine, or of unknown kind.
    Other,
    /// The CPU itself, such as Mesa's llvmpipe.
    Software,
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            AdapterKind::Discrete => "graphics card",
            AdapterKind::Integrated => "integrated GPU",
            AdapterKind::Other => "GPU",
            AdapterKind::Software => "software, on the CPU",
        })
    }
}

/// An adapter of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterInfo {
    /// The driver's name for it.
    pub name: String,
    /// The kind of processor.
    pub kind: AdapterKind,
    /// Vulkan, Metal or DX12.
    pub api: String,
    /// The driver and its version.
    pub driver: String,
    /// Bytes of the largest array.
    pub largest_array: u64,
    /// Bytes of memory that a workgroup shares.
    pub shared_memory: u32,
    /// Minimum and maximum number of threads per subgroup; 0 without subgroups.
    pub subgroup: [u32; 2],
    /// Whether it has everything that irradia needs.
    pub is_usable: bool,
}

/// Which adapter to open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// A real GPU, not software.
    Real,
    /// Any, a real one first.
    Any,
    /// The first whose name contains this, ignoring case.
    Named(String),
}

/// An open device. Work runs in the order in which it is submitted.
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    info: AdapterInfo,
    failure: Arc<Mutex<Option<DeviceError>>>,
    profile: OnceLock<Profile>,
    /// See [`Gpu::memory_generation`].
    memory_generation: AtomicU64,
    /// For [`Array::read`].
    staging: Mutex<Option<Readback>>,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_tuple("Gpu").field(&self.info).finish()
    }
}

/// Bytes that a workgroup of the largest kernel shares.
const SHARED_BYTES: u32 = 22 << 10;
/// Maximum number of storage arrays that a kernel binds.
const MAX_BINDINGS: u32 = 12;

/// The drivers of this machine, loaded once.
static INSTANCE: LazyLock<wgpu::Instance> = LazyLock::new(|| {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::PRIMARY,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
});

/// Bytes of stack for a driver's compiler, whose recursion may be as deep as a shader is large; threads of servers and tests have only
/// 2 MB.
const STACK_BYTES: usize = 32 << 20;

/// The one thread that loads drivers, opens devices and compiles shaders; it lives as long as the process. NVIDIA's driver does not
/// tolerate these calls on several threads at once (wgpu issue 10234), and may hang in a thread that ends after them (8365).
static DRIVER_THREAD: LazyLock<rayon::ThreadPool> = LazyLock::new(|| {
    let builder = rayon::ThreadPoolBuilder::new().num_threads(1).stack_size(STACK_BYTES);
    let builder = builder.thread_name(|_| "gpu driver".to_owned());
    builder.build().expect("a thread can be started")
});

/// The adapters of this machine, graphics cards first.
fn list() -> Vec<(wgpu::Adapter, AdapterInfo)> {
    let adapters = pollster::block_on(INSTANCE.enumerate_adapters(wgpu::Backends::PRIMARY));
    let mut list: Vec<_> = adapters
        .into_iter()
        .map(|adapter| {
            let info = describe(&adapter);
            (adapter, info)
        })
        .collect();
    list.sort_by_key(|(_, info)| info.kind);
    list
}

/// The first adapter of the wanted kind that is usable; `list` has graphics cards first.
fn chosen<A>(list: Vec<(A, AdapterInfo)>, wanted: &Wanted) -> Result<(A, AdapterInfo), DeviceError> {
    let is_wanted = |info: &AdapterInfo| match wanted {
        Wanted::Real => info.kind != AdapterKind::Software,
        Wanted::Any => true,
        Wanted::Named(name) => info.name.to_lowercase().contains(&name.to_lowercase()),
    };
    let found = list.into_iter().filter(|(_, info)| is_wanted(info));
    let (usable, others): (Vec<_>, Vec<_>) = found.partition(|(_, info)| info.is_usable);
    if let Some(first) = usable.into_iter().next() {
        return Ok(first);
    }
    Err(match (wanted, others.into_iter().next()) {
        (Wanted::Named(_), Some((_, info))) => DeviceError::Refused {
            name: info.name,
            reason: "its kernels have too few bindings, threads or bytes of shared memory".to_owned(),
        },
        (Wanted::Named(name), None) => DeviceError::None(format!("is called {name:?}")),
        (Wanted::Real, _) => DeviceError::None("was found".to_owned()),
        (Wanted::Any, _) => {
            DeviceError::None("was found; Mesa's software Vulkan would do (mesa-vulkan-drivers)".to_owned())
        }
    })
}

fn describe(adapter: &wgpu::Adapter) -> AdapterInfo {
    let (info, limits) = (adapter.get_info(), adapter.limits());
    let has_subgroups = adapter.features().contains(wgpu::Features::SUBGROUP);
    AdapterInfo {
        name: info.name,
        kind: match info.device_type {
            wgpu::DeviceType::DiscreteGpu => AdapterKind::Discrete,
            wgpu::DeviceType::IntegratedGpu => AdapterKind::Integrated,
            wgpu::DeviceType::Cpu => AdapterKind::Software,
            wgpu::DeviceType::VirtualGpu | wgpu::DeviceType::Other => AdapterKind::Other,
        },
        api: match info.backend {
            wgpu::Backend::Dx12 => "DX12".to_owned(),
            other => format!("{other:?}"),
        },
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        largest_array: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
        shared_memory: limits.max_compute_workgroup_storage_size,
        subgroup: if has_subgroups {
            [info.subgroup_min_size, info.subgroup_max_size]
        } else {
            [0; 2]
        },
        is_usable: limits.max_storage_buffers_per_shader_stage >= MAX_BINDINGS
            && limits.max_compute_invocations_per_workgroup >= WORKGROUP_SIZE
            && limits.max_compute_workgroup_storage_size >= SHARED_BYTES,
    }
}

impl Gpu {
    /// The adapters of this machine, graphics cards first.
    pub fn adapters() -> Vec<AdapterInfo> {
        DRIVER_THREAD.install(|| list().into_iter().map(|(_, info)| info).collect())
    }

    /// Opens an adapter.
    ///
    /// # Errors
    /// When there is none of the wanted kind, or its driver refuses.
    pub fn open(wanted: &Wanted) -> Result<Arc<Self>, DeviceError> {
        DRIVER_THREAD.install(|| Self::open_here(wanted))
    }

    fn open_here(wanted: &Wanted) -> Result<Arc<Self>, DeviceError> {
        let (adapter, info) = chosen(list(), wanted)?;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("irradia"),
            required_features: adapter.features() & wgpu::Features::TIMESTAMP_QUERY,
            required_limits: adapter.limits(),
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        };
        let (device, queue) =
            pollster::block_on(adapter.request_device(&descriptor)).map_err(|error| DeviceError::Refused {
                name: info.name.clone(),
                reason: one_line(&error.to_string()),
            })?;
        let failure = Arc::new(Mutex::new(None));
        let (lost, name) = (failure.clone(), info.name.clone());
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                note(&lost, failed(&name, &format!("it was lost: {message}")));
            }
        });
        let (noted, name) = (failure.clone(), info.name.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            note(&noted, failed(&name, &error.to_string()));
        }));
        Ok(Arc::new(Self {
            device,
            queue,
            info,
            failure,
            profile: OnceLock::new(),
            memory_generation: AtomicU64::new(0),
            staging: Mutex::default(),
        }))
    }

    /// The adapter that was opened.
    pub fn info(&self) -> &AdapterInfo {
        &self.info
    }

    /// Reports the first failure of the device since it was opened; after a failure, arrays hold unspecified words.
    ///
    /// # Errors
    /// When the device has failed.
    pub fn check(&self) -> Result<(), DeviceError> {
        match &*self.failure.lock().unwrap_or_else(PoisonError::into_inner) {
            None => Ok(()),
            Some(error) => Err(error.clone()),
        }
    }

    /// Records a failure that the device itself does not detect, or that a test simulates.
    pub fn fail(&self, reason: &str) {
        self.note(failed(&self.info.name, reason));
    }

    fn note(&self, error: DeviceError) {
        note(&self.failure, error);
    }

    /// Changes with every allocation, since it may replace the memory of an existing array.
    fn memory_generation(&self) -> u64 {
        self.memory_generation.load(Ordering::Relaxed)
    }

    /// Bytes of memory in use; 0 if the backend does not report it.
    pub fn used_memory(&self) -> u64 {
        let report = self.device.generate_allocator_report();
        report.map_or(0, |report| report.total_allocated_bytes)
    }

    /// From now on, measures each kernel by the device's clock, and waits for every submission. Returns whether the device has such a
    /// clock.
    pub fn start_profile(&self) -> bool {
        let has_clock = self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY);
        if has_clock {
            self.profile.get_or_init(|| Profile::new(&self.device, &self.queue));
        }
        has_clock
    }

    /// Seconds and calls of each kernel since [`Gpu::start_profile`] or the last call; empty if the device has no clock.
    pub fn take_profile(&self) -> BTreeMap<&'static str, (f64, u64)> {
        let profile = self.profile.get();
        profile.map_or_else(BTreeMap::new, |profile| {
            std::mem::take(&mut *profile.spent.lock().unwrap_or_else(PoisonError::into_inner))
        })
    }

    /// Waits until everything submitted is done.
    pub fn wait(&self) {
        self.wait_for(None);
    }

    /// Waits for a submission, or for all so far.
    fn wait_for(&self, submission_index: Option<wgpu::SubmissionIndex>) {
        let until = wgpu::PollType::Wait {
            submission_index,
            timeout: None,
        };
        if let Err(error) = self.device.poll(until) {
            self.fail(&error.to_string());
        }
    }
}

/// Records a failure, unless there is one already: the first is the cause.
fn note(failure: &Mutex<Option<DeviceError>>, error: DeviceError) {
    let mut failure = failure.lock().unwrap_or_else(PoisonError::into_inner);
    failure.get_or_insert(error);
}

fn failed(name: &str, reason: &str) -> DeviceError {
    DeviceError::Failed {
        name: name.to_owned(),
        reason: one_line(reason),
    }
}

/// The sum of the bits that are set, for a kernel's flags.
pub fn flags(bits: &[(bool, u32)]) -> u32 {
    bits.iter().filter(|(on, _)| *on).map(|(_, bit)| bit).sum()
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests;
