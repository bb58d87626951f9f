use std::fmt::Display;

/// The GPU that a test runs on. If `open` finds none, the test reports that it is skipped, or fails if `IRRADIA_REQUIRE_GPU` is set.
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

/// Validates a shader as every implementation does; needs no GPU.
///
/// # Panics
/// With its name and the reason, when it is not valid WGSL.
pub fn validate_shader(name: &str, source: &str) {
    let module =
        naga::front::wgsl::parse_str(source).unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(source)));
    let mut validator = naga::valid::Validator::new(
        naga::valid::ValidationFlags::all(),
        // `unpack2x16float` is part of core WGSL.
        naga::valid::Capabilities::default() | naga::valid::Capabilities::SHADER_FLOAT16_IN_FLOAT32,
    );
    if let Err(error) = validator.validate(&module) {
        panic!("{name}: {}", error.emit_to_string(source));
    }
}
