//! Requests: validation, and their storage in a run's folder.

use crate::{begin, dataset, finished, folder, input, scene};
use irradia_runs::formats::Lenses;
use irradia_runs::prelude::*;
use irradia_runs::{ReadingOptions, RunRecord, read_recipe};
use std::fs;
use std::path::Path;

#[test]
fn each_setting_out_of_range_is_rejected_by_name() {
    let good = || TrainInput::new("photos", "run");
    let reading = |reading: Reading| TrainInput { reading, ..good() };
    let cases = [
        (
            TrainInput {
                steps: Some(0),
                ..good()
            },
            "steps 0: must be 1 or more",
        ),
        (
            TrainInput {
                max_splats: Some(0),
                ..good()
            },
            "max_splats 0: must be 1 or more",
        ),
        (
            TrainInput {
                budget: Some(0.0),
                ..good()
            },
            "budget 0: must be more than 0 seconds",
        ),
        (
            TrainInput {
                budget: Some(f64::NAN),
                ..good()
            },
            "budget NaN: must be more than 0 seconds",
        ),
        (
            TrainInput {
                steps: Some(9),
                budget: Some(9.0),
                ..good()
            },
            "steps 9: cannot be combined with a budget",
        ),
        (
            TrainInput {
                until_psnr: Some(f64::INFINITY),
                ..good()
            },
            "until_psnr inf: must be a number of dB",
        ),
        (
            reading(Reading {
                downscale: 0.5,
                ..Reading::default()
            }),
            "downscale 0.5: must be 1 or more",
        ),
        (
            reading(Reading {
                downscale: f32::NAN,
                ..Reading::default()
            }),
            "downscale NaN: must be 1 or more",
        ),
        (
            reading(Reading {
                max_side: Some(0),
                ..Reading::default()
            }),
            "max_side 0: must be 1 or more",
        ),
        (
            reading(Reading {
                max_side: Some(64),
                downscale: 2.0,
                ..Reading::default()
            }),
            "max_side 64: cannot be combined with downscale",
        ),
    ];
    for (input, line) in cases {
        let error = input.check().expect_err(line);
        assert_eq!(error.to_string(), line);
        assert!(error.is_request());
    }
    let named = |name: &str| TrainInput {
        recipe: name.into(),
        ..good()
    };
    let set = |change: &str| TrainInput {
        set: vec![change.into()],
        ..good()
    };
    let format = reading(Reading {
        format: Some("exr".into()),
        ..Reading::default()
    });
    for (input, words) in [
        (format, ["format exr", "colmap"]),
        (named("clasic"), ["`clasic`", "classic"]),
        (named("absent.toml"), ["cannot read recipe", "absent.toml"]),
        (set("max_splat=3"), ["`max_splat`", "`max_splats`"]),
        (set("params.ssim_weight=2"), ["params.ssim_weight", "0 to 1"]),
    ] {
        let error = input.check().expect_err(words[0]);
        let line = error.to_string();
        assert!(words.iter().all(|word| line.contains(word)), "{line}");
        assert!(error.is_request() && line.lines().count() == 1, "{line}");
    }
}

#[test]
fn overrides_and_the_cap_change_the_recipe() {
    let input = TrainInput {
        set: vec!["eval_every=7".into()],
        max_splats: Some(123),
        ..TrainInput::new("photos", "run")
    };
    let request = input.check().expect("a request");
    assert_eq!((request.recipe().eval_every, request.recipe().max_splats), (7, 123));
    assert!(request.input().data.is_absolute());
}

#[test]
fn an_existing_run_is_replaced_only_on_request() {
    let folder = folder();
    begin(folder.path(), "run", 2);
    let again = || input(folder.path(), "run", 3);
    let refused = |input: TrainInput, word: &str| {
        let error = Run::begin_on(input.check().expect("a request"), dataset()).err();
        let error = error.expect("refused");
        assert!(error.to_string().contains(word) && error.is_request(), "{error}");
    };
    refused(again(), "already holds a run");
    refused(input(folder.path(), "run/run.json", 3), "is a file");
    let overwrite = TrainInput {
        overwrite: true,
        ..again()
    };
    Run::begin_on(overwrite.check().expect("a request"), dataset()).expect("replaced");
    let (_, record) = RunFolder::open(&folder.path().join("run")).expect("a run");
    assert_eq!((record.input.steps, record.complete), (Some(3), false));
}

#[test]
fn a_replaced_run_leaves_the_files_of_others() {
    let folder = folder();
    finished(folder.path(), "run", 3);
    let others = ["eval/notes.txt", "checkpoints/other.ckpt"].map(|name| folder.path().join("run").join(name));
    others
        .iter()
        .for_each(|file| std::fs::write(file, "").expect("written"));
    let request = || TrainInput {
        overwrite: true,
        ..input(folder.path(), "run", 3)
    };
    // A run cannot begin with the splats that it replaces.
    let from_itself = TrainInput {
        from: Some(folder.path().join("run")),
        ..request()
    };
    let error = Run::begin_on(from_itself.check().expect("a request"), dataset()).err();
    let error = error.expect("refused").to_string();
    assert!(error.contains("choose another --out"), "{error}");
    assert!(folder.path().join("run/scene.ply").is_file());
    Run::begin_on(request().check().expect("a request"), dataset()).expect("replaced");
    assert!(others.iter().all(|file| file.is_file()));
    assert!(!folder.path().join("run/scene.ply").exists());
}

