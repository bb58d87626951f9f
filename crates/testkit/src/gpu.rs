use std::fmt::Display;

/// The GPU on which tests run; where `open` finds none they are skipped, loudly, and fail if `IRRADIA_REQUIRE_GPU` is set.
///
/// # Panics
/// When a GPU is required and there is none.
pub fn gpu_or_skip<G, E: Display>(open: impl FnOnce() -> Result<G, E>) -> Option<G> {
    match open() {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            assert!(std::env::var_os("IRRADIA_REQUIRE_GPU").is_none(), "{error}");
            eprintln!("SKIPPED (no GPU): {error}");
            None
        }
    }
}
