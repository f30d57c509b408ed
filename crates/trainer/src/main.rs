//! The `splat` program; see [`splat_trainer::cli`].

use std::process::ExitCode;

/// A step allocates and frees megabytes dozens of times, which the system's allocator hands back to
/// the kernel and fetches anew each time.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    splat_trainer::cli::main()
}
