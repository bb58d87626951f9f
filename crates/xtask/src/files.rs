//! Rules a file can break by itself: its length, its name, and knowing the step.

/// Lines after which a file is two ideas.
const LONGEST: usize = 800;

/// Names that say nothing about what is inside.
const NAMELESS: [&str; 4] = ["utils", "helpers", "misc", "common"];

/// The one module that may ask which step it is.
const SCHEDULE: &str = "crates/train/src/schedule/";

/// One line for each rule that the file at `path` (relative, forward slashes) breaks.
pub fn broken(path: &str, text: &str) -> Vec<String> {
    let mut lines = Vec::new();
    let length = text.lines().count();
    if length > LONGEST {
        lines.push(format!("{path}: {length} lines, more than {LONGEST}; split it by idea"));
    }
    let (folders, file) = path.rsplit_once('/').unwrap_or(("", path));
    let stem = file.strip_suffix(".rs").unwrap_or(file);
    if let Some(name) = folders.split('/').chain([stem]).find(|name| NAMELESS.contains(name)) {
        lines.push(format!("{path}: `{name}` names no idea; name it for what it holds"));
    }
    if !path.starts_with(SCHEDULE) {
        for (number, line) in text.lines().enumerate() {
            if asks_the_step(line) {
                let number = number + 1;
                lines.push(format!(
                    "{path}:{number}: asks for every n-th step; only {SCHEDULE} knows the step"
                ));
            }
        }
    }
    lines
}

/// Whether code (comments aside) takes a remainder of something whose name ends in `step` or `steps`.
fn asks_the_step(line: &str) -> bool {
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
    fn a_file_ends_at_its_longest() {
        assert!(broken("a.rs", &"x\n".repeat(LONGEST)).is_empty());
        let lines = broken("crates/a/src/a.rs", &"x\n".repeat(LONGEST + 1));
        assert_eq!(lines, ["crates/a/src/a.rs: 801 lines, more than 800; split it by idea"]);
    }

    #[test]
    fn names_must_say_something() {
        for path in [
            "crates/a/src/utils.rs",
            "misc.rs",
            "crates/a/src/helpers/mod.rs",
            "crates/a/tests/common/mod.rs",
        ] {
            assert_eq!(broken(path, "").len(), 1, "{path}");
        }
        for path in ["crates/a/src/uncommon.rs", "src/miscellany.rs", "src/sort.rs"] {
            assert!(broken(path, "").is_empty(), "{path}");
        }
    }

    #[test]
    fn only_the_schedule_knows_the_step() {
        // Put together here, so that this file does not break the rule itself.
        for (before, after) in [
            ("if plan.step", " % 100 == 0"),
            ("self.steps", "%n"),
            ("step", ".is_multiple_of(8)"),
        ] {
            let text = format!("fn f() {{\n    {before}{after}\n}}\n");
            let lines = broken("crates/train/src/trainer.rs", &text);
            assert!(
                lines.len() == 1 && lines[0].starts_with("crates/train/src/trainer.rs:2: "),
                "{lines:?}"
            );
            assert!(broken("crates/train/src/schedule/mod.rs", &text).is_empty());
        }
        let comment = ["// every step", "% 100"].join(" ");
        for text in [
            comment.as_str(),
            "let stepped = a % b;",
            "println!(\"{steps} %\")",
            "let x = steps / 2;",
        ] {
            assert!(broken("a.rs", text).is_empty(), "{text}");
        }
    }
}
