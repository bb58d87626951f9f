use super::*;
use crate::report::CurvePoint;

fn report(seconds: f64, psnr: f64) -> Report {
    let point = |step: u64, psnr| CurvePoint {
        step,
        seconds: seconds * step as f64 / 100.0,
        loss: 1.0 / step as f64,
        psnr,
        splats: 10,
    };
    let mut curve: Vec<CurvePoint> = (1..=100).map(|step| point(step, None)).collect();
    curve[49].psnr = Some(psnr - 2.0);
    curve[99].psnr = Some(psnr - 0.1);
    Report {
        steps: 100,
        training_seconds: seconds,
        cpu_seconds: 2.0 * seconds,
        psnr,
        ssim: 0.8,
        splats: 10,
        peak_rss_bytes: 5_000_000,
        curve,
        ..Report::default()
    }
}

fn run(seed: u64, report: Option<Report>) -> Run {
    Run {
        seed,
        folder: format!("room/classic/seed_{seed}"),
        error: report.is_none().then(|| "no memory | left".to_owned()),
        figures: report.map(|r| Figures::of(&r, &[0.5; 20])),
    }
}

fn room() -> Scene {
    let runs = vec![
        (
            "classic".to_owned(),
            vec![
                run(0, Some(report(10.0, 26.0))),
                run(1, Some(report(12.0, 27.0))),
                run(2, None),
            ],
        ),
        ("fast:a=1".to_owned(), vec![run(0, Some(report(4.0, 25.5)))]),
    ];
    Scene::new("room".into(), "data/room".into(), runs, None)
}

#[test]
fn a_second_network_and_published_figures_are_shown_beside_ours() {
    let trained = Report {
        lpips: Some(0.1),
        lpips_net: Some("squeeze".into()),
        unseen_lpips: Some(0.2),
        unseen_lpips_net: Some("vgg".into()),
        trained_on_lpips: Some("squeeze".into()),
        ..report(10.0, 26.0)
    };
    let runs = vec![("curriculum".to_owned(), vec![run(0, Some(trained))])];
    let scenes = vec![Scene::new("chair".into(), "data/chair".into(), runs, None)];
    let comparison = Comparison {
        notes: lpips_bias_notes(&scenes),
        published: published("blender", "chair", "chair"),
        scenes,
        ..Comparison::default()
    };
    assert_eq!(
        comparison.notes,
        ["curriculum was trained on LPIPS (squeeze), which flatters that figure; LPIPS (vgg) is not part of its loss"]
    );
    for text in [to_text(&comparison), to_markdown(&comparison)] {
        for says in [
            "LPIPS (squeeze)",
            "0.2000",
            "irradia curriculum",
            "0.200",
            "35.83",
            "flatters",
        ] {
            assert!(text.contains(says), "{says}: {text}");
        }
    }
    assert!(published("blender", "chair", "chair").len() > 3);
}

#[test]
fn tables_name_the_network_of_lpips() {
    let with = |net: &str| Report {
        lpips: Some(0.1),
        lpips_net: Some(net.to_owned()),
        ..report(10.0, 26.0)
    };
    let head = |nets: &[&str]| {
        let runs = nets
            .iter()
            .zip(0..)
            .map(|(net, seed)| run(seed, Some(with(net))))
            .collect();
        let scene = Scene::new("room".into(), "data/room".into(), vec![("fast".to_owned(), runs)], None);
        let comparison = Comparison {
            scenes: vec![scene],
            ..Comparison::default()
        };
        let (text, markdown) = (to_text(&comparison), to_markdown(&comparison));
        assert!(text.contains(&comparison.lpips_heading()) && markdown.contains(&comparison.lpips_heading()));
        comparison.lpips_heading()
    };
    assert_eq!(head(&["alex", "alex"]), "LPIPS (alex)");
    assert_eq!(head(&["squeeze", "alex"]), "LPIPS (alex, squeeze)");
    assert_eq!(head(&[]), "LPIPS");
}

