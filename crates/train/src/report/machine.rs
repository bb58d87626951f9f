//! The machine of a run, and the memory it used. Read from `/proc` on Linux; elsewhere unknown values are empty or 0.

use serde::{Deserialize, Serialize};
use std::fs;

/// A computer.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// Model of the CPU; its architecture if the model is unknown.
    pub cpu: String,
    /// Cores available to this process.
    pub cores: u64,
    /// Bytes of memory; 0 where unknown.
    pub memory: u64,
    /// Operating system.
    pub os: String,
}

/// This computer.
pub fn machine() -> Machine {
    let read = |path| fs::read_to_string(path).unwrap_or_default();
    let os = field(&read("/etc/os-release"), "PRETTY_NAME=").map(|name| name.trim_matches('"').to_string());
    Machine {
        cpu: field(&read("/proc/cpuinfo"), "model name").map_or_else(
            || std::env::consts::ARCH.to_string(),
            |name| name.trim_start_matches([':', ' ', '\t']).to_string(),
        ),
        cores: std::thread::available_parallelism().map_or(1, |n| n.get() as u64),
        memory: kibibytes(&read("/proc/meminfo"), "MemTotal:"),
        os: os.unwrap_or_else(|| std::env::consts::OS.to_string()),
    }
}

/// Peak memory of this process, bytes; 0 if the system does not report it.
pub fn peak_rss_bytes() -> u64 {
    kibibytes(&fs::read_to_string("/proc/self/status").unwrap_or_default(), "VmHWM:")
}

/// The value of the first line that starts with `key`.
fn field<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    text.lines().find_map(|line| line.strip_prefix(key)).map(str::trim)
}

fn kibibytes(text: &str, key: &str) -> u64 {
    field(text, key)
        .and_then(|value| value.split_ascii_whitespace().next()?.parse::<u64>().ok())
        .map_or(0, |kib| kib.saturating_mul(1024))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_proc_are_parsed() {
        let status = "VmPeak:\t  10 kB\nVmHWM:\t   2048 kB\n";
        assert_eq!(kibibytes(status, "VmHWM:"), 2 << 20);
        assert_eq!(kibibytes("VmHWM:\tmuch\n", "VmHWM:"), 0);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn this_process_is_measured() {
        assert!(peak_rss_bytes() > 1 << 20);
        let machine = machine();
        assert!(machine.cores > 0 && machine.memory > 1 << 27 && !machine.cpu.is_empty() && !machine.os.is_empty());
    }
}