#[test]
fn a_run_is_repeated_on_the_same_photographs_only() {
    let folder = folder();
    finished(folder.path(), "run", 5);
    let replay = |out: &str| {
        let input = TrainInput::replay_of(folder.path().join("run"), folder.path().join(out)).expect("a run");
        input.check().expect("a request")
    };
    let mut other = dataset();
    let first = other.train[0];
    other.views[first].name = "another".to_owned();
    let error = Run::begin_on(replay("other"), other)
        .err()
        .expect("refused")
        .to_string();
    assert!(
        error.contains("changed") && !folder.path().join("other").exists(),
        "{error}"
    );
    let mut again = Run::begin_on(replay("again"), dataset()).expect("a run");
    again.train(&mut []).expect("trains");
    again.finish().expect("finishes");
    assert!(crate::scene(folder.path(), "again") == crate::scene(folder.path(), "run"));
}

#[test]
fn a_continued_scene_is_repeated_from_the_same_scene_only() {
    let folder = folder();
    for name in ["first", "continued"] {
        let mut input = input(folder.path(), name, 3);
        input.from = (name == "continued").then(|| folder.path().join("first"));
        let mut run = Run::begin_on(input.check().expect("a request"), dataset()).expect("a run");
        run.train(&mut []).expect("trains");
        run.finish().expect("finishes");
    }
    let replay = |out: &str| {
        let input = TrainInput::replay_of(folder.path().join("continued"), folder.path().join(out)).expect("a run");
        Run::begin_on(input.check().expect("a request"), dataset())
    };
    assert!(replay("again").is_ok());
    let first = folder.path().join("first/scene.ply");
    std::fs::copy(folder.path().join("continued/scene.ply"), &first).expect("replaced");
    let error = replay("other").err().expect("refused").to_string();
    assert!(error.contains("first/scene.ply has changed since"), "{error}");
}

#[test]
fn held_out_views_on_which_the_first_splats_were_trained_are_reported() {
    let folder = folder();
    finished(folder.path(), "run", 3);
    let warnings = |holdout: Option<&str>| {
        let mut input = TrainInput {
            from: Some(folder.path().join("run")),
            overwrite: true,
            ..input(folder.path(), "continued", 3)
        };
        input.reading.holdout = holdout.map(str::to_owned);
        let mut data = dataset();
        std::mem::swap(&mut data.train, &mut data.test);
        let run = Run::begin_on(input.check().expect("a request"), data).expect("a run");
        run.trainer().dataset.warnings.join("\n")
    };
    assert!(
        warnings(Some("5")).contains("4 of the 4 held-out views"),
        "{}",
        warnings(Some("5"))
    );
    assert!(!warnings(None).contains("held-out views"), "{}", warnings(None));
}

#[test]
fn a_request_round_trips() {
    let folder = folder();
    let asked = TrainInput {
        recipe: "classic".into(),
        set: vec!["eval_every=7".into()],
        until_psnr: Some(31.5),
        seed: u64::MAX,
        reading: Reading {
            format: Some("blender".into()),
            downscale: 1.5,
            max_side: None,
            holdout: Some("5".into()),
            images: Some(std::path::absolute("photographs").expect("a path")),
            lenses: Lenses::Whole,
            readout: Some("0.5:left".to_owned()),
        },
        ..input(folder.path(), "run", 4)
    };
    Run::begin_on(asked.clone().check().expect("a request"), dataset()).expect("a run");
    let run = folder.path().join("run");
    let (_, record) = RunFolder::open(&run).expect("a run");
    let kept = TrainInput {
        data: std::path::absolute("memory").expect("a path"),
        out: "".into(),
        ..asked.clone()
    };
    assert_eq!(record.input, kept);
    // A resumed run uses the resolved recipe in its folder.
    let resumed = TrainInput::of_run(&run).expect("a run");
    assert_eq!(
        (resumed.seed, resumed.until_psnr, resumed.set.len()),
        (u64::MAX, Some(31.5), 0)
    );
    let request = resumed.check().expect("a request");
    let recipe = read_recipe("classic", &asked.set).expect("a recipe");
    assert_eq!(request.recipe().hash(), recipe.hash());
}

#[test]
fn options_take_precedence_over_those_of_a_run_even_if_they_are_the_defaults() {
    let of_run = Reading {
        downscale: 2.0,
        max_side: None,
        holdout: Some("5".into()),
        lenses: Lenses::Whole,
        ..Reading::default()
    };
    assert_eq!(ReadingOptions::default().with_fallback(of_run.clone()), of_run);
    let usual = Reading::default();
    let given = ReadingOptions {
        max_side: usual.max_side,
        lenses: Some(usual.lenses),
        ..ReadingOptions::default()
    };
    let expected = Reading {
        holdout: of_run.holdout.clone(),
        ..usual
    };
    assert_eq!(given.with_fallback(of_run.clone()), expected);
    let full = ReadingOptions {
        full_size: true,
        ..ReadingOptions::default()
    };
    let read = full.with_fallback(of_run);
    assert_eq!((read.downscale, read.max_side, read.lenses), (1.0, None, Lenses::Whole));
}

