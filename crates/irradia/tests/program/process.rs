//! Runs the program, and creates the common inputs of most tests once: a small dataset and a short run on it.

use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use tempfile::TempDir;

/// Density control within the few steps of a test.
pub const DENSIFYING_ARGS: [&str; 6] = [
    "--recipe",
    "classic",
    "--set",
    "stage.grow.density.every=10",
    "--set",
    "stage.grow.density.reset_every=40",
];

/// Exit status and output of the program.
#[derive(Debug)]
pub struct ProgramOutput {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl From<Output> for ProgramOutput {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }
}

impl ProgramOutput {
    /// Asserts success.
    pub fn success(self) -> Self {
        assert_eq!(self.code, Some(0), "{self:#?}");
        self
    }

    /// Asserts failure with `code` and exactly one line of error that contains all of `words`.
    pub fn refused(self, code: i32, words: &[&str]) -> Self {
        assert_eq!(self.code, Some(code), "{self:#?}");
        assert!(!self.stderr.contains("panicked"), "{self:#?}");
        let errors: Vec<&str> = self.stderr.lines().filter(|line| line.starts_with("error:")).collect();
        assert_eq!(errors.len(), 1, "{self:#?}");
        for word in words {
            let times = errors[0].matches(word).count();
            assert!(times > 0, "the error does not contain {word:?}: {}", errors[0]);
        }
        self
    }
}

/// The program, to be run in `folder`, where LPIPS weights are found only in `share/irradia`.
pub fn program(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_irradia"));
    command.current_dir(folder).env_remove("IRRADIA_LPIPS");
    command.env("XDG_DATA_HOME", folder.join("share"));
    // As on a desktop: without it, Mesa's Vulkan layer prints error lines of its own.
    command.env("XDG_RUNTIME_DIR", folder);
    command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

/// Runs the program in `folder`; the words of `line` are its arguments.
pub fn irradia(folder: &Path, line: &str) -> ProgramOutput {
    irradia_with(folder, line, &[])
}

/// Likewise with `more` arguments, which may contain spaces.
pub fn irradia_with(folder: &Path, line: &str, more: &[&str]) -> ProgramOutput {
    let mut command = program(folder);
    command.args(line.split_whitespace()).args(more);
    command.output().expect("the program starts").into()
}

/// A fresh folder with a copy of the small dataset in `data`: 8 training views, 2 held out, 48 x 48.
pub fn with_data() -> TempDir {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    copied(FOLDER.get_or_init(|| {
        let folder = emptied("with_data");
        irradia(&folder, "synth data --views 8 --size 48x48").success();
        folder
    }))
}

/// A fresh folder with the small dataset and, in `run`, a run of 60 steps on it.
pub fn with_run() -> TempDir {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    copied(FOLDER.get_or_init(|| {
        let folder = emptied("with_run");
        copy(with_data().path(), &folder);
        irradia_with(&folder, "train data --out run --steps 60 --seed 7", &DENSIFYING_ARGS).success();
        folder
    }))
}

/// Removes from a finished run what its end wrote, as if it had been killed after its last checkpoint.
pub fn unfinish(run: &Path, scene: &str) {
    for file in [scene, "report.json", "report.html"] {
        fs::remove_file(run.join(file)).expect("removed");
    }
    let mut config = json(&run.join("run.json"));
    config["complete"] = false.into();
    fs::write(run.join("run.json"), config.to_string()).expect("written");
}

/// A folder that outlives the tests (statics are never dropped), emptied by the next test run.
fn emptied(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder");
    folder
}

fn copied(from: &Path) -> TempDir {
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a folder");
    copy(from, folder.path());
    folder
}

fn copy(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).expect("a folder") {
        let source = entry.expect("an entry").path();
        let target = to.join(source.file_name().expect("a name"));
        if source.is_dir() {
            fs::create_dir_all(&target).expect("a folder");
            copy(&source, &target);
        } else {
            fs::copy(&source, &target).expect("a copy");
        }
    }
}

/// All files under `folder`, by path.
pub fn files_under(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            files.extend(files_under(&path));
        } else {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// Asserts that no temporary file is left under `folder`.
pub fn assert_no_leftovers(folder: &Path) {
    for file in files_under(folder) {
        assert!(!file.to_string_lossy().ends_with(".tmp"), "{}", file.display());
    }
}

/// A JSON file.
pub fn json(path: &Path) -> Value {
    let text = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The events of a run, every line of which must be JSON.
pub fn events(run: &Path) -> Vec<Value> {
    let text = fs::read_to_string(run.join("events.jsonl")).expect("events");
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}")))
        .collect()
}

/// The bytes of a run's scene.
pub fn scene(run: &Path) -> Vec<u8> {
    fs::read(run.join("scene.ply")).expect("a scene")
}

/// Edits a JSON file.
pub fn edit(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut content = json(path);
    change(&mut content);
    fs::write(path, content.to_string()).expect("written");
}
