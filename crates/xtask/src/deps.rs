//! Checks imports between crates against the table of ARCHITECTURE.md.

use serde_json::Value;

/// Which other crates a crate may import.
enum May {
    /// Only these.
    Import(&'static [&'static str]),
    /// Everything.
    ImportAll,
}

use May::{Import, ImportAll};

/// Each crate's folder and its allowed imports. A crate missing here is a violation.
const TABLE: &[(&str, May)] = &[
    ("scene", Import(&[])),
    ("compute", Import(&[])),
    ("formats", Import(&["scene"])),
    ("sfm", Import(&["scene", "compute"])),
    ("splat", Import(&["scene", "compute"])),
    ("field", Import(&["scene", "compute"])),
    ("edit", Import(&["scene", "splat"])),
    ("measure", Import(&["scene", "compute"])),
    ("train", Import(&["scene", "compute", "splat", "field", "measure"])),
    ("synth", Import(&["scene"])),
    (
        "runs",
        Import(&[
            "scene", "compute", "formats", "sfm", "splat", "field", "edit", "measure", "train", "synth",
        ]),
    ),
    ("viewer", Import(&["scene", "splat", "field", "edit", "train", "runs"])),
    ("irradia", ImportAll),
    ("testkit", Import(&["scene"])),
    ("xtask", Import(&[])),
];

/// Crates for development only, which tests may import but the program may not.
const DEVELOPMENT: [&str; 2] = ["testkit", "xtask"];

/// One line per import that the table does not allow, given the output of `cargo metadata`.
pub fn violations(metadata: &Value) -> Vec<String> {
    let packages = || metadata["packages"].as_array().into_iter().flatten();
    let ours: Vec<&str> = packages().filter_map(|package| package["name"].as_str()).collect();
    let mut lines = Vec::new();
    for package in packages() {
        let name = crate_of(package["name"].as_str().unwrap_or_default());
        let Some((_, may)) = TABLE.iter().find(|(known, _)| *known == name) else {
            lines.push(format!(
                "{name}: not in the table of crates; add it to crates/xtask/src/deps.rs and ARCHITECTURE.md"
            ));
            continue;
        };
        for dependency in package["dependencies"].as_array().into_iter().flatten() {
            let full = dependency["name"].as_str().unwrap_or_default();
            if !ours.contains(&full) {
                continue;
            }
            let imported = crate_of(full);
            // Tests may import development crates; other imports follow the table, also in tests.
            let in_tests = dependency["kind"] == "dev";
            let allowed = if DEVELOPMENT.contains(&imported) {
                in_tests && imported != "xtask"
            } else {
                match may {
                    Import(list) => list.contains(&imported),
                    ImportAll => true,
                }
            };
            if !allowed {
                lines.push(format!(
                    "{name} must not import {imported}{}",
                    if in_tests { " (in tests)" } else { "" }
                ));
            }
        }
    }
    lines
}

/// The folder of a package: `irradia-scene` lives in `scene`, the binary `irradia` in its own.
fn crate_of(package: &str) -> &str {
    package.strip_prefix("irradia-").unwrap_or(package)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn workspace(name: &str, dependencies: &[(&str, Option<&str>)]) -> Value {
        let dependencies: Vec<Value> = dependencies
            .iter()
            .map(|(name, kind)| json!({ "name": name, "kind": kind }))
            .collect();
        let mut packages: Vec<Value> = [
            "irradia-scene",
            "irradia-formats",
            "irradia-testkit",
            "irradia-splat",
            "irradia-field",
        ]
        .iter()
        .filter(|other| **other != name)
        .map(|other| json!({ "name": other, "dependencies": [] }))
        .collect();
        packages.push(json!({ "name": name, "dependencies": dependencies }));
        json!({ "packages": packages })
    }

    #[test]
    fn allowed_imports_pass() {
        let splat = [
            ("irradia-scene", None),
            ("rayon", None),
            ("irradia-testkit", Some("dev")),
        ];
        assert!(violations(&workspace("irradia-splat", &splat)).is_empty());
        let all = [
            ("irradia-scene", None),
            ("irradia-formats", None),
            ("irradia-splat", None),
        ];
        assert!(violations(&workspace("irradia", &all)).is_empty());
    }

    #[test]
    fn each_violation_is_one_line_naming_both_crates() {
        for (name, dependency, line) in [
            (
                "irradia-train",
                ("irradia-formats", None),
                "train must not import formats",
            ),
            ("irradia-splat", ("irradia-field", None), "splat must not import field"),
            (
                "irradia-train",
                ("irradia-formats", Some("dev")),
                "train must not import formats (in tests)",
            ),
            ("irradia", ("irradia-testkit", None), "irradia must not import testkit"),
            (
                "irradia-splat",
                ("irradia-testkit", Some("build")),
                "splat must not import testkit",
            ),
        ] {
            assert_eq!(violations(&workspace(name, &[dependency])), [line]);
        }
    }

    #[test]
    fn unknown_crates_are_reported() {
        let lines = violations(&workspace("irradia-stranger", &[]));
        assert!(
            lines.len() == 1 && lines[0].starts_with("stranger: not in the table"),
            "{lines:?}"
        );
    }
}
