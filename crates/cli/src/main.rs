//! The `splat` program; see [`splat_cli`].

mod allocator;

use std::ffi::{c_int, c_long};
use std::process::ExitCode;

use allocator::OrSay;

/// A step allocates and frees megabytes dozens of times; the system's allocator would return them
/// to the kernel and fetch them again each time.
#[global_allocator]
static ALLOCATOR: OrSay<mimalloc::MiMalloc> = OrSay(mimalloc::MiMalloc);

/// `mi_option_purge_delay` of mimalloc.h: milliseconds until free memory is returned to the kernel,
/// -1 for never.
const PURGE_DELAY: c_int = 15;

unsafe extern "C" {
    /// Part of the allocator above, which its Rust crate does not expose.
    fn mi_option_set(option: c_int, value: c_long);
}

fn main() -> ExitCode {
    // The next step needs the memory that this one frees; fetching it anew takes a tenth of a step
    // of a million Gaussians. SAFETY: no other thread exists yet, and the number is an option of
    // the version in the lock file.
    unsafe { mi_option_set(PURGE_DELAY, -1) };
    // A file that exceeds a limit (`ulimit -f`) then causes a write error, after which results can
    // still be saved.
    #[cfg(unix)]
    // SAFETY: no handler is set; the signal is ignored.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
    // Makes this thread part of the pool. From outside the pool, each of a step's dozens of ops
    // would be handed over and waited for asleep. Fails if threads cannot be started, which the
    // first op then reports.
    let _ = rayon::ThreadPoolBuilder::new()
        .use_current_thread()
        .build_global();
    splat_cli::main()
}
