use crate::draft;
use irradia_edit::{Draft, Edit, EditError, EditList, apply, open_nothing};
use irradia_scene::GaussianCloud;

fn refused(text: &str) -> String {
    let message = EditList::parse(text).expect_err(text).to_string();
    assert!(!message.contains('\n') && !message.is_empty(), "{message}");
    message
}

#[test]
fn lists_are_checked_key_by_key() {
    let edit = |body: &str| format!("version = 1\n[[edits]]\nop = \"delete\"\nselect = [{body}]\n");
    for (text, words) in [
        ("", "version"),
        ("version = 2", "version is 2"),
        ("version = 1\nedit = []", "unknown field `edit`"),
        ("version = 1\n[[edits]]\nop = \"remove\"", "unknown variant `remove`"),
        (
            "version = 1\n[[edits]]\nop = \"delete\"",
            "edit 1: delete needs a selection",
        ),
        ("version = 1\n[[edits]]\nop = \"move\"", "missing field `by`"),
        ("version = 1\n[[edits]]\nop = \"move\"\nby = [0, 0]", "edit 1:"),
        ("version = 1\n[[edits]]\nop = \"move\"\nby = [nan, 0, 0]", "move by"),
        ("version = 1\n[[edits]]\nop = \"move\"\nby = [1e300, 0, 0]", "move by"),
        (
            "version = 1\n[[edits]]\nop = \"move\"\nby = [0, 0, 0]\nfar = 1",
            "unknown field `far`",
        ),
        ("version = 1\n[[edits]]\nop = \"scale\"\nfactor = 0", "scale factor"),
        ("version = 1\n[[edits]]\nop = \"scale\"\nfactor = -1", "scale factor"),
        (
            "version = 1\n[[edits]]\nop = \"rotate\"\naxis = [0, 0, 0]\ndegrees = 1",
            "rotate axis",
        ),
        ("version = 1\n[[edits]]\nop = \"reduce\"\ncount = 0", "reduce count"),
        (
            "version = 1\n[[edits]]\nop = \"recolor\"\nexposure = inf",
            "recolor exposure",
        ),
        (
            "version = 1\n[[edits]]\nop = \"set-length\"\nfrom = [0, 0, 0]\nto = [0, 0, 0]\nlength = 1",
            "set-length",
        ),
        ("version = 1\n[[edits]]\nop = \"merge\"\nfile = \"\"", "merge file"),
        ("version = 1\n[[edits]]\nop = \"upright\"\nselect = []", "no selection"),
        (
            "version = 1\n[[edits]]\nop = \"split\"\nname = \"../out\"\nselect = []",
            "split name",
        ),
        ("version = 1\nedits = 7", "line 2"),
        (&edit("{ shape = \"cube\" }"), "unknown variant `cube`"),
        (
            &edit("{ shape = \"sphere\", center = [0, 0, 0] }"),
            "missing field `radius`",
        ),
        (
            &edit("{ shape = \"sphere\", center = [0, 0, 0], radius = 1, size = 2 }"),
            "unknown field `size`",
        ),
        (&edit("{ shape = \"all\", radius = 1 }"), "unknown field `radius`"),
        (
            &edit("{ shape = \"sphere\", center = [0, inf, 0], radius = 1 }"),
            "sphere center",
        ),
        (
            &edit("{ shape = \"box\", center = [0, 0, 0], size = [1, 0, 1] }"),
            "box size",
        ),
        (
            &edit("{ shape = \"box\", center = [0, 0, 0], size = [1, 1, 1], rotation = [0, 0, 0, 0] }"),
            "box rotation",
        ),
        (&edit("{ shape = \"opacity\" }"), "needs min, max or both"),
        (&edit("{ shape = \"opacity\", min = nan }"), "must be numbers"),
        (&edit("{ shape = \"size\", min = 2, max = 1 }"), "above max"),
        (&edit("{ shape = \"views\", min = -1 }"), "edit 1:"),
        (
            &edit("{ shape = \"color\", low = [0, 0.5, 0], high = [1, 0.4, 1] }"),
            "low must not be above high",
        ),
        (&edit("{ mode = \"xor\", shape = \"all\" }"), "unknown variant `xor`"),
        (&edit("{ mode = \"subtract\", shape = \"invert\" }"), "no mode"),
        ("version = 1\n[[edits]]\nop = \"move\"\nby = [0, 0,", "line"),
    ] {
        let message = refused(text);
        assert!(message.contains(words), "{text}: {message}");
    }
}

#[test]
fn a_polygon_of_too_many_points_is_refused() {
    let points = "[1.0,2.0],".repeat(20_000);
    let text = format!(
        "version = 1\n[[edits]]\nop = \"delete\"\n[[edits.select]]\nshape = \"polygon\"\npoints = [{points}]\n\
         camera = {{ position = [0,0,0], rotation = [1,0,0,0], focal = [1,1], principal = [0,0], size = [1,1] }}\n"
    );
    assert!(refused(&text).contains("20000 points, must have 3 to 10000"));
    let flat = text
        .replace("focal = [1,1]", "focal = [0,1]")
        .replace(&points, "[0,0],[1,0],[0,1]");
    assert!(refused(&flat).contains("polygon camera.focal"));
    let many = "[[edits]]\nop = \"show\"\n".repeat(20_000);
    assert!(refused(&format!("version = 1\n{many}")).contains("at most"));
}

