//! Errors of the forecasts of finished runs: the total time predicted after a tenth, a quarter and half of the training, beside
//! the actual one; and how often the actual time was within the displayed range.
//!
//! `cargo run --release --example forecast -- RUN..`

use serde_json::Value;

fn main() -> anyhow::Result<()> {
    println!(
        "{:<40} {:>8} {:>9} {:>9} {:>9} {:>9}",
        "run", "took, s", "a tenth", "a quarter", "half", "in range"
    );
    for run in std::env::args().skip(1) {
        let text = std::fs::read_to_string(format!("{run}/events.jsonl"))?;
        // Seconds elapsed and remaining, by logged step.
        let pair = |line: &str| {
            let event: Value = serde_json::from_str(line).ok()?;
            let end = |i: usize| event["seconds_left_range"][i].as_f64();
            Some((
                event["seconds"].as_f64()?,
                event["seconds_left"].as_f64()?,
                [end(0)?, end(1)?],
            ))
        };
        let steps: Vec<(f64, f64, [f64; 2])> = text.lines().filter_map(pair).collect();
        let Some((took, ..)) = steps.last() else {
            println!("{run:<40} has no steps");
            continue;
        };
        let after = |fraction: f64| {
            let step = steps.iter().find(|(seconds, ..)| *seconds >= fraction * took);
            step.map_or(f64::NAN, |(seconds, left, _)| 100.0 * ((seconds + left) / took - 1.0))
        };
        let late = steps.iter().filter(|(seconds, ..)| *seconds >= 0.1 * took);
        let within = |(seconds, _, [low, high]): &&(f64, f64, [f64; 2])| (low..=high).contains(&&(took - seconds));
        let (held, all) = (late.clone().filter(within).count(), late.count());
        let held = 100.0 * held as f64 / all.max(1) as f64;
        let [tenth, quarter, half] = [0.1, 0.25, 0.5].map(after);
        println!("{run:<40} {took:8.1} {tenth:+8.0}% {quarter:+8.0}% {half:+8.0}% {held:8.0}%");
    }
    Ok(())
}
