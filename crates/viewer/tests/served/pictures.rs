//! The pictures that a page gets.

use crate::client::SHOT;
use crate::security::Served;
use irradia_runs::prelude::SynthOptions;
use serde_json::Value;
use std::fs;

#[test]
fn a_photograph_that_cannot_be_read_is_named_and_colours_are_drawn_instead_of_errors() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path().join("data");
    let options = SynthOptions {
        views: 3,
        width: 64,
        height: 48,
        ..SynthOptions::default()
    };
    irradia_runs::write_synth_dataset(&data, &options).expect("a dataset");
    let served = Served::of(&data, "127.0.0.1");
    // Damaged files are left out when a dataset is opened: these are damaged later.
    for split in ["train", "val", "test"] {
        for entry in fs::read_dir(data.join(split)).expect("photographs") {
            let path = entry.expect("a file").path();
            let bytes = fs::read(&path).expect("a photograph");
            fs::write(&path, &bytes[..bytes.len() / 2]).expect("written");
        }
    }
    let mut page = served.socket();
    let shot = SHOT.replace("\"id\":1", "\"id\":1,\"mode\":\"error\",\"view\":0");
    assert!(page.send(1, shot.as_bytes()));
    let (mut problems, mut pictures) = (Vec::new(), 0);
    while pictures == 0 {
        match page.receive().expect("a picture") {
            (1, text) => {
                let value: Value = serde_json::from_slice(&text).expect("JSON");
                if value["tell"] == "problem" {
                    problems.push(value["text"].as_str().expect("text").to_owned());
                }
            }
            (2, bytes) => {
                let length = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize;
                let header: Value = serde_json::from_slice(&bytes[4..4 + length]).expect("JSON");
                assert_eq!(header["range"], Value::Null, "colours have no range");
                pictures += 1;
            }
            _ => {}
        }
    }
    assert!(matches!(&problems[..], [line] if line.contains(".png")), "{problems:?}");
}
