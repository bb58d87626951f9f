use crate::{cameras, cloud, draft};
use irradia_edit::{Draft, Edit, Mode, SelectStep, Selection, Shape, Viewpoint, apply_to, open_nothing, select};
use irradia_scene::{GaussianCloud, Similarity, sh};
use irradia_splat::logit;

fn selected(draft: &Draft, words: &str) -> Selection {
    let edit: Edit = format!("delete {words}")
        .parse()
        .unwrap_or_else(|e| panic!("{words}: {e}"));
    select(draft, &edit.select.unwrap()).unwrap_or_else(|e| panic!("{words}: {e}"))
}

/// Identical splats at the given positions.
fn at(means: &[[f32; 3]]) -> Draft {
    let n = means.len();
    let cloud = GaussianCloud {
        means: means.to_vec(),
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        log_scales: vec![[0.05f32.ln(); 3]; n],
        opacity_logits: vec![logit(0.9); n],
        sh: vec![0.5; 3 * n],
        ..GaussianCloud::default()
    };
    Draft::new(cloud, Vec::new())
}

#[test]
fn regions_contain_what_is_in_them() {
    let line = at(&[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]);
    for (words, expected) in [
        ("all", vec![0, 1, 2, 3]),
        ("sphere center=1,0,0 radius=1", vec![0, 1, 2]),
        ("box center=2,0,0 size=2.2,1,1", vec![1, 2, 3]),
        // A quarter turn about z: the long edge lies along y.
        ("box center=2,0,0 size=2.2,1,1 rotation=1,0,0,1", vec![2]),
        ("half-space point=1.5,9,9 normal=2,0,0", vec![2, 3]),
        ("sphere center=0,0,0 radius=0.5 invert", vec![1, 2, 3]),
        ("-sphere center=0,0,0 radius=0.5", vec![1, 2, 3]),
        ("&sphere center=0,0,0 radius=1.5", vec![0, 1]),
        ("sphere center=0,0,0 radius=0.5 grow by=1.1", vec![0, 1]),
        ("sphere center=0,0,0 radius=0.5 connected gap=1.1", vec![0, 1, 2, 3]),
        ("sphere center=0,0,0 radius=0.5 connected gap=0.4", vec![0]),
        ("clusters min=2 gap=1.1", vec![0, 1, 2, 3]),
        ("clusters min=2 gap=0.4", vec![]),
    ] {
        assert_eq!(selected(&line, words).indices(), expected, "{words}");
    }
}

#[test]
fn ranges_contain_what_is_like_them() {
    let mut scene = at(&[[0.0; 3]; 3]);
    scene.cloud.opacity_logits = [0.1, 0.5, 0.9].map(logit).to_vec();
    scene.cloud.log_scales = [[0.1, 0.1, 0.1], [0.1, 0.1, 1.0], [2.0, 2.0, 0.1]]
        .map(|s: [f32; 3]| s.map(f32::ln))
        .to_vec();
    let colors = [[1.0, 0.0, 0.0], [0.9, 0.2, 0.1], [0.0, 0.0, 1.0]];
    scene.cloud.sh = colors.as_flattened().iter().map(|c| sh::dc_from_color(*c)).collect();
    for (words, expected) in [
        ("opacity min=0.4", vec![1, 2]),
        ("opacity min=0.4 max=0.6", vec![1]),
        ("size max=0.5", vec![0]),
        ("size min=1.5", vec![2]),
        ("elongation min=5", vec![1]),
        ("color low=0.5,0,0 high=1.1,0.5,0.5", vec![0, 1]),
    ] {
        assert_eq!(selected(&scene, words).indices(), expected, "{words}");
    }
}

#[test]
fn colours_beyond_black_and_white_are_black_and_white() {
    let mut scene = at(&[[0.0; 3]; 4]);
    let colors = [[-0.3; 3], [0.0; 3], [1.0; 3], [1.4; 3]];
    scene.cloud.sh = colors.as_flattened().iter().map(|c| sh::dc_from_color(*c)).collect();
    for (words, expected) in [
        ("color low=0.9,0.9,0.9 high=1,1,1", vec![2, 3]),
        ("color low=0,0,0 high=0.1,0.1,0.1", vec![0, 1]),
        // As the page's dropper asks for colours like that of a splat.
        ("color low=1.3,1.3,1.3 high=1.5,1.5,1.5", vec![2, 3]),
        ("color low=-0.4,-0.4,-0.4 high=-0.2,-0.2,-0.2", vec![0, 1]),
    ] {
        assert_eq!(selected(&scene, words).indices(), expected, "{words}");
    }
}

