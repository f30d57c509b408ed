//! Accuracy of images and gradients on hard cases: every case that breaks naive splatting code, in
//! single precision on any device against double precision on the CPU (which is itself checked
//! against PyTorch, see [`crate::gradcheck`]). Also the deviation of the affine projection from the
//! 3D model, which is not a matter of rounding.
//!
//! ```text
//! cases/ (scenes by sketch.rs) ──case──> measure (f32 on a device, f64 on the CPU) ──> Outcome ──report──> table, JSON, SVG
//! ```

mod case;
mod cases;
pub mod lenses;
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
