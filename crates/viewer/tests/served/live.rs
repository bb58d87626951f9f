//! A training with pages: they control it, and its bytes are those of a training without pages.

use crate::client::{SHOT, Socket, address_of};
use irradia_runs::prelude::*;
use irradia_viewer::{Listen, Subject, Viewer};
use std::net::SocketAddr;
use std::path::Path;

const STEPS: u64 = 40;

fn begin(folder: &Path, name: &str) -> Run {
    let options = SynthOptions {
        views: 4,
        width: 24,
        height: 16,
        seed: 1,
        ..SynthOptions::default()
    };
    let dataset = irradia_runs::synth::dataset(&options).expect("options");
    let input = TrainInput {
        steps: Some(STEPS),
        ..TrainInput::new("memory", folder.join(name))
    };
    Run::begin_on(input.check().expect("a request"), dataset).expect("a run")
}

fn bytes(folder: &Path, name: &str) -> Vec<u8> {
    std::fs::read(folder.join(name).join("scene.ply")).expect("a scene")
}

/// Reads messages until one about the training for which `enough` holds; each picture is answered by a new request.
fn follow(page: &mut Socket, enough: impl Fn(&str) -> bool) {
    for _ in 0..100_000 {
        match page.receive().expect("the server stays") {
            (1, text) => {
                let text = String::from_utf8(text).expect("text");
                if text.contains("\"tell\":\"train\"") && enough(&text) {
                    return;
                }
            }
            _ => {
                page.send(1, br#"{"do":"shown","id":1}"#);
                page.send(1, SHOT.as_bytes());
            }
        }
    }
    panic!("it never came");
}

/// Pauses, steps once, saves, resumes, and watches until the end.
fn page(address: SocketAddr) {
    let mut page = Socket::open(address);
    page.send(1, SHOT.as_bytes());
    follow(&mut page, |text| {
        text.contains("\"phase\":\"paused\",") && text.contains("\"step\":0,")
    });
    page.send(1, br#"{"do":"train","action":"step"}"#);
    follow(&mut page, |text| {
        text.contains("\"phase\":\"paused\",") && text.contains("\"step\":1,")
    });
    page.send(1, br#"{"do":"train","action":"save"}"#);
    follow(&mut page, |text| {
        text.contains("\"saved\":1,") && text.contains("\"phase\":\"paused\",")
    });
    page.send(1, br#"{"do":"train","action":"resume"}"#);
    follow(&mut page, |text| {
        text.contains("\"phase\":\"finished\",") && text.contains("\"step\":40,")
    });
}

#[test]
fn pages_control_a_training_and_change_no_byte() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut alone = begin(folder.path(), "alone");
    alone.train(&mut []).expect("trains");
    alone.finish().expect("finishes");

    let mut run = begin(folder.path(), "watched");
    let (subject, mut watcher) = Subject::of_run(&run);
    let listen = Listen {
        port: 0,
        ..Listen::default()
    };
    let viewer = Viewer::start(subject, &listen, Box::new(|_| ())).expect("a server");
    let address = address_of(viewer.address());
    // Paused before it begins, so that the page misses nothing.
    let mut first = Socket::open(address);
    first.send(1, br#"{"do":"train","action":"pause"}"#);
    first.send(1, b"garbage");
    while first.receive().is_some_and(|(_, text)| !text.starts_with(b"{\"")) {}
    std::thread::sleep(std::time::Duration::from_millis(300));
    drop(first);
    let pages = [0, 1].map(|i| {
        std::thread::spawn(move || {
            if i == 0 {
                page(address);
            } else {
                let mut other = Socket::open(address);
                other.send(1, SHOT.as_bytes());
                follow(&mut other, |text| text.contains("\"phase\":\"finished\","));
            }
        })
    });
    run.train(&mut watcher.observers()).expect("trains");
    for page in pages {
        page.join().expect("the page saw all of it");
    }
    assert!(run.finish().expect("finishes").complete);
    assert!(bytes(folder.path(), "watched") == bytes(folder.path(), "alone"));
}