/// A bridge of splats between two groups connects them until it is hidden.
#[test]
fn hidden_splats_connect_nothing() {
    let bridge = at(&[0.0, 0.1, 0.2, 1.0, 2.0, 3.0, 4.0, 4.1].map(|x| [x, 0.0, 0.0]));
    let hidden = crate::edited(&bridge, &["hide box center=2,0,0 size=2.2,1,1"]);
    let left = "sphere center=0,0,0 radius=0.05";
    for (words, expected) in [
        ("connected gap=1.05", vec![0, 1, 2]),
        ("connected gap=1.05 clusters min=3 gap=1.05", vec![0, 1, 2]),
        ("connected gap=1.05 clusters max=2 gap=1.05", vec![0, 1, 2, 6, 7]),
    ] {
        let words = format!("{left} {words}");
        assert_eq!(selected(&bridge, &words), Selection::all(8), "{words}");
        assert_eq!(selected(&hidden, &words).indices(), expected, "{words}");
    }
    // The splats to show are present.
    let shown = crate::edited(&hidden, &["show clusters min=8 gap=1.05"]);
    assert!(shown.hidden.is_empty());
    // What is locked is seen, and connects.
    let locked = crate::edited(&bridge, &["lock box center=2,0,0 size=2.2,1,1"]);
    assert_eq!(
        selected(&locked, &format!("{left} connected gap=1.05")).indices(),
        [0, 1, 2, 6, 7]
    );
}

#[test]
fn selections_are_sets() {
    let scene = draft(500, 0);
    let (a, b) = ("sphere center=0.5,0,0 radius=0.7", "box center=0,0.5,0 size=1,1,1");
    let count = |words: &str| selected(&scene, words).count();
    assert_eq!(
        count(&format!("{a} {b}")) + count(&format!("{a} &{b}")),
        count(a) + count(b)
    );
    assert_eq!(count(&format!("{a} -{b}")), count(a) - count(&format!("{a} &{b}")));
    assert_eq!(count(&format!("{a} invert")), 500 - count(a));
    assert_eq!(selected(&scene, &format!("{a} invert invert")), selected(&scene, a));
    assert_eq!(count(&format!("{a} -{a}")), 0);
    let grown = selected(&scene, &format!("{a} grow by=0.1"));
    let within = selected(&scene, "sphere center=0.5,0,0 radius=0.8");
    assert!(grown.count() >= count(a) && grown.indices().iter().all(|i| within.contains(*i as usize)));
}

#[test]
fn growing_finds_exactly_what_is_near() {
    let scene = draft(400, 0);
    let seed = selected(&scene, "sphere center=0,0,0 radius=0.4");
    let grown = selected(&scene, "sphere center=0,0,0 radius=0.4 grow by=0.15");
    let distance = |i: usize, j: usize| {
        let d: f32 = (0..3)
            .map(|c| (scene.cloud.means[i][c] - scene.cloud.means[j][c]).powi(2))
            .sum();
        d.sqrt()
    };
    for i in 0..400 {
        let near = seed.indices().iter().any(|j| distance(i, *j as usize) <= 0.15);
        assert_eq!(grown.contains(i), near, "{i}");
    }
    let far = selected(&scene, "sphere center=0,0,0 radius=0.4 grow by=100");
    assert_eq!(far, Selection::all(400));
    assert!(selected(&scene, "sphere center=9,0,0 radius=0.4 grow by=100").is_empty());
    // Distances are in the dataset's coordinates.
    let mut line = at(&[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]);
    line.cloud.world_from_dataset = Similarity {
        scale: 2.0,
        center: glam::DVec3::new(10.0, 0.0, 0.0),
    };
    let near = selected(&line, "sphere center=10,0,0 radius=0.1 grow by=1.1");
    assert_eq!(near.indices(), [0, 1, 2]);
}

