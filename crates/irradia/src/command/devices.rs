//! `irradia devices`

use crate::terminal::say;
use anyhow::Result;

/// Lists the GPUs, if this build can use any.
#[cfg(feature = "gpu")]
pub fn run() -> Result<()> {
    use irradia_compute::gpu::{AdapterInfo, Gpu};
    let line = |info: &AdapterInfo| {
        let subgroups = match info.subgroup {
            [0, _] => "no subgroups".to_owned(),
            [fewest, most] if fewest == most => format!("subgroups of {most}"),
            [fewest, most] => format!("subgroups of {fewest} to {most}"),
        };
        let unusable = if info.is_usable {
            ""
        } else {
            "; cannot be used: too few bindings"
        };
        format!(
            "{}: {}, {}, {}; arrays up to {} MB, {} kB shared, {subgroups}{unusable}",
            info.name,
            info.kind,
            info.api,
            info.driver,
            info.largest_array / 1_000_000,
            info.shared_memory / 1024,
        )
    };
    let gpus = Gpu::adapters();
    for info in &gpus {
        say(format_args!("{}", line(info)))?;
    }
    let threads = rayon::current_num_threads();
    say(format_args!(
        "cpu: {threads} threads, {}",
        irradia_compute::Level::detect().name()
    ))?;
    if gpus.is_empty() {
        say(format_args!(
            "no GPU was found: Vulkan, Metal or DX12 comes with its driver; Mesa has Vulkan in software (mesa-vulkan-drivers)"
        ))?;
    }
    Ok(())
}

/// Lists the CPU alone.
#[cfg(not(feature = "gpu"))]
pub fn run() -> Result<()> {
    let threads = rayon::current_num_threads();
    say(format_args!(
        "cpu: {threads} threads, {}",
        irradia_compute::Level::detect().name()
    ))?;
    say(format_args!("{}", irradia_compute::DeviceError::NotBuilt))
}
