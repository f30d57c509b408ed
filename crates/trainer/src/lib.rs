//! Captures, the training loop, evaluation, reports, and the `splat` program.

pub mod capture;
mod evaluate;
pub mod gradcheck;
pub mod train;

pub use evaluate::{Scores, ViewScore, evaluate};
