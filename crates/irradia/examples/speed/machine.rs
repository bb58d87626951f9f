//! What the machine allows: the rate of multiply-adds, the bandwidth of memory, and the memory that the process holds.

use crate::peak::Peak;
use cpu_time::ProcessTime;
use irradia_compute::Level;
use rayon::prelude::*;

/// Measured limits of all threads together, each with a core of its own.
#[derive(Clone, Copy)]
pub struct Limits {
    /// Arithmetic in registers, 10^9 operations per second; a multiply-add counts as two.
    pub gflops: f64,
    /// Memory read and written by a sequential update of an array, 10^9 bytes per second.
    pub gbytes: f64,
}

/// Measures in CPU time; the best of several rounds, since other load can only slow one down.
pub fn limits() -> Limits {
    let level = Level::detect();
    let threads = rayon::current_num_threads() as f64;
    let best = |round: &mut dyn FnMut() -> f64| (0..5).map(|_| round()).fold(f64::INFINITY, f64::min);
    let operation = best(&mut || {
        let began = ProcessTime::now();
        let operations: f64 = (0..threads as u32).into_par_iter().map(|_| level.run(Peak)).sum();
        began.elapsed().as_secs_f64() / operations
    });
    // 512 MiB: larger than every cache of a core.
    let mut values = vec![1.0f32; 1 << 27];
    let memory = best(&mut || {
        let began = ProcessTime::now();
        values.par_chunks_mut(1 << 16).for_each(|part| {
            for value in part {
                *value = *value * 0.999 + 0.001;
            }
        });
        began.elapsed().as_secs_f64()
    });
    Limits {
        gflops: threads / operation / 1e9,
        gbytes: threads * 8.0 * values.len() as f64 / memory / 1e9,
    }
}

/// Resident memory of this process now and at its highest since [`reset_peak`], bytes; zeros if the system does not report it.
pub fn resident() -> [u64; 2] {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ["VmRSS:", "VmHWM:"].map(|key| {
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let kib = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
        1024 * kib.unwrap_or(0)
    })
}

/// Resets the highest resident memory to the current value; Linux only.
pub fn reset_peak() {
    // On failure the figure is the maximum since the process started.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}
