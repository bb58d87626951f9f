//! Rules on single files: length, name, and use of the training step.

/// Maximum number of lines.
const MAX_LINES: usize = 800;

/// Names that do not describe the content.
const VAGUE_NAMES: [&str; 4] = ["utils", "helpers", "misc", "common"];

/// The only module that may take a remainder of the step.
const SCHEDULE: &str = "crates/train/src/schedule/";

/// One line per rule that the file at `path` (relative, forward slashes) violates.
pub fn violations(path: &str, text: &str) -> Vec<String> {
    let mut lines = Vec::new();
    let length = text.lines().count();
    if length > MAX_LINES {
        lines.push(format!(
            "{path}: {length} lines, more than {MAX_LINES}; split it by idea"
        ));
    }
    let (folders, file) = path.rsplit_once('/').unwrap_or(("", path));
    let stem = file.strip_suffix(".rs").unwrap_or(file);
    if let Some(name) = folders.split('/').chain([stem]).find(|name| VAGUE_NAMES.contains(name)) {
        lines.push(format!("{path}: `{name}` is not descriptive; name it for its content"));
    }
    if !path.starts_with(SCHEDULE) {
        for (number, line) in text.lines().enumerate() {
            if takes_remainder_of_step(line) {
                let number = number + 1;
                lines.push(format!(
                    "{path}:{number}: takes a remainder of the step; only {SCHEDULE} may"
                ));
            }
        }
    }
    lines
}

/// Whether code (ignoring comments) takes a remainder of something whose name ends in `step` or `steps`.
fn takes_remainder_of_step(line: &str) -> bool {
    let code = line.split("//").next().unwrap_or_default();
    code.match_indices("step").any(|(at, word)| {
        let rest = &code[at + word.len()..];
        let rest = rest.strip_prefix('s').unwrap_or(rest).trim_start();
        rest.starts_with('%') || rest.starts_with(".is_multiple_of") || rest.starts_with(".rem_euclid")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_files_are_reported() {
        assert!(violations("a.rs", &"x\n".repeat(MAX_LINES)).is_empty());
        let lines = violations("crates/a/src/a.rs", &"x\n".repeat(MAX_LINES + 1));
        assert_eq!(lines, ["crates/a/src/a.rs: 801 lines, more than 800; split it by idea"]);
    }

    #[test]
    fn vague_names_are_reported() {
        for path in [
            "crates/a/src/utils.rs",
            "misc.rs",
            "crates/a/src/helpers/mod.rs",
            "crates/a/tests/common/mod.rs",
        ] {
            assert_eq!(violations(path, "").len(), 1, "{path}");
        }
        for path in ["crates/a/src/uncommon.rs", "src/miscellany.rs", "src/sort.rs"] {
            assert!(violations(path, "").is_empty(), "{path}");
        }
    }

    #[test]
    fn only_the_schedule_may_take_a_remainder_of_the_step() {
        // Concatenated, so that this file does not violate the rule itself.
        for (before, after) in [
            ("if plan.step", " % 100 == 0"),
            ("self.steps", "%n"),
            ("step", ".is_multiple_of(8)"),
        ] {
            let text = format!("fn f() {{\n    {before}{after}\n}}\n");
            let lines = violations("crates/train/src/trainer.rs", &text);
            assert!(
                lines.len() == 1 && lines[0].starts_with("crates/train/src/trainer.rs:2: "),
                "{lines:?}"
            );
            assert!(violations("crates/train/src/schedule/mod.rs", &text).is_empty());
        }
        let comment = ["// every step", "% 100"].join(" ");
        for text in [
            comment.as_str(),
            "let stepped = a % b;",
            "println!(\"{steps} %\")",
            "let x = steps / 2;",
        ] {
            assert!(violations("a.rs", text).is_empty(), "{text}");
        }
    }
}
