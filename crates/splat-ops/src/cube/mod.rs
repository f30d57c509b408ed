//! Launches `splat-kernels` on CubeCL devices: CUDA, Vulkan, Metal, WebGPU.
//!
//! Tensors become buffers and buffers tensors here; the kernels know only buffers of f32 and sizes.
//! A `tracing` span of an op covers the launch of its kernels, not their execution.

mod activation;
mod adam;
mod blur;
mod perturb;
mod photometric;
mod project;
mod rasterize;
mod screen_statistics;
mod sh_colors;
mod spherical_harmonics;
mod ssim;
#[cfg(all(test, feature = "cpu", feature = "wgpu"))]
pub(crate) mod tests;

#[cfg(feature = "cpu")]
pub(crate) use rasterize::work as rasterize_work;

use burn::backend::TensorMetadata;
use burn::tensor::{DType, Shape};
use burn_cubecl::kernel::{cast, into_contiguous};
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::Buffer;

/// A tensor of f32, contiguous.
fn prepare(tensor: CubeTensor) -> CubeTensor {
    let tensor = if tensor.dtype == DType::F32 {
        tensor
    } else {
        cast(tensor, DType::F32)
    };
    into_contiguous(tensor)
}

/// The memory of a tensor that went through [`prepare`].
fn buffer(tensor: &CubeTensor) -> Buffer {
    let len = tensor.shape().num_elements();
    // A contiguous f32 tensor holds its elements. One that did not would be read as empty; every
    // kernel checks bounds.
    Buffer::new(tensor.handle.clone(), len).unwrap_or_else(|_| Buffer::empty(&tensor.client, 0))
}

/// The buffer of a tensor that the caller gives up, so that a kernel may write into it if nothing
/// else holds the memory; and a function that turns a buffer into a tensor like it.
fn taken(tensor: CubeTensor) -> (Buffer, impl FnOnce(Buffer) -> CubeTensor) {
    let shape = tensor.shape();
    let CubeTensor {
        client,
        device,
        handle,
        ..
    } = tensor;
    let memory = Buffer::new(handle, shape.num_elements());
    let memory = memory.unwrap_or_else(|_| Buffer::empty(&client, 0));
    let tensor = move |buffer: Buffer| {
        let handle = buffer.into_handle();
        CubeTensor::new_contiguous(client, device, shape, handle, DType::F32)
    };
    (memory, tensor)
}

/// A tensor of `shape` on the device of `like`, in the memory of `buffer`.
fn tensor(like: &CubeTensor, buffer: Buffer, shape: Shape) -> CubeTensor {
    CubeTensor::new_contiguous(
        like.client.clone(),
        like.device.clone(),
        shape,
        buffer.into_handle(),
        DType::F32,
    )
}

/// Gradients of inputs, from buffers; each has the shape of its input.
fn gradients<const N: usize>(
    grads: [Option<Buffer>; N],
    inputs: [Option<&CubeTensor>; N],
) -> [Option<CubeTensor>; N] {
    let mut inputs = inputs.into_iter();
    grads.map(|grad| {
        let (grad, input) = grad.zip(inputs.next().flatten())?;
        Some(tensor(input, grad, input.shape()))
    })
}
