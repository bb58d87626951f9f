//! `irradia devices`

use crate::terminal::print_line;
use anyhow::Result;

/// Lists what `--device` can name.
pub fn run() -> Result<()> {
    let gpus = gpus();
    for gpu in &gpus {
        print_line(gpu)?;
    }
    let threads = rayon::current_num_threads();
    let level = irradia_compute::Level::detect().name();
    print_line(format_args!("cpu: {threads} threads, {level}"))?;
    if cfg!(not(feature = "gpu")) {
        print_line(irradia_compute::DeviceError::NotBuilt)?;
    } else if gpus.is_empty() {
        print_line(
            "no GPU found: its driver must provide Vulkan, Metal or DX12; Mesa has a software Vulkan (mesa-vulkan-drivers)",
        )?;
    }
    Ok(())
}

/// The GPUs, one line each.
#[cfg(feature = "gpu")]
fn gpus() -> Vec<String> {
    use irradia_compute::gpu::{AdapterInfo, Gpu};
    let line = |info: AdapterInfo| {
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
    Gpu::adapters().into_iter().map(line).collect()
}

/// Without the feature there are none.
#[cfg(not(feature = "gpu"))]
fn gpus() -> Vec<String> {
    Vec::new()
}
