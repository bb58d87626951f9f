//! Development only: `cargo xtask deps`, `features`, `files` and `scripts` check the project's rules and print one line per violation.
#![forbid(unsafe_code)]

mod deps;
mod files;

use anyhow::{Context, Result, bail, ensure};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::{Command, ExitCode};

const USAGE: &str = "\
usage: cargo xtask CHECK
  deps      imports between crates
  features  tests and the program use external crates with the same features
  files     length and names of files; remainders of the step
  scripts   the shell scripts parse
  all       all of them";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let violations = match words[..] {
        ["deps"] => check_deps(),
        ["features"] => check_features(),
        ["files"] => check_files(),
        ["scripts"] => check_scripts(),
        ["all"] => check_deps().and_then(|mut violations| {
            violations.extend(check_features()?);
            violations.extend(check_files()?);
            violations.extend(check_scripts()?);
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
    let text = output(Command::new(cargo()).args(["metadata", "--no-deps", "--format-version", "1"]))?;
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

/// External crates of the program that have more features in tests. Cargo compiles such a crate twice, and all that depend on it: with two
/// variants of `bitflags`, `cargo run` after `cargo test-all` took 340 s on two cores.
fn check_features() -> Result<Vec<String>> {
    let features = |edges: &str| -> Result<BTreeMap<String, String>> {
        let tree = [
            "tree",
            "--workspace",
            "--prefix",
            "none",
            "--format",
            "{p}\t{f}",
            "--edges",
        ];
        let lines = output(Command::new(cargo()).args(tree).arg(edges))?;
        let packages = lines
            .lines()
            .filter_map(|line| line.trim_end_matches(" (*)").split_once('\t'));
        Ok(packages
            .map(|(package, features)| (package.to_owned(), features.to_owned()))
            .collect())
    };
    let in_tests = features("normal,build,dev")?;
    let differences = features("normal,build")?.into_iter().filter_map(|(package, program)| {
        let tests = in_tests.get(&package)?;
        (*tests != program)
            .then(|| format!("{package}: features {program:?}, but {tests:?} in tests, so that it is compiled twice"))
    });
    Ok(differences.collect())
}

fn check_files() -> Result<Vec<String>> {
    let mut violations = Vec::new();
    for (path, text) in tracked_files("*.rs")? {
        violations.extend(files::violations(&path, &String::from_utf8_lossy(&text)));
    }
    Ok(violations)
}

/// Shell scripts that bash cannot parse. `.ci/run` is one of them, so nothing in it can find this out.
fn check_scripts() -> Result<Vec<String>> {
    let root = repository()?;
    let mut violations = Vec::new();
    for (path, text) in tracked_files("*")? {
        let first_line = text.split(|&byte| byte == b'\n').next().unwrap_or_default();
        if !(first_line.starts_with(b"#!") && first_line.ends_with(b"sh")) {
            continue;
        }
        let parsed = Command::new("bash")
            .arg("-n")
            .arg(root.join(&path))
            .output()
            .context("cannot run bash")?;
        if !parsed.status.success() {
            violations.push(format!(
                "{path}: {}",
                String::from_utf8_lossy(&parsed.stderr).trim_end()
            ));
        }
    }
    Ok(violations)
}

/// Cargo sets its own path for the programs it runs.
fn cargo() -> String {
    std::env::var("CARGO").unwrap_or_else(|_| "cargo".into())
}

fn repository() -> Result<PathBuf> {
    let root = output(Command::new("git").args(["rev-parse", "--show-toplevel"]))?;
    Ok(root.trim_end().into())
}

/// The tracked files whose paths match `pattern`, with their bytes; without those deleted in the working tree.
fn tracked_files(pattern: &str) -> Result<Vec<(String, Vec<u8>)>> {
    let root = repository()?;
    let list = output(
        Command::new("git")
            .arg("-C")
            .arg(&root)
            .args(["ls-files", "-z", pattern]),
    )?;
    let mut found = Vec::new();
    for path in list.split('\0').filter(|path| !path.is_empty()) {
        match std::fs::read(root.join(path)) {
            Ok(bytes) => found.push((path.to_owned(), bytes)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => bail!("{path}: cannot read ({error})"),
        }
    }
    Ok(found)
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
