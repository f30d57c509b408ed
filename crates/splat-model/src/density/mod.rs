//! Density control: which Gaussians a scene needs (3DGS section 5.2).
//!
//! A strategy decides on the host from a few numbers per Gaussian; the rows are then gathered on the
//! device, and the optimiser's moments follow them through an [`EditLog`](crate::EditLog).

mod adaptive;
mod edit;
mod morton;
mod relocation;

pub use adaptive::{AdaptiveDensity, AdaptiveSettings, Refinement, RunShape};
pub use edit::{RowPlan, apply_plan, clamp_opacities};
pub use relocation::relocate;
