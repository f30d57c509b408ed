//! Between Flex tensors and plain slices.

use burn::backend::TensorMetadata;
use burn::backend::flex::FlexTensor;
use burn::tensor::TensorData;

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
    pub(super) fn slice<T: Real>(&self) -> &[T] {
        self.tensor
            .as_slice()
            .expect("a contiguous tensor of the type its op dispatched on")
    }

    pub(super) fn dims<const R: usize>(&self) -> [usize; R] {
        self.tensor.shape().dims()
    }
}

/// A tensor of the given values.
pub(super) fn tensor<T: Real, const R: usize>(values: Vec<T>, shape: [usize; R]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}
