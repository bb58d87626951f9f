//! `irradia edit`.

use crate::process::*;
use std::fs;

#[test]
fn edits_are_made_in_their_order_saved_and_replayed() {
    let folder = with_run();
    let ops = [
        "delete half-space point=0,0,2 normal=0,0,1",
        "rotate axis=0,0,1 degrees=90",
        "delete floaters",
    ];
    let line = "edit run -o out.ply --save-edits list.toml --pictures pictures";
    let said = irradia_with(folder.path(), line, &ops).success().stdout;
    let places = ["delete half-space", "rotate", "delete floaters"].map(|words| said.find(words).expect(words));
    assert!(places.is_sorted() && said.contains("splats ("), "{said}");
    assert!(folder.path().join("pictures/before.png").is_file() && folder.path().join("pictures/after.png").is_file());
    irradia(folder.path(), "edit run -o again.ply --edits list.toml").success();
    let [first, second] = ["out.ply", "again.ply"].map(|name| fs::read(folder.path().join(name)).expect(name));
    assert!(first == second);
    irradia(folder.path(), "render out.ply --orbit 1 --size 32x24 --out frames").success();

    let said = irradia_with(folder.path(), "edit run --preview", &["delete floaters"])
        .success()
        .stdout;
    assert!(said.starts_with("preview"), "{said}");
    irradia_with(folder.path(), "edit run -o edited", &["upright", "keep subject"]).success();
    for file in ["scene.ply", "cameras.json", "edits.toml"] {
        assert!(folder.path().join("edited").join(file).is_file(), "{file}");
    }
    irradia_with(folder.path(), "edit run --in-place", &["opacity factor=0.9"]).success();
    irradia(folder.path(), "train data --from edited --out next --steps 2").refused(2, &["edited/scene.ply", "moved"]);
    irradia_with(folder.path(), "edit run -o clean", &["keep subject"]).success();
    irradia(folder.path(), "train data --from clean --out next --steps 2").success();
    assert_no_leftovers(folder.path());
}

#[test]
fn mistakes_in_edits_are_refused_in_one_line() {
    let folder = with_run();
    for (line, ops, words) in [
        ("edit run -o out.ply", &[][..], &["no edits"][..]),
        ("edit run", &["delete all"], &["--out"]),
        ("edit run -o out.ply", &["explode all"], &["unknown variant"]),
        ("edit run -o out.ply", &["delete"], &["needs a selection"]),
        (
            "edit run -o out.ply",
            &["delete sphere center=0,0,0 radius=-1"],
            &["sphere radius"],
        ),
        ("edit run -o out.xyz", &["delete all"], &["known extensions", ".spz"]),
        ("edit run -o run", &["delete floaters"], &["would be replaced"]),
        ("edit run -o out.ply", &["merge file=none.ply"], &["none.ply"]),
        ("edit run --in-place", &["move by=1,0,0"], &["photographs"]),
        ("edit run --in-place", &["delete all"], &["nothing would be left"]),
    ] {
        irradia_with(folder.path(), line, ops).refused(2, words);
    }
    fs::write(
        folder.path().join("list.toml"),
        "version = 1\n[[edits]]\nop = \"move\"\n",
    )
    .unwrap();
    irradia(folder.path(), "edit run -o out.ply --edits list.toml").refused(2, &["list.toml", "edit 1", "by"]);
    irradia(folder.path(), "edit none.ply -o out.ply --edits none.toml").refused(1, &["none.toml"]);
    assert!(!folder.path().join("out.ply").exists());
}
