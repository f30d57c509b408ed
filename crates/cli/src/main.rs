//! The `splat` program; see [`splat_cli`].

mod allocator;

use std::ffi::{c_int, c_long};
use std::process::ExitCode;

use allocator::OrSay;

/// A step allocates and frees megabytes dozens of times, which the system's allocator hands back to
/// the kernel and fetches anew each time.
#[global_allocator]
static ALLOCATOR: OrSay<mimalloc::MiMalloc> = OrSay(mimalloc::MiMalloc);

/// `mi_option_purge_delay` of mimalloc.h: milliseconds until free memory goes back to the kernel,
/// -1 for never.
const PURGE_DELAY: c_int = 15;

unsafe extern "C" {
    /// Of the allocator above, whose Rust crate has no name for it.
    fn mi_option_set(option: c_int, value: c_long);
}

fn main() -> ExitCode {
    // The next step needs what this one frees. Fetching it anew is a tenth of a step of a million
    // Gaussians. SAFETY: no other thread is there yet; the number is an option of the version that
    // the lock file names.
    unsafe { mi_option_set(PURGE_DELAY, -1) };
    // A file that grows beyond a limit (`ulimit -f`) is then an error of writing, and what was done
    // can still be kept.
    #[cfg(unix)]
    // SAFETY: no handler is set, the signal is ignored.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
    // This thread works too. From outside of the pool each of the dozens of ops of a step would be
    // handed over, and its end waited for asleep. Fails where there can be no threads at all, which
    // the first op then says.
    let _ = rayon::ThreadPoolBuilder::new()
        .use_current_thread()
        .build_global();
    splat_cli::main()
}
