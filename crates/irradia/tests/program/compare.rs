//! `irradia compare`: runs under the same conditions, stored and reused.

use crate::process::*;
use std::fs;

const COMPARE_LINE: &str =
    "compare data --recipes classic,classic:params.ssim_weight=0.9 --seeds 2 --steps 20 --out both";

#[test]
fn a_comparison_summarises_its_runs_and_reuses_finished_ones() {
    let folder = with_data();
    let first = irradia(folder.path(), COMPARE_LINE).success();
    assert!(
        first.stdout.contains("classic:params.ssim_weight=0.9") && first.stdout.contains(" ± "),
        "{first:?}"
    );
    let both = folder.path().join("both");
    let json_before = json(&both.join("compare.json"));
    let entries = json_before["scenes"][0]["entries"].as_array().expect("entries");
    assert_eq!(entries.len(), 2);
    for entry in entries {
        for key in [
            "psnr",
            "ssim",
            "seconds",
            "cpu_seconds",
            "splats",
            "peak_memory",
            "loss_rises",
            "error_rises",
        ] {
            assert_eq!(entry[key]["runs"], 2, "{key}: {}", entry[key]);
        }
        assert!(entry["psnr"]["mean"].as_f64() > Some(8.0), "{entry}");
        let looks = entry["runs"][0]["figures"]["looks"].as_array().expect("looks");
        assert!(
            looks.len() > 10 && looks.last().expect("a look")["step"] == 20,
            "{looks:?}"
        );
        assert!(entry["reached"].as_array().is_some_and(|levels| !levels.is_empty()));
    }
    for seed in ["seed_0", "seed_1"] {
        assert!(
            both.join("data/classic_params.ssim_weight_0.9")
                .join(seed)
                .join("report.html")
                .is_file()
        );
    }
    // The page is self-contained: pictures are embedded.
    let page = fs::read_to_string(both.join("compare.html")).expect("a page");
    assert!(page.contains("data:image/jpeg;base64,") && !page.contains("https://"));
    let table = fs::read_to_string(both.join("compare.md")).expect("a table");
    assert!(table.contains("| data | classic:params.ssim_weight=0.9 |"), "{table}");
    assert_no_leftovers(&both);

    // Only missing runs are trained again.
    fs::remove_dir_all(both.join("data/classic/seed_1")).expect("removed");
    let scene = scene(&both.join("data/classic/seed_0"));
    let again = irradia(folder.path(), COMPARE_LINE).success();
    let trained: Vec<&str> = again.stderr.lines().filter(|line| line.ends_with("..")).collect();
    assert_eq!(trained, ["[3/4] data, classic, seed 1 .."], "{again:?}");
    assert!(scene == self::scene(&both.join("data/classic/seed_0")));
    let psnr = |value: &serde_json::Value| value["scenes"][0]["entries"][0]["psnr"]["mean"].as_f64();
    assert_eq!(psnr(&json(&both.join("compare.json"))), psnr(&json_before));

    // Changes of the data or of the program are detected.
    let request = both.join("data/classic/seed_0/request.json");
    let kept = fs::read_to_string(&request).expect("a request");
    let mut changed = json(&request);
    changed["program"] = "another".into();
    fs::write(&request, changed.to_string()).expect("written");
    irradia(folder.path(), COMPARE_LINE).refused(2, &["seed_0", "another build", "--overwrite"]);
    fs::write(&request, kept).expect("written");
    let picture = folder.path().join("data/train/r_000.png");
    let bytes = fs::read(&picture).expect("a picture");
    fs::copy(folder.path().join("data/train/r_001.png"), &picture).expect("replaced");
    irradia(folder.path(), COMPARE_LINE).refused(2, &["seed_0", "data that has changed since"]);
    fs::write(&picture, bytes).expect("written");
    let weights = folder.path().join("share/irradia/lpips_alex.safetensors");
    fs::create_dir_all(weights.parent().expect("a folder")).expect("a folder");
    fs::write(&weights, "not read").expect("written");
    irradia(folder.path(), COMPARE_LINE).refused(2, &["seed_0", "other conditions"]);
    fs::remove_file(&weights).expect("removed");

    // Other conditions make another comparison, except with --overwrite.
    let other = COMPARE_LINE.replace("--steps 20", "--steps 21");
    irradia(folder.path(), &other).refused(2, &["other conditions", "--overwrite"]);
    irradia(folder.path(), &(other + " --overwrite")).success();
    assert_eq!(json(&both.join("data/classic/seed_0/report.json"))["steps"], 21);
}

