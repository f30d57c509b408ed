//! Fuzz targets of everything that reads a file: does any input make it panic, hang, or take more
//! memory than its size allows?
//!
//! ```text
//! formats/ (seeds, mutations, what is run) ──> driver ──> memory (peak of every run), coverage (if compiled for it)
//! ```
//!
//! Inputs are made from small valid files, which are made here, by mutations that know the format
//! ([`formats`]) and by some that know nothing ([`mutate`]). What a reader lets through is handed
//! on now and then, as the program would: a capture is trained on, a scene rendered, a checkpoint
//! resumed.
//!
//! - `cargo test --release --workspace` runs a few seconds of each, from fixed seeds: a failure
//!   comes again.
//! - `fuzz/run.sh PARSER... SECONDS` compiles the readers with counters on their branches, which
//!   guide the search, and runs for that much time of the processor each. Stable Rust is enough,
//!   and nothing is installed.
//!
//! An input that fails is written to `fuzz/failures/`; `splat-fuzz PARSER --replay FILE...` runs it
//! again.

pub mod coverage;
pub mod driver;
pub mod formats;
pub mod memory;
pub mod mutate;

pub use driver::{Campaign, Failed, Report};
pub use formats::{TARGETS, Target};

/// Counts the memory of every binary with these targets.
#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;
