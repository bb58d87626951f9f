//! The shared folder beside the checkout: real data and golden files, never copied into the project.

use std::path::{Path, PathBuf};

/// The path of `relative` in `../shared`, or `None` with a message if it is absent.
///
/// # Panics
/// When it is absent and `IRRADIA_REQUIRE_SHARED` is set, as in CI.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared")
        .join(relative);
    if path.exists() {
        return Some(path);
    }
    assert!(
        std::env::var_os("IRRADIA_REQUIRE_SHARED").is_none(),
        "IRRADIA_REQUIRE_SHARED is set and ../shared/{relative} does not exist"
    );
    eprintln!("SKIPPED (no ../shared): this test reads ../shared/{relative}");
    None
}
