//! Conversion between Flex tensors and slices.

use burn::backend::TensorMetadata;
use burn::backend::flex::FlexTensor;
use burn::tensor::{Element, TensorData};

pub(crate) use super::overwritten::{overwritten, zeros};
use super::real::Real;

/// A tensor whose elements are one row-major slice.
pub(super) struct Buffer {
    tensor: FlexTensor,
}

impl Buffer {
    pub(super) fn new(tensor: FlexTensor) -> Self {
        Self {
            tensor: tensor.to_contiguous(),
        }
    }

    /// The elements. The caller chooses `T` by the tensor's type.
    pub(super) fn slice<T: Element + bytemuck::Pod>(&self) -> &[T] {
        self.tensor
            .as_slice()
            .expect("a contiguous tensor of the type its op dispatched on")
    }

    pub(super) fn dims<const R: usize>(&self) -> [usize; R] {
        self.tensor.shape().dims()
    }
}

/// A tensor to overwrite: in its own memory if nothing else holds that, else in a copy.
pub(super) struct BufferMut {
    tensor: FlexTensor,
}

impl BufferMut {
    pub(super) fn new(tensor: FlexTensor) -> Self {
        let contiguous = tensor.to_contiguous();
        // Dropped first, since its memory would otherwise count as shared.
        drop(tensor);
        Self { tensor: contiguous }
    }

    /// The elements. The caller chooses `T` by the tensor's type.
    pub(super) fn slice<T: Real>(&mut self) -> &mut [T] {
        self.tensor.storage_mut()
    }

    pub(super) fn into_tensor(self) -> FlexTensor {
        self.tensor
    }
}

/// A tensor with the given values.
pub(super) fn tensor<T: Real, const R: usize>(values: Vec<T>, shape: [usize; R]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}
