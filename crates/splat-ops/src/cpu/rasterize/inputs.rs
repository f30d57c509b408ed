//! The inputs of a call, camera by camera.

use super::super::buffer::Buffer;
use super::super::real::Real;
use crate::backend::{PROJECTED_WIDTH, RasterizeTensors};

/// The inputs of one camera.
pub(super) struct Camera<'a, T> {
    pub(super) packed: &'a [T],
    pub(super) colors: &'a [T],
    pub(super) opacities: &'a [T],
    pub(super) background: Option<&'a [T]>,
    pub(super) channels: usize,
    /// Whether absolute gradients may be asked for.
    pub(super) absolute: bool,
}

/// The tensors of one call.
pub(super) type Buffers = RasterizeTensors<Buffer, Option<Buffer>>;

impl<'a, T: Real> Camera<'a, T> {
    pub(super) fn new(buffers: &'a Buffers, index: usize) -> Self {
        let [_, n, d] = buffers.colors.dims();
        fn part<T: Real>(buffer: &Buffer, index: usize, length: usize) -> &[T] {
            &buffer.slice()[index * length..(index + 1) * length]
        }
        Self {
            packed: part(&buffers.packed, index, n * PROJECTED_WIDTH),
            colors: part(&buffers.colors, index, n * d),
            opacities: part(&buffers.opacities, index, n),
            background: buffers.background.as_ref().map(|b| part(b, index, d)),
            channels: d,
            absolute: buffers.absgrad.is_some(),
        }
    }
}
