//! Terminal output. A closed pipe or window (`| head`) must never end a run.

use anyhow::{Context, Result};
use std::fmt::Display;
use std::io::{ErrorKind, Write, stderr, stdout};

/// Prints a result on standard output.
///
/// # Errors
/// When it cannot be written; a closed pipe is no error.
pub fn print_line(line: impl Display) -> Result<()> {
    match writeln!(stdout(), "{line}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// Prints progress on standard error; failures are ignored.
pub fn note(line: impl Display) {
    let _ = writeln!(stderr(), "{line}");
}

/// An error with its causes in one line, without repetitions.
pub fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !line.contains(&cause) {
            line += if line.is_empty() { "" } else { ": " };
            line += &cause;
        }
    }
    line.lines().map(str::trim).collect::<Vec<_>>().join(" ")
}
