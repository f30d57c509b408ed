//! How accurate the ops are where it is hard: every case that breaks naive splatting code, in single precision on any
//! device against double precision on the CPU (which is itself held to PyTorch, see [`crate::gradcheck`]).
//!
//! ```text
//! cases/ (scenes by sketch.rs) ──case──> measure (f32 on a device, f64 on the CPU) ──> Outcome ──report──> table, JSON, SVG
//! ```

mod case;
mod cases;
mod measure;
pub mod model_error;
mod sketch;

pub use case::Case;
pub use cases::cases;
pub use measure::{AccuracyError, Outcome};
