//! The laboratory: checks gradients against PyTorch and central differences, measures accuracy on
//! hard cases and the performance of a training step.

#[cfg(feature = "cpu")]
pub mod accuracy;
#[cfg(feature = "cpu")]
pub mod central;
pub mod gradcheck;
pub mod memory;
#[cfg(feature = "cpu")]
pub mod performance;
