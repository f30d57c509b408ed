//! Errors of the ops, and how they get past Burn's dispatch.

use std::sync::{Arc, OnceLock};

use burn::tensor::DType;

/// An input that an op refuses, or a device that failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OpError {
    /// A tensor has the wrong shape.
    #[error("{op}: `{tensor}` must have shape {expected}, got {got:?}")]
    Shape {
        /// The op.
        op: &'static str,
        /// The argument.
        tensor: &'static str,
        /// The shape it must have, in letters.
        expected: &'static str,
        /// The shape it has.
        got: Vec<usize>,
    },
    /// A tensor has a type that its device cannot compute with, or another than the first one.
    #[error("{op}: `{tensor}` has type {got:?}; {reason}")]
    DType {
        /// The op.
        op: &'static str,
        /// The argument.
        tensor: &'static str,
        /// Its type.
        got: DType,
        /// Why it is refused.
        reason: &'static str,
    },
    /// An ordinary argument is out of range.
    #[error("{op}: {what}")]
    Argument {
        /// The op.
        op: &'static str,
        /// The fault, and the range allowed.
        what: String,
    },
    /// The splats touch more tiles than one call can list.
    #[error(
        "{op}: {intersections} intersections of a splat and a tile; one call can list {limit}. \
         Render fewer cameras or a smaller image per call, or remove Gaussians: huge ones first"
    )]
    TooManyIntersections {
        /// The op.
        op: &'static str,
        /// Intersections of a splat and a tile.
        intersections: u64,
        /// How many of them can be listed.
        limit: u64,
    },
    /// The lists of splats by tile need more memory than this process can get.
    #[error(
        "{op}: {intersections} intersections of a splat and a tile need {needed} of memory, and {left} can be had. \
         Render a smaller image, fewer cameras per call, or remove Gaussians: huge ones first"
    )]
    OutOfMemory {
        /// The op.
        op: &'static str,
        /// Intersections of a splat and a tile.
        intersections: u64,
        /// Memory needed, in words.
        needed: String,
        /// Memory left, in words.
        left: String,
    },
    /// A kernel needs more buffers than the device lets it have.
    #[error(
        "{op}: this device lets a kernel bind {bound} storage buffers (wgpu's limit \
         `max_storage_buffers_per_shader_stage`, less one for CubeCL), and {needed} are needed. Choose another device, \
         for instance the CPU"
    )]
    TooFewBindings {
        /// The op.
        op: &'static str,
        /// How many a kernel can bind.
        bound: u32,
        /// How many the op needs.
        needed: u32,
    },
    /// The device failed.
    #[error("{op}: the device failed: {what}")]
    Device {
        /// The op.
        op: &'static str,
        /// In the device's words.
        what: String,
    },
}

/// Where a backend leaves the error of an op. Burn's dispatch brings back tensors and nothing else,
/// so the error takes this way round it. Clones share one slot; the first error stays.
#[derive(Debug, Clone, Default)]
pub struct ErrorSlot(Arc<OnceLock<OpError>>);

impl ErrorSlot {
    /// Leaves an error for the op's caller. The tensors that the backend then returns are dropped.
    pub fn report(&self, error: OpError) {
        // Only the first one tells what went wrong; what follows from it does not.
        let _ = self.0.set(error);
    }

    /// The error, if there was one.
    pub fn error(&self) -> Option<&OpError> {
        self.0.get()
    }
}
