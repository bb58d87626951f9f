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
    #[error("no GPU {0}; irradia devices lists all devices")]
    None(String),
    /// This build does not support GPUs.
    #[error("this build of irradia does not have the feature gpu")]
    NotBuilt,
    /// The driver refuses.
    #[error("the GPU {name} cannot be used: {reason}")]
    Refused {
        /// Its name.
        name: String,
        /// The driver's message.
        reason: String,
    },
    /// The device failed after it was opened.
    #[error("the GPU {name} failed: {reason}")]
    Failed {
        /// Its name.
        name: String,
        /// The driver's message.
        reason: String,
    },
    /// An array is larger than the device can bind.
    #[error(
        "{label} need {needed} MB in one piece, and the GPU {name} binds {limit} MB at most: use fewer splats ({}), smaller photographs \
         (--max-side), or --device cpu",
        max_splats(fitting)
    )]
    TooLarge {
        /// Its name.
        name: String,
        /// Name of the array.
        label: &'static str,
        /// Its size, megabytes.
        needed: u64,
        /// The largest array that the device binds, megabytes.
        limit: u64,
        /// About how many splats would fit.
        fitting: Option<usize>,
    },
    /// The device has no more memory.
    #[error(
        "{label} need {needed} MB, and the GPU {name} has no room for them beside the {held} MB in use: use fewer splats ({}), smaller \
         photographs (--max-side), or --device cpu",
        max_splats(fitting)
    )]
    OutOfMemory {
        /// Its name.
        name: String,
        /// Name of the array.
        label: &'static str,
        /// Its size, megabytes.
        needed: u64,
        /// Memory in use, megabytes.
        held: u64,
        /// About how many splats would fit.
        fitting: Option<usize>,
    },
}

fn max_splats(fitting: &Option<usize>) -> String {
    fitting.map_or_else(|| "--max-splats".to_owned(), |splats| format!("--max-splats {splats}"))
}

impl DeviceError {
    /// Adds the number of splats that would fit, in whole thousands, given that `splats` did not: memory is proportional to them.
    #[must_use]
    pub fn at_splats(mut self, splats: usize) -> Self {
        let share = |part: u64, whole: u64| splats as u64 * part / whole.max(1);
        let (fitting, most) = match &mut self {
            DeviceError::TooLarge {
                needed, limit, fitting, ..
            } => (fitting, share(*limit, *needed)),
            // A tenth less than the memory in use, since arrays differ in size.
            DeviceError::OutOfMemory {
                needed, held, fitting, ..
            } => (fitting, share(*held * 9, (*held + *needed) * 10)),
            _ => return self,
        };
        *fitting = Some((most / 1000 * 1000) as usize).filter(|splats| *splats > 0);
        self
    }
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
    /// When there is no such GPU, or its driver refuses. [`DeviceChoice::Auto`] falls back to the CPU instead.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_is_said_with_what_would_in_one_line() {
        let name = "card".to_owned();
        let error = DeviceError::TooLarge {
            name: name.clone(),
            label: "harmonics",
            needed: 4000,
            limit: 2000,
            fitting: None,
        };
        assert!(error.to_string().contains("fewer splats (--max-splats)"));
        let line = error.at_splats(6_000_500).to_string();
        assert!(
            line.contains("harmonics need 4000 MB") && line.contains("--max-splats 3000000"),
            "{line}"
        );
        let error = DeviceError::OutOfMemory {
            name,
            label: "harmonics",
            needed: 1000,
            held: 9000,
            fitting: None,
        };
        let line = error.at_splats(1_000_000).to_string();
        assert!(
            line.contains("beside the 9000 MB") && line.contains("--max-splats 810000"),
            "{line}"
        );
        assert!(!line.contains('\n'));
    }
}