#[test]
fn a_process_that_died_before_its_run_began_leaves_no_run() {
    let folder = folder();
    let run = folder.path().join("run");
    fs::create_dir(&run).expect("a folder");
    fs::write(run.join("recipe.toml"), "somebody's own").expect("written");
    let again = || Run::begin_on(input(folder.path(), "run", 2).check().expect("a request"), dataset());
    assert!(
        again()
            .err()
            .expect("refused")
            .to_string()
            .contains("already holds a run")
    );
    fs::write(run.join(".lock"), "4194305").expect("written");
    again().expect("a run");
}

/// A file as written by the first builds of 0.1.0: no recipe, and `lpips` in later ones only.
#[test]
fn an_old_run_json_is_read() {
    let text = r#"{
        "data": "/photos", "format": null, "downscale": 2.0, "max_side": null, "until_psnr": null,
        "budget": 90.0, "seed": 3, "steps": 500, "complete": false
    }"#;
    let record: RunRecord = serde_json::from_str(text).expect("an old record");
    assert_eq!(record.input.data, Path::new("/photos"));
    assert_eq!((record.input.seed, record.input.reading.downscale), (3, 2.0));
    // It had no default size limit.
    assert_eq!(record.input.reading.max_side, None);
    assert_eq!((record.input.lpips, record.complete), (None, false));

    let folder = folder();
    let run = folder.path().join("run");
    begin(folder.path(), "run", 3);
    fs::write(run.join("run.json"), text).expect("written");
    let input = TrainInput::of_run(&run).expect("an old run");
    // A budget given when the run was resumed replaces its steps.
    assert_eq!((input.budget, input.steps), (Some(90.0), None));
    input.check().expect("a request");
}

#[test]
fn a_moved_run_keeps_the_photographs_that_were_posed_for_it() {
    let folder = folder();
    let [run, moved] = ["run", "moved"].map(|name| folder.path().join(name));
    let posed = TrainInput {
        data: run.join("posed"),
        ..input(folder.path(), "run", 2)
    };
    drop(Run::begin_on(posed.check().expect("a request"), dataset()).expect("a run"));
    fs::create_dir(run.join("posed")).expect("a folder");
    fs::rename(&run, &moved).expect("moved");
    // Another run takes its place.
    fs::create_dir_all(run.join("posed")).expect("a folder");
    assert_eq!(TrainInput::of_run(&moved).expect("a run").data, moved.join("posed"));
}

#[test]
fn folders_without_a_run_get_one_line_of_error() {
    let folder = folder();
    let error = TrainInput::of_run(folder.path()).expect_err("no run");
    let line = error.to_string();
    assert!(line.contains("holds no run") && line.contains("run.json"), "{line}");
    assert!(!error.is_request());
    fs::write(folder.path().join("run.json"), "{").expect("written");
    let line = TrainInput::of_run(folder.path()).expect_err("damaged").to_string();
    assert!(line.contains("run.json is damaged"), "{line}");
}

#[test]
fn unreadable_weights_leave_no_run() {
    let folder = folder();
    let input = TrainInput {
        lpips: Some("nowhere.safetensors".into()),
        ..input(folder.path(), "run", 2)
    };
    let error = Run::begin_on(input.check().expect("a request"), dataset()).err();
    let line = error.expect("refused").to_string();
    assert!(line.contains("nowhere.safetensors"), "{line}");
    assert!(!folder.path().join("run").exists());
}

#[test]
fn missing_lpips_weights_are_a_warning() {
    let named = |recipe: &str| {
        let input = TrainInput {
            recipe: recipe.into(),
            ..TrainInput::new("photos", "run")
        };
        input.check().expect("a request").warnings()
    };
    assert!(named("classic").is_empty());
    assert!(matches!(&named("curriculum")[..], [one] if one.contains("LPIPS")));
}

#[test]
fn a_run_trains_on_files_and_on_a_dataset_in_memory() {
    let folder = folder();
    let data = folder.path().join("data");
    write_synth_dataset(&data, &crate::SMALL).expect("written");
    let make = |name: &str, begin: &dyn Fn(TrainRequest) -> Result<Run, RunError>| {
        let request = TrainInput {
            data: data.clone(),
            ..input(folder.path(), name, 6)
        };
        let mut run = begin(request.check().expect("a request")).expect("a run");
        run.train(&mut []).expect("trains");
        run.finish().expect("finishes");
        scene(folder.path(), name).len()
    };
    let sizes = ["files", "memory"].map(|name| match name {
        "files" => make(name, &Run::begin),
        _ => make(name, &|request| Run::begin_on(request, dataset())),
    });
    // Poses pass through a file's matrices: approximately equal, not bit for bit.
    assert_eq!(sizes[0], sizes[1]);
}