#[test]
fn spreads_are_means_with_sample_deviations() {
    assert_eq!(Spread::from_values([]), None);
    assert_eq!(Spread::from_values([f64::NAN]), None);
    let one = Spread::from_values([3.0, f64::INFINITY]).unwrap();
    assert_eq!((one.mean, one.deviation, one.runs), (3.0, None, 1));
    let three = Spread::from_values([1.0, 2.0, 3.0]).unwrap();
    assert_eq!((three.mean, three.deviation, three.runs), (2.0, Some(1.0), 3));
}

#[test]
fn levels_are_interpolated_between_evaluations() {
    let point = |step, seconds, psnr| EvaluationPoint { step, seconds, psnr };
    let evaluations = [
        point(10, 1.0, 20.0),
        point(20, 3.0, 24.0),
        point(30, 5.0, 22.0),
        point(40, 9.0, 25.0),
    ];
    let seconds = |psnr| position_at_psnr(&evaluations, psnr, |l| l.seconds);
    assert_eq!(seconds(21.0), Some(1.5));
    assert_eq!(seconds(24.0), Some(3.0));
    // Only the first time counts; the fall in between is ignored.
    assert_eq!(seconds(25.0), Some(9.0));
    assert_eq!(seconds(19.0), Some(1.0), "no later than the first evaluation");
    assert_eq!(seconds(25.1), None);
    assert_eq!(position_at_psnr(&evaluations, 22.0, |l| l.step as f64), Some(15.0));
    assert_eq!(fall_fraction(&evaluations), Some(1.0 / 3.0));
    assert_eq!(fall_fraction(&evaluations[..1]), None);
}

#[test]
fn rises_are_counted_between_blocks() {
    let falling: Vec<f64> = (0..100).map(|i| 1.0 / f64::from(i + 1)).collect();
    assert_eq!(rise_fraction(&falling), Some(0.0));
    let rising: Vec<f64> = falling.iter().rev().copied().collect();
    assert_eq!(rise_fraction(&rising), Some(1.0));
    // Alternating from step to step, but falling over ten.
    let noisy: Vec<f64> = (0..100)
        .map(|i| 10.0 - 0.05 * f64::from(i) + f64::from(i % 2))
        .collect();
    assert_eq!(rise_fraction(&noisy), Some(0.0));
    assert_eq!(rise_fraction(&[1.0; 9]), None);
    assert_eq!(rise_fraction(&[f64::NAN; 50]), None);
}

#[test]
fn a_scene_summarises_its_runs_without_failed_ones() {
    let scene = room();
    let [classic, fast] = &scene.entries[..] else {
        panic!("two recipes")
    };
    let psnr = classic.psnr.unwrap();
    assert_eq!((psnr.mean, psnr.runs), (26.5, 2));
    assert!((psnr.deviation.unwrap() - 0.5f64.sqrt()).abs() < 1e-12);
    assert_eq!(classic.lpips, None);
    let levels: Vec<f64> = fast.reached.iter().map(|r| r.psnr).collect();
    assert_eq!(levels, [23.5, 24.0, 24.5, 25.0, 25.5, 26.0, 26.5, 27.0]);
    let at = |entry: &Entry, psnr: f64| entry.reached.iter().find(|r| r.psnr == psnr).unwrap().seconds;
    // The final evaluation is that of the report and replaces the one at the same step.
    assert_eq!(classic.runs[0].figures.as_ref().unwrap().evaluations.len(), 2);
    assert_eq!(at(fast, 25.5).unwrap().mean, 4.0);
    assert_eq!(at(fast, 26.0), None);
    // 25 dB: at 7.5 s by one run; at 6 s, its first evaluation, by the other.
    assert_eq!(at(classic, 25.0).unwrap().mean, 6.75);
    assert_eq!(at(classic, 26.5).map(|s| s.runs), Some(1));
    assert_eq!(
        scene.mark,
        Some(Mark {
            psnr: 26.5,
            seconds: 11.0
        })
    );
}

