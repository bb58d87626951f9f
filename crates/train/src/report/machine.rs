//! What the run ran on, and what it took of it. Read from `/proc` on Linux; elsewhere what is unknown stays empty or 0.

use serde::{Deserialize, Serialize};
use std::fs;

/// A computer.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// Model of the processor; its architecture where the model is unknown.
    pub cpu: String,
    /// Cores this process may use.
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
        cpu: field(&read("/proc/cpuinfo"), "model name")
            .map_or_else(|| std::env::consts::ARCH.to_string(), |name| name.trim_start_matches([':', ' ', '\t']).to_string()),
        cores: std::thread::available_parallelism().map_or(1, |n| n.get() as u64),
        memory: kibibytes(&read("/proc/meminfo"), "MemTotal:"),
        os: os.unwrap_or_else(|| std::env::consts::OS.to_string()),
    }
}

/// The most memory this process ever held, bytes; 0 where the system does not say.
pub fn peak_rss_bytes() -> u64 {
    kibibytes(&fs::read_to_string("/proc/self/status").unwrap_or_default(), "VmHWM:")
}

/// Processor seconds this process has used on all threads; 0 where the system does not say. Steps of 0.01 s.
pub fn cpu_seconds() -> f64 {
    fs::read_to_string("/proc/self/stat").ok().and_then(|stat| stat_seconds(&stat)).unwrap_or(0.0)
}

/// User and system time of a line of `/proc/self/stat` (proc(5): fields 14 and 15).
fn stat_seconds(stat: &str) -> Option<f64> {
    /// USER_HZ, which Linux fixes at 100 for every architecture programs run on today.
    const TICKS: f64 = 100.0;
    // The second field is the program's name in parentheses and may hold anything: count from behind the last one.
    let mut fields = stat[stat.rfind(')')? + 1..].split_ascii_whitespace().skip(11);
    let user: f64 = fields.next()?.parse().ok()?;
    let system: f64 = fields.next()?.parse().ok()?;
    Some((user + system) / TICKS)
}

/// What follows `key` on the first line that starts with it.
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
    fn lines_of_proc_are_understood() {
        let status = "VmPeak:\t  10 kB\nVmHWM:\t   2048 kB\n";
        assert_eq!(kibibytes(status, "VmHWM:"), 2 << 20);
        assert_eq!(kibibytes("VmHWM:\tmuch\n", "VmHWM:"), 0);
        let stat = "12 (a ) b) S 1 2 3 4 5 6 7 8 9 10 250 50 0 0 20";
        assert_eq!(stat_seconds(stat), Some(3.0));
        assert_eq!(stat_seconds("12 (cut"), None);
        assert_eq!(stat_seconds("12 (cut) S 1"), None);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn this_process_is_seen() {
        let start = std::time::Instant::now();
        let before = cpu_seconds();
        let mut sum = 0u64;
        while start.elapsed().as_millis() < 60 {
            sum = std::hint::black_box(sum.wrapping_mul(3) + 1);
        }
        assert!(cpu_seconds() >= before && cpu_seconds() < 3600.0);
        assert!(peak_rss_bytes() > 1 << 20);
        let machine = machine();
        assert!(machine.cores > 0 && machine.memory > 1 << 27 && !machine.cpu.is_empty() && !machine.os.is_empty());
    }
}
