//! Camera paths and films, and the viewer's command line.

use crate::process::*;
use serde_json::json as value;
use std::fs;
use std::net::TcpListener;

#[test]
fn paths_become_frames_and_films() {
    let folder = with_run();
    for path in ["orbit", "spiral", "training"] {
        let out = format!("render run --path {path} --frames 3 --size 40x30 --out {path}");
        irradia(folder.path(), &out).success();
        let frames = files_under(&folder.path().join(path));
        assert_eq!(frames.len(), 3, "{frames:?}");
        let first = fs::read(&frames[0]).expect("a frame");
        assert_ne!(first, fs::read(&frames[1]).expect("a frame"), "{path} moves");
    }
    irradia(
        folder.path(),
        "render run --path spiral --frames 4 --size 41x30 --fps 10 --out film.gif",
    )
    .success();
    let film = fs::read(folder.path().join("film.gif")).expect("a film");
    // Width and height, little endian, after the signature.
    assert_eq!((&film[..6], &film[6..10]), (&b"GIF89a"[..], &[41, 0, 30, 0][..]));
    // At more than 50 frames a second, frames are left out, and the length is right; folders are created.
    irradia(
        folder.path(),
        "render run --orbit 24 --size 8x6 --fps 100 --out new/fast.gif",
    )
    .success();
    let film = fs::read(folder.path().join("new/fast.gif")).expect("a film");
    // The delay of a frame follows the label of its control block.
    let delays = film.windows(3).filter(|w| w[..3] == [0x21, 0xf9, 4]).count();
    assert_eq!(delays, 12);
}

#[test]
fn frames_that_an_earlier_path_left_are_reported() {
    let folder = with_run();
    let rendered = |frames: u32| {
        let line = format!("render run --orbit {frames} --size 8x6 --out frames");
        irradia(folder.path(), &line).success().stderr
    };
    assert!(!rendered(3).contains("earlier"));
    let said = rendered(2);
    assert!(said.contains("frame_0002.png and later frames"), "{said}");
}

#[test]
fn a_saved_path_shows_the_same_of_a_scene_that_was_moved() {
    let folder = with_run();
    let camera = &json(&folder.path().join("run/cameras.json"))[3];
    let key = value!({ "time": 0, "position": camera["position"], "rotation": camera["rotation"], "fov": 0.8 });
    let path = value!({ "irradia_path": 1, "fps": 30, "loop": false, "ease": false, "closing": 0, "keys": [key] });
    fs::write(folder.path().join("path.json"), path.to_string()).expect("written");
    let edits = ["rotate axis=1,2,3 degrees=70", "scale factor=1.5", "move by=1,-2,0.5"];
    irradia_with(folder.path(), "edit run -o run/moved.ply", &edits).success();
    let picture = |scene: &str, out: &str| {
        let line = format!("render {scene} --path path.json --size 60x40 --out {out}");
        irradia(folder.path(), &line).success();
        image::open(folder.path().join(out).join("frame_0000.png"))
            .expect("a picture")
            .to_rgb8()
            .into_raw()
    };
    let (before, after) = (picture("run", "before"), picture("run/moved.ply", "after"));
    let difference: f64 = before.iter().zip(&after).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    // Rotated harmonics differ in their last bits.
    assert!(difference < 0.5 * before.len() as f64, "{difference}");
}

#[test]
fn paths_that_cannot_be_followed_are_refused_in_one_line() {
    let folder = with_run();
    fs::write(folder.path().join("path.json"), "{\"camera_path\": 3}").expect("written");
    fs::create_dir(folder.path().join("folder.gif")).expect("a folder");
    for (command, code, parts) in [
        ("render run --path none.json --out x", 1, &["none.json"][..]),
        ("render run --path path.json --out x", 1, &["path.json"]),
        ("render run --path orbit --frames 0 --out x", 2, &["--frames"]),
        ("render run --path orbit --depth --out x.gif", 2, &["depth"]),
        ("render run --orbit 3 --path orbit --out x", 2, &["--path"]),
        ("render run --orbit 3 --fps 10 --out x", 2, &["--fps 10", "film"]),
        ("render run --orbit 3 --frames 3 --out x", 2, &["--frames"]),
        ("render run --orbit 3 --split all --out x", 2, &["--split"]),
        (
            "render run --path spiral --max-side 20 --out x",
            2,
            &["--path", "--size"],
        ),
        (
            "render run --path path.json --frames 3 --out x",
            2,
            &["--frames 3", "path.json"],
        ),
        (
            "render run --orbit 3 --out folder.gif",
            2,
            &["folder.gif", "is a folder"],
        ),
    ] {
        irradia(folder.path(), command).refused(code, parts);
    }
}

#[test]
fn what_cannot_be_viewed_is_refused_in_one_line() {
    let folder = with_run();
    fs::remove_file(folder.path().join("run/scene.ply")).expect("removed");
    irradia(folder.path(), "view run").refused(1, &["run", "no scene yet", "--resume"]);
    irradia(folder.path(), "view nowhere.ply").refused(1, &["nowhere.ply"]);
    // A host of another machine.
    let taken = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("bound").port();
    let command = format!("view data --host 192.0.2.1 --port {port}");
    irradia(folder.path(), &command).refused(1, &["192.0.2.1", "--host"]);
}