#[test]
fn the_mark_is_the_final_result_of_the_first_recipe() {
    let runs = vec![
        ("classic".to_owned(), vec![run(0, Some(report(12.0, 26.0)))]),
        (
            "fast".to_owned(),
            vec![run(0, Some(report(4.0, 27.0))), run(1, Some(report(4.0, 26.0)))],
        ),
        (
            "slow".to_owned(),
            vec![run(0, Some(report(4.0, 27.0))), run(1, Some(report(4.0, 25.0)))],
        ),
    ];
    let scene = Scene::new("room".into(), "data/room".into(), runs, None);
    let [classic, fast, slow] = &scene.entries[..] else {
        panic!("three recipes")
    };
    assert_eq!(classic.mark_share, Some(1.0));
    // At 3 s, half-way from 25 to 27 dB, by one run; at its end by the other.
    assert_eq!(fast.to_mark.as_ref().unwrap().seconds.unwrap().mean, 3.5);
    assert_eq!(fast.mark_share, Some(3.5 / 12.0));
    assert_eq!(slow.to_mark.as_ref().unwrap().seconds.unwrap().runs, 1);
    assert_eq!(
        slow.mark_share, None,
        "a run that never reaches it is not excluded from a mean"
    );
    let means = overall(std::slice::from_ref(&scene));
    let marks: Vec<_> = means.iter().map(|o| (o.marks, o.marks_in_a_third)).collect();
    assert_eq!(marks, [(1, 0), (1, 1), (0, 0)]);
    let comparison = Comparison {
        scenes: vec![scene],
        ..Comparison::default()
    };
    let row = "| room | 26.00 dB | 12.0 s | 12.0 (1.00) | 3.5 (0.29) | 3.0 (1 of 2) |";
    assert!(to_markdown(&comparison).contains(row), "{}", to_markdown(&comparison));
}

#[test]
fn the_mean_over_scenes_covers_only_scenes_with_figures_of_all_recipes() {
    let mut half = room();
    half.entries[1].psnr = None;
    assert!(overall(&[half.clone()]).is_empty());
    let means = overall(&[room(), half, room()]);
    assert_eq!((means[0].scenes, means[0].psnr, means[1].psnr), (2, 26.5, 25.5));
    assert_eq!(means[0].lpips, None);
}

fn comparison() -> Comparison {
    let scenes = vec![room()];
    Comparison {
        conditions: vec!["100 steps".into(), "3 seeds".into()],
        device: "CPU".into(),
        overall: overall(&scenes),
        scenes,
        ..Comparison::default()
    }
}

#[test]
fn tables_show_spreads_and_failures() {
    let text = to_text(&comparison());
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 8, "{text}");
    assert!(lines[1].contains("26.50 ± 0.71") && lines[1].ends_with("2/3"), "{text}");
    assert!(lines[2].contains("fast:a=1") && lines[2].contains("25.50 "), "{text}");
    assert!(
        lines[7].starts_with("failed: room, classic, seed 2: no memory"),
        "{text}"
    );
    let markdown = to_markdown(&comparison());
    assert!(
        markdown.starts_with("100 steps, 3 seeds. CPU.\n\n| scene | recipe |"),
        "{markdown}"
    );
    assert!(
        markdown.contains("no memory \\| left") && markdown.contains("| 27 dB |"),
        "{markdown}"
    );
    assert!(markdown.contains("12.0 (1 of 2)"), "{markdown}");
}

#[test]
fn the_page_is_self_contained_and_hostile_text_stays_data() {
    let mut comparison = comparison();
    comparison.scenes[0].name = "</script><script>alert(1)</script>".into();
    let html = to_html(&comparison);
    assert!(!html.contains("<script>alert") && html.matches("</script>").count() == 2);
    let rest = html.replace("http://www.w3.org/2000/svg", "");
    for word in [
        "http://",
        "https://",
        "src=\"",
        "@import",
        "url(",
        "/*STYLE*/",
        "/*SCRIPT*/",
        "/*DATA*/",
    ] {
        assert!(!rest.contains(word), "{word}");
    }
}