#[test]
fn a_failed_run_is_a_row_and_does_not_end_the_comparison() {
    let folder = with_data();
    fs::create_dir(folder.path().join("empty")).expect("a folder");
    let line = "compare empty data --recipes classic --seeds 1 --steps 5 --out both";
    let ended = irradia(folder.path(), line).success();
    assert!(ended.stdout.contains("failed: empty, classic, seed 0: "), "{ended:?}");
    let figures = json(&folder.path().join("both/compare.json"));
    let run = &figures["scenes"][0]["entries"][0]["runs"][0];
    assert!(
        run["figures"].is_null() && run["error"].as_str().is_some_and(|e| e.contains("empty")),
        "{run}"
    );
    assert!(figures["scenes"][1]["entries"][0]["psnr"]["mean"].as_f64().is_some());
    let line = "compare empty --recipes classic --seeds 1 --steps 5 --out none";
    irradia(folder.path(), line).refused(1, &["no run was completed"]);
}

#[test]
fn a_protocol_fixes_the_conditions_and_shows_published_figures() {
    let folder = with_data();
    fs::rename(folder.path().join("data"), folder.path().join("chair")).expect("renamed");
    let line = "compare chair --recipes classic --seeds 1 --steps 5 --protocol blender --out both";
    let ended = irradia(folder.path(), line).success();
    for says in [
        "irradia classic",
        "3DGS",
        "35.83",
        "instant-ngp",
        "not comparable",
        "instead of 800",
    ] {
        assert!(ended.stdout.contains(says), "{says}: {ended:?}");
    }
    let both = folder.path().join("both");
    let published = json(&both.join("compare.json"))["published"].clone();
    assert!(
        published[0]["scene"] == "chair" && published[0]["psnr"] == 33.0,
        "{published}"
    );
    let request = fs::read_to_string(both.join("chair/classic/seed_0/request.json")).expect("a request");
    assert!(
        request.contains("--background") && request.contains("white"),
        "{request}"
    );

    fs::rename(folder.path().join("chair"), folder.path().join("teapot")).expect("renamed");
    let ended = irradia(folder.path(), &line.replace("chair", "teapot")).success();
    assert!(ended.stdout.contains("teapot: no published figures"), "{ended:?}");
    irradia(folder.path(), &(line.to_owned() + " --downscale 2")).refused(2, &["--protocol"]);
    irradia(
        folder.path(),
        "compare teapot --recipes classic --protocol nerf --out x",
    )
    .refused(2, &["mipnerf360"]);
}

#[test]
fn mistakes_are_found_before_any_training() {
    let folder = with_data();
    let cases = [
        ("compare data --recipes nonsense --out both", "nonsense"),
        ("compare data --recipes classic,classic:no.such=1 --out both", "no"),
        (
            "compare data --recipes fast:render.background=[1,0,0],classic:no.such=1 --out both",
            "`no`",
        ),
        ("compare nowhere --recipes classic --out both", "nowhere"),
        ("compare data --recipes absent.toml --out both", "absent.toml"),
        ("compare data --recipes classic --out both --device abacus", "abacus"),
    ];
    for (line, word) in cases {
        irradia(folder.path(), line).refused(2, &[word]);
        assert!(!folder.path().join("both").exists(), "{line}");
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_comparison_keeps_finished_runs() {
    use std::time::{Duration, Instant};
    let folder = with_data();
    let line = "compare data --recipes classic,classic:max_splats=4000 --seeds 1 --out both --threads 1";
    // The first run is made beforehand; the second would take minutes.
    let short = "compare data --recipes classic:stage.warmup.steps=1 --seeds 1 --steps 5 --out both";
    irradia(folder.path(), short).success();
    let mut command = program(folder.path());
    let child = command.args(line.split_whitespace()).spawn().expect("it starts");
    let events = folder.path().join("both/data/classic/seed_0/events.jsonl");
    let started = Instant::now();
    while !events.exists() {
        assert!(started.elapsed() < Duration::from_secs(60), "no training began");
        std::thread::sleep(Duration::from_millis(20));
    }
    let interrupt = std::process::Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(interrupt.expect("kill").success());
    let ended: ProgramOutput = child.wait_with_output().expect("it ends").into();
    let ended = ended.success();
    assert!(ended.stdout.contains("stopped"), "{ended:?}");
    assert!(folder.path().join("both/compare.json").is_file());
}
