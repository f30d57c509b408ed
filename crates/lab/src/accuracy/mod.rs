//! How far pictures and gradients are from the truth, where it is hard: every case that breaks
//! naive splatting code, in single precision on any device against double precision on the CPU
//! (which is itself held to PyTorch, see [`crate::gradcheck`]); and how far the affine projection
//! is from the 3D model, which is no matter of rounding.
//!
//! ```text
//! cases/ (scenes by sketch.rs) ──case──> measure (f32 on a device, f64 on the CPU) ──> Outcome ──report──> table, JSON, SVG
//! ```

mod case;
mod cases;
mod measure;
pub mod model_error;
pub mod projection;
pub mod report;
mod sketch;

pub use case::Case;
pub use cases::cases;
pub use measure::{AccuracyError, Outcome};
#[cfg(test)]
pub(crate) use sketch::{Sketch, neighbours};
