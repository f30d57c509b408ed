//! Fuzz targets for all file readers: no input may make them panic, hang, or use more memory than
//! its size allows.
//!
//! ```text
//! formats/ (seeds, mutations, what is run) ──> driver ──> memory (peak of every run), coverage (if compiled for it)
//! ```
//!
//! Inputs are derived from small valid files, which are generated here, by mutations that know the
//! format ([`formats`]) and by generic ones ([`mutate`]). Some accepted inputs are passed on, as in
//! the program: a capture is trained, a scene rendered, a checkpoint resumed.
//!
//! - `cargo test --release --workspace` runs a few seconds of each target from fixed seeds, so
//!   failures are reproducible.
//! - `fuzz/run.sh PARSER... SECONDS` compiles the readers with branch counters, which guide the
//!   search, and runs each for that much processor time. It needs only stable Rust and installs
//!   nothing.
//!
//! A failing input is written to `fuzz/failures/`; `splat-fuzz PARSER --replay FILE...` runs it
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
