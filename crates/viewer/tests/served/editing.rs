//! Editing by pages: which requests are carried out, and which are refused.

use crate::client::{Socket, TOO_LARGE};
use crate::security::{Served, serve};
use irradia_runs::Editing;
use irradia_runs::formats::{SplatFormat, encode_splats, read_splats, write_splats};
use serde_json::{Value, json};
use std::fs;
use std::time::{Duration, SystemTime};

/// A page that has been greeted.
fn page(served: &Served) -> Socket {
    let mut page = served.socket();
    next_message(&mut page, "editing");
    page
}

/// The next message of a kind.
fn next_message(page: &mut Socket, kind: &str) -> Value {
    loop {
        let (opcode, bytes) = page.receive().expect("a message");
        if opcode == 1 {
            let value: Value = serde_json::from_slice(&bytes).expect("JSON");
            if value["tell"] == kind {
                return value;
            }
        }
    }
}

fn send_request(page: &mut Socket, request: &Value) {
    assert!(page.send(1, request.to_string().as_bytes()));
}

/// Sends a request; returns the state of the session once `key` has the value `value`.
fn request_state(page: &mut Socket, request: &Value, (key, value): (&str, Value)) -> Value {
    send_request(page, request);
    loop {
        let editing = next_message(page, "editing");
        if editing["busy"] == false && editing[key] == value {
            return editing;
        }
    }
}

/// Sends a request; returns why it is refused.
fn refusal(page: &mut Socket, request: &Value) -> String {
    send_request(page, request);
    next_message(page, "problem")["text"].as_str().expect("text").to_owned()
}

fn select_right_splat() -> Value {
    json!({ "do": "select", "replace": true, "steps": [{ "shape": "sphere", "center": [1, 0, 0], "radius": 0.5 }] })
}

#[test]
fn pages_share_a_session_that_leaves_the_source_alone() {
    let served = serve("127.0.0.1");
    let source = fs::read(served.scene()).expect("the scene");
    let (mut first, mut second) = (page(&served), page(&served));
    let selected = request_state(&mut first, &select_right_splat(), ("selected", json!(1)));
    assert_eq!(selected["box"], json!([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]));
    let deleted = request_state(
        &mut first,
        &json!({ "do": "edit", "edit": { "op": "delete" } }),
        ("at", json!(2)),
    );
    assert_eq!((&selected["of"], &deleted["of"]), (&json!(3), &json!(2)));
    while next_message(&mut second, "editing") != deleted {}
    let name = json!("saved scene.edits.toml and scene.edited.ply");
    request_state(&mut second, &json!({ "do": "save" }), ("saved", name));
    let folder = served.scene().parent().expect("a folder").to_owned();
    assert_eq!(read_splats(&folder.join("scene.edited.ply")).expect("splats").len(), 2);
    assert_eq!(fs::read(served.scene()).expect("the scene"), source);
    let list = fs::read_to_string(folder.join("scene.edits.toml")).expect("the list");
    let list = irradia_edit::EditList::parse(&list).expect("a list");
    assert_eq!(list.edits[0].to_string(), "delete sphere center=1,0,0 radius=0.5");
    request_state(&mut second, &json!({ "do": "undo" }), ("selected", json!(1)));
    request_state(&mut second, &json!({ "do": "go", "at": 0 }), ("selected", json!(0)));
    request_state(&mut second, &json!({ "do": "go", "at": u32::MAX }), ("of", json!(2)));
    // Another session does not replace what this one saved.
    let again = Served::of(served.scene(), "127.0.0.1");
    let mut third = page(&again);
    request_state(&mut third, &select_right_splat(), ("selected", json!(1)));
    let name = json!("saved scene.edits-2.toml and scene.edited-2.ply");
    request_state(&mut third, &json!({ "do": "save" }), ("saved", name));
}

#[test]
fn a_scene_that_was_replaced_since_it_was_opened_is_not_edited() {
    let served = serve("127.0.0.1");
    let mut page = page(&served);
    let mut cloud = read_splats(served.scene()).expect("splats");
    cloud.means[0][1] = 5.0;
    fs::remove_file(served.scene()).expect("removed");
    write_splats(served.scene(), &cloud).expect("written");
    // File systems tell times a few milliseconds apart at best.
    let file = fs::OpenOptions::new().write(true).open(served.scene()).expect("opened");
    let later = SystemTime::now() + Duration::from_secs(1);
    file.set_modified(later).expect("set");
    for _ in 0..2 {
        let line = refusal(&mut page, &select_right_splat());
        assert!(
            line.ends_with("scene.ply has changed since it was opened: start irradia view again to edit it"),
            "{line}"
        );
    }
    assert_ne!(served.status("/download/ply", &[&served.host()]), 200);
    served.assert_draws();
}

