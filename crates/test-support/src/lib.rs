//! Helpers shared by the tests of all crates.

mod fixture;

pub use fixture::{Reference, relative_error};

use std::fmt::Display;

/// The adapter opened by a test of the CubeCL kernels, a software one included. Without an adapter
/// the test is skipped with a message, or fails if the environment variable `SPLAT_REQUIRE_WGPU` is
/// set, as in CI.
///
/// # Panics
/// If an adapter is required and there is none.
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
