//! Between Flex tensors and plain slices.

use burn::backend::TensorMetadata;
use burn::backend::flex::FlexTensor;
use burn::tensor::{Element, TensorData};

pub(crate) use super::overwritten::{overwritten, zeros};
use super::real::Real;

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