#[test]
fn a_page_is_told_the_scene_once() {
    let served = serve("127.0.0.1");
    let mut page = served.socket();
    let told = [(); 2].map(|()| {
        let (_, text) = page.receive().expect("a message");
        let message: Value = serde_json::from_slice(&text).expect("JSON");
        (message["tell"].clone(), message["scene"]["version"].clone())
    });
    assert_eq!(told, [(json!("hello"), json!(1)), (json!("editing"), Value::Null)]);
}

#[test]
fn a_page_learns_whether_it_comes_back_to_the_same_server() {
    let served = serve("127.0.0.1");
    let hello = |served: &Served| next_message(&mut served.socket(), "hello");
    let (first, second) = (hello(&served), hello(&served));
    assert!(first["server"].is_string() && first["server"] == second["server"]);
    assert_eq!(first["scene"]["version"], second["scene"]["version"]);
    let other = hello(&Served::of(served.scene(), "127.0.0.1"));
    assert_eq!(first["id"], other["id"], "the same scene");
    assert_ne!(first["server"], other["server"]);
}

#[test]
fn hostile_requests_are_refused_in_one_line_and_change_nothing() {
    let served = serve("127.0.0.1");
    let mut page = page(&served);
    let camera = json!({ "position": [0, 0, -4], "rotation": [1, 0, 0, 0], "focal": [50, 50], "principal": [32, 24], "size": [64, 48] });
    let lasso = |points: usize| {
        let points: Vec<[f64; 2]> = (0..points).map(|i| [i as f64 % 64.0, i as f64 % 48.0]).collect();
        json!({ "do": "select", "steps": [{ "shape": "polygon", "camera": camera, "points": points }] })
    };
    let step = |step: Value| json!({ "do": "select", "steps": [step] });
    let edit = |edit: Value| json!({ "do": "edit", "whole": true, "edit": edit });
    for (request, says) in [
        (lasso(2001), "at most 2000 points"),
        (lasso(2), "points"),
        (
            step(json!({ "shape": "sphere", "center": [0, 0, 0], "radius": -1 })),
            "radius",
        ),
        (
            step(json!({ "shape": "sphere", "center": [0, 0, 1e300], "radius": 1 })),
            "center",
        ),
        (
            step(json!({ "shape": "box", "center": [0, 0, 0], "size": [0, 1, 1] })),
            "size",
        ),
        (
            step(json!({ "shape": "box", "mode": "subtract", "center": [0, 0, 0], "size": [1, 1, 1] })),
            "nothing is selected",
        ),
        (json!({ "do": "select", "steps": [] }), "1 to 8 steps"),
        (
            json!({ "do": "edit", "edit": { "op": "delete" } }),
            "nothing is selected",
        ),
        (edit(json!({ "op": "delete" })), "needs a selection"),
        (edit(json!({ "op": "merge", "file": "/etc/passwd" })), "has been sent"),
        (edit(json!({ "op": "recolor", "exposure": 1e9 })), "exposure"),
        (
            edit(json!({ "op": "set-length", "from": [0, 0, 0], "to": [0, 0, 0], "length": 1 })),
            "set-length",
        ),
        (
            json!({ "do": "edit", "edit": { "op": "split", "name": "../../evil" } }),
            "split name",
        ),
    ] {
        let line = refusal(&mut page, &request);
        assert!(line.contains(says) && !line.contains('\n'), "{request}: {line}");
    }
    // A request that cannot be read counts as a fault of the page, which is not told.
    for text in [
        r#"{"do":"select","steps":[{"shape":"sphere","center":[0,0,NaN],"radius":1}]}"#,
        r#"{"do":"select","steps":[{"shape":"sphere","center":[0,0,1e999],"radius":1}]}"#,
        r#"{"do":"select","steps":[{"shape":"cube"}]}"#,
        r#"{"do":"edit","whole":true,"edit":{"op":"format-disk"}}"#,
        r#"{"do":"go","at":-1}"#,
    ] {
        assert!(page.send(1, text.as_bytes()));
    }
    let editing = request_state(&mut page, &select_right_splat(), ("selected", json!(1)));
    assert_eq!((&editing["total"], &editing["of"]), (&json!(1), &json!(3)));
    page.send(1, &vec![b' '; TOO_LARGE]);
    assert!(page.is_ended(), "larger than any request");
    served.assert_draws();
}