#[test]
fn words_are_checked_too() {
    for (line, words) in [
        ("", "empty"),
        ("center=1", "begins with its operation"),
        ("explode", "unknown variant"),
        ("keep", "such as in \"delete sphere center=0,0,0 radius=1\""),
        ("delete sphere center=0,0,0", "sphere: missing field `radius`"),
        ("delete all sphere radius=1", "sphere: missing field `center`"),
        ("move by=1", "move: invalid type"),
        (
            "move by=1, 2, 3",
            "2,: not a shape; a key is written KEY=VALUE, without spaces",
        ),
        ("delete - sphere center=0,0,0 radius=1", "-: not a shape"),
        ("opacity 0.5", "0.5: not a shape"),
        (
            &format!("delete all {}x=1", "a.".repeat(100_000)),
            "all: unknown field `a`",
        ),
        ("delete sphere center=0,0,0 radius=one", "expected a number"),
        ("reduce count=some", "expected a whole number"),
        ("reduce count=1.5", "expected a whole number"),
        ("reduce count=-1", "expected a whole number"),
        ("delete sphere center=0,0,0 radius=1 radius=2", "given twice"),
        ("delete sphere center=0,0 radius=1", "invalid length"),
        ("move by=0,0,nan", "move by"),
        ("delete all op=keep", "not a key"),
        ("delete all =3", "not a key"),
        ("merge file=\"my scene.ply", "not closed"),
    ] {
        let error: EditError = line.parse::<Edit>().expect_err(line);
        let message = error.to_string();
        assert!(!message.contains('\n'), "{message}");
        assert!(message.contains(words), "{line}: {message}");
    }
}

#[test]
fn names_may_look_like_numbers_and_numbers_may_have_exponents() {
    for (line, same) in [
        ("split name=05 all", "split name=\"05\" all"),
        ("merge file=1e6", "merge file=\"1e6\""),
        ("reduce count=1e6", "reduce count=1000000"),
        (
            "delete sphere center=1e0,-2E1,1e-1 radius=2e0",
            "delete sphere center=1,-20,0.1 radius=2",
        ),
    ] {
        assert_eq!(line.parse::<Edit>(), same.parse(), "{line}");
        assert!(line.parse::<Edit>().is_ok(), "{line}");
    }
}

#[test]
fn every_edit_survives_its_words_and_its_toml_and_its_json() {
    let camera = "camera.position=0,0,-3 camera.rotation=1,0,0,0 camera.focal=100,100.5 camera.principal=50,40 camera.size=100,80";
    for line in [
        "delete floaters",
        "merge file=\"my scene/of words é.ply\"",
        "split name=\"5\" all",
        "split name=\"true\" all",
        "delete floaters score=0.5 -sphere center=1,2,3 radius=0.25",
        "keep subject margin=1.5 &views min=3 max=10",
        &format!("hide polygon {camera} points=0,0;10.5,0;10,10 visible=true"),
        &format!("lock brush {camera} points=5,5; radius=3 grow by=0.1 invert"),
        "rotate axis=0,0,1 degrees=-45.5 about=1,2,3 all",
        "upright axis=z up=0,1,0 ground=1,1,1",
        "recolor exposure=-0.5 saturation=0 contrast=1.5",
        "split name=chair.spz clusters max=100 gap=0.5 connected",
        "merge file=other/scene.ply",
        "duplicate color low=0,0,0 high=0.5,0.5,0.5 elongation min=10",
    ] {
        let edit: Edit = line.parse().unwrap_or_else(|error| panic!("{line}: {error}"));
        let words: Edit = edit
            .to_string()
            .parse()
            .unwrap_or_else(|error| panic!("{edit}: {error}"));
        assert_eq!(words, edit);
        let list = EditList {
            edits: vec![edit.clone()],
            ..EditList::default()
        };
        assert_eq!(EditList::parse(&list.to_toml()).unwrap(), list, "{}", list.to_toml());
        let json = serde_json::to_string(&edit).unwrap();
        assert_eq!(serde_json::from_str::<Edit>(&json).unwrap(), edit, "{json}");
    }
}

/// Every operation and shape on an empty scene, and on scenes of one splat, of coincident splats and of non-finite ones.
#[test]
fn odd_scenes_do_no_harm() {
    let mut poisoned = draft(30, 1);
    poisoned.cloud.means[3] = [f32::NAN; 3];
    poisoned.cloud.means[4] = [f32::INFINITY, 0.0, 0.0];
    poisoned.cloud.log_scales[5] = [f32::INFINITY; 3];
    poisoned.cloud.quats[6] = [0.0; 4];
    poisoned.cloud.sh[40] = f32::NAN;
    let mut same = draft(30, 0);
    same.cloud.means.fill([0.5; 3]);
    let empty = Draft::new(GaussianCloud::default(), draft(1, 0).cameras);
    for scene in [poisoned, same, empty, draft(1, 0)] {
        for line in [
            "delete floaters",
            "keep subject",
            "delete views max=2",
            "delete clusters max=3",
            "keep sphere center=0,0,0 radius=1 connected",
            "keep sphere center=0,0,0 radius=1 grow by=0.5",
            "delete clusters max=3 gap=0.000001",
            "delete opacity max=0.5 size min=0.1 elongation min=2",
            "upright",
            "rotate axis=1,0,0 degrees=10",
            "rotate axis=1,0,0 degrees=10 all",
            "scale factor=1000000 all",
            "scale factor=1000000",
            "move by=1000000000,0,0",
            "duplicate",
            "recolor exposure=20",
            "opacity factor=0",
            "opacity factor=1000000",
            "reduce count=3",
            "split name=x all",
        ] {
            let mut after = scene.clone();
            let made = apply(&mut after, &line.parse().unwrap(), &open_nothing);
            assert!(made.is_ok(), "{line}: {made:?}");
            assert!(
                after.cloud.is_consistent() && after.hidden.len() == after.len(),
                "{line}"
            );
        }
    }
}
