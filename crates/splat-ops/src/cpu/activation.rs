//! `exp`, the logistic function, and their gradients, elementwise.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use burn::backend::{Flex, TensorMetadata};
use burn::tensor::{DType, TensorData};
use rayon::prelude::*;

use super::buffer::Buffer;
use super::real::Real;
use super::simd::vectorized;
use super::uninit::Uncleared;
use crate::backend::{ActivationBackend, ActivationOps};
use crate::composed;
use crate::settings::Activation;

/// Elements per unit of parallel work.
const CHUNK: usize = 8192;

impl ActivationOps for Flex {
    fn activation(x: FlexTensor, function: Activation) -> FlexTensor {
        match x.dtype() {
            DType::F32 | DType::F64 => in_precision!(x, forward, x, function),
            _ => composed::activation::<Self>(x, function),
        }
    }
}

impl ActivationBackend for Flex {
    fn activation_backward(
        x: FlexTensor,
        y: FlexTensor,
        grad_y: FlexTensor,
        function: Activation,
    ) -> FlexTensor {
        match x.dtype() {
            DType::F32 | DType::F64 => in_precision!(x, backward, x, y, grad_y, function),
            _ => composed::activation_backward::<Self>(x, y, grad_y, function),
        }
    }
}

fn forward<T: Real>(_: PhantomData<T>, x: FlexTensor, function: Activation) -> FlexTensor {
    let shape = x.shape();
    let x = Buffer::new(x);
    let mut y = Uncleared::<T>::new(shape.num_elements());
    y.chunks(CHUNK)
        .into_par_iter()
        .zip(x.slice::<T>().par_chunks(CHUNK))
        .for_each(|(y, x)| match function {
            Activation::Exp => exp(x, y.overwritten()),
            Activation::Sigmoid => sigmoid(x, y.overwritten()),
        });
    FlexTensor::from_data(TensorData::new(y.written(), shape))
}

fn backward<T: Real>(
    _: PhantomData<T>,
    x: FlexTensor,
    y: FlexTensor,
    grad: FlexTensor,
    function: Activation,
) -> FlexTensor {
    let shape = x.shape();
    let (x, y, grad) = (Buffer::new(x), Buffer::new(y), Buffer::new(grad));
    let mut out = Uncleared::<T>::new(shape.num_elements());
    out.chunks(CHUNK)
        .into_par_iter()
        .zip(x.slice::<T>().par_chunks(CHUNK))
        .zip(y.slice::<T>().par_chunks(CHUNK))
        .zip(grad.slice::<T>().par_chunks(CHUNK))
        .for_each(|(((out, x), y), grad)| match function {
            Activation::Exp => multiply(grad, y, out.overwritten()),
            Activation::Sigmoid => sigmoid_backward(x, grad, out.overwritten()),
        });
    FlexTensor::from_data(TensorData::new(out.written(), shape))
}

vectorized! {
    fn exp<T: Real, const FMA: bool>(x: &[T], y: &mut [T]) {
        for (y, x) in y.iter_mut().zip(x) {
            *y = T::exp::<FMA>(*x);
        }
    }
}

vectorized! {
    /// `exp(min(x, 0)) / (1 + exp(-|x|))`: one of the two exponentials is 1.
    fn sigmoid<T: Real, const FMA: bool>(x: &[T], y: &mut [T]) {
        for (y, x) in y.iter_mut().zip(x) {
            let small = T::exp::<FMA>(-x.abs());
            let above = if *x < T::ZERO { small } else { T::ONE };
            *y = above / (T::ONE + small);
        }
    }
}

vectorized! {
    /// `e / (1 + e)^2` with `e = exp(-|x|)`, which loses no digits at either end.
    fn sigmoid_backward<T: Real, const FMA: bool>(x: &[T], grad: &[T], out: &mut [T]) {
        for ((out, x), grad) in out.iter_mut().zip(x).zip(grad) {
            let small = T::exp::<FMA>(-x.abs());
            let one = T::ONE + small;
            *out = *grad * (small / one / one);
        }
    }
}

vectorized! {
    fn multiply<T: Real, const FMA: bool>(a: &[T], b: &[T], out: &mut [T]) {
        for ((out, a), b) in out.iter_mut().zip(a).zip(b) {
            *out = *a * *b;
        }
    }
}
