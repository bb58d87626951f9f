//! Where numbers are computed: the CPU, or a GPU.

use std::fmt;
use std::str::FromStr;
#[cfg(feature = "gpu")]
use {
    crate::gpu::{Gpu, Wanted},
    std::sync::Arc,
};

/// Why a device cannot be used: one line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// There is no GPU of the wanted kind.
    #[error("no GPU {0}; irradia devices lists what is there")]
    None(String),
    /// This build has no GPU.
    #[error("this irradia was built without its feature gpu")]
    NotBuilt,
    /// The driver refuses.
    #[error("the GPU {name} cannot be used: {reason}")]
    Refused {
        /// Its name.
        name: String,
        /// The driver's words.
        reason: String,
    },
    /// It failed at work.
    #[error("the GPU {name} failed: {reason}")]
    Failed {
        /// Its name.
        name: String,
        /// The driver's words.
        reason: String,
    },
    /// Memory for one array is above what the device binds at once.
    #[error(
        "{label} need {needed} MB in one piece, and the GPU {name} binds {limit} MB at most: use fewer splats (--max-splats), smaller \
         photographs (--max-side), or --device cpu"
    )]
    TooLarge {
        /// Its name.
        name: String,
        /// What was to be stored.
        label: &'static str,
        /// Megabytes.
        needed: u64,
        /// Megabytes.
        limit: u64,
    },
}

/// Which device is wanted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The CPU.
    #[default]
    Cpu,
    /// A real GPU if there is one, else the CPU.
    Auto,
    /// Any GPU, a real one first, software if there is no other.
    Gpu,
    /// The first GPU whose name contains this.
    Named(String),
}

impl FromStr for DeviceChoice {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "cpu" => DeviceChoice::Cpu,
            "auto" => DeviceChoice::Auto,
            "gpu" => DeviceChoice::Gpu,
            name => DeviceChoice::Named(name.to_owned()),
        })
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            DeviceChoice::Cpu => "cpu",
            DeviceChoice::Auto => "auto",
            DeviceChoice::Gpu => "gpu",
            DeviceChoice::Named(name) => name,
        })
    }
}

/// A device to compute on.
#[derive(Clone, Debug, Default)]
pub enum Device {
    /// The CPU, with all threads.
    #[default]
    Cpu,
    /// A GPU.
    #[cfg(feature = "gpu")]
    Gpu(Arc<Gpu>),
}

impl Device {
    /// Opens a device.
    ///
    /// # Errors
    /// When there is no such GPU, or its driver refuses. [`DeviceChoice::Auto`] takes the CPU then.
    pub fn open(choice: &DeviceChoice) -> Result<Self, DeviceError> {
        #[cfg(feature = "gpu")]
        return match choice {
            DeviceChoice::Cpu => Ok(Device::Cpu),
            DeviceChoice::Auto => Ok(Gpu::open(&Wanted::Real).map_or(Device::Cpu, Device::Gpu)),
            DeviceChoice::Gpu => Gpu::open(&Wanted::Any).map(Device::Gpu),
            DeviceChoice::Named(name) => Gpu::open(&Wanted::Named(name.clone())).map(Device::Gpu),
        };
        #[cfg(not(feature = "gpu"))]
        match choice {
            DeviceChoice::Cpu | DeviceChoice::Auto => Ok(Device::Cpu),
            DeviceChoice::Gpu | DeviceChoice::Named(_) => Err(DeviceError::NotBuilt),
        }
    }

    /// Whether it is the CPU.
    pub fn is_cpu(&self) -> bool {
        matches!(self, Device::Cpu)
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Device::Cpu => f.write_str("the CPU"),
            #[cfg(feature = "gpu")]
            Device::Gpu(gpu) => {
                let info = gpu.info();
                write!(f, "the GPU {} ({}, {})", info.name, info.kind, info.api)
            }
        }
    }
}