#[test]
fn a_known_selection_is_not_evaluated_again() {
    let edit = |line: &str| -> Edit { line.parse().unwrap_or_else(|error| panic!("{line}: {error}")) };
    for line in [
        "delete sphere center=0,0,0 radius=0.4",
        "move by=1,0,0 all",
        "opacity factor=0.5",
    ] {
        let (edit, mut with) = (edit(line), draft(100, 0));
        let known = select(&with, edit.select.as_deref().unwrap_or_default()).expect("possible");
        apply_to(&mut with, &edit, &known, &open_nothing).expect("possible");
        assert!(with == crate::edited(&draft(100, 0), &[line]), "{line}");
    }
    // This one needs cameras, unless its result is known.
    let mut scene = Draft::new(cloud(5, 0, 1), Vec::new());
    let known = Selection::of(5, |i| i < 2);
    apply_to(&mut scene, &edit("delete views min=1"), &known, &open_nothing).expect("not evaluated");
    assert_eq!(scene.len(), 3);
}

#[test]
fn what_is_drawn_over_a_picture_selects_what_it_covers() {
    let mut scene = at(&[[0.0; 3], [0.0, 0.0, -1.0], [0.5, 0.0, 0.0], [0.0, 0.0, -9.0]]);
    scene.cameras = cameras();
    // From z = -3, looking along +z: three on the axis, one of them behind the camera.
    let camera = Viewpoint {
        position: [0.0, 0.0, -3.0],
        rotation: [1.0, 0.0, 0.0, 0.0],
        focal: [100.0, 100.0],
        principal: [50.0, 40.0],
        size: [100, 80],
    };
    let square = |half: f64| {
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        corners.map(|[x, y]| [50.0 + half * x, 40.0 + half * y]).to_vec()
    };
    let of = |shape: Shape| select(&scene, &[SelectStep::add(shape)]).unwrap().indices();
    let polygon = |half: f64, visible: bool| {
        of(Shape::Polygon {
            camera,
            points: square(half),
            visible,
        })
    };
    assert_eq!(polygon(5.0, false), [0, 1]);
    assert_eq!(polygon(30.0, false), [0, 1, 2]);
    // The nearer of the two is nearly opaque but no larger than the farther one, whose rim still shows: make it larger.
    scene.cloud.log_scales[1] = [0.3f32.ln(); 3];
    scene.cloud.opacity_logits[1] = 9.0;
    scene.cloud.log_scales[0] = [0.01f32.ln(); 3];
    let visible = Shape::Polygon {
        camera,
        points: square(5.0),
        visible: true,
    };
    assert_eq!(select(&scene, &[SelectStep::add(visible)]).unwrap().indices(), [1]);
    let brush = |points: Vec<[f64; 2]>, radius: f64| Shape::Brush {
        camera,
        points,
        radius,
        visible: false,
    };
    let of = |shape: Shape| select(&scene, &[SelectStep::add(shape)]).unwrap().indices();
    // The splat at x = 0.5 is at pixel 50 + 100 * 0.5 / 3 = 66.7.
    assert_eq!(of(brush(vec![[66.0, 40.0]], 2.0)), [2]);
    assert_eq!(of(brush(vec![[40.0, 41.0], [80.0, 41.0]], 2.0)), [0, 1, 2]);
    assert!(of(brush(vec![[40.0, 45.0], [80.0, 45.0]], 2.0)).is_empty());
    // A figure of eight: even-odd.
    let twice = Shape::Polygon {
        camera,
        points: [square(30.0), square(5.0)].concat(),
        visible: false,
    };
    assert_eq!(of(twice), [2]);
}

#[test]
fn views_count_the_cameras_that_see() {
    let mut scene = at(&[[0.0; 3], [0.0, -9.0, 0.0]]);
    scene.cameras = cameras();
    assert_eq!(selected(&scene, "views min=8").indices(), [0]);
    assert_eq!(selected(&scene, "views max=0").indices(), [1]);
}

#[test]
fn the_subject_is_where_the_cameras_look() {
    let mut scene = at(&[[0.0; 3], [0.5, 0.0, 0.0], [2.9, 0.0, 0.0], [0.0, -5.0, 0.0]]);
    scene.cameras = cameras();
    assert_eq!(selected(&scene, "subject").indices(), [0, 1]);
    assert_eq!(selected(&scene, "subject margin=0.2").indices(), [0]);
    let without = Draft::new(cloud(5, 0, 1), Vec::new());
    let step = SelectStep {
        mode: Mode::Add,
        shape: Shape::Subject { margin: None },
    };
    let message = select(&without, &[step]).unwrap_err().to_string();
    assert!(message.contains("cameras") && !message.contains('\n'), "{message}");
}
