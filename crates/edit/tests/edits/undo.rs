use crate::{cloud, draft};
use irradia_edit::{Draft, Edit, EditList, History, Provenance, apply};
use irradia_scene::{GaussianCloud, Rng};

const EDIT_LINES: [&str; 16] = [
    "delete sphere center=0.4,0,0 radius=0.4",
    "move by=0.1,0,0 half-space point=0,0,0 normal=0,0,1",
    "rotate axis=1,1,0 degrees=33",
    "duplicate by=0,0,2 sphere center=0,0,0 radius=0.5",
    "recolor exposure=0.5 contrast=1.2 box center=0,0,0 size=1,1,1",
    "opacity factor=0.7",
    "hide sphere center=0,0.5,0 radius=0.3",
    "lock sphere center=0,-0.5,0 radius=0.3",
    "merge file=other",
    "split name=part half-space point=0,0,0.8 normal=0,0,1",
    "scale factor=1000",
    "show",
    "unlock",
    "reduce count=100",
    "upright up=0,0,1",
    "keep sphere center=0,0,0 radius=100000",
];

fn open(file: &str) -> Result<GaussianCloud, String> {
    match file {
        "other" => Ok(cloud(30, 4, 9)),
        _ => Err(format!("no {file}")),
    }
}

/// Random sequences of edits, each undone bit for bit, redone, and replayed from the written list.
#[test]
fn every_edit_is_undone_to_the_bit_and_replayed() {
    for seed in 0..12 {
        let mut rng = Rng::new(seed, 0);
        let before = draft(150, 2);
        let mut history = History::new(before.clone());
        let mut states = vec![before.clone()];
        for _ in 0..8 {
            let line = EDIT_LINES[rng.below(EDIT_LINES.len() as u32) as usize];
            let edit: Edit = line.parse().unwrap();
            history.apply(&edit, &open).unwrap();
            states.push(history.draft().clone());
        }
        let list = EditList::parse(&history.list().to_toml()).unwrap();
        let mut replayed = before.clone();
        for edit in &list.edits {
            apply(&mut replayed, edit, &open).unwrap();
        }
        assert_eq!(replayed, *states.last().unwrap(), "seed {seed}");
        for state in states.iter().rev().skip(1) {
            history.undo().expect("an edit");
            assert_eq!(history.draft(), state, "seed {seed}");
        }
        assert!(history.undo().is_none() && history.list().edits.is_empty());
        for state in &states[1..] {
            history.redo(&open).expect("undone").unwrap();
            assert_eq!(history.draft(), state, "seed {seed}");
        }
        assert!(history.redo(&open).is_none());
    }
}

/// Unchanged splats equal their sources, forwards and backwards.
#[test]
fn provenance_says_from_where_every_splat_comes() {
    fn check(before: &Draft, after: &Draft, provenance: &Provenance) {
        assert_eq!(provenance.changed.len(), after.len());
        for i in (0..after.len()).filter(|i| !provenance.changed.contains(*i)) {
            let source = provenance.source(i).expect("unchanged splats were there") as usize;
            assert_eq!(after.cloud.means[i], before.cloud.means[source]);
            assert_eq!(after.cloud.quats[i], before.cloud.quats[source]);
            assert_eq!(after.cloud.opacity_logits[i], before.cloud.opacity_logits[source]);
        }
    }
    let before = draft(200, 1);
    let mut history = History::new(before.clone());
    let mut total = Provenance::identity(before.len());
    for line in EDIT_LINES {
        let from = history.draft().clone();
        let applied = history.apply(&line.parse().unwrap(), &open).unwrap();
        check(&from, history.draft(), &applied.provenance);
        total = total.then(&applied.provenance);
        check(&before, history.draft(), &total);
    }
    while !history.list().edits.is_empty() {
        let from = history.draft().clone();
        let provenance = history.undo().unwrap();
        check(&from, history.draft(), &provenance);
    }
}

#[test]
fn a_failed_edit_changes_nothing_and_forgets_nothing() {
    let mut history = History::new(draft(50, 0));
    history
        .apply(&"delete sphere center=0,0,0 radius=0.5".parse().unwrap(), &open)
        .unwrap();
    history.undo();
    let before = history.draft().clone();
    assert!(history.apply(&"merge file=missing".parse().unwrap(), &open).is_err());
    assert_eq!((history.draft(), history.redo_count()), (&before, 1));
}
