//! Measures the capture doctor: recall and precision of each diagnosis on captures with planted faults, false alarms on clean ones.
//!
//! ```text
//! cargo run --release -p irradia-runs --example doctor -- OUT              # all, about ten minutes
//! cargo run --release -p irradia-runs --example doctor -- OUT blur zoom    # those whose names contain one of the words
//! ```
//!
//! Captures are photographs of `../shared/data`, at half their size, and ray-traced ones. Each is examined twice: from pairs alone,
//! as by `irradia doctor`, and with the model, as by `irradia pose`. Each folder in OUT is one capture, for inspection.

mod captures;

use captures::{Capture, Expected};
use irradia_runs::{DoctorInput, Finding, PoseInput, doctor, pose};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Right, missed and wrong diagnoses of one kind.
#[derive(Clone, Copy, Debug, Default)]
struct Score {
    right: usize,
    missed: usize,
    wrong: usize,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = PathBuf::from(arguments.next().ok_or("usage: doctor OUT [WORD ..]")?);
    let words: Vec<String> = arguments.collect();
    let mut scores: BTreeMap<(&str, &str), Score> = BTreeMap::new();
    let mut clean = [(0, 0); 2];
    for capture in captures::all() {
        let name = capture.name();
        if !words.is_empty() && !words.iter().any(|word| name.contains(word.as_str())) {
            continue;
        }
        let folder = out.join(&name);
        let (photos, expected) = capture.photographs(&folder.join("photos"))?;
        for (mode, (which, findings)) in examine(&photos, &folder).into_iter().enumerate() {
            println!("{name} ({which}): {}", format_findings(&findings));
            if let Expected::Nothing { photographs } = &expected {
                clean[mode].0 += photographs;
                clean[mode].1 += findings.len();
                for finding in &findings {
                    println!("    false alarm? {}: {}", finding.kind, finding.sentence);
                }
            }
            score(&expected, &capture, &findings, |kind, score| {
                let total = scores.entry((kind, which)).or_default();
                total.right += score.right;
                total.missed += score.missed;
                total.wrong += score.wrong;
            });
        }
    }
    println!(
        "\n{:<16} {:<8} {:>6} {:>7} {:>6} {:>7} {:>10}",
        "diagnosis", "from", "right", "missed", "wrong", "recall", "precision"
    );
    for ((kind, which), Score { right, missed, wrong }) in &scores {
        let of = |all: usize| *right as f64 / all.max(1) as f64;
        println!(
            "{kind:<16} {which:<8} {right:>6} {missed:>7} {wrong:>6} {:>7.2} {:>10.2}",
            of(right + missed),
            of(right + wrong)
        );
    }
    for ((photographs, alarms), which) in clean.into_iter().zip(MODES) {
        println!("clean captures ({which}): {alarms} findings on {photographs} photographs");
    }
    Ok(())
}

const MODES: [&str; 2] = ["pairs", "model"];

/// The findings from pairs alone, and with the model.
fn examine(photos: &Path, folder: &Path) -> Vec<(&'static str, Vec<Finding>)> {
    // Both use the same features, which are extracted once.
    let quick = DoctorInput {
        out: Some(folder.join("posed")),
        ..DoctorInput::new(photos)
    };
    let pairs = doctor(&quick, &|_| {})
        .map(|report| report.findings)
        .unwrap_or_default();
    let posed = pose(&PoseInput::new(photos, folder.join("posed")), &|_| {});
    let model = match posed {
        Ok(report) => {
            println!("    {} of {} posed", report.registered, report.photos);
            report.findings
        }
        Err(error) => {
            println!("    {error}");
            pairs.clone()
        }
    };
    vec![(MODES[0], pairs), (MODES[1], model)]
}

fn format_findings(findings: &[Finding]) -> String {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    findings
        .iter()
        .for_each(|finding| *counts.entry(finding.kind).or_default() += 1);
    let words: Vec<String> = counts
        .into_iter()
        .map(|(kind, count)| format!("{kind} {count}"))
        .collect();
    if words.is_empty() {
        "nothing".into()
    } else {
        words.join(", ")
    }
}

/// Compares findings with what was done to the capture.
fn score(expected: &Expected, capture: &Capture, findings: &[Finding], mut add: impl FnMut(&'static str, Score)) {
    match expected {
        Expected::Nothing { .. } => {}
        Expected::Photographs { kind, names } => {
            let found: Vec<&str> = findings
                .iter()
                .filter(|finding| finding.kind == *kind)
                .flat_map(|finding| finding.photos.iter().map(String::as_str))
                .collect();
            let right = names.iter().filter(|name| found.contains(&name.as_str())).count();
            let wrong = found.iter().filter(|name| !names.iter().any(|n| n == **name)).count();
            add(
                kind,
                Score {
                    right,
                    missed: names.len() - right,
                    wrong,
                },
            );
        }
        Expected::Capture { kinds } => {
            let found = findings.iter().any(|finding| kinds.contains(&finding.kind));
            // Findings of faults that this capture does not have are counted below.
            add(
                capture.injury,
                Score {
                    right: usize::from(found),
                    missed: usize::from(!found),
                    wrong: 0,
                },
            );
        }
    }
    // A finding about a whole capture is wrong wherever that fault was not planted.
    const CAPTURE_FINDINGS: [(&str, &str); 6] = [
        ("gap", "gap"),
        ("open-loop", "loop"),
        ("rotation-only", "rotation"),
        ("stands-still", "turntable"),
        ("moving", "moving"),
        ("contradiction", "twin"),
    ];
    for (kind, injury) in CAPTURE_FINDINGS {
        let expects = matches!(expected, Expected::Capture { kinds } if kinds.contains(&kind));
        let found = findings.iter().any(|finding| finding.kind == kind);
        if found && !expects && !capture.tolerates(kind) {
            add(
                injury,
                Score {
                    wrong: 1,
                    ..Score::default()
                },
            );
        }
    }
}
