//! Between Flex tensors and plain slices.

use burn::backend::TensorMetadata;
use burn::backend::flex::FlexTensor;
use burn::tensor::{Element, TensorData};
use rayon::prelude::*;

use super::real::Real;

/// Memory for `len` values that are all written before any is read. Tests fill it with NaN first.
pub(super) fn overwritten<T: Overwritten + bytemuck::Pod>(len: usize) -> Vec<T> {
    #[cfg(test)]
    if super::poison::is_on() {
        return vec![T::POISON; len];
    }
    zeros(len)
}

/// Zeros, written by all threads where they are many: a step asks for more than one thread clears
/// in the meantime.
pub(super) fn zeros<T: Overwritten + bytemuck::Pod>(len: usize) -> Vec<T> {
    const BLOCK: usize = 1024;
    if len < 64 * BLOCK {
        return vec![T::CLEAR; len];
    }
    let blocks = rayon::iter::repeat_n([T::CLEAR; BLOCK], len.div_ceil(BLOCK));
    let blocks: Vec<[T; BLOCK]> = blocks.collect();
    let mut values = bytemuck::allocation::cast_vec(blocks);
    values.truncate(len);
    values
}

/// Value of [`overwritten`] memory before it is written.
pub(crate) trait Overwritten: Copy + Send + Sync {
    /// Zero.
    const CLEAR: Self;
    /// NaN, or for an index one far outside of any list.
    #[cfg(test)]
    const POISON: Self;
}

macro_rules! overwritten {
    ($type:ty, $poison:expr) => {
        impl Overwritten for $type {
            const CLEAR: Self = 0 as $type;
            #[cfg(test)]
            const POISON: Self = $poison;
        }
    };
}

overwritten!(f32, f32::NAN);
overwritten!(f64, f64::NAN);
overwritten!(u32, 0x7fc0_0000);
overwritten!(i32, 0x7fc0_0000);

/// A tensor whose elements lie in one row-major slice.
pub(super) struct Buffer {
    tensor: FlexTensor,
}

impl Buffer {
    pub(super) fn new(tensor: FlexTensor) -> Self {
        Self {
            tensor: tensor.to_contiguous(),
        }
    }

    /// The elements. The caller has chosen `T` by the tensor's type.
    pub(super) fn slice<T: Element + bytemuck::Pod>(&self) -> &[T] {
        self.tensor
            .as_slice()
            .expect("a contiguous tensor of the type its op dispatched on")
    }

    pub(super) fn dims<const R: usize>(&self) -> [usize; R] {
        self.tensor.shape().dims()
    }
}

/// A tensor to be overwritten: in its own memory where nothing else holds that, in a copy
/// otherwise.
pub(super) struct BufferMut {
    tensor: FlexTensor,
}

impl BufferMut {
    pub(super) fn new(tensor: FlexTensor) -> Self {
        let contiguous = tensor.to_contiguous();
        // Or its memory would count as shared.
        drop(tensor);
        Self { tensor: contiguous }
    }

    /// The elements. The caller has chosen `T` by the tensor's type.
    pub(super) fn slice<T: Real>(&mut self) -> &mut [T] {
        self.tensor.storage_mut()
    }

    pub(super) fn into_tensor(self) -> FlexTensor {
        self.tensor
    }
}

/// A tensor of the given values.
pub(super) fn tensor<T: Real, const R: usize>(values: Vec<T>, shape: [usize; R]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}
