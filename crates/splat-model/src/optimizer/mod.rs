//! Optimisers whose moments follow the rows of a parameter when a strategy adds, removes or
//! reorders them.
//!
//! A [`FieldOptimizer`] owns the state of one field. Fields are stepped as `[N, width]` tensors of
//! any original rank; the reshape copies nothing, and changes no result of an elementwise
//! optimiser.

mod adam;
mod edit;
mod field_optimizer;
mod groups;
mod state_record;
#[cfg(all(test, feature = "cpu"))]
mod tests;
mod through_host;

pub use adam::{SplatAdam, SplatAdamState};
pub use edit::{MomentEdit, RowOptimizer};
pub use field_optimizer::FieldOptimizer;
pub use state_record::StateRecord;
pub use through_host::ThroughHost;
