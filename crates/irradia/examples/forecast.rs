//! How far the forecast of finished runs was off: the whole time that each foretold after a tenth, a quarter and half of its
//! training, beside what it took.
//!
//! `cargo run --release --example forecast -- RUN..`

use serde_json::Value;

fn main() -> anyhow::Result<()> {
    println!(
        "{:<40} {:>8} {:>9} {:>9} {:>9}",
        "run", "took, s", "a tenth", "a quarter", "half"
    );
    for run in std::env::args().skip(1) {
        let text = std::fs::read_to_string(format!("{run}/events.jsonl"))?;
        // Seconds gone by and left, by logged step.
        let pair = |line: &str| {
            let event: Value = serde_json::from_str(line).ok()?;
            Some((event["seconds"].as_f64()?, event["seconds_left"].as_f64()?))
        };
        let steps: Vec<(f64, f64)> = text.lines().filter_map(pair).collect();
        let Some((took, _)) = steps.last() else {
            println!("{run:<40} has no steps");
            continue;
        };
        let after = |share: f64| {
            let step = steps.iter().find(|(seconds, _)| *seconds >= share * took);
            step.map_or(f64::NAN, |(seconds, left)| 100.0 * ((seconds + left) / took - 1.0))
        };
        let [tenth, quarter, half] = [0.1, 0.25, 0.5].map(after);
        println!("{run:<40} {took:8.1} {tenth:+8.0}% {quarter:+8.0}% {half:+8.0}%");
    }
    Ok(())
}
