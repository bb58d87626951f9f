//! Development only: `cargo xtask deps` and `cargo xtask files` hold the house's rules, one line per broken one.
#![forbid(unsafe_code)]

mod deps;
mod files;

use anyhow::{Context, Result, bail, ensure};
use std::process::{Command, ExitCode};

const USAGE: &str = "\
usage: cargo xtask CHECK
  deps    who may import whom
  files   length and names of files; only the schedule knows the step
  all     both";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let broken = match words[..] {
        ["deps"] => check_deps(),
        ["files"] => check_files(),
        ["all"] => check_deps().and_then(|mut broken| {
            broken.extend(check_files()?);
            Ok(broken)
        }),
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
    };
    match broken {
        Ok(broken) if broken.is_empty() => ExitCode::SUCCESS,
        Ok(broken) => {
            broken.iter().for_each(|line| eprintln!("{line}"));
            ExitCode::FAILURE
        }
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn check_deps() -> Result<Vec<String>> {
    // Cargo tells the programs it runs where it is itself.
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let text = output(Command::new(cargo).args(["metadata", "--no-deps", "--format-version", "1"]))?;
    let metadata = serde_json::from_str(&text).context("cargo metadata printed something that is not JSON")?;
    let broken = deps::broken(&metadata);
    ensure!(
        metadata["packages"]
            .as_array()
            .is_some_and(|packages| !packages.is_empty()),
        "cargo metadata names no packages"
    );
    Ok(broken)
}

fn check_files() -> Result<Vec<String>> {
    let root = output(Command::new("git").args(["rev-parse", "--show-toplevel"]))?;
    let root = std::path::Path::new(root.trim_end());
    let list = output(Command::new("git").arg("-C").arg(root).args(["ls-files", "-z", "*.rs"]))?;
    let mut broken = Vec::new();
    for path in list.split('\0').filter(|path| !path.is_empty()) {
        match std::fs::read_to_string(root.join(path)) {
            Ok(text) => broken.extend(files::broken(path, &text)),
            // Tracked but deleted in the working tree: on its way out.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => bail!("{path}: cannot read ({error})"),
        }
    }
    Ok(broken)
}

/// What a command prints, when it succeeds.
fn output(command: &mut Command) -> Result<String> {
    let done = command.output().with_context(|| format!("cannot run {command:?}"))?;
    ensure!(
        done.status.success(),
        "{command:?} failed: {}",
        String::from_utf8_lossy(&done.stderr).trim()
    );
    String::from_utf8(done.stdout).with_context(|| format!("{command:?} printed something that is not UTF-8"))
}
