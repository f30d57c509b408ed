//! The program's allocator, which reports exhausted memory in one line. Without it the process
//! aborts with a backtrace.

use std::alloc::{GlobalAlloc, Layout};

/// An allocator whose failure ends the process with a message and the exit status of bad input.
pub struct OrSay<A>(pub A);

// SAFETY: as promised by the inner allocator; a failed allocation is never returned.
unsafe impl<A: GlobalAlloc> GlobalAlloc for OrSay<A> {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promises are those that the inner allocator requires.
        there(unsafe { self.0.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        there(unsafe { self.0.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as above.
        there(unsafe { self.0.realloc(memory, layout, size) }, size)
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { self.0.dealloc(memory, layout) }
    }
}

/// Returns the memory, or ends the process if there is none.
#[inline(always)]
fn there(memory: *mut u8, size: usize) -> *mut u8 {
    if memory.is_null() {
        give_up(size);
    }
    memory
}

/// Allocates nothing, and runs no destructor that might.
#[cold]
fn give_up(size: usize) -> ! {
    use std::io::Write;
    let mut line = [0; 160];
    let mut rest = &mut line[..];
    let size = size.div_ceil(1_000_000);
    let _ = writeln!(
        rest,
        "error: out of memory: {size} MB more cannot be had; take a smaller picture, fewer Gaussians, or --downscale the photos"
    );
    let unused = rest.len();
    let length = line.len() - unused;
    let _ = std::io::stderr().write_all(&line[..length]);
    #[cfg(unix)]
    // SAFETY: ends the process.
    unsafe {
        libc::_exit(2)
    }
    #[cfg(not(unix))]
    std::process::abort()
}
