//! What the tests of all crates share.

use std::fmt::Display;

/// The adapter that a test of the CubeCL kernels opened, a software one included. Where there is
/// none the test is skipped, loudly; with the environment variable `SPLAT_REQUIRE_WGPU` set, as in
/// CI, that is a failure.
///
/// # Panics
/// Without an adapter where one is required.
pub fn adapter_or_skip<T>(opened: Result<T, impl Display>) -> Option<T> {
    match opened {
        Ok(adapter) => Some(adapter),
        Err(error) => {
            let message = format!("no wgpu adapter, the CubeCL kernels are NOT tested: {error}");
            assert!(
                std::env::var_os("SPLAT_REQUIRE_WGPU").is_none(),
                "SPLAT_REQUIRE_WGPU is set, but there is {message}"
            );
            eprintln!("\n*** SKIPPED: {message} ***\n");
            None
        }
    }
}
