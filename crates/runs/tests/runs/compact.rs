//! Compaction of scenes.

use crate::folder;
use irradia_runs::formats::read_splats;
use irradia_runs::prelude::*;
use irradia_runs::{CompactEvent, CompactInput, CompactTarget, compact};
use std::fs;

#[test]
fn a_scene_gets_as_small_as_it_is_asked_to_and_its_pictures_stay() {
    let folder = folder();
    let here = |name: &str| folder.path().join(name);
    let options = SynthOptions {
        views: 4,
        width: 36,
        height: 24,
        ..SynthOptions::default()
    };
    write_synth_dataset(here("photos"), &options).expect("photographs");
    let request = TrainInput {
        steps: Some(60),
        max_splats: Some(800),
        ..TrainInput::new(here("photos"), here("run"))
    };
    let mut run = Run::begin(request.check().expect("a request")).expect("a run");
    run.train(&mut []).expect("trains");
    run.finish().expect("finishes");

    let input = |target: Option<CompactTarget>, out: &str| CompactInput {
        target,
        keep_psnr: None,
        steps: 30,
        ..CompactInput::new(here("run"), here("photos"), here(out))
    };
    let mut events = Vec::new();
    let count = read_splats(&here("run/scene.ply")).expect("a scene").len();
    let request = input(Some(CompactTarget::Splats(count / 2)), "half.sog");
    let half = compact(&request, &mut |event| events.push(event)).expect("compacted");
    assert_eq!(half.splats, [count, count / 2]);
    assert_eq!(read_splats(&request.out).expect("read").len(), count / 2);
    assert_eq!(half.bytes[1], fs::metadata(&request.out).expect("there").len());
    assert!(half.with_harmonics < count / 2);
    assert!(half.psnr[1] > half.psnr[0] - 2.0, "{half:?}");
    assert!(half.held_out_psnr.is_some());
    assert_eq!(events.len(), 31);
    let last = events[30];
    assert!(matches!(last, CompactEvent::Tried { splats, psnr, .. } if splats == count / 2 && psnr == half.psnr[1]));

    let again = input(request.target, "again.sog");
    compact(&again, &mut |_| ()).expect("compacted");
    assert_eq!(
        fs::read(&request.out).unwrap(),
        fs::read(&again.out).unwrap(),
        "the same bytes"
    );

    // In a scene this small, more than half of the file does not depend on the number of splats.
    let most = half.bytes[1] * 7 / 8;
    let small = compact(&input(Some(CompactTarget::Bytes(most)), "small.sog"), &mut |_| ()).expect("compacted");
    assert!(small.bytes[1] <= most && small.bytes[1] > most * 3 / 4, "{small:?}");
    let other = compact(&input(Some(CompactTarget::Splats(count)), "all.spz"), &mut |_| ()).expect("compacted");
    assert_eq!(other.splats, [count, count]);

    // Any loss is allowed: the result is the smallest scene that is tried.
    let searched = CompactInput {
        keep_psnr: Some(100.0),
        steps: 10,
        ..input(None, "least.sog")
    };
    let least = compact(&searched, &mut |_| ()).expect("compacted");
    assert!(least.splats[1] < count / 10, "{least:?}");
    // No loss is allowed: more splats are kept, and a note says so.
    let strict = CompactInput {
        keep_psnr: Some(0.0),
        steps: 10,
        target: Some(CompactTarget::Splats(count / 20)),
        ..searched
    };
    let strict = compact(&strict, &mut |_| ()).expect("compacted");
    assert!(strict.splats[1] > count / 20 && strict.notes.iter().any(|note| note.contains("more splats are kept")));

    let refusal = |input: CompactInput| compact(&input, &mut |_| ()).expect_err("refused").to_string();
    let tiny = refusal(input(Some(CompactTarget::Bytes(100)), "tiny.sog"));
    assert!(tiny.contains("100 bytes") && !here("tiny.sog").exists(), "{tiny}");
    assert!(refusal(input(None, "a.sog")).contains("needs a target"));
    assert!(refusal(input(request.target, "a.npz")).contains("another format"));
}