#[test]
fn a_scene_that_a_page_sends_is_merged_saved_and_replayed() {
    let served = serve("127.0.0.1");
    let scene = fs::read(served.scene()).expect("the scene");
    let mut page = page(&served);
    for (target, origin, body, says) in [
        ("/merge/a.ply", "http://evil.example".to_owned(), &scene[..], "403"),
        ("/merge/a.exe", served.origin(), &scene[..], "422"),
        ("/merge/a.ply", served.origin(), &scene[..100], "422"),
        ("/merge/", served.origin(), &scene[..], "404"),
    ] {
        let answer = served.send_scene(target, &origin, body);
        assert!(answer.starts_with(&format!("HTTP/1.1 {says}")), "{target}: {answer}");
    }
    let cloud = read_splats(served.scene()).expect("splats");
    let sent = encode_splats(SplatFormat::Spz, &cloud, &Default::default()).expect("encoded");
    let answer = served.send_scene("/merge/..%2Fother.spz", &served.origin(), &sent);
    assert!(answer.contains(r#"{"name":"_other.spz","splats":3}"#), "{answer}");
    let merge = json!({ "do": "edit", "whole": true, "edit": { "op": "merge", "file": "_other.spz" } });
    let merged = request_state(&mut page, &merge, ("of", json!(6)));
    assert_eq!(merged["selected"], json!(3), "what came is selected");
    request_state(&mut page, &json!({ "do": "undo" }), ("of", json!(3)));
    request_state(&mut page, &json!({ "do": "redo" }), ("of", json!(6)));
    let name = json!("saved scene.edits.toml and scene.edited.ply");
    request_state(&mut page, &json!({ "do": "save" }), ("saved", name));
    let folder = served.scene().parent().expect("a folder");
    assert_eq!(fs::read(folder.join("_other.spz")).expect("what was sent"), sent);
    let list = fs::read_to_string(folder.join("scene.edits.toml")).expect("the list");
    let mut program = Editing::open(served.scene()).expect("the scene");
    program
        .apply(&irradia_edit::EditList::parse(&list).expect("a list"))
        .expect("possible");
    let edited = read_splats(&folder.join("scene.edited.ply")).expect("splats");
    assert_eq!(program.draft().cloud, edited, "the program makes the same of the list");
}

#[test]
fn a_merged_scene_that_looks_different_is_reported() {
    let served = serve("127.0.0.1");
    let mut cloud = read_splats(served.scene()).expect("splats");
    cloud.antialiased = true;
    let sent = encode_splats(SplatFormat::Spz, &cloud, &Default::default()).expect("encoded");
    served.send_scene("/merge/filtered.spz", &served.origin(), &sent);
    let mut page = page(&served);
    let merge = json!({ "do": "edit", "whole": true, "edit": { "op": "merge", "file": "filtered.spz" } });
    let line = refusal(&mut page, &merge);
    assert!(
        line.starts_with("filtered.spz: trained with Mip-Splatting's filter"),
        "{line}"
    );
}

#[test]
fn what_needs_no_place_is_done_while_the_scene_is_shown_as_it_was_opened() {
    let served = serve("127.0.0.1");
    let mut page = page(&served);
    request_state(&mut page, &select_right_splat(), ("selected", json!(1)));
    let compare = json!({ "do": "compare", "before": true });
    request_state(&mut page, &compare, ("before", json!(true)));
    let delete = json!({ "do": "edit", "edit": { "op": "delete" } });
    let deleted = request_state(&mut page, &delete, ("at", json!(2)));
    assert_eq!((&deleted["of"], &deleted["before"]), (&json!(2), &json!(false)));
    request_state(&mut page, &compare, ("before", json!(true)));
    assert!(refusal(&mut page, &select_right_splat()).contains("as it was opened"));
    // It is shown again, so that the next selection is made.
    let selected = request_state(&mut page, &select_right_splat(), ("at", json!(3)));
    assert_eq!(selected["before"], json!(false));
}

#[test]
fn a_download_needs_a_known_format_and_the_token() {
    let served = serve("127.0.0.1");
    let host = served.host();
    request_state(&mut page(&served), &select_right_splat(), ("selected", json!(1)));
    for name in [
        "ply",
        "compressed.ply",
        "points.ply",
        "spz",
        "splat",
        "ksplat",
        "sog",
        "glb",
        "spz.glb",
        "gltf",
        "npz",
        "edits.toml",
    ] {
        assert_eq!(served.status(&format!("/download/{name}"), &[&host]), 200, "{name}");
    }
    for name in ["exe", "meta.json", "", "..%2fscene.ply", "ply/../../x", "PLY%00"] {
        assert_eq!(served.status(&format!("/download/{name}"), &[&host]), 404, "{name}");
    }
    assert_eq!(served.status("/selection/999", &[&host]), 404);
    assert_eq!(served.status("/selection/1", &[&host]), 200);
    assert_eq!(
        served.status("/download/ply", &[&host, "Origin: http://evil.example"]),
        403
    );
    let guarded = serve("0.0.0.0");
    for path in ["/download/ply", "/selection/1", "/socket"] {
        assert_eq!(guarded.status(path, &[&guarded.host()]), 403, "{path}");
    }
}

#[test]
fn what_is_no_scene_of_splats_is_not_edited() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path().join("data");
    irradia_runs::write_synth_dataset(
        &data,
        &irradia_runs::prelude::SynthOptions {
            views: 3,
            width: 16,
            height: 12,
            ..Default::default()
        },
    )
    .expect("a dataset");
    let served = Served::of(&data, "127.0.0.1");
    let mut page = served.socket();
    assert!(refusal(&mut page, &select_right_splat()).contains("dataset"));
    assert_eq!(served.status("/download/ply", &[&served.host()]), 404);
}

#[test]
fn a_scene_that_is_turned_is_seen_from_the_same_side_and_keeps_its_paths() {
    let served = serve("127.0.0.1");
    let folder = served.scene().parent().expect("a folder");
    let camera = |name: &str, x: f64| {
        json!({ "name": name, "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 32, "cy": 24,
                "position": [x, 0, -4], "rotation": [1, 0, 0, 0] })
    };
    let cameras = json!([camera("a", 3.0), camera("b", -3.0)]);
    fs::write(folder.join("cameras.json"), cameras.to_string()).expect("written");
    let near = |value: &Value, expected: &[f64]| {
        let values: Vec<f64> = value
            .as_array()
            .expect("numbers")
            .iter()
            .filter_map(Value::as_f64)
            .collect();
        let close = values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(close && values.len() == expected.len(), "{values:?}");
    };
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let turned = |scene: &Value| {
        near(&scene["first"], &[0.0, 3.0, -4.0]);
        near(&scene["world_from_photographs"]["rotation"], &[half, 0.0, 0.0, half]);
        near(&scene["world_from_photographs"]["translation"], &[0.0; 3]);
    };
    let opened = Served::of(served.scene(), "127.0.0.1");
    let mut page = opened.socket();
    near(&next_message(&mut page, "hello")["scene"]["first"], &[3.0, 0.0, -4.0]);
    next_message(&mut page, "editing");
    let turn = json!({ "op": "rotate", "axis": [0, 0, 1], "degrees": 90 });
    send_request(&mut page, &json!({ "do": "edit", "whole": true, "edit": turn }));
    turned(&next_message(&mut page, "scene"));
    let name = json!("saved scene.edits.toml and scene.edited.ply");
    request_state(&mut page, &json!({ "do": "save" }), ("saved", name));
    let again = Served::of(&folder.join("scene.edited.ply"), "127.0.0.1");
    turned(&next_message(&mut again.socket(), "hello")["scene"]);
}

#[test]
fn metres_are_those_per_unit_of_the_scene_as_it_was_opened_however_edits_scale_it() {
    let served = serve("127.0.0.1");
    let folder = served.scene().parent().expect("a folder");
    // A folder with this file is that of a run, which keeps the unit.
    fs::write(folder.join("run.json"), "{}").expect("written");
    fs::write(folder.join("unit.json"), r#"{ "metres_per_unit": 2 }"#).expect("written");
    let opened = Served::of(served.scene(), "127.0.0.1");
    let mut first = page(&opened);
    let enlarge = json!({ "op": "scale", "factor": 4 });
    send_request(&mut first, &json!({ "do": "edit", "whole": true, "edit": enlarge }));
    assert_eq!(next_message(&mut first, "scene")["placement"]["scale"], json!(4.0));
    let hello = next_message(&mut opened.socket(), "hello");
    assert_eq!(hello["scene"]["placement"]["scale"], json!(4.0));
    assert_eq!(hello["metres"], json!(2.0));
    let mut second = page(&opened);
    send_request(&mut first, &json!({ "do": "unit", "metres": 3 }));
    for page in [&mut first, &mut second] {
        assert_eq!(next_message(page, "unit")["metres"], json!(3.0));
    }
    assert_eq!(next_message(&mut opened.socket(), "hello")["metres"], json!(3.0));
}
