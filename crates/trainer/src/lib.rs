//! Captures, the training loop, evaluation, reports, and the `splat` program.

pub mod gradcheck;
