//! Lines for people. A reader that went away (`| head`, a closed window) must never end a run.

use anyhow::{Context, Result};
use std::fmt::Display;
use std::io::{ErrorKind, Write, stderr, stdout};

/// Prints a result on standard output.
///
/// # Errors
/// When it cannot be written; a reader that has read enough is no error.
pub fn say(line: impl Display) -> Result<()> {
    match writeln!(stdout(), "{line}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// Prints what happens meanwhile on standard error, if anybody listens.
pub fn note(line: impl Display) {
    let _ = writeln!(stderr(), "{line}");
}

/// An error with its causes in one line; what a cause repeats is left out.
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
