//! Errors of the ops, and how they pass through Burn's dispatch.

use std::sync::{Arc, OnceLock};

use burn::tensor::DType;

/// An input that an op refuses, or a device failure.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OpError {
    /// A tensor has the wrong shape.
    #[error("{op}: `{tensor}` must have shape {expected}, got {got:?}")]
    Shape {
        /// The op.
        op: &'static str,
        /// The argument.
        tensor: &'static str,
        /// The expected shape, in letters.
        expected: &'static str,
        /// The actual shape.
        got: Vec<usize>,
    },
    /// A tensor has a type that its device does not support, or that differs from the first
    /// tensor's.
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
        /// The fault and the allowed range.
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
        /// Intersections, each of a splat and a tile.
        intersections: u64,
        /// Most intersections that can be listed.
        limit: u64,
    },
    /// The tile lists need more memory than this process can get.
    #[error(
        "{op}: {intersections} intersections of a splat and a tile need {needed} of memory, and {left} can be had. \
         Render a smaller image, fewer cameras per call, or remove Gaussians: huge ones first"
    )]
    OutOfMemory {
        /// The op.
        op: &'static str,
        /// Intersections, each of a splat and a tile.
        intersections: u64,
        /// Memory needed, in words.
        needed: String,
        /// Memory left, in words.
        left: String,
    },
    /// A kernel needs more buffers than the device can bind.
    #[error(
        "{op}: this device lets a kernel bind {bound} storage buffers (wgpu's limit \
         `max_storage_buffers_per_shader_stage`, less one for CubeCL), and {needed} are needed. Choose another device, \
         for instance the CPU"
    )]
    TooFewBindings {
        /// The op.
        op: &'static str,
        /// Buffers that a kernel can bind.
        bound: u32,
        /// Buffers that the op needs.
        needed: u32,
    },
    /// The device failed.
    #[error("{op}: the device failed: {what}")]
    Device {
        /// The op.
        op: &'static str,
        /// The device's message.
        what: String,
    },
}

/// Slot for the error of an op. Burn's dispatch returns only tensors, so backends leave errors
/// here. Clones share one slot, and the first error stays.
#[derive(Debug, Clone, Default)]
pub struct ErrorSlot(Arc<OnceLock<OpError>>);

impl ErrorSlot {
    /// Leaves an error for the op's caller, which then drops the tensors that the backend returns.
    pub fn report(&self, error: OpError) {
        // Later errors are consequences of the first.
        let _ = self.0.set(error);
    }

    /// The error, if any.
    pub fn error(&self) -> Option<&OpError> {
        self.0.get()
    }
}
