//! Development only: `cargo xtask deps` and `cargo xtask files` check the project's rules and print one line per violation.
#![forbid(unsafe_code)]

mod deps;
mod files;

use anyhow::{Context, Result, bail, ensure};
use std::process::{Command, ExitCode};

const USAGE: &str = "\
usage: cargo xtask CHECK
  deps    imports between crates
  files   length and names of files; remainders of the step
  all     both";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let violations = match words[..] {
        ["deps"] => check_deps(),
        ["files"] => check_files(),
        ["all"] => check_deps().and_then(|mut violations| {
            violations.extend(check_files()?);
            Ok(violations)
        }),
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
    };
    match violations {
        Ok(violations) if violations.is_empty() => ExitCode::SUCCESS,
        Ok(violations) => {
            violations.iter().for_each(|line| eprintln!("{line}"));
            ExitCode::FAILURE
        }
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn check_deps() -> Result<Vec<String>> {
    // Cargo sets its own path for the programs it runs.
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let text = output(Command::new(cargo).args(["metadata", "--no-deps", "--format-version", "1"]))?;
    let metadata = serde_json::from_str(&text).context("cargo metadata printed something that is not JSON")?;
    let violations = deps::violations(&metadata);
    ensure!(
        metadata["packages"]
            .as_array()
            .is_some_and(|packages| !packages.is_empty()),
        "cargo metadata names no packages"
    );
    Ok(violations)
}

fn check_files() -> Result<Vec<String>> {
    let root = output(Command::new("git").args(["rev-parse", "--show-toplevel"]))?;
    let root = std::path::Path::new(root.trim_end());
    let list = output(Command::new("git").arg("-C").arg(root).args(["ls-files", "-z", "*.rs"]))?;
    let mut violations = Vec::new();
    for path in list.split('\0').filter(|path| !path.is_empty()) {
        match std::fs::read_to_string(root.join(path)) {
            Ok(text) => violations.extend(files::violations(path, &text)),
            // Tracked but deleted in the working tree.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => bail!("{path}: cannot read ({error})"),
        }
    }
    Ok(violations)
}

/// The standard output of a command that succeeds.
fn output(command: &mut Command) -> Result<String> {
    let done = command.output().with_context(|| format!("cannot run {command:?}"))?;
    ensure!(
        done.status.success(),
        "{command:?} failed: {}",
        String::from_utf8_lossy(&done.stderr).trim()
    );
    String::from_utf8(done.stdout).with_context(|| format!("{command:?} printed something that is not UTF-8"))
}
